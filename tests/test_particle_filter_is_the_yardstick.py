"""The particle filter's likelihood is unbiased, so it measures what the Gaussian approximation costs."""

from typing import Any

import equinox as eqx
import estimation_cases as cases
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import integrators as ig
from symplearn import ParticleFault
from symplearn._distributions import DoubleExponential, MultivariateNormal, StudentT, Uniform
from symplearn._errors import InputError
from symplearn._filter import log_likelihood
from symplearn._hidden_markov import HiddenMarkovModel
from symplearn._model import Coordinates, FullState, Gaussian, Propagator, StateSpaceModel, intervals_between
from symplearn._noise import AbstractNoise, Additive, AdditiveGaussian, Dense, Multiplicative, ScaledIdentity
from symplearn._particle_filter import SystematicResampling, particle_filter

N, REPEATS = 10, 200
SPANS = intervals_between(jnp.arange(float(N)))
SCORE = eqx.filter_jit(log_likelihood)


@eqx.filter_jit
def repeated(model, ys, particles=500):
    """The filter under many keys."""
    keys = jax.random.split(jax.random.key(1), REPEATS)
    return jax.vmap(lambda key: particle_filter(model, ys, SPANS, key=key, particles=particles))(keys)


def assert_unbiased(log_likelihoods, exact):
    """The mean likelihood lies within three standard errors of the exact one."""
    ratios = np.exp(np.asarray(log_likelihoods) - exact)
    error = ratios.std() / np.sqrt(REPEATS)
    # An error of a tenth or more would let anything pass.
    assert error < 0.1
    assert abs(ratios.mean() - 1) < 3 * error


def test_on_a_linear_model_it_is_the_kalman_filter_on_average():
    """The likelihood's mean is the Kalman filter's, and so are the moments; readings are missing in part."""
    system = cases.linear_system()
    ys = cases.simulate(*system, N, np.random.default_rng(0))[1]
    ys[3], ys[5, 0] = np.nan, np.nan
    found = repeated(cases.as_model(*system), ys, 1000)
    exact, m, P = cases.kalman_log_likelihood(*system, ys)
    assert not bool(jnp.any(found.fault)) and not bool(jnp.any(found.lost))
    assert_unbiased(found.log_likelihood, exact)
    np.testing.assert_allclose(jnp.sum(found.increments, axis=1), found.log_likelihood, rtol=1e-12)
    means, covariances = np.asarray(found.filtered_means[:, -1]), np.asarray(found.filtered_covariances[:, -1])
    # Four standard errors; weighted means of 1000 particles have a bias of about a thousandth of a deviation besides.
    deviations = np.sqrt(np.diag(P))
    assert np.all(np.abs(means.mean(axis=0) - m) < 4 * means.std(axis=0) / np.sqrt(REPEATS) + 2e-3 * deviations)
    # Their covariances are too small by about the reciprocal of the effective size, some hundreds.
    np.testing.assert_allclose(covariances.mean(axis=0), P, atol=0.02 * P.max())
    # A row without a reading leaves the weights, and so the likelihood, as they are.
    assert not bool(jnp.any(jnp.abs(found.increments[:, 3]) > 1e-12))


class Hill(eqx.Module):
    """x / 2 + 3 x / (1 + x^2), which has two stable states."""

    def __call__(self, x, interval):
        return 0.5 * x + 3 * x / (1 + x**2)


class Bent(eqx.Module):
    """4 + x + x^2 / 10."""

    def __call__(self, x, context=None):
        return 4.0 + x + 0.1 * x**2


GRID = np.linspace(-14.0, 14.0, 2801)
START = scipy.stats.norm(0.5, 1.0).pdf(GRID)
DRIFT = 0.5 * GRID + 3 * GRID / (1 + GRID**2)
SEEN = 4.0 + GRID + 0.1 * GRID**2
MOVES = {
    "student": (Additive(StudentT(0.6, 4.0)), scipy.stats.t(4.0, 0.0, 0.6)),
    "gaussian": (AdditiveGaussian(ScaledIdentity(0.25, 1)), scipy.stats.norm(0.0, 0.5)),
}


def read_through_a_uniform(y, a=0.3, s=0.4):
    """The density of y = h v + eta for uniform v and Gaussian eta: a difference of two normal distributions."""
    lower, upper = (y - (1 + a) * SEEN) / s, (y - (1 - a) * SEEN) / s
    return np.abs(scipy.stats.norm.cdf(upper) - scipy.stats.norm.cdf(lower)) / (2 * a * np.abs(SEEN))


READS = {
    "added": (Additive(DoubleExponential(0.5)), lambda y: scipy.stats.laplace(0.0, 0.5).pdf(y - SEEN)),
    "multiplied and added": (
        Multiplicative(Uniform(0.7, 1.3), AdditiveGaussian(ScaledIdentity(0.16, 1))),
        read_through_a_uniform,
    ),
    "multiplied": (
        Multiplicative(MultivariateNormal([1.0], ScaledIdentity(0.01, 1))),
        lambda y: scipy.stats.norm(1.0, 0.1).pdf(y / SEEN) / np.abs(SEEN),
    ),
}


def hill_readings(seed=2):
    """A recording whose noise is drawn by NumPy."""
    rng, x, ys = np.random.default_rng(seed), 0.8, []
    for _ in range(N):
        ys.append([4.0 + x + 0.1 * x**2 + 0.5 * rng.normal()])
        x = 0.5 * x + 3 * x / (1 + x**2) + 0.5 * rng.normal()
    return jnp.array(ys)


def exact_recursion(ys, move, density):
    """Algorithm 1 on a grid: the log likelihood and the last filtered mean."""
    dx = GRID[1] - GRID[0]
    kernel = move.pdf(GRID[:, None] - DRIFT[None, :]) * dx
    p, total = START, 0.0
    for k, y in enumerate(ys):
        if k > 0:
            p = kernel @ p
        p = density(y[0]) * p
        Z = p.sum() * dx
        total, p = total + np.log(Z), p / Z
    return total, (GRID * p).sum() * dx


# What the Gaussian approximation may cost on ten readings, in nats. Measured over six recordings: -1.56 to -0.16 with
# heavy tails, -0.81 to 0.84 with both noises, -0.67 to -0.03 with a factor alone; on the one below -1.44, 0.69, -0.07.
COSTS = [
    pytest.param("student", "added", 1.6, marks=pytest.mark.slow),
    ("gaussian", "multiplied and added", 0.9),
    ("gaussian", "multiplied", 0.2),
]


@pytest.mark.parametrize(("move", "read", "cost"), COSTS)
def test_it_is_the_exact_recursion_on_average(move, read, cost):
    """Its mean likelihood is that of integration on a grid, whatever the noises; the Gaussian filter is near it."""
    process, law = MOVES[move]
    measurement, density = READS[read]
    ys = hill_readings()
    model = StateSpaceModel(Hill(), Bent(), process, measurement, Gaussian(jnp.array([0.5]), jnp.eye(1)))
    # Halving the grid's spacing moves the log likelihood by less than 1e-6.
    exact, mean = exact_recursion(np.asarray(ys), law, density)
    found = repeated(model, ys)
    assert_unbiased(found.log_likelihood, exact)
    means = np.asarray(found.filtered_means[:, -1, 0])
    # Weighted means have a bias of a few thousandths besides.
    assert abs(means.mean() - mean) < 4 * means.std() / np.sqrt(REPEATS) + 5e-3
    gaussian = float(SCORE(model, ys, SPANS))
    assert abs(gaussian - exact) < cost
    assert abs(mean_likelihood(found.log_likelihood)[0] - exact) < abs(gaussian - exact)


def mean_likelihood(log_likelihoods):
    """The logarithm of the mean likelihood, and its standard error."""
    values = np.asarray(log_likelihoods)
    total = np.logaddexp.reduce(values) - np.log(len(values))
    return total, np.exp(values - total).std() / np.sqrt(len(values))


class Added(eqx.Module):
    """f(x) + w."""

    part: Any

    def __call__(self, x, w, record):
        return self.part(x, record) + w


class LaplaceReading(eqx.Module):
    """The log density of a reading with double exponential noise."""

    def __call__(self, y, x, context):
        return DoubleExponential(0.5).log_density(y - Bent()(x))


def test_the_general_model_weighs_by_its_own_density():
    """A hidden Markov model with the density of its reading gives the state-space model's numbers under one key."""
    initial, ys = Gaussian(jnp.array([0.5]), jnp.eye(1)), hill_readings()
    process = Additive(MultivariateNormal(jnp.zeros(1), ScaledIdentity(0.25, 1)))
    measurement = READS["added"][0]
    model = StateSpaceModel(Hill(), Bent(), process, measurement, initial)
    noises = process.distribution, measurement.distribution
    general = HiddenMarkovModel(Added(Hill()), Added(Bent()), *noises, initial, LaplaceReading())
    ours, theirs = (particle_filter(one, ys, SPANS, key=jax.random.key(3), particles=500) for one in (general, model))
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)
    again = particle_filter(model, ys, SPANS, key=jax.random.key(3), particles=500)
    assert all(bool(jnp.all(a == b)) for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(theirs), strict=True))
    other = particle_filter(model, ys, SPANS, key=jax.random.key(4), particles=500)
    assert float(other.log_likelihood) != float(again.log_likelihood)


def pendulum(shrink):
    """A pendulum read by its angle, all variances divided by `shrink`."""
    dynamics = Propagator(ig.problems.Pendulum(gravity=1.0), ig.Leapfrog(), substeps=5)
    noises = AdditiveGaussian(Dense(0.02 / shrink * np.eye(2))), AdditiveGaussian(ScaledIdentity(0.25 / shrink, 1))
    initial = Gaussian(jnp.array([2.0, 0.0]), 0.3 / shrink * jnp.eye(2))
    return StateSpaceModel(dynamics, Coordinates((0,)), *noises, initial)


def swings(seed, shrink):
    """The same model by NumPy: it starts near the top, where the flow bends most."""
    rng, scale, ys = np.random.default_rng(seed), 1 / np.sqrt(shrink), []
    x = np.array([2.0, 0.0]) + scale * np.array([0.2, 0.3])
    for _ in range(N):
        ys.append(x[:1] + 0.5 * scale * rng.normal(size=1))
        for _ in range(5):
            p = x[1] - 0.1 * np.sin(x[0])
            q = x[0] + 0.2 * p
            x = np.array([q, p - 0.1 * np.sin(q)])
        x = x + np.sqrt(0.02) * scale * rng.normal(size=2)
    return np.array(ys)


def cost_on_the_pendulum(shrink, seed=1):
    ys, model = swings(seed, shrink), pendulum(shrink)
    total, error = mean_likelihood(repeated(model, ys).log_likelihood)
    return float(SCORE(model, ys, SPANS)) - total, error


def test_the_gaussian_approximation_costs_less_as_the_noise_shrinks():
    """On a pendulum the unscented likelihood is tenths of a nat off with large noise, and nears the particles' as the
    noise's standard deviation shrinks, in proportion."""
    # Over eight recordings with large noise it was -0.82 to 0.66 nats off.
    large, _ = cost_on_the_pendulum(1.0)
    assert 0.1 < abs(large) < 1.0
    for shrink in (20.0, 400.0):
        cost, error = cost_on_the_pendulum(shrink)
        # The first correction to a Gaussian is its skewness, of first order in the deviation; the next is of second
        # order, so within 1 / shrink nats. Four standard errors, of about 0.012 nats.
        assert abs(cost - large / np.sqrt(shrink)) < 4 * error + 1 / shrink


@eqx.filter_jit
def line(gain, variance, ys):
    """A walk of one state, x' = gain x + xi, read with noise of a variance."""
    noises = AdditiveGaussian(ScaledIdentity(1.0, 1)), AdditiveGaussian(ScaledIdentity(variance, 1))
    model = StateSpaceModel(cases.Linear(gain), FullState(), *noises, Gaussian(jnp.zeros(1), jnp.eye(1)))
    return particle_filter(model, ys, SPANS, key=jax.random.key(5), particles=64)


@pytest.mark.parametrize(
    ("gain", "variance", "far", "fault", "at"),
    [(1.0, 1.0, 1e9, ParticleFault.WEIGHTLESS, 4), (1e200, 1.0, np.nan, ParticleFault.STATE, 2),
     (1.0, 0.0, 0.0, ParticleFault.DENSITY, 0)],
)  # fmt: skip
def test_weights_that_all_vanish_are_a_value(gain, variance, far, fault, at):
    """No particle near the reading, an escape, or no density: -1e15, the reading and why, and nothing is NaN."""
    ys = np.full((N, 1), np.nan)
    ys[0], ys[4] = 0.0, far
    found = line(jnp.full((1, 1), gain), jnp.asarray(variance), ys)
    assert float(found.log_likelihood) == -1e15 and not bool(found.ok)
    assert int(found.fault) == fault and int(found.fault_step) == at
    assert f"FAILED at reading {at}" in str(found)
    assert all(not np.any(np.isnan(leaf)) for leaf in jax.tree.leaves(found))
    assert float(jnp.sum(found.increments)) == pytest.approx(-1e15)


def test_systematic_resampling_copies_by_weight():
    """A particle of weight w has between floor(n w) and ceil(n w) copies, n w on average, and without weight none."""
    rng = np.random.default_rng(9)
    weights = rng.dirichlet(np.full(40, 0.3))
    weights[[0, 7, 39]] = 0.0
    weights /= weights.sum()
    keys = jax.random.split(jax.random.key(6), 4000)
    chosen = np.asarray(
        jax.jit(jax.vmap(SystematicResampling().ancestors, in_axes=(0, None)))(keys, jnp.asarray(weights))
    )
    copies = np.stack([np.bincount(row, minlength=40) for row in chosen])
    # Round-off of the cumulative sum may move a copy by one in 1e15 draws.
    assert np.all(copies >= np.floor(40 * weights)) and np.all(copies <= np.ceil(40 * weights))
    # Four standard errors of a share of a copy, at most a half.
    np.testing.assert_allclose(copies.mean(axis=0), 40 * weights, atol=4 * 0.5 / np.sqrt(len(keys)))
    with pytest.raises(ValueError, match="share"):
        SystematicResampling(1.5)


class MomentsOnly(AbstractNoise):
    """Noise that says no more than its moments."""

    def enter(self, moments, interval=None):
        return moments


def test_what_has_no_density_is_refused():
    """A noise known by its moments, a general model without a density, and a noise of another size get one sentence."""
    initial = Gaussian(jnp.zeros(1), jnp.eye(1))
    added = AdditiveGaussian(ScaledIdentity(1.0, 1))
    draws = MultivariateNormal(jnp.zeros(1), ScaledIdentity(1.0, 1))

    def refused(model, match, **options):
        with pytest.raises(InputError, match=match):
            particle_filter(model, hill_readings(), SPANS, key=jax.random.key(0), **options)

    refused(StateSpaceModel(Hill(), Bent(), added, MomentsOnly(), initial), "density of a reading")
    refused(StateSpaceModel(Hill(), Bent(), MomentsOnly(), added, initial), "cannot be drawn")
    refused(HiddenMarkovModel(Added(Hill()), Added(Bent()), draws, draws, initial), "log_density_of_reading")
    refused(StateSpaceModel(Hill(), Bent(), added, Additive(Uniform(0.0, 1.0, 3)), initial), "dim=1")
    refused(StateSpaceModel(Hill(), Bent(), added, added), "initial")
    refused(StateSpaceModel(Hill(), Bent(), added, added, initial), "`particles` of at least 2", particles=1)
