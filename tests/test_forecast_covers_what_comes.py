"""Forecasts continue the path, and what comes lies in the stated interval as often as stated."""

import equinox as eqx
import estimation_cases as cases
import jax.numpy as jnp
import numpy as np
import pytest

import integrators as ig
from symplearn._errors import InputError
from symplearn._fit import Estimate
from symplearn._forecast import forecast
from symplearn._model import FullState, Gaussian, LinearDynamics, Propagator, StateSpaceModel
from symplearn._noise import AdditiveGaussian, ScaledIdentity
from symplearn._objectives import MarginalLikelihood, TimeSeries
from symplearn._prior import Flat, Prior

N, AHEAD = 12, 6


class Oscillator(ig.AbstractSeparableHamiltonian):
    """H = (p^2 + q^2) / 2."""

    def kinetic(self, p):
        return 0.5 * p @ p

    def potential(self, q):
        return 0.5 * q @ q


def estimated(ys):
    """An estimate at the truth: what is tested is the forecast, not the fit."""
    model = cases.as_model(*cases.linear_system())
    series = TimeSeries(jnp.arange(float(N)), jnp.asarray(ys))
    return Estimate(model, series, MarginalLikelihood(), Prior(Flat()), 0.0, 0.0, 0.0, 0.0, True, 0)


def recorded(seed):
    system = cases.linear_system()
    return cases.simulate(*system, N + AHEAD, np.random.default_rng(seed))[1]


def test_the_forecast_is_the_kalman_predictor():
    """On a linear model, means and covariances are those of the last filtered moments pushed forward."""
    A, H, Q, R, m0, P0 = cases.linear_system()
    ys = recorded(0)
    _, m, P = cases.kalman_log_likelihood(A, H, Q, R, m0, P0, ys[:N])
    ahead = forecast(estimated(ys[:N]), until=N - 1.0 + AHEAD)
    assert np.array_equal(ahead.times, np.arange(N, N + AHEAD))
    for k in range(AHEAD):
        m, P = A @ m, A @ P @ A.T + Q
        np.testing.assert_allclose(ahead.state_means[k], m, atol=1e-12)
        np.testing.assert_allclose(ahead.state_covariances[k], P, atol=1e-12)
        np.testing.assert_allclose(ahead.sds[k], np.sqrt(np.diagonal(H @ P @ H.T + R)), atol=1e-12)
        # A linear model has no spread to shift the mean.
        np.testing.assert_allclose(ahead.path[k], H @ m, atol=1e-12)
    assert "Forecast of 6 readings from 12 to 17" in str(ahead)


def test_what_comes_is_covered():
    """Over 150 recordings, 95 % of the readings to come are within 1.96 sd of the forecast mean."""
    inside = []
    for seed in range(150):
        ys = recorded(seed)
        ahead = forecast(estimated(ys[:N]), until=N - 1.0 + AHEAD)
        inside.append(np.mean(np.abs(ys[N:] - ahead.means) < 1.96 * ahead.sds))
    # Recordings are independent, readings within one are not.
    error = np.std(inside) / 150**0.5
    assert abs(np.mean(inside) - 0.95) < 4 * error and error < 0.01


@pytest.mark.parametrize("times", [[N + 1.0, N + 4.0], [N + 4.0]])
def test_times_of_ones_own_are_rows_of_the_whole_forecast(times):
    """Of times with gaps between them the forecast is that of every data interval, whatever is passed over."""
    estimate = estimated(recorded(0)[:N])
    some, every = forecast(estimate, times=times), forecast(estimate, until=N + 4.0)
    rows = np.asarray(times, dtype=int) - N
    assert np.array_equal(some.times, times)
    for name in ("path", "means", "sds", "state_path", "state_means", "state_covariances"):
        # The same steps, compiled for another number of them. Seen: 0
        np.testing.assert_allclose(getattr(some, name), getattr(every, name)[rows], rtol=1e-13, err_msg=name)


def test_times_far_apart_are_stepped_as_finely_as_the_data():
    """Ten data intervals away an oscillator stands where leapfrog of the model's own step has brought it, and its
    noise has entered ten times; between the data's times none enters."""
    q, p, h = 1.0, 0.0, 0.25
    series = TimeSeries(jnp.array([0.0, 0.5]), jnp.array([[q, p], [np.nan, np.nan]]))
    noises = AdditiveGaussian(ScaledIdentity(0.01, dim=2)), AdditiveGaussian(ScaledIdentity(1e-8, dim=2))
    start = Gaussian(jnp.array([q, p]), jnp.zeros((2, 2)))
    model = StateSpaceModel(Propagator(Oscillator(), ig.Leapfrog(), 2), FullState(), *noises, start)
    estimate = Estimate(model, series, MarginalLikelihood(), Prior(Flat()), 0.0, 0.0, 0.0, 0.0, True, 0)
    ahead = forecast(estimate, times=[5.5, 5.6])
    for _ in range(22):
        p -= 0.5 * h * q
        q += h * p
        p -= 0.5 * h * q
    np.testing.assert_allclose(ahead.state_path[0], [q, p], atol=1e-12)  # round-off of 22 steps. Seen: 4e-16
    # A turn keeps the determinant of what has entered 11 times, once before the last reading.
    spread = np.trace(ahead.state_covariances[0])
    # Leapfrog of this step is a turn of an ellipse that is 0.8 % from a circle.
    np.testing.assert_allclose(spread, 11 * 2 * 0.01, rtol=0.01)
    np.testing.assert_allclose(np.trace(ahead.state_covariances[1]), spread, rtol=0.01)


def test_a_matrix_is_not_asked_for_part_of_its_step():
    """`LinearDynamics`, one step per data interval, is forecast at whole intervals only: another time is refused."""
    A = cases.linear_system()[0]
    model = eqx.tree_at(lambda e: e.model.dynamics, estimated(recorded(0)[:N]), LinearDynamics(jnp.asarray(A)))
    m = MarginalLikelihood().filter(model.model, model.recording).filtered_means[-1]
    found = forecast(model, times=[N + 4.0]).state_means[0]
    np.testing.assert_allclose(found, np.linalg.matrix_power(A, 5) @ m, atol=1e-12)  # round-off of order one
    with pytest.raises(InputError, match="is one step per data interval of 1"):
        forecast(model, times=[N + 0.5])


def test_a_driven_model_is_forecast_with_its_inputs():
    """With inputs held from each time on, states to come are x <- A x + B u from the last filtered mean; without, or
    with too few of them, nothing is forecast."""
    A, H, Q, R, m0, P0 = cases.linear_system()
    B, rng = np.array([[0.3], [-0.2], [0.5]]), np.random.default_rng(3)
    u, ys = rng.normal(size=(N + AHEAD, 1)), recorded(0)
    one = estimated(ys[:N])
    model = eqx.tree_at(lambda m: m.dynamics, one.model, LinearDynamics(jnp.asarray(A), jnp.asarray(B)))
    series = TimeSeries(jnp.arange(float(N)), jnp.asarray(ys[:N]), jnp.asarray(u[:N]))
    driven = Estimate(model, series, MarginalLikelihood(), Prior(Flat()), 0.0, 0.0, 0.0, 0.0, True, 0)
    m = MarginalLikelihood().filter(model, series).filtered_means[-1]
    ahead = forecast(driven, until=N - 1.0 + AHEAD, inputs=u[N - 1 :])
    for k in range(AHEAD):
        m = A @ m + B @ u[N - 1 + k]
        np.testing.assert_allclose(ahead.state_means[k], m, atol=1e-12)  # round-off of order one. Seen: 0
    with pytest.raises(InputError, match="give `inputs`"):
        forecast(driven, until=N - 1.0 + AHEAD)
    with pytest.raises(InputError, match=r"of shape \(7, input\)"):
        forecast(driven, until=N - 1.0 + AHEAD, inputs=u[N:])


def test_bad_requests_are_refused():
    """Both or neither of `until` and `times`, times in the past, and a model that escapes are refused."""
    estimate = estimated(recorded(0)[:N])
    for request in ({}, {"until": 20.0, "times": [20.0]}):
        with pytest.raises(InputError, match="either `until` or `times`"):
            forecast(estimate, **request)
    for request in ({"until": 3.0}, {"times": [3.0, 20.0]}, {"times": []}):
        with pytest.raises(InputError, match="after the last reading"):
            forecast(estimate, **request)
    for request in ({"until": np.nan}, {"until": np.inf}, {"until": 1e9}, {"times": [1e9]}):
        with pytest.raises(InputError, match="is not within 10,000,000 intervals"):
            forecast(estimate, **request)
    with pytest.raises(InputError, match="finite, increasing"):
        forecast(estimate, times=[20.0, np.inf])
    growing = eqx.tree_at(lambda e: e.model.dynamics.A, estimate, 1e80 * jnp.eye(3))
    with pytest.raises(InputError, match="not finite"):
        forecast(growing, until=N - 1.0 + AHEAD)
