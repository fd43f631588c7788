"""On linear models the smoother is conditioning of one joint Gaussian, for states and for noises."""

import equinox as eqx
import estimation_cases as cases
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import integrators as ig
from symplearn._distributions import MultivariateNormal
from symplearn._filter import unscented_filter
from symplearn._model import Coordinates, Gaussian, Propagator, StateSpaceModel, intervals_between
from symplearn._noise import Additive, AdditiveGaussian, Dense
from symplearn._smoother import smooth
from symplearn._transforms import STANDARD, UnscentedTransform

N = 12
SPANS = intervals_between(jnp.arange(float(N)))


@eqx.filter_jit
def smoothed(model, ys, transform=STANDARD):
    return smooth(model, unscented_filter(model, ys, SPANS, None, transform), SPANS, None, transform)


def recorded(system, seed=0):
    ys = cases.simulate(*system, N, np.random.default_rng(seed))[1]
    ys[3], ys[7, 0] = np.nan, np.nan
    return ys


# alpha 1e-3 has weights of 1e6, which cost six of sixteen digits (specification, section 0).
@pytest.mark.parametrize(("alpha", "tolerance"), [(1.0, 1e-11), (1e-3, 1e-8)])
def test_everything_smoothed_is_the_joint_gaussian_conditioned(alpha, tolerance):
    """States, noises, covariances and standardised series equal dense Gaussian conditioning."""
    system = cases.linear_system()
    ys = recorded(system)
    expected = cases.Conditioned(*system, ys)
    found = smoothed(cases.as_model(*system), ys, UnscentedTransform(alpha))
    for name in (
        "means", "covariances", "disturbances", "disturbance_covariances", "standardised_disturbances",
    ):  # fmt: skip
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=tolerance, err_msg=name)
    seen = ~np.isnan(ys)
    assert np.array_equal(np.asarray(found.observed), seen)
    # Of a missing channel the other's residual tells, as their noises are correlated; of a missing row nothing does.
    np.testing.assert_allclose(found.residuals, expected.residuals, atol=tolerance)
    assert found.residuals[7, 0] != 0 and not np.any(found.residuals[3])
    np.testing.assert_allclose(
        found.standardised_residuals, np.where(seen, expected.standardised_residuals, 0.0), atol=tolerance
    )


def test_noises_count_from_their_means():
    """Where both noises have a mean of their own, disturbances and residuals are those of the same noises about 0."""
    A, H, Q, R, m0, P0 = system = cases.linear_system()
    ys, drift, offset = recorded(system), np.array([0.3, -0.2, 0.1]), np.array([0.5, -0.4])
    noises = (Additive(MultivariateNormal(mean, Dense(matrix))) for mean, matrix in ((drift, Q), (offset, R)))
    plain = cases.as_model(*system)
    shifted = StateSpaceModel(plain.dynamics, plain.observation, *noises, plain.initial)
    # What the drift adds to the states is known, and so is what it adds to the readings.
    added = [np.zeros(3)]
    for _ in range(N - 1):
        added.append(A @ added[-1] + drift)
    found, expected = smoothed(shifted, ys + np.array(added) @ H.T + offset), smoothed(plain, ys)
    for name in ("disturbances", "standardised_disturbances", "residuals", "standardised_residuals"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-11, err_msg=name)


def test_without_process_noise_disturbances_are_scores():
    """With no process noise the standardised series are scores of a shift of each equation."""
    zero = np.zeros((3, 3))
    system = cases.linear_system(zero, zero)
    ys = recorded(system)
    found = smoothed(cases.as_model(*system), ys)
    # Slopes of a state that is known exactly come by steps of 1e-5, which keep ten digits.
    np.testing.assert_allclose(found.standardised_disturbances, cases.Conditioned(*system, ys).scores, atol=1e-8)
    assert not np.any(np.asarray(found.disturbances))


def test_standardised_series_are_calibrated():
    """Over 300 recordings made by the model each series, equation by equation, has mean 0 and variance 1."""
    system = cases.linear_system()
    ys = np.array([cases.simulate(*system, N, np.random.default_rng(seed))[1] for seed in range(300)])
    found = jax.jit(jax.vmap(lambda y: smoothed(cases.as_model(*system), y)))(ys)
    for series in (found.standardised_disturbances, found.standardised_residuals):
        series = np.asarray(series)
        # Only recordings are independent: four standard errors over those, at each time and equation at once.
        means, squares = series.mean(axis=(0, 1)), (series**2).mean(axis=1).mean(axis=0)
        error_mean = series.mean(axis=1).std(axis=0) / 300**0.5
        error_square = (series**2).mean(axis=1).std(axis=0) / 300**0.5
        assert np.all(np.abs(means) < 4 * error_mean)
        assert np.all(np.abs(squares - 1) < 4 * error_square)
        assert np.all(error_square < 0.1)


def test_an_impulse_shows_where_and_when_it_acted():
    """A pendulum is pushed once: the largest disturbance is the momentum's, at that time."""
    times = jnp.linspace(0.0, 11.0, N)
    pendulum = ig.problems.Pendulum(gravity=1.0)
    before = ig.integrate(pendulum, ig.RK4(), jnp.array([1.0, 0.0]), times[:7], substeps=50).xs
    pushed = before[-1] + jnp.array([0.0, 0.8])
    # At the seventh reading: the disturbance that ends the sixth interval.
    after = ig.integrate(pendulum, ig.RK4(), pushed, times[6:], substeps=50).xs[1:]
    noise = 0.02 * np.random.default_rng(5).normal(size=(N, 1))
    ys = np.concatenate([before, after])[:, :1] + noise
    quiet = AdditiveGaussian(Dense(np.diag([1e-6, 1e-3]))), AdditiveGaussian(Dense(4e-4 * np.eye(1)))
    start = Gaussian(jnp.array([1.0, 0.0]), 0.01 * jnp.eye(2))
    model = StateSpaceModel(Propagator(pendulum, ig.Leapfrog(), 20), Coordinates((0,)), *quiet, start)
    found = np.abs(smoothed(model, ys).standardised_disturbances)
    assert np.unravel_index(found[:, 1].argmax(), found[:, 1].shape) == (5,)
    # The push is 25 standard deviations of the process noise; nothing else is beyond chance plus its echo.
    assert found[5, 1] > 5.0


@pytest.mark.slow
def test_a_long_recording_is_smoothed():
    """120,000 readings go through, and the states in the middle are those of the stationary smoother.

    Batches of a hundred thousand small LAPACK solves hang on two cores; none is used.
    """
    n = 120_000
    system = cases.linear_system()
    ys = jnp.asarray(np.random.default_rng(0).normal(size=(n, 2)))
    spans = intervals_between(jnp.arange(float(n)))
    model = cases.as_model(*system)
    run = eqx.filter_jit(lambda model, ys: smooth(model, unscented_filter(model, ys, spans), spans))
    found = run(model, ys)
    middle = slice(n // 2 - 100, n // 2 + 100)
    expected = cases.Conditioned(*system, np.asarray(ys[middle]))
    # A hundred readings away neither end is felt any more: 0.9^100 is 3e-5, and the filter forgets faster.
    np.testing.assert_allclose(found.means[n // 2], expected.means[100], atol=1e-8)
    np.testing.assert_allclose(found.covariances[n // 2], expected.covariances[100], atol=1e-8)
    assert bool(jnp.all(jnp.isfinite(found.standardised_disturbances)))
