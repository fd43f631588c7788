"""A start that is not known is learnt as a parameter or integrated out, and the two agree as probability says."""

import equinox as eqx
import estimation_cases as cases
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import integrators as ig
from symplearn._distributions import MultivariateNormal
from symplearn._log_posterior import negative_log_posterior
from symplearn._model import Coordinates, FullState, Gaussian, LinearDynamics, Propagator, StateSpaceModel
from symplearn._noise import Additive, AdditiveGaussian, Dense, Multiplicative, ScaledIdentity
from symplearn._objectives import MARGINAL_LIKELIHOOD, TimeSeries
from symplearn._parameters import Frozen, Learnt, flatten
from symplearn._prior import Flat, Normal, Prior

A = np.array([[0.9, 0.2], [-0.3, 0.8]])
Q, R = np.diag([0.05, 0.1]), np.diag([0.3, 0.2])
MEAN, SPREAD = np.array([1.0, -0.5]), np.array([0.3, 0.2])
N = 8
YS = cases.simulate(A, np.eye(2), Q, R, MEAN, np.diag(SPREAD), N, np.random.default_rng(5))[1]
SERIES = TimeSeries(jnp.arange(float(N)), jnp.asarray(YS))
NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(40)


def model(initial, observation=None):
    noises = AdditiveGaussian(Dense(Q)), AdditiveGaussian(Dense(R))
    return StateSpaceModel(LinearDynamics(Frozen(jnp.asarray(A))), observation or FullState(), *noises, initial)


SCORE = eqx.filter_jit(MARGINAL_LIKELIHOOD)


@jax.jit
@jax.vmap
def likelihood_from(start):
    """The likelihood of the recording where the state at the first reading is known exactly."""
    return jnp.exp(-MARGINAL_LIKELIHOOD(model(Gaussian(start, jnp.zeros((2, 2)))), SERIES))


def grid(mean, sds):
    """Points and weights of the integral over a normal density with independent entries."""
    first, second = (axis.ravel() for axis in np.meshgrid(NODES, NODES, indexing="ij"))
    points = mean + sds * np.stack([first, second], axis=1)
    return points, np.outer(WEIGHTS, WEIGHTS).ravel() / (2 * np.pi)


def test_a_gaussian_start_is_the_integral_over_known_starts():
    """The marginal likelihood with x_0 ~ N(m, P) is the mean over x_0 of the likelihood from exactly there."""
    points, weights = grid(MEAN, np.sqrt(SPREAD))
    integral = np.log(weights @ likelihood_from(jnp.asarray(points)))
    marginal = -float(SCORE(model(Gaussian(jnp.asarray(MEAN), jnp.diag(SPREAD))), SERIES))
    # 40 Gauss nodes on a Gaussian factor about as narrow as the density they are for.
    assert marginal == pytest.approx(integral, abs=1e-7)
    # From each start the score is the textbook's, so the integral is.
    known = cases.kalman_log_likelihood(A, np.eye(2), Q, R, points[100], np.zeros((2, 2)), YS)[0]
    assert float(jnp.log(likelihood_from(jnp.asarray(points[100:101])))[0]) == pytest.approx(known, rel=1e-11)


def test_no_initial_distribution_is_the_integral_over_all_starts():
    """Without an `initial` the score is that of a flat density over x_0, first reading included."""
    spread = 0.5 * R
    points, weights = grid(YS[0], np.sqrt(np.diag(spread)))
    # Divide by the density that the nodes are drawn for: what is left is the integral over dx_0.
    density = stats.multivariate_normal(YS[0], spread).pdf(points)
    integral = np.log(weights @ (likelihood_from(jnp.asarray(points)) / density))
    # As above.
    assert -float(SCORE(model(None), SERIES)) == pytest.approx(integral, abs=1e-7)


@eqx.filter_jit
def slope(given, prior):
    """The slope of the log posterior along the free coordinates."""
    free, rebuild = flatten(given)
    return -jax.jacfwd(lambda free: negative_log_posterior(rebuild(free), SERIES, MARGINAL_LIKELIHOOD, prior))(free)


def learnt(mean):
    """The start as a parameter: known exactly once its mean is chosen."""
    return model(Gaussian(Learnt(mean), jnp.zeros((2, 2))))


def test_a_learnt_start_ends_at_the_conditional_mean():
    """With a normal prior the MAP of x_0 is its mean given all readings, which a smoother has for x_0 ~ N(m, P)."""
    joint = cases.Conditioned(A, np.eye(2), Q, R, MEAN, np.diag(SPREAD), YS)
    prior = Prior({"initial.mean": Normal(MEAN, SPREAD)})
    at_map = slope(learnt(joint.means[0]), prior)
    # Slopes are sums of terms of order ten.
    np.testing.assert_allclose(at_map, 0.0, atol=1e-11)
    # And the posterior is that Gaussian: one step along a channel costs its precision.
    step = np.array([0.1, 0.0])
    precision = np.linalg.inv(joint.covariances[0])
    np.testing.assert_allclose(slope(learnt(joint.means[0] + step), prior), -precision @ step, atol=1e-11)


def test_a_flat_start_ends_at_least_squares():
    """With a flat prior the MAP of x_0 is the limit of the conditional mean as its prior widens."""
    joint = cases.Conditioned(A, np.eye(2), Q, R, MEAN, 1e6 * np.eye(2), YS)
    # A prior of variance 1e6 pulls with 1e-6 of the precision, over a distance of one.
    np.testing.assert_allclose(slope(learnt(joint.means[0]), Prior(Flat())), 0.0, atol=1e-5)


def swing(start, times):
    """The unit pendulum by two leapfrog steps to each data interval, written out."""
    q, p = start.T
    path = [q]
    for dt in np.repeat(np.diff(times) / 2, 2):
        p = p - 0.5 * dt * np.sin(q)
        q = q + dt * p
        p = p - 0.5 * dt * np.sin(q)
        path.append(q)
    return np.array(path[::2])


def test_a_nonlinear_start_is_learnt_by_its_trajectory():
    """Without process noise the likelihood of a known start is that of its trajectory, whatever the dynamics."""
    times = np.array([0.0, 0.3, 0.5, 1.1, 1.4])
    ys = np.array([[0.9], [0.8], [np.nan], [0.1], [-0.2]])
    start = np.array([1.0, -0.2])
    dynamics = Propagator(ig.problems.Pendulum(Frozen(1.0), Frozen(1.0), Frozen(1.0)), ig.Leapfrog(), substeps=2)
    noises = (AdditiveGaussian(ScaledIdentity(v, dim=d)) for v, d in ((0.0, 2), (0.01, 1)))
    given = StateSpaceModel(dynamics, Coordinates((0,)), *noises, Gaussian(Learnt(start), jnp.zeros((2, 2))))
    residuals = ys[:, 0] - swing(start, times)
    expected = np.nansum(stats.norm(0.0, 0.1).logpdf(residuals))
    found = -SCORE(given, TimeSeries(jnp.asarray(times), jnp.asarray(ys)))
    assert float(found) == pytest.approx(expected, rel=1e-12)


OFFSET, FACTOR, VARIES = np.array([0.5, -0.3]), np.array([2.0, 0.8]), np.diag([0.02, 0.01])
BIASED = Additive(MultivariateNormal(OFFSET, Dense(R)))


@pytest.mark.parametrize(
    ("noise", "factor", "varies"),
    [
        (BIASED, np.ones(2), np.zeros((2, 2))),
        (Multiplicative(MultivariateNormal(FACTOR, Dense(VARIES)), BIASED), FACTOR, VARIES),
    ],
    ids=["added", "multiplied and added"],
)
def test_without_a_start_the_first_reading_is_freed_of_its_noises_mean(noise, factor, varies):
    """Under a flat prior the state given y = w x + eta is (y - E eta) / E w, with the variance of the noise there
    divided by E w E w'."""
    one = eqx.tree_at(lambda m: m.measurement_noise, model(None), noise)
    found = MARGINAL_LIKELIHOOD.filter(one, SERIES)
    state = (YS[0] - OFFSET) / factor
    variance = (np.outer(state, state) * varies + R) / np.outer(factor, factor)
    # Round-off of order one. Seen: 2e-16
    np.testing.assert_allclose(found.filtered_means[0], state, atol=1e-14)
    np.testing.assert_allclose(found.filtered_covariances[0], variance, atol=1e-14)
