"""Noise distributions have the density, the moments and the draws that their names promise."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from symplearn._distributions import (
    DoubleExponential,
    Gamma,
    LogNormal,
    MultivariateNormal,
    StudentT,
    Uniform,
)
from symplearn._errors import InputError
from symplearn._noise import Additive, Dense, Diagonal, Multiplicative, ScaledIdentity
from symplearn._parameters import Bounded, Frozen, Positive, named_parameters, resolve
from symplearn._transforms import Moments

# Two unlike entries each, with SciPy's name for every entry.
PAIRS = {
    "uniform": (
        Uniform([0.9, -2.0], [1.1, 3.0]),
        [scipy.stats.uniform(0.9, 0.2), scipy.stats.uniform(-2.0, 5.0)],
    ),
    "double exponential": (
        DoubleExponential([0.5, 2.0], [0.0, -1.0]),
        [scipy.stats.laplace(0.0, 0.5), scipy.stats.laplace(-1.0, 2.0)],
    ),
    "student": (
        StudentT([0.5, 2.0], [5.0, 2.5], [1.0, 0.0]),
        [scipy.stats.t(5.0, 1.0, 0.5), scipy.stats.t(2.5, 0.0, 2.0)],
    ),
    "gamma": (
        Gamma([100.0, 0.5], [0.01, 2.0]),
        [scipy.stats.gamma(100.0, scale=0.01), scipy.stats.gamma(0.5, scale=2.0)],
    ),
    "log normal": (
        LogNormal([-0.005, 1.0], [0.1, 0.5]),
        [scipy.stats.lognorm(0.1, scale=np.exp(-0.005)), scipy.stats.lognorm(0.5, scale=np.exp(1.0))],
    ),
    "normal": (
        MultivariateNormal([1.0, -2.0], Diagonal([0.04, 9.0])),
        [scipy.stats.norm(1.0, 0.2), scipy.stats.norm(-2.0, 3.0)],
    ),
}
COVARIANCE = np.array([[2.0, 0.6, -0.3], [0.6, 1.0, 0.2], [-0.3, 0.2, 0.5]])
CORRELATED = MultivariateNormal([1.0, 0.0, -1.0], Dense(COVARIANCE))
DRAWS = eqx.filter_jit(lambda distribution, keys: jax.vmap(distribution.sample)(keys))
LOG_DENSITIES = eqx.filter_jit(lambda distribution, values: jax.vmap(distribution.log_density)(values))


@pytest.mark.parametrize("name", PAIRS)
def test_mean_and_variance_are_scipys(name):
    """The mean and the covariance are those of SciPy's distribution, entry by entry."""
    ours, theirs = PAIRS[name]
    np.testing.assert_allclose(ours.mean, [one.mean() for one in theirs], rtol=1e-13, atol=1e-15)
    expected = np.diag([one.var() for one in theirs])
    # SciPy's own variances of the Student and log-normal distributions are sums of a few terms.
    np.testing.assert_allclose(ours.structure.matrix, expected, rtol=1e-12)
    np.testing.assert_allclose(ours.structure.root @ ours.structure.root.T, expected, rtol=1e-12)


@pytest.mark.parametrize("name", PAIRS)
def test_density_is_scipys(name):
    """The log density is the sum of SciPy's over the entries, -inf outside the support included."""
    ours, theirs = PAIRS[name]
    rng = np.random.default_rng(1)
    values = np.concatenate(
        [np.stack([one.rvs(20, random_state=rng) for one in theirs], axis=1), rng.normal(0.0, 6.0, (20, 2))]
    )
    expected = sum(one.logpdf(values[:, i]) for i, one in enumerate(theirs))
    found = LOG_DENSITIES(ours, values)
    # Log gamma functions of 100 are about 360 and keep 13 digits of it.
    np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-11)
    one_alone = ours.log_density(jnp.asarray(values[0]), jnp.array([False, True]))
    assert float(one_alone) == pytest.approx(theirs[1].logpdf(values[0, 1]), rel=1e-11)


@pytest.mark.parametrize("name", PAIRS)
def test_draws_follow_the_distribution(name):
    """20,000 draws pass Kolmogorov's test in each entry, and their entries are uncorrelated."""
    ours, theirs = PAIRS[name]
    draws = np.asarray(DRAWS(ours, jax.random.split(jax.random.key(2), 20_000)))
    for i, one in enumerate(theirs):
        # Twelve tests at a fixed seed: at a level of 1e-4 all pass in 99.9% of seeds.
        assert scipy.stats.kstest(draws[:, i], one.cdf).pvalue > 1e-4
    # Ranks, because the Student entries have no fourth moment; four standard errors.
    assert abs(scipy.stats.spearmanr(draws).statistic) < 4 / np.sqrt(len(draws))


def test_the_correlated_normal_is_scipys():
    """Density, marginal density of any entries and draws of a dense Gaussian are the textbook's."""
    rng = np.random.default_rng(3)
    mean = np.array([1.0, 0.0, -1.0])
    for seen in ([True, True, True], [True, False, True], [False, False, True]):
        value, seen = rng.normal(size=3), np.array(seen)
        expected = scipy.stats.multivariate_normal(mean[seen], COVARIANCE[np.ix_(seen, seen)]).logpdf(value[seen])
        found = CORRELATED.log_density(jnp.where(seen, value, jnp.nan), jnp.asarray(seen))
        assert float(found) == pytest.approx(expected, rel=1e-12)
    draws = np.asarray(DRAWS(CORRELATED, jax.random.split(jax.random.key(4), 20_000)))
    white = np.linalg.solve(np.linalg.cholesky(COVARIANCE), (draws - mean).T)
    for row in white:
        assert scipy.stats.kstest(row, scipy.stats.norm.cdf).pvalue > 1e-4
    # The standard errors of unit variances are sqrt(2 / n), of their covariances sqrt(1 / n).
    np.testing.assert_allclose(white @ white.T / len(draws), np.eye(3), atol=4 * np.sqrt(2 / len(draws)))
    singular = MultivariateNormal(jnp.zeros(2), Dense(np.ones((2, 2))))
    assert np.isnan(float(singular.log_density(jnp.zeros(2))))


def test_numbers_hold_for_every_entry_and_may_learn():
    """One number holds for `dim` entries; parameters learn, and bare and frozen ones are known."""
    factor = Uniform(0.9, Positive(1.1), dim=3)
    np.testing.assert_allclose(resolve(factor).mean, np.ones(3))
    np.testing.assert_allclose(resolve(factor).structure.matrix, 0.1**2 / 3 * np.eye(3), rtol=1e-12)
    assert list(named_parameters(Multiplicative(factor))) == ["factor.upper"]
    tailed = StudentT(Positive([0.1, 0.2]), Bounded(4.0, 2.0, 100.0), Frozen(0.0))
    assert set(named_parameters(Additive(tailed))) == {"distribution.scale", "distribution.dof"}
    # 0.2^2 * 4 / (4 - 2).
    assert float(resolve(tailed).structure.matrix[1, 1]) == pytest.approx(0.08)
    learns = MultivariateNormal(jnp.ones(2), ScaledIdentity(Positive(0.3), 2))
    assert list(named_parameters(Additive(learns))) == ["distribution.covariance.variance"]


def test_the_likelihood_has_slopes_in_a_distributions_numbers():
    """The multiplied variance moves with the factor's half width as a does in a^2 / 3."""

    def variance(a):
        noise = Multiplicative(Uniform(1.0 - a, 1.0 + a))
        return noise.enter(Moments(jnp.array([2.0]), jnp.zeros((1, 1)), jnp.zeros((1, 1)))).covariance[0, 0]

    # 2^2 a^2 / 3.
    assert float(jax.grad(variance)(0.3)) == pytest.approx(4 * 2 * 0.3 / 3, rel=1e-12)


def test_wrong_numbers_are_refused():
    """Bounds the wrong way round, scales and dofs without a variance, and lengths that differ get one sentence."""
    wrong = (
        lambda: Uniform(1.1, 0.9),
        lambda: DoubleExponential(0.0),
        lambda: StudentT(1.0, 2.0),
        lambda: Gamma(-1.0, 1.0),
        lambda: LogNormal(0.0, [1.0, 0.0]),
        lambda: Uniform([0.0, 0.0], [1.0, 1.0, 1.0]),
        lambda: Uniform([0.0, 0.0], 1.0, dim=3),
        lambda: MultivariateNormal(jnp.zeros(2), ScaledIdentity(1.0, 3)),
    )
    for make in wrong:
        with pytest.raises(InputError):
            make()
