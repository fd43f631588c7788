"""A posterior's forecast has the closed form's mean and variance, and counts the draws that diverge."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import integrators as ig
from symplearn._errors import InputError
from symplearn._fit import Estimate
from symplearn._model import FullState, Gaussian, LinearDynamics, Propagator, StateSpaceModel
from symplearn._noise import AdditiveGaussian, Diagonal, ScaledIdentity, WienerIncrement
from symplearn._objectives import MarginalLikelihood, TimeSeries
from symplearn._parameters import Frozen, Learnt
from symplearn._posterior import posterior_of
from symplearn._predict import posterior_forecast, stochastic_forecast
from symplearn._prior import Flat, Prior
from symplearn._sampler import Drawn

A = np.array([[0.9, 0.3], [-0.2, 0.8]])
Q, R, P0, V = np.diag([0.04, 0.02]), 0.09 * np.eye(2), 0.25 * np.eye(2), 4.0 * np.eye(2)
STEPS, AHEAD, DRAWS = 5, 4, 2000


def linear_posterior():
    """A linear model whose initial mean learns, its readings, and draws of the normal posterior of the textbook."""
    rng = np.random.default_rng(2)
    x, ys = np.array([1.0, -1.0]), []
    for _ in range(STEPS):
        ys.append(x + rng.normal(size=2) * 0.3)
        x = A @ x + rng.normal(size=2) * np.sqrt(np.diagonal(Q))
    ys = np.array(ys)
    C = reading_covariance(P0)
    M = np.vstack([np.linalg.matrix_power(A, k) for k in range(STEPS)])
    gain = V @ M.T @ np.linalg.inv(M @ V @ M.T + C)
    mean, covariance = gain @ ys.ravel(), V - gain @ M @ V
    noises = AdditiveGaussian(Diagonal(np.diagonal(Q))), AdditiveGaussian(Diagonal(np.diagonal(R)))
    initial = Gaussian(Learnt(jnp.asarray(mean)), jnp.asarray(P0))
    model = StateSpaceModel(LinearDynamics(Frozen(jnp.asarray(A))), FullState(), *noises, initial)
    series = TimeSeries(np.arange(float(STEPS)), ys)
    return posterior(model, series, rng.multivariate_normal(mean, covariance, size=DRAWS)), ys


def posterior(model, series, draws):
    """Exact draws (draw, parameter) about a model, as a posterior: nothing has to be fitted or sampled."""
    estimate = Estimate(model, series, MarginalLikelihood(), Prior(Flat()), *[0.0] * 4, True, 1)
    free = jnp.asarray(draws).reshape(4, -1, draws.shape[1])
    return posterior_of(estimate, Drawn(free, jnp.zeros(free.shape[:2]), evaluations=0), "exact")


def reading_covariance(first):
    """The covariance of all readings, for a first state of a given covariance."""
    C = np.zeros((2 * STEPS, 2 * STEPS))
    powers = [np.linalg.matrix_power(A, k) for k in range(STEPS)]
    for k in range(STEPS):
        for j in range(STEPS):
            shared = powers[k] @ first @ powers[j].T
            for i in range(1, min(k, j) + 1):
                shared = shared + powers[k - i] @ Q @ powers[j - i].T
            C[2 * k : 2 * k + 2, 2 * j : 2 * j + 2] = shared
    return C + np.kron(np.eye(STEPS), R)


@pytest.fixture(scope="module")
def linear():
    return linear_posterior()


def closed_form(ys, noisy):
    """Means and covariances of the states after the last reading, from the one joint normal of everything.

    A first state of N(0, V + P0) is the initial mean and the spread around it, both unknown.
    """
    n = STEPS + AHEAD
    powers = [np.linalg.matrix_power(A, k) for k in range(n)]
    F = np.block([[powers[k - j] if j <= k else np.zeros((2, 2)) for j in range(n)] for k in range(n)])
    W = np.kron(np.eye(n), Q)
    W[:2, :2] = V + P0
    if not noisy:
        W[2 * STEPS :] = 0.0
    C = F @ W @ F.T
    seen = slice(0, 2 * STEPS)
    gain = C[:, seen] @ np.linalg.inv(C[seen, seen] + np.kron(np.eye(STEPS), R))
    mean, covariance = gain @ ys.ravel(), C - gain @ C[seen]
    variances = np.diagonal(covariance).reshape(n, 2)
    return mean.reshape(n, 2)[STEPS:], variances[STEPS:]


@pytest.mark.parametrize("process_noise", [True, False])
def test_mean_and_variance_ahead(linear, process_noise):
    """With process noise and without it, mean and variance of the states to come are those of the joint normal."""
    posterior, ys = linear
    ahead = posterior_forecast(
        posterior, until=STEPS - 1.0 + AHEAD, draws=DRAWS, process_noise=process_noise, key=jax.random.key(1)
    )
    means, variances = closed_form(ys, process_noise)
    np.testing.assert_allclose(ahead.times, STEPS + np.arange(AHEAD))
    # Three standard errors.
    assert np.all(np.abs(ahead.mean() - means) < 3 * np.sqrt(variances / DRAWS))
    assert np.all(np.abs(ahead.sd() ** 2 / variances - 1) < 3 * np.sqrt(2 / DRAWS))
    low, high = ahead.quantiles([0.05, 0.95])
    # The quantile of a normal density has a standard error of 2.1 sd / sqrt(n).
    assert np.all(np.abs((high - low) / np.sqrt(variances) - 2 * 1.645) < 3 * 2 * 2.1 / np.sqrt(DRAWS))
    # The filter of the MAP has the mean of the joint normal: everything is linear.
    np.testing.assert_allclose(ahead.map_path, means, atol=1e-9)


def test_measurement_noise_adds_its_variance(linear):
    """With measurement noise the readings' variance is the states' plus R."""
    posterior, ys = linear
    ahead = posterior_forecast(
        posterior, times=[float(STEPS)], draws=DRAWS, measurement_noise=True, key=jax.random.key(2)
    )
    assert np.all(np.abs(ahead.sd() ** 2 / (closed_form(ys, True)[1][:1] + 0.09) - 1) < 3 * np.sqrt(2 / DRAWS))


@pytest.mark.slow
def test_in_sample_paths_start_at_the_smoothed_state(linear):
    """In sample, the first state of the draws is that of the joint normal given all readings."""
    posterior, ys = linear
    path = posterior_forecast(posterior, times=np.arange(3.0), draws=DRAWS, in_sample=True, key=jax.random.key(3))
    C = reading_covariance(V + P0)
    seen = C[:2] - np.kron(np.eye(STEPS), R)[:2]
    gain = seen @ np.linalg.inv(C)
    variances = np.diagonal(seen[:, :2] - gain @ seen.T)
    assert np.all(np.abs(path.mean()[0] - gain @ ys.ravel()) < 3 * np.sqrt(variances / DRAWS))
    assert np.all(np.abs(path.sd()[0] ** 2 / variances - 1) < 3 * np.sqrt(2 / DRAWS))


def test_a_discrete_map_has_no_finer_times(linear):
    """Dynamics of one step per data interval are refused between its ends, and times must lie ahead."""
    posterior, _ = linear
    for times, sentence in (([4.5, 5.0], "one step per data interval"), ([3.0], "after the last reading")):
        with pytest.raises(InputError, match=sentence):
            posterior_forecast(posterior, times=times, key=jax.random.key(0))
    with pytest.raises(InputError, match="either `until` or `times`"):
        posterior_forecast(posterior, key=jax.random.key(0))


class Oscillator(ig.AbstractSeparableHamiltonian):
    """H = p'p / 2 + k q'q / 2 - c sum(q^4) / 4: with c > 0 it escapes from far out."""

    stiffness: jax.Array
    quartic: Frozen

    def kinetic(self, p):
        return 0.5 * p @ p

    def potential(self, q):
        return 0.5 * self.stiffness * q @ q - 0.25 * self.quartic * jnp.sum(q**4)


def oscillator_posterior(quartic, noise, initial_sd=0.01):
    """Draws of an oscillator's stiffness, all but known, after six readings a time unit apart."""
    model = StateSpaceModel(
        Propagator(Oscillator(jnp.asarray(1.0), Frozen(jnp.asarray(quartic))), ig.Leapfrog(), 5),
        FullState(),
        noise,
        AdditiveGaussian(ScaledIdentity(1e-4, 2)),
        Gaussian(jnp.array([0.5, 0.0]), initial_sd**2 * jnp.eye(2)),
    )
    times = np.arange(6.0)
    readings = np.stack([0.5 * np.cos(times), -0.5 * np.sin(times)], axis=1)
    draws = np.random.default_rng(1).normal(1.0, 1e-4, size=(400, 1))
    return posterior(model, TimeSeries(times, readings), draws)


@pytest.fixture(scope="module")
def swing():
    return oscillator_posterior(0.0, AdditiveGaussian(ScaledIdentity(jnp.asarray(1e-3), 2)))


FINE = np.arange(5.25, 9.1, 0.25)


@pytest.mark.slow
def test_finer_times_have_the_same_noise(swing):
    """Asked for a finer step, the spread at the data's times is the same: noise enters once per data interval."""
    coarse, fine = (
        posterior_forecast(swing, times=times, draws=400, key=jax.random.key(4))
        for times in (np.arange(6.0, 10.0), FINE)
    )
    # Two estimates of a variance from 400 draws each: a standard error of 10 %.
    assert np.all(np.abs(fine.sd()[3::4] ** 2 / coarse.sd() ** 2 - 1) < 0.35)
    # Between data times a harmonic flow only turns the spread.
    trace = np.sum(fine.sd() ** 2, axis=1)
    np.testing.assert_allclose(trace[3:6], trace[3], rtol=0.05)
    assert trace[7] > 1.3 * trace[3]


def test_wiener_noise_enters_everywhere():
    """Noise per unit time adds up alike whatever the step."""
    posterior = oscillator_posterior(0.0, WienerIncrement(ScaledIdentity(1e-3, 2)))
    fine = posterior_forecast(posterior, times=FINE, draws=400, key=jax.random.key(5))
    trace = np.sum(fine.sd() ** 2, axis=1)
    # 2e-3 per time unit is added by a harmonic flow that turns the spread; variances of 400 draws are good to 7 %.
    np.testing.assert_allclose(trace[15] - trace[3], 6e-3, rtol=0.25)


def test_diverged_draws_are_counted(swing):
    """Paths that escape are counted and said, and left out of means and bands, which are never NaN."""

    def escapes(noise, times=FINE):
        posterior = oscillator_posterior(0.5, AdditiveGaussian(ScaledIdentity(jnp.asarray(noise), 2)))
        return posterior_forecast(posterior, times=times, draws=400, key=jax.random.key(6))

    ahead = escapes(0.1)
    assert 0 < ahead.diverged[-1] < 400
    assert f"{ahead.diverged[-1]} of 400 DIVERGED" in str(ahead)
    assert np.all(np.diff(ahead.diverged) >= 0)
    for band in (ahead.mean(), ahead.sd(), ahead.quantiles([0.05, 0.5, 0.95]), ahead.map_path):
        assert np.all(np.isfinite(band))
    with pytest.raises(InputError, match="All 400 draws have diverged by t = "):
        escapes(1e4)
    assert "none diverged" in str(posterior_forecast(swing, times=FINE, draws=400, key=jax.random.key(7)))


def test_a_recording_of_zeros_has_no_size():
    """Where nothing but 0 was read no draw is too far beyond it: all are alive."""
    linear, _ = linear_posterior()
    model, still = linear.estimate.model, TimeSeries(np.arange(float(STEPS)), np.zeros((STEPS, 2)))
    estimate = Estimate(model, still, MarginalLikelihood(), Prior(Flat()), *[0.0] * 4, True, 1)
    ahead = stochastic_forecast(estimate, until=STEPS + 2.0, draws=20, key=jax.random.key(0))
    assert not np.any(ahead.diverged)
