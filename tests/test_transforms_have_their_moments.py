"""Each transform gives the moments it claims: exact to its degree, sums of squares, and one interface for all."""

from typing import Any

import equinox as eqx
import estimation_cases as cases
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from symplearn._errors import InputError
from symplearn._filter import kalman_filter, log_likelihood
from symplearn._model import (
    AbstractAffine,
    Coordinates,
    FullState,
    Gaussian,
    LinearDynamics,
    LinearObservation,
    StateSpaceModel,
    intervals_between,
)
from symplearn._noise import AdditiveGaussian, Dense
from symplearn._transforms import Cubature, GaussHermite, Taylor, UnscentedTransform

TRANSFORMS = [UnscentedTransform(), UnscentedTransform(1e-3), Cubature(), GaussHermite(3), Taylor()]
MEAN = np.array([0.4, -0.7, 1.1])
ROOT = np.array([[0.5, 0.0, 0.0], [0.2, 0.3, 0.0], [-0.1, 0.1, 0.4]])
COVARIANCE = ROOT @ ROOT.T
N = 8
SPANS = intervals_between(jnp.arange(float(N)))


def moments(transform, function):
    return transform(function, jnp.asarray(MEAN), jnp.asarray(ROOT))


def cross(found):
    return np.asarray(found.source @ found.factor.T)


@pytest.mark.parametrize("transform", TRANSFORMS, ids=str)
def test_affine_functions_are_exact(transform):
    """Mean, covariance and cross-covariance of A x + b are A m + b, A P A' and P A'."""
    A, b = np.array([[1.0, 2.0, -1.0], [0.3, 0.0, 0.5]]), np.array([0.1, -3.0])
    found = moments(transform, lambda x: jnp.asarray(A) @ x + jnp.asarray(b))
    # At alpha = 1e-3 differences of about 1e-3 lose four of sixteen digits.
    tolerance = 1e-10 if transform == UnscentedTransform(1e-3) else 1e-13
    np.testing.assert_allclose(found.mean, A @ MEAN + b, atol=tolerance)
    np.testing.assert_allclose(found.covariance, A @ COVARIANCE @ A.T, atol=tolerance)
    np.testing.assert_allclose(cross(found), COVARIANCE @ A.T, atol=tolerance)
    np.testing.assert_allclose(found.source @ found.source.T, COVARIANCE, atol=1e-14)


@pytest.mark.parametrize("transform", [t for t in TRANSFORMS if not isinstance(t, Taylor)], ids=str)
def test_means_of_quadratics_are_exact(transform):
    """E[x' M x] = m' M m + tr(M P), by every transform but the first-order one."""
    M = np.array([[1.0, 0.3, 0.0], [0.3, -2.0, 0.5], [0.0, 0.5, 0.7]])
    found = moments(transform, lambda x: jnp.array([x @ jnp.asarray(M) @ x]))
    # At alpha = 1e-3 second differences of 1e-6 leave ten of sixteen digits.
    tolerance = 1e-8 if transform == UnscentedTransform(1e-3) else 1e-13
    np.testing.assert_allclose(found.mean[0], MEAN @ M @ MEAN + np.trace(M @ COVARIANCE), atol=tolerance)


def test_gauss_hermite_is_exact_to_its_degree():
    """Order 4 gives the variance of x^3 exactly (degree 6), order 3 does not; E and Cov as in closed form."""
    transform, m, s = GaussHermite(4), 0.3, 0.8
    found = transform(lambda x: x**3, jnp.array([m]), jnp.array([[s]]))
    mean = m**3 + 3 * m * s**2
    sixth = m**6 + 15 * m**4 * s**2 + 45 * m**2 * s**4 + 15 * s**6
    fourth = m**4 + 6 * m**2 * s**2 + 3 * s**4
    np.testing.assert_allclose(found.mean[0], mean, rtol=1e-13)
    np.testing.assert_allclose(found.covariance[0, 0], sixth - mean**2, rtol=1e-12)
    np.testing.assert_allclose(cross(found)[0, 0], fourth - m * mean, rtol=1e-12)
    low = GaussHermite(3)(lambda x: x**3, jnp.array([m]), jnp.array([[s]]))
    assert abs(float(low.covariance[0, 0]) - (sixth - mean**2)) > 0.01


def test_transforms_approach_the_moments_of_a_sine():
    """E[sin x] = exp(-P/2) sin m: Gauss-Hermite to 1e-10 at order 12, the others to the orders of their expansions."""
    truth = np.exp(-0.5 * np.diagonal(COVARIANCE)) * np.sin(MEAN)
    errors = {str(t): np.abs(moments(t, jnp.sin).mean - truth).max() for t in (GaussHermite(12), *TRANSFORMS)}
    assert errors[str(GaussHermite(12))] < 1e-10
    assert errors[str(UnscentedTransform())] < 0.2 * errors[str(Taylor())]
    assert errors[str(Cubature())] < 0.2 * errors[str(Taylor())]


def test_cubature_is_unscented():
    """Cubature is the textbook unscented transform at (1, 0, 0), where the centre weighs nothing."""

    def f(x):
        return np.array([np.sin(x[0]) + x[1] ** 2, x[2] * x[1]])

    points = np.vstack([MEAN + np.sqrt(3) * ROOT.T, MEAN - np.sqrt(3) * ROOT.T])
    values = np.array([f(x) for x in points])
    mean = values.mean(axis=0)
    found = moments(Cubature(), lambda x: jnp.array([jnp.sin(x[0]) + x[1] ** 2, x[2] * x[1]]))
    np.testing.assert_allclose(found.mean, mean, rtol=1e-13)
    np.testing.assert_allclose(found.covariance, (values - mean).T @ (values - mean) / 6, rtol=1e-12)
    np.testing.assert_allclose(cross(found), (points - MEAN).T @ (values - mean) / 6, rtol=1e-12)


def step(x):
    return np.array([x[0] + 0.3 * x[1], x[1] - 0.3 * np.sin(x[0])])


class Step(eqx.Module):
    """The same pendulum step for the model."""

    def __call__(self, x, interval):
        return jnp.array([x[0] + 0.3 * x[1], x[1] - 0.3 * jnp.sin(x[0])])


class Projected(eqx.Module):
    """The pendulum's bob, seen from the side."""

    def __call__(self, x, context):
        return jnp.sin(x[:1])


def pendulum(observation):
    noises = AdditiveGaussian(Dense(1e-3 * jnp.eye(2))), AdditiveGaussian(Dense(0.01 * jnp.eye(1)))
    return StateSpaceModel(Step(), observation, *noises, Gaussian(jnp.array([1.0, 0.0]), 0.1 * jnp.eye(2)))


def readings():
    x, rng, rows = np.array([1.1, 0.1]), np.random.default_rng(0), []
    for _ in range(N):
        rows.append(np.sin(x[:1]) + 0.1 * rng.normal(size=1))
        x = step(x)
    return np.array(rows)


def test_taylor_is_the_extended_kalman_filter():
    """The likelihood is that of the textbook extended filter, its Jacobians written out."""
    ys, m, P, total = readings(), np.array([1.0, 0.0]), 0.1 * np.eye(2), 0.0
    for k, y in enumerate(ys):
        if k > 0:
            F = np.array([[1.0, 0.3], [-0.3 * np.cos(m[0]), 1.0]])
            m, P = step(m), F @ P @ F.T + 1e-3 * np.eye(2)
        H = np.array([[np.cos(m[0]), 0.0]])
        S, r = H @ P @ H.T + 0.01, y - np.sin(m[0])
        K = P @ H.T / S
        total += -0.5 * float(r[0] ** 2 / S[0, 0] + np.log(2 * np.pi * S[0, 0]))
        m, P = m + (K @ r), P - K @ S @ K.T
    assert float(log_likelihood(pendulum(Projected()), jnp.asarray(ys), SPANS, None, Taylor())) == pytest.approx(
        total, abs=1e-11
    )


class Nudged(eqx.Module):
    """A linear reading that does not say so, and is therefore sampled."""

    def __call__(self, x, context):
        return x[:1]


def test_a_linear_reading_is_exact_whatever_the_transform():
    """With alpha = 1e-3 a reading declared affine loses no digits; the same reading undeclared loses several."""
    ys, rough = jnp.asarray(readings()), UnscentedTransform(1e-3)
    one = float(log_likelihood(pendulum(Coordinates((0,))), ys, SPANS, None, rough))
    other = float(log_likelihood(pendulum(Nudged()), ys, SPANS, None, rough))
    assert one == pytest.approx(other, abs=1e-6) and one != other
    for affine in (LinearObservation(jnp.eye(1, 2)), OwnReading(jnp.eye(1, 2))):
        assert float(log_likelihood(pendulum(affine), ys, SPANS, None, rough)) == pytest.approx(one, abs=1e-13)


class OwnReading(AbstractAffine):
    """A user's affine reading."""

    matrix: Any

    def slope(self, x):
        return self.matrix

    def __call__(self, x, context=None):
        return self.matrix @ x


def test_the_kalman_filter_is_the_textbook_s():
    """`kalman_filter` has the likelihood and the last moments of the textbook filter, with inputs left at zero."""
    A, H, Q, R, m0, P0 = system = cases.linear_system()
    _, ys, _, _ = cases.simulate(*system, N, np.random.default_rng(0))
    total, m, P = cases.kalman_log_likelihood(*system, ys)
    parts = LinearDynamics(jnp.asarray(A)), LinearObservation(jnp.asarray(H))
    noises = AdditiveGaussian(Dense(Q)), AdditiveGaussian(Dense(R))
    found = kalman_filter(StateSpaceModel(*parts, *noises, Gaussian(m0, P0)), jnp.asarray(ys), SPANS)
    assert float(found.log_likelihood) == pytest.approx(total, abs=1e-12)
    np.testing.assert_allclose(found.filtered_means[-1], m, atol=1e-13)
    np.testing.assert_allclose(found.filtered_covariances[-1], P, atol=1e-13)


def test_what_cannot_be_done_is_refused():
    """A Kalman filter of a nonlinear model, a grid of millions of points and orders below 2 are named."""
    with pytest.raises(InputError, match="the dynamics is `Step`"):
        kalman_filter(pendulum(FullState()), jnp.zeros((N, 2)), SPANS)
    with pytest.raises(ValueError, match="takes 5\\^8 points in 8 dimensions"):
        GaussHermite(5)(jnp.sin, jnp.zeros(8), jnp.eye(8))
    with pytest.raises(InputError, match="`order` of at least 2"):
        GaussHermite(1)


@pytest.mark.slow
def test_derivatives_pass_through_every_transform():
    """The likelihood's gradient agrees with central differences under each transform."""
    ys = jnp.asarray(readings())

    def score(vector, transform):
        model = eqx.tree_at(lambda m: m.initial.mean, pendulum(Projected()), vector)
        return log_likelihood(model, ys, SPANS, None, transform)

    for transform in (Cubature(), GaussHermite(3), Taylor()):
        run = jax.jit(lambda v, transform=transform: jax.value_and_grad(score)(v, transform))
        at = jnp.array([1.0, 0.2])
        slopes = [(run(at + e)[0] - run(at - e)[0]) / 2e-5 for e in 1e-5 * jnp.eye(2)]
        # Step 1e-5: truncation 1e-10, round-off 1e-15 * 10 / 1e-5.
        np.testing.assert_allclose(run(at)[1], slopes, rtol=1e-6)
