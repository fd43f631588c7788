"""Along its noises a posterior is a funnel; samplers walk in coordinates in which it is straight."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import softmax

from symplearn._arviz import arviz
from symplearn._dram import DRAM, blocks_of
from symplearn._fit import fit
from symplearn._funnel import Straightened, bent_back, funnel_of
from symplearn._importance import AdaptiveImportance, kish
from symplearn._model import FullState, Gaussian, LinearDynamics, StateSpaceModel
from symplearn._noise import AdditiveGaussian, Diagonal, ScaledIdentity
from symplearn._objectives import TimeSeries
from symplearn._parameters import Frozen, Learnt, Positive, flatten
from symplearn._posterior import log_posterior_of
from symplearn._prior import HalfNormal, Normal, Prior
from symplearn._sample import sample
from symplearn._sampler import Drawn
from symplearn._whitening import whiten

COUNT, READ, SPREAD = 12, 1e-3, 2.0
READINGS = 0.7 + 0.05 * np.random.default_rng(3).normal(size=COUNT)
PRIOR = Prior({"initial": Normal(0.0, SPREAD**2), "process_noise": HalfNormal(1.0)})


def estimate_of(noise, prior=PRIOR):
    """A random walk from an unknown mean, read with a known noise."""
    model = StateSpaceModel(
        dynamics=LinearDynamics(Frozen(np.eye(1))),
        observation=FullState(),
        process_noise=AdditiveGaussian(noise),
        measurement_noise=AdditiveGaussian(ScaledIdentity(Frozen(READ), 1)),
        initial=Gaussian(Learnt(jnp.zeros(1)), Frozen(1e-6 * np.eye(1))),
    )
    return fit(model, TimeSeries(np.arange(float(COUNT)), READINGS[:, None]), prior=prior)


@pytest.fixture(scope="module")
def walk():
    """The estimate of the walk's mean and of its one variance, and its funnel."""
    estimate = estimate_of(ScaledIdentity(Positive(1e-3), 1))
    density = log_posterior_of(estimate)
    return estimate, eqx.filter_jit(density), funnel_of(estimate, density)


def textbook(variance):
    """Mean and variance of the walk's start given its process noise, and the log evidence, from the joint normal."""
    order = np.minimum.outer(np.arange(COUNT), np.arange(COUNT))
    covariance = READ * np.eye(COUNT) + 1e-6 + variance * order
    weights = np.linalg.solve(covariance, np.ones(COUNT))
    precision = weights.sum() + 1 / SPREAD**2
    of_all = covariance + SPREAD**2
    norm = np.linalg.slogdet(2 * np.pi * of_all)[1]
    evidence = -0.5 * (READINGS @ np.linalg.solve(of_all, READINGS) + norm)
    return weights @ READINGS / precision, 1 / precision, evidence


def places(estimate):
    """Where the logarithm of the variance and the mean are in the vector of free coordinates."""
    vector = np.asarray(flatten(estimate.model)[0])
    log_variance = np.log(float(estimate.values()["process_noise.structure.variance"]))
    k = int(np.argmin(np.abs(vector - log_variance)))
    return k, 1 - k


def test_levels_are_the_conditional_posteriors(walk):
    """At each level the mean and the spread are those of the conditional normal posterior of the textbook."""
    _, _, funnel = walk
    real = np.concatenate([[True], np.any(np.diff(np.asarray(funnel.roots), axis=0) != 0, axis=(1, 2))])
    assert real.sum() > 5
    for s, mean, root in zip(
        *(np.asarray(one)[real] for one in (funnel.levels, funnel.means, funnel.roots)), strict=True
    ):
        exact_mean, exact_variance, _ = textbook(np.exp(s))
        # Derivatives by differences, to about 1e-4; one step of Newton's method meets a normal's mean as exactly.
        np.testing.assert_allclose(root[0, 0] ** 2, exact_variance, rtol=1e-3)
        assert abs(mean[0] - exact_mean) < 0.01 * exact_variance**0.5


def test_volume_is_the_jacobians(walk):
    """log_volume is log |det d free / d straight|, between levels, beyond the last, and where widths grow no more."""
    _, density, funnel = walk
    jacobian = jax.jit(jax.jacfwd(funnel.free))
    for straight in jnp.array([[-9.0, 0.7], [-2.0, 8.0], [-0.4321, -1.5], [0.0, -7.0], [1.5, 0.7], [7.0, 0.1]]):
        exact = np.linalg.slogdet(np.asarray(jacobian(straight)))[1]
        # Both are sums of logarithms of order 10: round-off.
        np.testing.assert_allclose(float(funnel.log_volume(straight)), exact, atol=1e-12)
        expected = density(funnel.free(straight)) + exact
        np.testing.assert_allclose(float(Straightened(density, funnel)(straight)), float(expected), rtol=1e-12)


def test_draws_come_back(walk):
    """Draws in straight coordinates come back in free ones, with the log density that is there."""
    _, density, funnel = walk
    straight = jax.random.normal(jax.random.key(0), (2, 3, 2))
    there = jax.jit(jax.vmap(jax.vmap(Straightened(density, funnel))))(straight)
    back = bent_back(Drawn(straight, there, evaluations=0), funnel)
    for chain in range(2):
        for draw in range(3):
            free = funnel.free(straight[chain, draw])
            # The same arithmetic in a batch: round-off, of log densities of order 100 times more.
            np.testing.assert_allclose(back.free[chain, draw], free, rtol=1e-13)
            np.testing.assert_allclose(back.log_density[chain, draw], density(free), atol=1e-10)


def test_posterior_is_that_of_quadrature(walk):
    """Variance and mean of the walk, and the evidence, are those of an integral over the variance."""
    estimate, _, _ = walk
    posterior = sample(estimate, sampler=AdaptiveImportance(batch=500, target=1500), key=jax.random.key(1))
    assert posterior.converged, str(posterior)
    grid = np.linspace(np.log(1e-12), np.log(10.0), 4001)
    means, variances, evidence = np.array([textbook(np.exp(s)) for s in grid]).T
    log_prior = np.log(2 / np.sqrt(2 * np.pi)) - 0.5 * np.exp(2 * grid) + grid  # half-normal, per unit of log variance
    mass = softmax(evidence + log_prior)
    exact = np.log(np.sum(np.exp(evidence + log_prior - evidence.max()))) + evidence.max() + np.log(grid[1] - grid[0])
    assert abs(posterior.log_evidence - exact) < 3 * posterior.log_evidence_sd < 0.3
    k, other = places(estimate)
    draws = np.asarray(posterior.free)
    for found, right in (
        (draws[..., k], mass @ grid),
        (np.exp(draws[..., k]), mass @ np.exp(grid)),
        (draws[..., other], mass @ means),
        (draws[..., other] ** 2, mass @ (variances + means**2)),
    ):
        assert abs(found.mean() - right) < 3 * float(arviz().mcse(np.ascontiguousarray(found)))


CHANNELS = 4


@pytest.fixture(scope="module")
def walks():
    """Four walks side by side from unknown means, both of whose noises learn, and the logarithms of both variances of
    the posterior on a grid, with its mass: each mean is integrated by the textbook's formula."""
    random = np.random.default_rng(5)
    readings = random.normal(size=CHANNELS) + 0.1 * random.normal(size=(COUNT, CHANNELS))
    model = StateSpaceModel(
        dynamics=LinearDynamics(Frozen(np.eye(CHANNELS))),
        observation=FullState(),
        process_noise=AdditiveGaussian(ScaledIdentity(Positive(1e-3), CHANNELS)),
        measurement_noise=AdditiveGaussian(ScaledIdentity(Positive(1e-2), CHANNELS)),
        initial=Gaussian(Learnt(jnp.zeros(CHANNELS)), Frozen(1e-6 * np.eye(CHANNELS))),
    )
    prior = Prior(PRIOR.densities | {"measurement_noise": HalfNormal(1.0)})
    estimate = fit(model, TimeSeries(np.arange(float(COUNT)), readings), prior=prior)
    grids = np.meshgrid(np.linspace(-18.0, -2.0, 81), np.linspace(-8.0, -2.0, 61), indexing="ij")
    log_mass = sum(np.log(2 / np.sqrt(2 * np.pi)) - 0.5 * np.exp(2 * one) + one for one in grids)
    order = np.minimum.outer(np.arange(COUNT), np.arange(COUNT))
    process, measurement = (np.exp(one)[..., None, None] for one in grids)
    of_all = measurement * np.eye(COUNT) + 1e-6 + process * order + SPREAD**2
    solved = np.linalg.solve(of_all, np.broadcast_to(readings, (*of_all.shape[:2], COUNT, CHANNELS)))
    squares = np.sum(readings * solved, axis=(-2, -1))
    log_mass += -0.5 * (squares + CHANNELS * np.linalg.slogdet(2 * np.pi * of_all)[1])
    return estimate, grids, log_mass + np.log(0.2 * 0.1)


@pytest.mark.slow
def test_both_noises_posterior_is_that_of_quadrature(walks):
    """With both noises to learn, their logarithms' means and spreads, and the evidence, are those of quadrature."""
    estimate, grids, log_mass = walks
    posterior = sample(estimate, sampler=AdaptiveImportance(batch=500, target=1500), key=jax.random.key(3))
    assert posterior.converged, str(posterior)
    exact = np.log(np.sum(np.exp(log_mass - log_mass.max()))) + log_mass.max()
    assert abs(posterior.log_evidence - exact) < 3 * posterior.log_evidence_sd < 0.3
    mass = softmax(log_mass)
    for name, grid in zip(("process_noise", "measurement_noise"), grids, strict=True):
        draws = np.log(np.asarray(posterior.values[f"{name}.structure.variance"]))
        for found, right in ((draws, np.sum(mass * grid)), (draws**2, np.sum(mass * grid**2))):
            assert abs(found.mean() - right) < 3 * float(arviz().mcse(np.ascontiguousarray(found)))


@pytest.mark.slow
def test_straight_coordinates_are_standard_normal(walks):
    """Draws of a standard normal, bent back, are worth more than four fifths as many of the posterior; draws of the
    Laplace approximation at the maximum less than a twentieth."""
    estimate, _, _ = walks
    density = log_posterior_of(estimate)
    funnel = funnel_of(estimate, density)
    z = jax.random.normal(jax.random.key(0), (2000, CHANNELS + 2))
    straight = jax.jit(jax.vmap(Straightened(density, funnel)))(z)
    laplace = whiten(density, flatten(estimate.model)[0])
    plain = jax.jit(jax.vmap(density))(laplace.free(z))
    worth, of_laplace = (kish(np.asarray(one + 0.5 * jnp.sum(z**2, axis=1))) / len(z) for one in (straight, plain))
    assert worth > 0.8 and of_laplace < 0.05, (worth, of_laplace)


@pytest.mark.slow
def test_several_variances_move_together():
    """Two process noises: the first straight coordinate is along both of their logarithms, the rest is orthogonal."""
    model = StateSpaceModel(
        dynamics=LinearDynamics(Frozen(np.eye(2))),
        observation=FullState(),
        process_noise=AdditiveGaussian(Diagonal(Positive(np.array([1e-3, 1e-2])))),
        measurement_noise=AdditiveGaussian(ScaledIdentity(Frozen(READ), 2)),
        initial=Gaussian(Learnt(jnp.zeros(2)), Frozen(1e-6 * np.eye(2))),
    )
    readings = np.cumsum(0.05 * np.random.default_rng(1).normal(size=(COUNT, 2)), axis=0)
    estimate = fit(model, TimeSeries(np.arange(float(COUNT)), readings), prior=PRIOR)
    funnel = funnel_of(estimate, log_posterior_of(estimate))
    axes = np.asarray(funnel.axes)
    # Round-off.
    np.testing.assert_allclose(axes.T @ axes, np.eye(4), atol=1e-14)
    assert np.sum(np.isclose(axes[:, 0], 0.5**0.5)) == 2 and np.sum(np.isclose(axes[:, 0], 0.0)) == 2


def test_no_funnel_where_none_can_be():
    """Without a process noise that learns, or with nothing else that does, sampling goes on in free coordinates."""
    known = estimate_of(ScaledIdentity(Frozen(1e-3), 1), Prior(Normal(0.0, SPREAD**2)))
    assert funnel_of(known, log_posterior_of(known)) is None


@pytest.mark.slow
def test_blocks_are_places_of_the_free_vector(walk):
    """`DRAM` with blocks walks in free coordinates: the variance, in no block, never moves."""
    estimate, _, _ = walk
    k, other = places(estimate)
    blocks = blocks_of(estimate.model, "initial")
    assert blocks == ((other,),)
    scout = AdaptiveImportance(batch=200, target=100, rounds=4)
    held = DRAM(blocks=blocks, chains=2, steps=80, thin=1, scout=scout)
    free = np.asarray(sample(estimate, sampler=held, key=jax.random.key(2)).free)
    assert np.ptp(free[..., k]) == 0.0 and np.ptp(free[..., other]) > 0.0
