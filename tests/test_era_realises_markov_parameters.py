"""The eigensystem realisation algorithm gives back the system whose Markov parameters it is given."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from symplearn._errors import InputError
from symplearn._markov_estimators import generalised_least_squares_markov, least_squares_markov
from symplearn._markov_parameters import MarkovParameters, impulse_response, markov_parameters_of
from symplearn._model import Gaussian, LinearDynamics, LinearObservation, StateSpaceModel
from symplearn._noise import AdditiveGaussian, ScaledIdentity
from symplearn._objectives import TimeSeries
from symplearn._realisation import (
    CorrectedHankel,
    PrintedHankel,
    marginal_markov,
    realise,
    realised_model,
)

# States, channels, inputs, lag.
SIZES = [(3, 2, 2, 12), (1, 1, 1, 4), (2, 1, 3, 8), (5, 3, 1, 16), (6, 2, 2, 20)]


def random_system(states, channels, inputs):
    rng = np.random.default_rng([states, channels, inputs])
    A = rng.normal(size=(states, states))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    return (
        A,
        rng.normal(size=(states, inputs)),
        rng.normal(size=(channels, states)),
        rng.normal(size=(channels, inputs)),
    )


def powers(A, B, H, D, lag):
    """D, H B, H A B, ... by matrix powers."""
    return np.array([D, *(H @ np.linalg.matrix_power(A, k) @ B for k in range(lag - 1))])


@pytest.mark.parametrize("size", SIZES)
def test_exact_parameters_come_back(size):
    """Exact Markov parameters of random systems are reproduced, beyond the lag given too, with the poles of A."""
    matrices, lag = random_system(*size[:3]), size[-1]
    exact = powers(*matrices, 2 * lag)
    np.testing.assert_allclose(
        impulse_response(*(jnp.asarray(matrix) for matrix in matrices), lag=2 * lag).blocks, exact, rtol=0, atol=1e-13
    )
    found = realise(MarkovParameters(exact[:lag]), size[0])
    # Round-off times the ratio of the largest to the smallest singular value kept, up to 170; 1e-14 at most was seen.
    np.testing.assert_allclose(markov_parameters_of(found, 2 * lag).blocks, exact, rtol=0, atol=1e-12)
    poles, expected = (np.sort_complex(np.linalg.eigvals(np.asarray(A))) for A in (found.dynamics.A, matrices[0]))
    np.testing.assert_allclose(poles, expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize("size", SIZES)
def test_the_coordinates_are_balanced_and_the_gap_tells_the_order(size):
    """Observability and controllability Gramians over the Hankel matrix are the singular values; later values are 0."""
    lag = size[-1]
    found = realise(MarkovParameters(powers(*random_system(*size[:3]), lag)), size[0])
    A, B, H = (np.asarray(m) for m in (found.dynamics.A, found.dynamics.B, found.observation.matrix))
    rows, columns = lag // 2, lag - 1 - lag // 2
    power = [np.linalg.matrix_power(A, k) for k in range(lag)]
    values = np.asarray(found.singular_values)
    seen = sum(power[k].T @ H.T @ H @ power[k] for k in range(rows))
    reached = sum(power[k] @ B @ B.T @ power[k].T for k in range(columns))
    for gramian in (seen, reached):
        np.testing.assert_allclose(gramian, np.diag(values[: size[0]]), rtol=0, atol=1e-12 * values[0])
    assert np.all(values[size[0] :] < 1e-14 * values[0])


def test_the_printed_start_is_wrong():
    """A Hankel matrix that starts at G_0 (E20) misses even exact parameters by as much as their size."""
    matrices = random_system(3, 2, 2)
    exact = powers(*matrices, 12)
    parameters = MarkovParameters(exact)
    printed = markov_parameters_of(realise(parameters, 3, PrintedHankel()), 12)
    assert np.abs(np.asarray(printed.blocks) - exact).max() > 0.3 * np.abs(exact).max()
    # Where D = H A^-1 B, G_0 continues the sequence and the printed start realises it, one lag later.
    A, B, H, _ = matrices
    shifted = powers(A, B, H, H @ np.linalg.solve(A, B), 12)
    again = realise(MarkovParameters(shifted), 3, PrintedHankel())
    moved = np.asarray(again.observation.matrix @ again.dynamics.B)
    np.testing.assert_allclose(moved, shifted[0], rtol=0, atol=1e-12)


def test_sizes_of_the_hankel_matrix_are_free():
    """Any Hankel matrix that holds the order gives the same system; one that does not is refused."""
    parameters = MarkovParameters(powers(*random_system(3, 2, 2), 12))
    for rows, columns in ((2, 9), (9, 2), (5, 5), (2, 2)):
        found = realise(parameters, 3, CorrectedHankel(rows, columns))
        np.testing.assert_allclose(markov_parameters_of(found, 12).blocks, parameters.blocks, rtol=0, atol=1e-12)
    assert (
        realise(parameters, 3).singular_values.shape
        == realise(parameters, 3, CorrectedHankel(6, 5)).singular_values.shape
    )
    for order in (0, 4, 11):
        with pytest.raises(InputError, match=r"size \(12, 10\) and rank 3"):
            realise(parameters, order)
    with pytest.raises(InputError, match=r"size \(2, 2\) and rank 2"):
        realise(parameters, 3, CorrectedHankel(1, 1))
    with pytest.raises(InputError, match="needs 13 Markov parameters, but there are 12"):
        realise(parameters, 3, CorrectedHankel(6, 6))
    assert PrintedHankel(6, 6).pair(parameters)[0].shape == (12, 12)
    with pytest.raises(InputError, match="at least 1"):
        realise(parameters, 3, CorrectedHankel(0, 6))
    with pytest.raises(InputError, match="there are 2"):
        realise(MarkovParameters(parameters.blocks[:2]), 1)


def pendulum(spacing, seed):
    """The controlled, damped pendulum of section 3.3.3 without noise: 20 s of training data, and the true readings."""
    A = expm(spacing * np.array([[0.0, 1.0], [-9.81, -1.0]]))
    rows = int(20 / spacing + 1e-9) + 1
    us, x, ys = np.sqrt(spacing) * np.random.default_rng(seed).normal(size=rows), np.zeros(2), []
    for u in us:
        ys.append(x[0])
        x = A @ x + np.array([0.0, u])
    return TimeSeries(spacing * jnp.arange(rows), jnp.asarray(ys)[:, None], jnp.asarray(us)[:, None])


def mean_square(series, hankel):
    """The training error of LS + ERA over k >= 1, by simulation in numpy."""
    found = realise(least_squares_markov(series, 18), 2, hankel)
    A, B, H, D = (np.asarray(m) for m in (found.dynamics.A, found.dynamics.B, found.observation.matrix,
                                          found.observation.feedthrough))  # fmt: skip
    x, errors = np.zeros(2), []
    for y, u in zip(np.asarray(series.readings), np.asarray(series.inputs), strict=True):
        errors.append(H @ x + D @ u - y)
        x = A @ x + B @ u
    return np.mean(np.array(errors[1:]) ** 2)


@pytest.mark.parametrize(
    ("spacing", "corrected", "printed", "spread"), [(0.1, -2.44, -1.79, 0.3), (0.5, -5.08, -1.19, 0.25)]
)
def test_on_the_pendulum_the_corrected_start_is_better(spacing, corrected, printed, spread):
    """The base-10 logarithms of the mean training errors are those of specification 5.7, for noise ratio 0."""
    errors = np.array([
        [mean_square(series, hankel(9, 8)) for hankel in (CorrectedHankel, PrintedHankel)]
        for series in (pendulum(spacing, seed) for seed in range(60))
    ])  # fmt: skip
    # One error scatters by 0.5 (dt 0.1) or 0.4 (dt 0.5) in log10; means of 60 other draws lay within 0.2 of these.
    assert np.log10(errors.mean(axis=0)) == pytest.approx(np.array([corrected, printed]), abs=spread)
    assert np.mean(errors[:, 0] < errors[:, 1]) > 0.8


def drift(seed, states, channels, inputs, noise, rows):
    """The model of section 3.2.2.1, A = I, with both noises' standard deviation `noise`: model, recording, G."""
    rng = np.random.default_rng(seed)
    H, D = (rng.normal(size=(channels, columns)) / channels**0.5 for columns in (states, inputs))
    B = rng.normal(size=(states, inputs)) / states**0.5
    us, x, ys = rng.normal(size=(rows, inputs)), np.zeros(states), []
    for u in us:
        ys.append(H @ x + D @ u + noise * rng.normal(size=channels))
        x = x + B @ u + noise * rng.normal(size=states)
    model = StateSpaceModel(
        LinearDynamics(jnp.eye(states), jnp.asarray(B)),
        LinearObservation(jnp.asarray(H), jnp.asarray(D)),
        AdditiveGaussian(ScaledIdentity(noise**2, states)),
        AdditiveGaussian(ScaledIdentity(noise**2, channels)),
        Gaussian(jnp.zeros(states), jnp.zeros((states, states))),
    )
    series = TimeSeries(jnp.arange(float(rows)), jnp.asarray(np.array(ys)), jnp.asarray(us))
    return model, series, np.array([D, *[H @ B] * 17])


def spectral_error(parameters, exact):
    """The spectral norm of Ghat_{0:17} - G."""
    return np.linalg.norm(np.concatenate(np.asarray(parameters.blocks) - exact, axis=1), 2)


def test_weights_help_where_the_process_noise_accumulates():
    """With A = I (5.5) Lambda_k grows with k, and weighted least squares has the smaller error on average."""
    errors = []
    for seed in range(100):
        model, series, exact = drift(seed, 5, 2, 1, 0.5, 400)
        found = least_squares_markov(series, 18), generalised_least_squares_markov(series, 18, model)
        errors.append([spectral_error(parameters, exact) for parameters in found])
    gains = -np.diff(errors, axis=1)[:, 0]
    # Three standard errors of the mean gain; it is 0.73 of 3.4, and its standard error 0.15.
    assert gains.mean() > 3 * gains.std() / len(gains) ** 0.5


@pytest.mark.slow
def test_the_marginal_likelihood_beats_both():
    """A linear model fitted by (3.2), from a start made of the data alone, has far smaller errors than LS and GLS."""
    errors = []
    for seed in range(4):
        model, series, exact = drift(seed, 2, 1, 1, 0.5, 120)
        fitted = marginal_markov(series, 18, realised_model(series, 18, 1))
        assert fitted.estimate.converged
        found = least_squares_markov(series, 18), generalised_least_squares_markov(series, 18, model), fitted.parameters
        errors.append([spectral_error(parameters, exact) for parameters in found])
    plain, weighted, marginal = np.mean(errors, axis=0)
    assert marginal < 0.5 * weighted and marginal < 0.5 * plain
