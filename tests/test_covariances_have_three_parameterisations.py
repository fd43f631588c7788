"""A covariance may be given by variances, standard deviations or log-variances: one likelihood, three priors."""

import equinox as eqx
import estimation_cases as cases
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize, stats

from symplearn._model import Gaussian, LinearDynamics, LinearObservation, StateSpaceModel
from symplearn._noise import (
    AdditiveGaussian,
    Correlated,
    Dense,
    Diagonal,
    LogVariance,
    ScaledIdentity,
    StandardDeviation,
)
from symplearn._objectives import MARGINAL_LIKELIHOOD, TimeSeries
from symplearn._parameters import Correlation, Frozen, Learnt, Positive, flatten, resolve
from symplearn._prior import Flat, HalfNormal, LogDensity, Normal, Prior

N = 25
A, H, Q, _, M0, P0 = cases.linear_system()
YS = cases.simulate(A, H, Q, 0.2 * np.eye(2), M0, P0, N, np.random.default_rng(3))[1]
SERIES = TimeSeries(jnp.arange(float(N)), jnp.asarray(YS))
WRAPS = {
    "variance": Positive,
    "deviation": lambda v: StandardDeviation(Positive(np.sqrt(v))),
    "logarithm": lambda v: LogVariance(Learnt(np.log(v))),
}
# The free coordinate is log v, log s = (log v) / 2 and log v: its slopes are so many times those by log v.
RATIOS = {"variance": 1.0, "deviation": 2.0, "logarithm": 1.0}
# What a prior is over, as a function of log v, and the logarithm of its derivative.
VALUES = {
    "variance": (np.exp, lambda log_v: log_v),
    "deviation": (lambda log_v: np.exp(log_v / 2), lambda log_v: log_v / 2 - np.log(2)),
    "logarithm": (lambda log_v: log_v, lambda log_v: 0.0),
}


def model(how, v):
    """The linear system with the measurement noise v in each channel, to be learnt."""
    known = LinearDynamics(Frozen(jnp.asarray(A))), LinearObservation(Frozen(jnp.asarray(H)))
    noises = AdditiveGaussian(Dense(Q)), AdditiveGaussian(ScaledIdentity(WRAPS[how](v), dim=2))
    return StateSpaceModel(*known, *noises, Gaussian(jnp.asarray(M0), jnp.asarray(P0)))


@eqx.filter_jit
def likelihood(given):
    """The log likelihood and its slope by the free coordinate."""
    free, rebuild = flatten(given)
    both = jax.jacfwd(lambda free: 2 * (-MARGINAL_LIKELIHOOD(rebuild(free), SERIES),), has_aux=True)
    slope, value = both(free)
    return value, slope[0]


@eqx.filter_jit
def prior_slope(given, prior):
    free, rebuild = flatten(given)
    return jax.grad(lambda free: prior.log_density(rebuild(free)))(free)[0]


def posterior_slope(how, v, density):
    given = model(how, v)
    return float(likelihood(given)[1] + prior_slope(given, Prior(density)))


def textbook(log_v):
    return cases.kalman_log_likelihood(A, H, Q, np.exp(log_v) * np.eye(2), M0, P0, YS)[0]


def textbook_map(log_prior):
    """The log variance of highest likelihood times prior density, by SciPy, to about 1e-7."""

    def score(log_v):
        return -textbook(log_v) - log_prior(log_v)

    return optimize.minimize_scalar(score, bounds=(-6.0, 4.0), method="bounded", options={"xatol": 1e-8}).x


@pytest.mark.parametrize("how", WRAPS)
def test_every_structure_takes_every_parameterisation(how):
    """Scaled identity, diagonal and dense are the matrices of their variances, and `root` a square root of them."""
    wrap, variances = WRAPS[how], np.array([0.3, 2.0])
    correlation = np.array([[1.0, -0.6], [-0.6, 1.0]])
    dense = np.sqrt(np.outer(variances, variances)) * correlation
    for structure, expected in (
        (ScaledIdentity(wrap(0.3), dim=2), 0.3 * np.eye(2)),
        (Diagonal(wrap(variances)), np.diag(variances)),
        (Correlated(wrap(variances), Correlation(correlation)), dense),
        (Correlated(wrap(variances), correlation), dense),
    ):
        plain = resolve(structure)
        # Logarithms and square roots to and fro.
        np.testing.assert_allclose(plain.matrix, expected, rtol=1e-13, atol=1e-15)
        np.testing.assert_allclose(plain.root @ plain.root.T, expected, rtol=1e-13, atol=1e-15)
        assert np.all(np.triu(plain.root, 1) == 0)


@pytest.mark.parametrize("how", WRAPS)
def test_the_likelihood_is_one(how):
    """At the same covariance every parameterisation has the textbook's likelihood, so all have one maximum."""
    for v in (0.05, 0.2, 1.3):
        value, slope = likelihood(model(how, v))
        assert float(value) == pytest.approx(textbook(np.log(v)), rel=1e-12)
        step = 1e-5
        expected = (textbook(np.log(v) + step) - textbook(np.log(v) - step)) / (2 * step)
        # Central differences of numbers of order 100 keep eight digits.
        assert float(slope) == pytest.approx(RATIOS[how] * expected, rel=1e-6, abs=1e-7)
    best = textbook_map(lambda _: 0.0)
    # The slope rises by some ten nats per unit of log v, and the place is known to 1e-7.
    assert abs(likelihood(model(how, np.exp(best)))[1]) < 1e-5
    assert abs(likelihood(model(how, 1.1 * np.exp(best)))[1]) > 0.1


@pytest.mark.parametrize(
    ("density", "oracle"), [(Flat(), lambda _: 0.0), (Normal(0.5, 0.01), stats.norm(0.5, 0.1).logpdf)]
)
def test_a_prior_is_over_what_is_written(density, oracle):
    """One density over a variance, a deviation or a logarithm is three priors, each with its own Jacobian and MAP."""
    found = []
    for how, (value, log_slope) in VALUES.items():
        best = textbook_map(lambda log_v, value=value, add=log_slope: oracle(value(log_v)) + add(log_v))
        # Slopes rise by up to a hundred nats per unit of log v, and the place is known to 1e-7.
        assert abs(posterior_slope(how, np.exp(best), density)) < 1e-4
        found.append(best)
    # With 50 readings a Jacobian moves log v by at least 1 / 100.
    assert min(abs(np.diff([*found, found[0]]))) > 0.01


def test_a_transformed_prior_is_the_same_prior():
    """A half-normal over the variance, written as a density of s or of log v, has the same posterior everywhere."""
    half = HalfNormal(0.04)
    same = {
        "variance": half,
        "deviation": LogDensity(lambda s: half.log_density(s**2) + jnp.log(2 * s)),
        "logarithm": LogDensity(lambda log_v: half.log_density(jnp.exp(log_v)) + log_v),
    }
    for v in (0.05, 0.2, 1.3):
        slopes = [posterior_slope(how, v, density) / RATIOS[how] for how, density in same.items()]
        np.testing.assert_allclose(slopes, slopes[0], rtol=1e-10, atol=1e-10)
    best = textbook_map(lambda log_v: stats.halfnorm(scale=0.2).logpdf(np.exp(log_v)) + log_v)
    # As above.
    assert abs(posterior_slope("variance", np.exp(best), half)) < 1e-4


def test_a_half_normal_is_told_its_variance():
    """half-N(0, 1e-6) over a variance falls as 0.5e6 v^2, as in the dissertation's pendulum; its scale is 1e-3.

    Over a standard deviation the same numbers are another prior: of the variance's root, not of the variance.
    """
    half, v = HalfNormal(1e-6), 2e-3
    assert float(half.log_density(jnp.array(v)) - half.log_density(jnp.array(0.0))) == pytest.approx(-0.5e6 * v**2)
    assert float(half.log_density(jnp.array(v))) == pytest.approx(stats.halfnorm(scale=1e-3).logpdf(v), rel=1e-13)
    # In free coordinates, log v and log s, with their Jacobians v and s.
    over_variance = Prior(half).log_density(model("variance", v))
    over_deviation = Prior(half).log_density(model("deviation", v))
    oracle = stats.halfnorm(scale=1e-3)
    assert float(over_variance) == pytest.approx(oracle.logpdf(v) + np.log(v), rel=1e-12)
    assert float(over_deviation) == pytest.approx(oracle.logpdf(np.sqrt(v)) + np.log(np.sqrt(v)), rel=1e-12)
