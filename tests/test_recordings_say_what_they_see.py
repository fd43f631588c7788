"""Profile likelihood and information tell which numbers a recording sees, and how well."""

import jax.numpy as jnp
import numpy as np
import pytest

from symplearn._errors import InputError
from symplearn._fit import fit
from symplearn._information import information
from symplearn._model import FullState, Gaussian, LinearDynamics, StateSpaceModel
from symplearn._noise import AdditiveGaussian, ScaledIdentity
from symplearn._objectives import TimeSeries
from symplearn._parameters import Frozen, Positive
from symplearn._prior import HalfNormal, Normal, Prior
from symplearn._profile_likelihood import DROP, profile_likelihood
from symplearn._trajectory_objectives import PropagatorLeastSquares

VARIANCE = 0.04
A = np.array([[0.8, 0.3], [-0.2, 0.6]])


def readings(still=False, n=40):
    """x' = A x + w, read exactly; or with a second coordinate that never moves from 0."""
    rng, xs = np.random.default_rng(3), [np.array([1.0, 0.0 if still else 1.0])]
    for _ in range(n):
        x = A @ xs[-1] + np.sqrt(VARIANCE) * rng.normal(size=2)
        xs.append(x * [1.0, 0.0] if still else x)
    return np.array(xs)


def fitted(xs, variance=VARIANCE):
    noises = AdditiveGaussian(ScaledIdentity(variance, 2)), AdditiveGaussian(ScaledIdentity(1e-9, 2))
    model = StateSpaceModel(LinearDynamics(jnp.zeros((2, 2))), FullState(), *noises)
    prior = {"dynamics": Normal(0.0, 1.0)}
    if isinstance(variance, Positive):
        prior["process_noise"] = HalfNormal(1.0)
    series = TimeSeries(np.arange(len(xs), dtype=float), xs)
    return fit(model, series, PropagatorLeastSquares(), prior=Prior(prior))


@pytest.fixture(scope="module")
def moving():
    return fitted(readings())


def test_the_profile_of_a_regression_is_a_parabola(moving):
    """The drop is (a - a_hat)^2 / (2 s^2 [(X'X)^-1]_jj), and the interval a_hat +- 1.96 standard errors.

    The prior, which is in the estimate, is not in the profile.
    """
    xs = readings()
    X, Y = xs[:-1], xs[1:]
    best = np.linalg.lstsq(X, Y, rcond=None)[0].T
    error = np.sqrt(VARIANCE * np.linalg.inv(X.T @ X)[1, 1])
    profile = profile_likelihood(moving, "dynamics.A[0,1]")
    # Each lane ends where 1e-4 nats are promised.
    near = profile.drop < 20
    expected = (profile.values - best[0, 1]) ** 2 / (2 * error**2)
    np.testing.assert_allclose(profile.drop[near], expected[near], atol=1e-3)
    assert profile.settled.all() and profile.identifiable
    half = np.sqrt(2 * DROP) * error
    np.testing.assert_allclose([profile.lower, profile.upper], best[0, 1] + [-half, half], atol=1e-2 * error)


@pytest.mark.slow
def test_a_variance_that_is_too_small_to_see_is_bounded_from_above_only():
    """Of process noise hidden under measurement noise only an upper bound is told; the measurement noise is bounded."""
    c, s = np.cos(0.3), np.sin(0.3)
    turn, xs = np.array([[c, s], [-s, c]]), [np.array([1.0, 0.0])]
    for _ in range(29):
        xs.append(turn @ xs[-1])
    model = StateSpaceModel(
        LinearDynamics(Frozen(turn)),
        FullState(),
        AdditiveGaussian(ScaledIdentity(Positive(1e-3), 2)),
        AdditiveGaussian(ScaledIdentity(Positive(1e-2), 2)),
        Gaussian(xs[0], 1e-8 * np.eye(2)),
    )
    noise = 0.1 * np.random.default_rng(1).normal(size=(30, 2))
    estimate = fit(model, TimeSeries(np.arange(30.0), np.array(xs) + noise), prior=Prior(HalfNormal(1.0)))
    hidden = profile_likelihood(estimate, "process_noise.structure.variance")
    assert hidden.lower is None and 0.0 < hidden.upper < 0.01 and "NOT bounded from below" in str(hidden)
    seen = profile_likelihood(estimate, "measurement_noise.structure.variance")
    # Without process noise the mean square of the noise is the likelihood's own estimate.
    assert seen.identifiable and seen.lower < np.mean(noise**2) < seen.upper
    assert information(estimate).unseen in ((), ("process_noise.structure.variance",))


def test_the_information_is_that_of_the_regression(moving):
    """For known noise the Hessian is X'X / s^2 for each row, here in units of the prior's deviation of 1."""
    xs = readings()
    eigenvalues = np.linalg.eigvalsh(xs[:-1].T @ xs[:-1] / VARIANCE)
    found = information(moving)
    # Central differences of the gradient, to seven digits.
    np.testing.assert_allclose(found.eigenvalues, np.sort(np.tile(eigenvalues, 2))[::-1], rtol=1e-6)
    assert found.unseen == () and "sees 4 of 4" in str(found)


def test_what_the_recording_cannot_see_is_named():
    """A column of A that multiplies a coordinate which never moves is unseen, and nothing else is."""
    found = information(fitted(readings(still=True)))
    assert found.unseen == ("dynamics.A[0,1]", "dynamics.A[1,1]")
    assert "CANNOT see dynamics.A[0,1], dynamics.A[1,1]" in str(found)
    np.testing.assert_allclose(found.left[[1, 3]], 1.0, rtol=1e-6)


@pytest.mark.parametrize("label", ["dynamics.B", "dynamics.A", "", "dynamics.A[2,0]"])
def test_an_unknown_number_is_refused(moving, label):
    """A name that the model does not learn is refused with the names that it does."""
    with pytest.raises(InputError, match=r"learns dynamics.A\[0,0\]"):
        profile_likelihood(moving, label)
