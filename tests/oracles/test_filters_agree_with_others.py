"""Likelihoods, filters and smoothers are those of filterpy, dynamax and statsmodels on the same model."""

import agreement_cases as agreement
import equinox as eqx
import estimation_cases as cases
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dynamax.nonlinear_gaussian_ssm import (
    ParamsNLGSSM,
    UKFHyperParams,
    extended_kalman_smoother,
    unscented_kalman_smoother,
)
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
from statsmodels.tsa.statespace.kalman_smoother import KalmanSmoother

from symplearn._filter import kalman_filter, log_likelihood, unscented_filter
from symplearn._model import Gaussian, Instant, LinearDynamics, LinearObservation, StateSpaceModel, intervals_between
from symplearn._noise import AdditiveGaussian, Dense, WienerIncrement
from symplearn._smoother import smooth
from symplearn._transforms import Taylor, UnscentedTransform

SCORE = eqx.filter_jit(log_likelihood)
HISTORY = eqx.filter_jit(unscented_filter)
SMOOTHED = eqx.filter_jit(smooth)
BUILT = {"henon-heiles": agreement.henon_heiles(), "pendulum": agreement.pendulum()}


@pytest.fixture(params=BUILT)
def case(request):
    return BUILT[request.param]


def assert_moments_equal(found, expected, tolerance):
    """Means and covariances over time, to a share of the standard deviations."""
    (m, P), (mean, covariance) = found, expected
    scale = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    np.testing.assert_allclose((m - mean) / scale, 0.0, atol=tolerance)
    np.testing.assert_allclose((P - covariance) / (scale[:, :, None] * scale[:, None, :]), 0.0, atol=tolerance)


def filterpy_filter(case, readings, alpha, beta, kappa):
    """filterpy's score, filtered and smoothed moments, measurement first, missing channels left out by hand.

    `update` takes the sigma points that were drawn last, whatever became of the state since: drawn anew before each.
    """
    Q, R, m, P = case.numbers
    points = MerweScaledSigmaPoints(len(m), alpha, beta, kappa)
    ukf = UnscentedKalmanFilter(len(m), len(R), dt=0.0, hx=case.read, fx=case.step, points=points)
    ukf.x, ukf.P, ukf.Q, ukf.R, total, past = m, P, Q, R, 0.0, []
    for k, (reading, length) in enumerate(zip(readings, case.lengths, strict=True)):
        if k > 0:
            ukf.predict(dt=length[0])
        seen = ~np.isnan(reading)
        if seen.any():
            ukf.sigmas_f = points.sigma_points(ukf.x, ukf.P)
            ukf.update(reading[seen], R[np.ix_(seen, seen)], hx=lambda x, seen=seen: case.read(x)[seen])
            total += ukf.log_likelihood
        past.append((ukf.x, ukf.P))
    filtered = tuple(np.array(moments) for moments in zip(*past, strict=True))
    return total, filtered, ukf.rts_smoother(*filtered, dts=case.lengths[1:, 0])[:2]


# The dissertation's alpha of 1e-3 gives weights of 1e6, which cost filterpy six of its sixteen digits.
@pytest.mark.parametrize(
    ("parameters", "tolerance"),
    [
        ((1.0, 2.0, 0.0), 1e-10),
        ((0.5, 2.0, 1.0), 1e-10),
        ((1.2, 1.5, -1.0), 1e-10),
        ((1e-3, 2.0, 0.0), 1e-7),
    ],
)
def test_the_unscented_filter_and_smoother_are_filterpys(case, parameters, tolerance):
    """Log likelihood, filtered and smoothed moments equal filterpy's for several alpha, beta and kappa."""
    transform = UnscentedTransform(*parameters)
    expected, past, whole = filterpy_filter(case, case.readings, *parameters)
    filtered = HISTORY(case.model, case.readings, case.spans, None, transform)
    assert float(filtered.log_likelihood) == pytest.approx(expected, rel=tolerance)
    # filterpy subtracts covariances, whose round-off is that of the widest over the narrowest.
    found = filtered.filtered_means, filtered.filtered_covariances
    assert_moments_equal(found, past, 100 * tolerance)
    smoothed = SMOOTHED(case.model, filtered, case.spans, None, transform)
    assert_moments_equal((smoothed.means, smoothed.covariances), whole, 100 * tolerance)


def test_missing_readings_are_filterpys_left_out(case):
    """With rows missing, whole and in part, the log likelihood equals filterpy's, given what was read alone."""
    readings = case.readings.copy()
    readings[0, 1] = readings[4] = readings[9, 0] = readings[-1] = np.nan
    expected = filterpy_filter(case, readings, 1.0, 2.0, 0.0)[0]
    # A sum of 20 to 30 terms in double precision.
    assert float(SCORE(case.model, readings, case.spans)) == pytest.approx(expected, rel=1e-10)


def dynamax_model(case):
    """dynamax hands the input of the coming reading to the dynamics: here, the length of the interval before it."""
    Q, R, m, P = map(jnp.asarray, case.numbers)
    return ParamsNLGSSM(
        initial_mean=m,
        initial_covariance=P,
        dynamics_function=lambda x, u: case.traced_step(x, u[0]),
        dynamics_covariance=Q,
        emission_function=lambda x, u: case.read(x),
        emission_covariance=R,
    )


def dynamax_smoother(case, transform):
    arrays = {"emissions": jnp.asarray(case.readings), "inputs": jnp.asarray(case.lengths)}
    if isinstance(transform, Taylor):
        return extended_kalman_smoother(dynamax_model(case), **arrays)
    parameters = UKFHyperParams(transform.alpha, transform.beta, transform.kappa)
    return unscented_kalman_smoother(dynamax_model(case), hyperparams=parameters, **arrays)


@pytest.mark.parametrize(
    "transform",
    [UnscentedTransform(), UnscentedTransform(0.5, 2.0, 1.0), Taylor()],
    ids=["default", "narrow", "taylor"],
)
def test_unscented_and_extended_filters_and_smoothers_are_dynamaxs(case, transform):
    """Log likelihood, filtered and smoothed moments equal dynamax's, of its unscented and of its extended filter."""
    expected = jax.jit(lambda: dynamax_smoother(case, transform))()
    filtered = HISTORY(case.model, case.readings, case.spans, None, transform)
    # dynamax adds 1e-9 to the diagonal of what it inverts: in its filter, 4e-7 of the measurement variance.
    assert float(filtered.log_likelihood) == pytest.approx(float(expected.marginal_loglik), rel=1e-6)
    found = filtered.filtered_means, filtered.filtered_covariances
    assert_moments_equal(found, (expected.filtered_means, expected.filtered_covariances), 1e-5)
    # In its smoother, the same of the predicted covariance, which exceeds the process noise: 1e-5 to 1e-3.
    tolerance = 1e-9 / np.linalg.eigvalsh(case.numbers[0]).min()
    smoothed = SMOOTHED(case.model, filtered, case.spans, None, transform)
    both = expected.smoothed_means, expected.smoothed_covariances
    assert_moments_equal((smoothed.means, smoothed.covariances), both, tolerance)


def driven_linear_model():
    """A driven linear model with uneven times and missing readings, statsmodels' answer for it, and what was read."""
    A, H, Q, R, m0, P0 = cases.linear_system()
    rng, n = np.random.default_rng(7), 25
    B, D = rng.normal(size=(3, 2)), rng.normal(size=(2, 2))
    times, inputs = np.cumsum(rng.uniform(0.3, 2.0, size=n)), rng.normal(size=(n, 2))
    # Whatever was read, the likelihood is that of the same Gaussian; these are near the driven motion's size.
    readings = 2.0 * rng.normal(size=(n, 2))
    readings[0, 1] = readings[4] = readings[9, 0] = readings[-1, 1] = np.nan
    model = StateSpaceModel(
        LinearDynamics(A, B),
        LinearObservation(H, D),
        WienerIncrement(Dense(Q)),
        AdditiveGaussian(Dense(R)),
        Gaussian(jnp.asarray(m0), jnp.asarray(P0)),
    )
    spans = intervals_between(jnp.asarray(times), jnp.asarray(inputs))
    instants = Instant(jnp.asarray(times), jnp.asarray(inputs))
    other = KalmanSmoother(2, 3, design=H, transition=A, selection=np.eye(3), obs_cov=R)
    other.bind(readings)  # before what varies in time
    other["state_cov"] = Q[:, :, None] * np.diff(times, append=times[-1] + 1.0)
    other["state_intercept"], other["obs_intercept"] = B @ inputs.T, D @ inputs.T
    other.initialize_known(m0, P0)
    other.tolerance = 0.0  # no step is skipped as if the filter had settled
    return (model, jnp.asarray(readings), spans, instants), other.smooth(), ~np.isnan(readings)


def test_the_linear_filter_is_statsmodels():
    """On a driven linear model with missing readings the score, its parts and innovations equal statsmodels'."""
    problem, expected, seen = driven_linear_model()
    for filtered in (jax.jit(kalman_filter)(*problem), HISTORY(*problem)):
        # The tolerance; both are double precision on a well-conditioned model.
        assert float(filtered.log_likelihood) == pytest.approx(expected.llf, rel=1e-10)
        np.testing.assert_allclose(filtered.increments, expected.llf_obs, atol=1e-10)
        np.testing.assert_allclose(filtered.innovations[seen], expected.forecasts_error.T[seen], atol=1e-10)
        standardised = expected.standardized_forecasts_error.T
        np.testing.assert_allclose(filtered.standardised_innovations[seen], standardised[seen], atol=1e-10)


def test_the_linear_smoother_is_statsmodels():
    """On the same model smoothed states, disturbances and residuals, with covariances, equal statsmodels'."""
    (model, readings, spans, instants), expected, seen = driven_linear_model()
    found = SMOOTHED(model, HISTORY(model, readings, spans, instants), spans, instants)
    Q = np.moveaxis(expected.model["state_cov"], -1, 0)[:-1]
    xi, xi_covariances = (
        expected.smoothed_state_disturbance.T[:-1],
        by_time(expected.smoothed_state_disturbance_cov)[:-1],
    )
    spread = np.diagonal(Q - xi_covariances, axis1=1, axis2=2)
    for mine, theirs in [
        (found.means, expected.smoothed_state.T),
        (found.covariances, by_time(expected.smoothed_state_cov)),
        (found.disturbances, xi),
        (found.disturbance_covariances, xi_covariances),
        (found.standardised_disturbances, xi / np.sqrt(spread)),
        (found.residuals[seen], expected.smoothed_measurement_disturbance.T[seen]),
        (
            found.residual_covariances[seen.all(axis=1)],
            by_time(expected.smoothed_measurement_disturbance_cov)[seen.all(axis=1)],
        ),
    ]:
        # Numbers of size one in double precision, through 25 steps forward and 25 back.
        np.testing.assert_allclose(mine, theirs, atol=1e-10)


def by_time(array):
    """statsmodels keeps time last."""
    return np.moveaxis(array, -1, 0)
