"""Proposition 3: for rho(A) < 1 and a bounded number of rows, the likelihood becomes least squares as nbar grows, with
errors that fall as rho^nbar."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from symplearn._markov_parameters import MarkovParameters, markov_parameters_of, output_covariances
from symplearn._model import Gaussian, LinearDynamics, LinearObservation, StateSpaceModel
from symplearn._noise import AdditiveGaussian, ScaledIdentity

RHO, COUNT, LONGEST = 0.9, 10, 120
LAGS = np.arange(10, LONGEST + 1, 5)


def system(radius=RHO):
    """Three states, one channel, two inputs; `radius` is the modulus of the largest eigenvalues of A."""
    rng = np.random.default_rng(3)
    A = rng.normal(size=(3, 3))
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
    B, H, D = (jnp.asarray(rng.normal(size=s)) for s in ((3, 2), (1, 3), (1, 2)))
    noises = AdditiveGaussian(ScaledIdentity(1.0, 3)), AdditiveGaussian(ScaledIdentity(0.5, 1))
    return StateSpaceModel(
        LinearDynamics(jnp.asarray(A), B), LinearObservation(H, D), *noises, Gaussian(jnp.zeros(3), jnp.zeros((3, 3)))
    )


def slope(values):
    """The rate of log(values) per step of nbar, by a straight line."""
    return np.polyfit(LAGS, np.log(values), 1)[0]


@jax.jit
def responses(blocks, inputs):
    """The readings without noise, (draw, row); one shape for every lag, so that it compiles once."""
    return jax.vmap(MarkovParameters(blocks).response)(inputs)[..., 0]


def after(model, lag, inputs):
    """sum_{i=nbar}^{k} G_i u_{k-i} for all rows k: (draw, row)."""
    blocks = markov_parameters_of(model, LONGEST + COUNT).blocks
    kept = jnp.arange(LONGEST + COUNT)[:, None, None] < lag
    return np.asarray(responses(blocks, inputs) - responses(jnp.where(kept, blocks, 0.0), inputs))


def truncations(model, inputs):
    """The sums cut off for the rows k = nbar, ..., nbar + 9: (draw, lag, row)."""
    return np.stack([after(model, lag, inputs)[:, lag : lag + COUNT] for lag in LAGS], axis=1)


@pytest.fixture(scope="module")
def draws():
    """Fifty draws of the inputs."""
    return jnp.asarray(np.random.default_rng(0).normal(size=(50, LONGEST + COUNT, 2)))


def test_the_truncated_sum_decays_at_the_rate_rho(draws):
    """The part of the readings that is cut off falls as rho^nbar; a system with rho = 1 keeps it."""
    size = np.sqrt(np.mean(truncations(system(), draws) ** 2, axis=(0, 2)))
    assert slope(size) == pytest.approx(np.log(RHO), rel=0.05)
    assert abs(slope(np.sqrt(np.mean(truncations(system(1.0), draws) ** 2, axis=(0, 2))))) < 0.2 * abs(np.log(RHO))


def test_lambda_settles_at_the_rate_rho_squared():
    """Lambda_{nbar+1} - Lambda_nbar = H A^nbar Sigma A^nbar' H' falls as rho^(2 nbar)."""
    model = system()
    A, H = np.asarray(model.dynamics.A), np.asarray(model.observation.matrix)
    rest = np.array([np.sum((H @ np.linalg.matrix_power(A, k)) ** 2) for k in LAGS])
    assert slope(rest) == pytest.approx(2 * np.log(RHO), rel=0.05)
    covariances = np.asarray(output_covariances(model, jnp.arange(LONGEST + 2.0)))[:, 0, 0]
    # Differences of numbers of order 10 to 100: round-off of 1e-13.
    np.testing.assert_allclose(covariances[LAGS + 1] - covariances[LAGS], rest, rtol=1e-9, atol=1e-12)


def test_the_likelihood_becomes_least_squares(draws):
    """The exact objective (3.10) of ten rows less that of least squares (3.13) falls as rho^nbar, at least linearly."""
    model = system()
    cut = truncations(model, draws)
    covariances = np.asarray(output_covariances(model, jnp.arange(float(LONGEST + COUNT))))[:, 0, 0]
    residuals = np.random.default_rng(1).normal(size=(len(cut), COUNT)) * np.sqrt(covariances[-1])
    gaps = []
    for j, lag in enumerate(LAGS):
        weights = covariances[lag : lag + COUNT]
        exact = np.sum(residuals**2 / weights + np.log(weights), axis=1)
        # (3.13) leaves the truncated sum in its residual.
        plain = np.sum((residuals + cut[:, j]) ** 2, axis=1) / covariances[-1] + COUNT * np.log(covariances[-1])
        gaps.append(np.sqrt(np.mean((exact - plain) ** 2)))
    assert slope(gaps) == pytest.approx(np.log(RHO), rel=0.05)
    # Ten rows: rho^120 = 3e-6 times the size of one row's output.
    assert gaps[-1] < 1e-4 < 1.0 < gaps[0]


def test_a_growing_number_of_rows_is_another_matter(draws):
    """The hidden assumption of appendix C: at one nbar, the sum of what is cut off grows with the number of rows."""
    squares = after(system(), 10, draws) ** 2
    few, many = np.mean(np.sum(squares[:, 10:20], axis=1)), np.mean(np.sum(squares[:, 10:], axis=1))
    assert many > 5 * few
