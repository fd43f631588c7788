"""Every sampler hits known means, covariances and evidences within Monte Carlo error."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from estimation_cases import linear_system, simulate

from symplearn._arviz import arviz
from symplearn._dram import DRAM, blocks_of
from symplearn._errors import InputError
from symplearn._fit import Estimate, fit
from symplearn._importance import AdaptiveImportance
from symplearn._mclmc import MCLMC
from symplearn._model import Gaussian, LinearDynamics, LinearObservation, StateSpaceModel
from symplearn._noise import AdditiveGaussian, Dense
from symplearn._nuts import NUTS
from symplearn._objectives import TimeSeries
from symplearn._parameters import Frozen, Learnt
from symplearn._prior import Normal, Prior
from symplearn._random_walk import RandomWalk
from symplearn._sample import sample, sample_density
from symplearn._tempered_smc import TemperedSMC

SCOUT = AdaptiveImportance(batch=200, target=200, rounds=8)
SAMPLERS = [
    AdaptiveImportance(batch=500, target=1500),
    RandomWalk(chains=16, steps=3000, thin=3, scout=SCOUT),
    NUTS(chains=4, draws=800, warm_up=300, doublings=6, scout=SCOUT),
    DRAM(chains=8, steps=3000, thin=3, shrinkage=0.25, scout=SCOUT),
    DRAM(blocks=((0,), (1,)), chains=8, steps=4000, thin=4, shrinkage=0.25, scout=SCOUT),
    MCLMC(chains=8, draws=1000, scout=SCOUT),
    TemperedSMC(length=8, thin=2),
]
NAMES = ["importance", "random walk", "NUTS", "DRAM", "DRAM within Gibbs", "MCLMC", "tempered SMC"]


class Bent(eqx.Module):
    """x0 ~ N(0, 1) and x1 ~ N(slope x0 + bend (x0^2 - 1), sd^2) given x0."""

    slope: jax.Array
    bend: jax.Array
    sd: jax.Array

    def __call__(self, x):
        return -0.5 * (x[0] ** 2 + ((x[1] - self.slope * x[0] - self.bend * (x[0] ** 2 - 1)) / self.sd) ** 2)


TARGETS = {
    "standard normal": (0.0, 0.0, 1.0),
    "normal of correlation 0.8": (0.8, 0.0, 0.6),
    "banana": (0.0, 0.5, 1.0),
}


def off_by(draws, exact):
    """How many Monte Carlo standard errors, by ArviZ, the mean of draws (chain, draw) is from the exact one."""
    return abs(draws.mean() - exact) / float(arviz().mcse(np.ascontiguousarray(draws)))


@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.parametrize("sampler", SAMPLERS, ids=NAMES)
def test_moments_of_three_densities(sampler, target):
    """Means, variances and the covariance of three densities are right to within Monte Carlo error."""
    slope, bend, sd = TARGETS[target]
    density = Bent(*map(jnp.asarray, TARGETS[target]))
    # Started off the mode and with the wrong curvature.
    posterior = sample_density(density, [0.5, -0.5], sampler=sampler, key=jax.random.key(4))
    assert posterior.converged, str(posterior)
    x, y = np.moveaxis(np.asarray(posterior.values["x"]), 2, 0)
    exact = [(x, 0.0), (y, 0.0), (x**2, 1.0), (y**2, slope**2 + 2 * bend**2 + sd**2), (x * y, slope)]
    # One of these 105 comparisons is beyond 3 standard errors by chance in a run of four, beyond 3.5 in one of twenty.
    assert max(off_by(draws, value) for draws, value in exact) < 3.5
    if posterior.log_evidence is not None:
        assert abs(posterior.log_evidence - math.log(2 * math.pi * sd)) < 3 * posterior.log_evidence_sd


@pytest.fixture(scope="module")
def conjugate():
    """A linear model whose initial mean learns: its estimate, and the closed form of its posterior."""
    A, H, Q, R, m0, P0 = linear_system()
    ys = simulate(A, H, Q, R, m0, P0, 6, np.random.default_rng(3))[1]
    noises = AdditiveGaussian(Dense(Q)), AdditiveGaussian(Dense(R))
    initial = Gaussian(Learnt(jnp.zeros(3)), jnp.asarray(P0))
    parts = LinearDynamics(Frozen(jnp.asarray(A))), LinearObservation(Frozen(jnp.asarray(H)))
    prior = Prior(Normal(0.0, 4.0))
    estimate = fit(StateSpaceModel(*parts, *noises, initial), TimeSeries(np.arange(6.0), ys), prior=prior)
    return estimate, closed_form(A, H, Q, R, P0, 4.0 * np.eye(3), ys)


def closed_form(A, H, Q, R, P0, V, ys):
    """Mean and covariance of the initial mean given readings, and the log evidence, for a prior N(0, V)."""
    n, d = len(ys), len(A)
    powers = [np.linalg.matrix_power(A, k) for k in range(n)]
    F = np.block([[powers[k - j] if j <= k else np.zeros((d, d)) for j in range(n)] for k in range(n)])
    W = np.kron(np.eye(n), Q)
    W[:d, :d] = P0
    G = np.kron(np.eye(n), H)
    S = G @ F @ W @ F.T @ G.T + np.kron(np.eye(n), R)
    M = G @ np.vstack(powers)
    T = M @ V @ M.T + S
    gain = V @ M.T @ np.linalg.inv(T)
    y = ys.ravel()
    evidence = -0.5 * (y @ np.linalg.solve(T, y) + np.linalg.slogdet(2 * np.pi * T)[1])
    return gain @ y, V - gain @ M @ V, evidence


# The others take long to compile, and are held to closed forms above.
BY_COST = [
    pytest.param(sampler, id=name, marks=() if name == "importance" else pytest.mark.slow)
    for name, sampler in zip(NAMES, SAMPLERS, strict=True)
    if name != "DRAM within Gibbs"  # its blocks are of two parameters
]


@pytest.mark.parametrize("sampler", BY_COST)
def test_moments_of_a_conjugate_posterior(conjugate, sampler):
    """The posterior of a linear model's initial mean is the normal one of the textbook."""
    estimate, (mean, covariance, evidence) = conjugate
    posterior = sample(estimate, sampler=sampler, key=jax.random.key(1))
    assert posterior.converged, str(posterior)
    draws = np.asarray(posterior.values["initial.mean"]) - mean
    # Nine numbers for each of seven samplers: by chance one in six such sets has one of them beyond three standard
    # errors, one in 250 beyond four. (Of eight keys the random walk's worst: 3.2, 1.5, 1.8, 2.3, 1.2, 0.9, 1.4, 2.2.)
    for i in range(3):
        assert off_by(draws[..., i], 0.0) < 4.0
        for j in range(i + 1):
            assert off_by(draws[..., i] * draws[..., j], covariance[i, j]) < 4.0
    if posterior.log_evidence is not None:
        assert abs(posterior.log_evidence - evidence) < 3 * posterior.log_evidence_sd
        # Without it the line before could not fail: 1500 effective draws, or 8 runs through four powers.
        assert posterior.log_evidence_sd < 0.1


def test_log_posterior_is_that_of_the_draw(conjugate):
    """The log posterior kept beside a draw is the normal density of the textbook times the evidence."""
    estimate, (mean, covariance, evidence) = conjugate
    posterior = sample(estimate, sampler=SAMPLERS[0], key=jax.random.key(2))
    x = np.asarray(posterior.free)[0, :5] - mean
    norm = np.linalg.slogdet(2 * np.pi * covariance)[1]
    exact = evidence - 0.5 * (np.einsum("ni,ij,nj->n", x, np.linalg.inv(covariance), x) + norm)
    # Both are sums of some twenty terms of order 1: round-off.
    np.testing.assert_allclose(posterior.log_posterior[0, :5], exact, atol=1e-9)


def test_a_start_that_is_no_mode(conjugate):
    """An estimate that has not converged, or sits where the Hessian is indefinite, is sampled all the same."""
    estimate, (mean, covariance, _) = conjugate
    far = fit(estimate.model, estimate.recording, prior=estimate.prior, max_steps=1)
    moved = eqx.tree_at(lambda e: e.model.initial.mean.free, far, jnp.asarray([9.0, -9.0, 9.0]))
    assert isinstance(moved, Estimate)
    posterior = sample(moved, sampler=SAMPLERS[0], key=jax.random.key(5))
    assert posterior.converged, str(posterior)
    draws = np.asarray(posterior.values["initial.mean"]) - mean
    assert max(off_by(draws[..., i], 0.0) for i in range(3)) < 3.0


def test_an_indefinite_hessian_is_said():
    """Between two modes the Hessian is indefinite; both modes are found, and the repair is told."""

    def two_modes(x):
        return jnp.logaddexp(-0.5 * jnp.sum((x - 2.0) ** 2), -0.5 * jnp.sum((x + 2.0) ** 2))

    posterior = sample_density(two_modes, [0.0, 0.0], sampler=SAMPLERS[0], key=jax.random.key(6))
    assert posterior.converged, str(posterior)
    assert "not positive definite in 1 of 2 directions" in str(posterior)
    x = np.asarray(posterior.values["x"])[..., 0]
    assert off_by((x > 0) * 1.0, 0.5) < 3.0
    assert abs(posterior.log_evidence - math.log(4 * math.pi)) < 3 * posterior.log_evidence_sd


def test_a_tail_open_to_zero():
    """exp(u) below 0, as of the logarithm of a variance the data cannot tell from zero, is sampled to its tail."""

    def open_to_zero(x):
        # A variance v = exp(u) with a half-normal prior and readings that only bound it from above.
        return x[0] - 0.5 * jnp.exp(2 * x[0])

    posterior = sample_density(open_to_zero, [0.0], sampler=SAMPLERS[0], key=jax.random.key(7))
    assert posterior.converged, str(posterior)
    v = np.exp(np.asarray(posterior.values["x"])[..., 0])
    # v is half-normal: mean sqrt(2 / pi), mean square 1; P(v < 0.01) = 0.00798.
    for draws, exact in ((v, math.sqrt(2 / math.pi)), (v**2, 1.0), ((v < 0.01) * 1.0, 0.0079786)):
        assert off_by(draws, exact) < 3.0
    assert abs(posterior.log_evidence - 0.5 * math.log(math.pi / 2)) < 3 * posterior.log_evidence_sd


@pytest.mark.slow
def test_what_is_in_no_block_is_held(conjugate):
    """Blocks name their leaves' places in the free vector, and what is in none of them never moves."""
    estimate, _ = conjugate
    assert blocks_of(estimate.model, "initial") == ((0, 1, 2),)
    with pytest.raises(InputError, match="No leaf that learns begins with dynamics; what learns is: initial.mean"):
        blocks_of(estimate.model, "dynamics")
    held = DRAM(blocks=((0, 1),), chains=2, steps=40, thin=1, scout=SCOUT)
    free = np.asarray(sample(estimate, sampler=held, key=jax.random.key(8)).free)
    assert np.ptp(free[..., 2]) == 0.0 and np.ptp(free[..., 1]) > 0.0
    with pytest.raises(InputError, match="disjoint places in a vector of 3"):
        sample(estimate, sampler=DRAM(blocks=((0, 3),)), key=jax.random.key(8))
