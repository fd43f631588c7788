"""Theorem 1: with no process noise and a known start the marginal likelihood is the error of a free simulation."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.stats import multivariate_normal

import integrators as ig
from symplearn._errors import InputError
from symplearn._fit import fit
from symplearn._model import (
    Coordinates,
    FullState,
    Gaussian,
    LinearDynamics,
    LinearObservation,
    Propagator,
    StateSpaceModel,
    intervals_between,
    slice_at,
)
from symplearn._noise import AdditiveGaussian, Dense, ScaledIdentity
from symplearn._objectives import MarginalLikelihood, TimeSeries
from symplearn._parameters import Frozen, resolve
from symplearn._prior import Flat
from symplearn._trajectory_objectives import SimulationLeastSquares

N, SD, SPAN, SUBSTEPS = 12, 0.2, 0.5, 10
TIMES = SPAN * np.arange(N + 1)
START = np.array([1.5, 0.0])


def rk4_path(gravity, substeps=SUBSTEPS):
    """The pendulum by the classical Runge-Kutta method, written here in numpy."""

    def slope(x):
        return np.array([x[1], -gravity * np.sin(x[0])])

    xs, dt = [START], SPAN / substeps
    for _ in range(N):
        x = xs[-1]
        for _ in range(substeps):
            a = slope(x)
            b = slope(x + dt / 2 * a)
            c = slope(x + dt / 2 * b)
            x = x + dt / 6 * (a + 2 * b + 2 * c + slope(x + dt * c))
        xs.append(x)
    return np.array(xs)


def readings():
    """Angles of a pendulum with gravity 1, with noise, no model of ours in them: forty times finer steps."""
    return rk4_path(1.0, 400)[:, :1] + SD * np.random.default_rng(0).normal(size=(N + 1, 1))


def pendulum(noise, gravity=1.0):
    return StateSpaceModel(
        Propagator(ig.problems.Pendulum(Frozen(1.0), Frozen(1.0), gravity), ig.RK4(), SUBSTEPS),
        Coordinates((0,)),
        AdditiveGaussian(ScaledIdentity(noise, 2)),
        AdditiveGaussian(ScaledIdentity(SD**2, 1)),
        Gaussian(jnp.asarray(START), noise * jnp.eye(2)),
    )


FILTER = eqx.filter_jit(MarginalLikelihood())
SIMULATION = eqx.filter_jit(SimulationLeastSquares())
SERIES = TimeSeries(jnp.asarray(TIMES), jnp.asarray(readings()))


def free_run_score(gravity, ys):
    """Minus the log density of the residuals of the free run, by SciPy."""
    return -multivariate_normal(cov=SD**2).logpdf(ys[:, 0] - rk4_path(gravity)[:, 0]).sum()


def linear_case():
    """Three states, two inputs, two channels, with a feedthrough; spectral radius 0.9; any readings will do."""
    rng = np.random.default_rng(1)
    A = rng.normal(size=(3, 3))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    B, H, D = rng.normal(size=(3, 2)), rng.normal(size=(2, 3)), rng.normal(size=(2, 2))
    R = np.array([[0.2, 0.05], [0.05, 0.1]])
    x0, us, ys = rng.normal(size=3), rng.normal(size=(N + 1, 2)), rng.normal(size=(N + 1, 2))
    return A, B, H, D, R, x0, us, ys


def linear_model(A, B, H, D, R, x0):
    noises = AdditiveGaussian(Dense(np.zeros((3, 3)))), AdditiveGaussian(Dense(R))
    maps = LinearDynamics(*map(jnp.asarray, (A, B))), LinearObservation(*map(jnp.asarray, (H, D)))
    return StateSpaceModel(*maps, *noises, Gaussian(jnp.asarray(x0), jnp.zeros((3, 3))))


def linear_residuals(A, B, H, D, R, x0, us, ys):
    free, x = [], x0
    for u in us:
        free.append(H @ x + D @ u)
        x = A @ x + B @ u
    return ys - np.array(free)


def test_a_linear_model_is_exact():
    """For a linear model with inputs, filter and objective are the simulation error to round-off."""
    *system, us, ys = case = linear_case()
    expected = -multivariate_normal(cov=system[4]).logpdf(linear_residuals(*case)).sum()
    series = TimeSeries(jnp.asarray(TIMES), jnp.asarray(ys), jnp.asarray(us))
    model = linear_model(*system)
    # Twenty-six squared residuals, each to round-off of a few units.
    assert float(SIMULATION(model, series)) == pytest.approx(expected, abs=1e-12)
    # The filter whitens each by a factor of its own covariance and adds them one by one, to 1457, of which a unit of
    # round-off is 2.3e-13: 1.4e-12 was seen on one machine, so twenty units.
    assert float(FILTER(model, series)) == pytest.approx(expected, abs=5e-12)


def test_what_is_missing_is_left_out():
    """Missing channels and rows are left out of the score, and several recordings add theirs."""
    *system, us, ys = case = linear_case()
    ys[4, 0], ys[7], ys[0, 1] = np.nan, np.nan, np.nan
    expected = 0.0
    for r in linear_residuals(*case):
        seen = ~np.isnan(r)
        if seen.any():
            expected -= multivariate_normal(cov=system[4][np.ix_(seen, seen)]).logpdf(r[seen])
    series = TimeSeries(jnp.asarray(TIMES), jnp.asarray(ys), jnp.asarray(us))
    model = linear_model(*system)
    assert float(SIMULATION(model, series)) == pytest.approx(expected, abs=1e-12)
    assert float(SIMULATION(model, [series, series])) == pytest.approx(2 * expected, abs=1e-12)
    assert np.all(np.isfinite(eqx.filter_jit(eqx.filter_grad(SimulationLeastSquares()))(model, series).dynamics.A))


def test_the_pendulum_is_approached_linearly():
    """For the pendulum the filter's distance from the free run falls a hundredfold with the noise."""
    expected = free_run_score(1.0, readings())
    assert float(SIMULATION(pendulum(1e-8), SERIES)) == pytest.approx(expected, abs=1e-11)
    gaps = [float(FILTER(pendulum(e), SERIES)) - expected for e in (1e-8, 1e-10, 1e-12, 1e-14)]
    # First order in the noise e: the next order is e times smaller; round-off of 1e-12 against a gap of 1e-7.
    np.testing.assert_allclose(np.array(gaps[:2]) / gaps[1:3], 100, atol=1)
    assert abs(gaps[3]) < 1e-6


def test_gradients_are_those_of_the_mean_squared_error():
    """The slope by a parameter is (n + 1) / (2 s^2) times that of the mean squared error, and so is its zero."""
    ys, h = readings(), 1e-5

    def mean_squared_error(gravity):
        return np.mean((ys[:, 0] - rk4_path(gravity)[:, 0]) ** 2)

    factor = (N + 1) / (2 * SD**2)
    slopes = [eqx.filter_jit(eqx.filter_grad(o)) for o in (MarginalLikelihood(), SimulationLeastSquares())]
    for gravity in (0.8, 1.2):
        expected = factor * (mean_squared_error(gravity + h) - mean_squared_error(gravity - h)) / (2 * h)
        found = [slope(pendulum(0.0, gravity), SERIES).dynamics.system.gravity for slope in slopes]
        # Central differences: h^2 = 1e-10 of the third derivative, round-off 1e-16 / h.
        np.testing.assert_allclose(found, expected, rtol=1e-7)
    best = minimize_scalar(mean_squared_error, bracket=(0.8, 1.2), tol=1e-10).x
    estimate = fit(pendulum(0.0, 0.8), SERIES, SimulationLeastSquares(), prior=Flat())
    # Brent's method resolves a minimum to the root of round-off.
    assert estimate.converged and float(estimate.values()["dynamics.system.gravity"]) == pytest.approx(best, abs=1e-6)


def test_without_a_start_the_first_reading_is_it():
    """Without an initial distribution the run starts at the first reading, which is then given, not scored."""
    xs, noise = rk4_path(1.0), Dense(SD**2 * np.eye(2))
    ys = np.vstack([START, xs[1:] + SD * np.random.default_rng(3).normal(size=(N, 2))])
    model = pendulum(0.0)
    read = StateSpaceModel(model.dynamics, FullState(), model.process_noise, AdditiveGaussian(noise))
    expected = -multivariate_normal(cov=SD**2 * np.eye(2)).logpdf(ys[1:] - xs[1:]).sum()
    assert float(SIMULATION(read, TimeSeries(jnp.asarray(TIMES), jnp.asarray(ys)))) == pytest.approx(
        expected, abs=1e-11
    )
    blind = StateSpaceModel(model.dynamics, Coordinates((0,)), model.process_noise, model.measurement_noise)
    with pytest.raises(InputError, match="has no inverse"):
        SimulationLeastSquares()(blind, SERIES)
    with pytest.raises(InputError, match="2 channels"):
        SimulationLeastSquares()(model, TimeSeries(jnp.asarray(TIMES), jnp.asarray(ys)))


def test_the_propagator_is_the_trajectory():
    """Chained over data intervals the propagator is the integrator's own trajectory, and refuses what it cannot."""
    dynamics, spans = pendulum(0.0).dynamics, intervals_between(jnp.asarray(TIMES))
    dynamics = eqx.filter_jit(resolve(dynamics))
    x = jnp.asarray(START)
    for k in range(3):
        x = dynamics(x, slice_at(spans, k))
    # Thirty steps, each to round-off.
    np.testing.assert_allclose(x, rk4_path(1.0)[3], atol=1e-13)
    assert np.array_equal(Coordinates((1, 0))(x), x[::-1])
    with pytest.raises(TypeError, match="separable"):
        Propagator(ig.problems.Cherry(), ig.Leapfrog())
    with pytest.raises(InputError, match="`substeps` of at least 1"):
        Propagator(ig.problems.Cherry(), ig.Tao(), substeps=0)


class Explosive(eqx.Module):
    """x' = c x^2: leaves the reals in a few steps."""

    c: jax.Array

    def __call__(self, x, interval):
        return jnp.sqrt(self.c) * self.c * x**2


def test_leaving_the_reals_is_a_finite_score():
    """A trajectory that overflows, or becomes NaN, scores 1e15 nats, with derivatives that are finite numbers."""
    noise = AdditiveGaussian(Dense(np.eye(1)))
    series = TimeSeries(jnp.arange(13.0), jnp.zeros((13, 1)))

    @jax.jit
    def scores(c):
        def score(c):
            model = StateSpaceModel(Explosive(c), FullState(), noise, noise, Gaussian(np.ones(1), np.eye(1)))
            return SimulationLeastSquares()(model, series)

        return score(c), jax.grad(score)(c), jax.jacfwd(score)(c)

    assert list(map(float, scores(1e30))) == list(map(float, scores(-1.0))) == [1e15, 0.0, 0.0]
    assert np.all(np.isfinite(scores(0.1))) and float(scores(0.1)[1]) != 0.0
