"""Proposition 2: for a finite impulse response the likelihood's maximum is least squares, once Lambda_k has settled."""

import jax.numpy as jnp
import numpy as np
import pytest

from symplearn._markov_estimators import (
    full_information_markov,
    generalised_least_squares_markov,
    least_squares_markov,
)
from symplearn._markov_parameters import markov_parameters_of, output_covariances
from symplearn._model import Gaussian, LinearDynamics, LinearObservation, StateSpaceModel
from symplearn._noise import AdditiveGaussian, Dense
from symplearn._objectives import TimeSeries

ROWS, LAG = 80, 4


def system(channels, nilpotent=True, noise=1.0):
    """A strictly upper triangular A of size 3, so that A^3 = 0 and G_i = 0 from i = 4 on; or one that is not."""
    rng = np.random.default_rng(11)
    A = np.triu(rng.normal(size=(3, 3)), 1) + (0.0 if nilpotent else 0.9 * np.eye(3))
    B, H, D = rng.normal(size=(3, 2)), rng.normal(size=(channels, 3)), rng.normal(size=(channels, 2))
    Q, R = noise * np.diag([1.0, 0.5, 2.0]), noise * (0.2 * np.eye(channels) + 0.1)
    model = StateSpaceModel(
        LinearDynamics(jnp.asarray(A), jnp.asarray(B)),
        LinearObservation(jnp.asarray(H), jnp.asarray(D)),
        AdditiveGaussian(Dense(Q)),
        AdditiveGaussian(Dense(R)),
        Gaussian(jnp.zeros(3), jnp.zeros((3, 3))),
    )
    us, x, ys = rng.normal(size=(ROWS, 2)), np.zeros(3), []
    for u in us:
        ys.append(H @ x + D @ u + np.linalg.cholesky(R + 1e-300 * np.eye(channels)) @ rng.normal(size=channels))
        x = A @ x + B @ u + np.sqrt(Q) @ rng.normal(size=3)
    return model, TimeSeries(jnp.arange(float(ROWS)), jnp.asarray(np.array(ys)), jnp.asarray(us))


def test_markov_parameters_end_and_lambda_settles():
    """G_i = 0 for i >= 4 and Lambda_k is one matrix for k >= 3, another before."""
    model, series = system(1)
    blocks = np.asarray(markov_parameters_of(model, 8).blocks)
    assert np.all(blocks[LAG:] == 0.0) and np.all(np.abs(blocks[:LAG]).max(axis=(1, 2)) > 0.01)
    covariances = np.asarray(output_covariances(model, series.times))
    np.testing.assert_allclose(covariances[LAG - 1 :, 0, 0], covariances[-1, 0, 0], rtol=1e-14)
    assert np.all(np.diff(covariances[:LAG, 0, 0]) > 0.01)


def test_the_weighted_objective_is_that_of_least_squares():
    """For k >= nbar and any G: the exact objective (3.10) is the least-squares one (3.13) divided by Lambda_nbar."""
    model, series = system(1)
    ys, us = np.asarray(series.readings), np.asarray(series.inputs)
    covariances = np.asarray(output_covariances(model, series.times))
    rng = np.random.default_rng(0)
    for _ in range(10):
        blocks = np.concatenate([rng.normal(size=(LAG, 1, 2)), np.zeros((ROWS - LAG, 1, 2))])
        exact = [ys[k] - sum(blocks[i] @ us[k - i] for i in range(k + 1)) for k in range(LAG, ROWS)]
        short = [ys[k] - sum(blocks[i] @ us[k - i] for i in range(LAG)) for k in range(LAG, ROWS)]
        weighted = sum(r @ np.linalg.solve(S, r) for r, S in zip(exact, covariances[LAG:], strict=True))
        # Equal but for the order of sums.
        assert weighted == pytest.approx(sum(r @ r for r in short) / covariances[LAG, 0, 0], rel=1e-12)


@pytest.mark.parametrize("printed_start", [True, False])
@pytest.mark.parametrize("channels", [1, 3])
def test_both_have_one_minimiser(channels, printed_start):
    """Weighted and plain least squares give the same parameters from rows k >= nbar, and from k = nbar - 1 on, where
    Lambda_k has settled too. With several channels Lambda need not even be proportional to I, since all channels share
    their regressors."""
    model, series = system(channels)
    plain = least_squares_markov(series, LAG, printed_start=printed_start).blocks
    weighted = generalised_least_squares_markov(series, LAG, model, printed_start=printed_start).blocks
    np.testing.assert_allclose(weighted, plain, rtol=0, atol=1e-12)


def test_the_assumptions_are_needed():
    """Where A is not nilpotent, or where the first rows are kept, the two estimators differ."""
    model, series = system(1, nilpotent=False)
    plain = least_squares_markov(series, LAG).blocks
    assert float(jnp.abs(generalised_least_squares_markov(series, LAG, model).blocks - plain).max()) > 1e-2
    model, series = system(1)
    every = full_information_markov(series, LAG, model, cross_covariances=False).blocks
    assert float(jnp.abs(every - least_squares_markov(series, LAG).blocks).max()) > 1e-3


def test_least_squares_on_noiseless_data_gives_the_parameters():
    """Without noise the readings of a finite impulse response give its G_i exactly, and zeros after the last."""
    for channels in (1, 3):
        model, series = system(channels, noise=0.0)
        found = least_squares_markov(series, LAG + 2).blocks
        np.testing.assert_allclose(found, markov_parameters_of(model, LAG + 2).blocks, rtol=0, atol=1e-13)
