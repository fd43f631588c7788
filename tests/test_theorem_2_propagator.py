"""Theorem 2: as the noise of an invertible reading vanishes, the marginal likelihood is one-step prediction error."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

import integrators as ig
from symplearn._errors import InputError
from symplearn._model import (
    Coordinates,
    FullState,
    Gaussian,
    LinearDynamics,
    LinearObservation,
    Propagator,
    StateSpaceModel,
)
from symplearn._noise import AdditiveGaussian, Dense, WienerIncrement
from symplearn._objectives import MarginalLikelihood, TimeSeries
from symplearn._trajectory_objectives import PropagatorLeastSquares

N, SPAN, SUBSTEPS = 12, 0.5, 10
TIMES = SPAN * np.arange(N + 1)
FILTER = eqx.filter_jit(MarginalLikelihood())
PROPAGATOR = eqx.filter_jit(PropagatorLeastSquares())
H2, D2 = np.array([[1.0, 0.3], [-0.2, 0.8]]), np.array([[0.7], [-0.4]])
Q2, P2, M2 = np.diag([0.02, 0.05]), 0.1 * np.eye(2), np.array([1.5, 0.0])


def leapfrog(x, span=SPAN, substeps=SUBSTEPS):
    """The pendulum with unit constants, kick, drift, kick, in numpy."""
    (q, p), dt = x, span / substeps
    for _ in range(substeps):
        p = p - dt / 2 * np.sin(q)
        q = q + dt * p
        p = p - dt / 2 * np.sin(q)
    return np.array([q, p])


def pendulum_case():
    """Readings of both coordinates, sheared and driven, with noise, and the states they read."""
    rng, xs = np.random.default_rng(2), [M2]
    for _ in range(N):
        xs.append(leapfrog(xs[-1], substeps=400))
    us = rng.normal(size=(N + 1, 1))
    ys = np.array(xs) @ H2.T + us @ D2.T + 0.2 * rng.normal(size=(N + 1, 2))
    return TimeSeries(*map(jnp.asarray, (TIMES, ys, us))), np.linalg.solve(H2, (ys - us @ D2.T).T).T


def pendulum(g, initial=True, observation=None):
    dynamics = Propagator(ig.problems.Pendulum(1.0, 1.0, 1.0), ig.Leapfrog(), SUBSTEPS)
    reading = LinearObservation(jnp.asarray(H2), jnp.asarray(D2)) if observation is None else observation
    noises = AdditiveGaussian(Dense(Q2)), AdditiveGaussian(Dense(g * np.eye(2)))
    return StateSpaceModel(dynamics, reading, *noises, Gaussian(M2, P2) if initial else None)


def decays_linearly(gaps):
    """Linear in the noise: ratio 100 within 5 for each two decades, below 1e-6 at 1e-10 (specification, T2)."""
    np.testing.assert_allclose(np.array(gaps[:-1]) / np.array(gaps[1:]), 100, atol=5)
    assert abs(gaps[-1]) < 1e-6


def test_a_linear_model_tends_to_one_step_prediction():
    """For a linear model the score tends to one-step prediction of the states, with the reading's Jacobian."""
    rng = np.random.default_rng(4)
    A, H = 0.4 * rng.normal(size=(3, 3)), np.eye(3) + 0.3 * rng.normal(size=(3, 3))
    B, Q, P0, m0 = rng.normal(size=(3, 2)), np.diag([0.3, 0.1, 0.2]), np.eye(3), rng.normal(size=3)
    us, xs = rng.normal(size=(N + 1, 2)), [rng.normal(size=3)]
    for u in us[:-1]:
        xs.append(A @ xs[-1] + B @ u + np.sqrt(np.diag(Q)) * rng.normal(size=3))
    xs = np.array(xs)
    ys = xs @ H.T
    jacobian = -np.log(abs(np.linalg.det(H)))
    later = multivariate_normal(cov=Q).logpdf(xs[1:] - xs[:-1] @ A.T - us[:-1] @ B.T).sum() + N * jacobian
    first = multivariate_normal(m0, P0).logpdf(xs[0]) + jacobian
    series = TimeSeries(*map(jnp.asarray, (TIMES, ys, us)))

    def model(g):
        noises = AdditiveGaussian(Dense(Q)), AdditiveGaussian(Dense(g * np.eye(3)))
        maps = LinearDynamics(*map(jnp.asarray, (A, B))), LinearObservation(jnp.asarray(H))
        return StateSpaceModel(*maps, *noises, Gaussian(jnp.asarray(m0), jnp.asarray(P0)))

    # Thirteen terms, each to round-off of a few units.
    assert float(PROPAGATOR(model(1.0), series)) == pytest.approx(-later, rel=1e-13)
    decays_linearly([-float(FILTER(model(g), series)) - later - first for g in (1e-6, 1e-8, 1e-10)])


def test_the_pendulum_tends_to_one_step_prediction():
    """The same holds for the pendulum through a sheared and driven reading."""
    series, xs = pendulum_case()
    ahead = np.array([leapfrog(x) for x in xs[:-1]])
    jacobian = -np.log(abs(np.linalg.det(H2)))
    later = multivariate_normal(cov=Q2).logpdf(xs[1:] - ahead).sum() + N * jacobian
    first = multivariate_normal(M2, P2).logpdf(xs[0]) + jacobian
    assert float(PROPAGATOR(pendulum(1.0), series)) == pytest.approx(-later, rel=1e-12)
    decays_linearly([-float(FILTER(pendulum(g), series)) - later - first for g in (1e-6, 1e-8, 1e-10)])


def test_remark_1_the_first_state_is_given():
    """With no distribution for the start the terms of the first reading drop out, on both sides (Remark 1)."""
    series, xs = pendulum_case()
    ahead = np.array([leapfrog(x) for x in xs[:-1]])
    later = multivariate_normal(cov=Q2).logpdf(xs[1:] - ahead).sum()
    whole = TimeSeries(series.times, jnp.asarray(xs))
    assert float(PROPAGATOR(pendulum(1.0, False, FullState()), whole)) == pytest.approx(-later, rel=1e-12)
    models = [pendulum(g, False, FullState()) for g in (1e-6, 1e-8, 1e-10)]
    decays_linearly([-float(FILTER(model, whole)) - later for model in models])


def test_missing_readings_and_uneven_intervals():
    """An incomplete start leaves its interval out, a missing channel only itself; noise follows the interval."""
    _, xs = pendulum_case()
    times = np.cumsum(np.r_[0.0, np.linspace(0.3, 0.9, N)])
    ys = xs.copy()
    ys[3, 1], ys[6] = np.nan, np.nan
    expected = 0.0
    for k in range(N):
        seen = ~np.isnan(ys[k + 1])
        if np.isnan(ys[k]).any() or not seen.any():
            continue
        dt = times[k + 1] - times[k]
        error = (ys[k + 1] - leapfrog(ys[k], dt))[seen]
        expected -= multivariate_normal(cov=dt * Q2[np.ix_(seen, seen)]).logpdf(error)
    noises = WienerIncrement(Dense(Q2)), AdditiveGaussian(Dense(np.eye(2)))
    model = StateSpaceModel(pendulum(1.0).dynamics, FullState(), *noises)
    series = TimeSeries(jnp.asarray(times), jnp.asarray(ys))
    assert float(PROPAGATOR(model, series)) == pytest.approx(expected, rel=1e-12)
    assert float(PROPAGATOR(model, [series, series])) == pytest.approx(2 * expected, rel=1e-12)


def test_what_cannot_be_predicted():
    """A reading without an inverse is refused; a singular noise scores 1e15 with finite derivatives."""
    series, xs = pendulum_case()
    angles = TimeSeries(series.times, jnp.asarray(xs[:, :1]))
    model = eqx.tree_at(lambda m: m.measurement_noise.structure.covariance, pendulum(1.0), jnp.eye(1))
    with pytest.raises(InputError, match="no inverse for a state of size 2"):
        PropagatorLeastSquares()(eqx.tree_at(lambda m: m.observation, model, Coordinates((0,))), angles)
    still = eqx.tree_at(lambda m: m.process_noise.structure.covariance, pendulum(1.0), jnp.zeros((2, 2)))
    score, slope = eqx.filter_jit(eqx.filter_value_and_grad(PropagatorLeastSquares()))(still, series)
    assert float(score) == 1e15 and np.isfinite(float(slope.dynamics.system.gravity))
