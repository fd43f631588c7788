"""Tempered sequential Monte Carlo weighs modes that lie far apart, and gives the evidence with its error."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from symplearn._errors import InputError
from symplearn._sample import sample_density
from symplearn._tempered_smc import TemperedSMC

SAMPLER = TemperedSMC(lines=256, length=8, thin=4, reach=8.0)
SHARE, LOG_EVIDENCE = 0.7, 2.5


class TwoModes(eqx.Module):
    """exp(2.5) times 0.3 N(-at, I) + 0.7 N(at, sd^2 I)."""

    at: jax.Array
    sd: jax.Array

    def __call__(self, x):
        left = math.log(1 - SHARE) - 0.5 * jnp.sum((x + self.at) ** 2)
        right = math.log(SHARE) - 0.5 * jnp.sum(((x - self.at) / self.sd) ** 2) - x.size * jnp.log(self.sd)
        return LOG_EVIDENCE - 0.5 * x.size * math.log(2 * math.pi) + jnp.logaddexp(left, right)


class Box(eqx.Module):
    """A standard normal density without its norm, impossible where the first coordinate is not above an edge."""

    edge: jax.Array

    def __call__(self, x):
        return jnp.where(x[0] > self.edge, -0.5 * jnp.sum(x**2), -jnp.inf)


def drawn(density, start, sampler=SAMPLER, seed=0):
    return sample_density(density, start, sampler=sampler, key=jax.random.key(seed))


def off_by(by_run, exact):
    """How many standard errors the mean over independent runs is from the exact one."""
    return abs(np.mean(by_run) - exact) / (np.std(by_run, ddof=1) / len(by_run) ** 0.5)


@pytest.mark.slow
def test_shares_of_two_modes_and_the_evidence():
    """Started in the lesser of two modes eight standard deviations apart: shares, moments and evidence are right."""
    posterior = drawn(TwoModes(jnp.asarray([4.0, 0.0]), jnp.asarray(0.7)), [-4.0, 0.0])
    assert posterior.converged, str(posterior)
    x = np.asarray(posterior.values["x"])
    # Three Monte Carlo standard errors, by the spread of the runs.
    assert off_by((x[..., 0] > 0).mean(axis=1), SHARE) < 3.0
    assert off_by(x[..., 0].mean(axis=1), (2 * SHARE - 1) * 4.0) < 3.0
    assert off_by((x[..., 1] ** 2).mean(axis=1), 1 - SHARE + SHARE * 0.7**2) < 3.0
    assert abs(posterior.log_evidence - LOG_EVIDENCE) < 3 * posterior.log_evidence_sd
    assert posterior.log_evidence_sd < 0.1  # 8 runs of 2048 particles; without it the line before could not fail
    assert "8 runs of 2048 particles" in str(posterior)


@pytest.mark.slow
def test_impossible_places_weigh_nothing():
    """Where half of the first particles are impossible, as where trajectories escape, the evidence is half as large."""
    posterior = drawn(Box(jnp.asarray(0.0)), [1.0, 0.0])
    assert np.all(np.asarray(posterior.values["x"])[..., 0] > 0)
    assert abs(posterior.log_evidence - math.log(math.pi)) < 3 * posterior.log_evidence_sd
    x = np.asarray(posterior.values["x"])[..., 0]
    assert off_by(x.mean(axis=1), math.sqrt(2 / math.pi)) < 3.0


@pytest.mark.slow
def test_walks_are_long_enough_for_ten_parameters():
    """By default the walks grow with the parameters: variances and evidence are right for ten with kinks and tails."""

    def kinked(x):
        return -0.5 * jnp.sum(x[:5] ** 2) - jnp.sum(jnp.abs(x[5:]))

    posterior = drawn(kinked, 10 * [0.1], TemperedSMC())
    assert posterior.converged, str(posterior)
    squares = np.mean(np.asarray(posterior.values["x"]) ** 2, axis=1)
    assert off_by(squares[:, :5].mean(axis=1), 1.0) < 3.0 and off_by(squares[:, 5:].mean(axis=1), 2.0) < 3.0
    assert abs(posterior.log_evidence - 2.5 * math.log(2 * math.pi) - 5 * math.log(2)) < 3 * posterior.log_evidence_sd
    assert posterior.log_evidence_sd < 0.15  # 8 runs; without it the line before could not fail


@pytest.mark.slow
def test_runs_that_lose_a_mode_disagree():
    """A budget too small for the second mode, which some runs find and others do not, is not called converged."""
    small = TemperedSMC(lines=32, length=8, thin=4, reach=4.0)
    posterior = drawn(TwoModes(jnp.asarray([5.0, 5.0]), jnp.asarray(0.5)), [-5.0, -5.0], small)
    shares = (np.asarray(posterior.values["x"])[..., 0] > 0).mean(axis=1)
    assert shares.min() == 0.0 and shares.max() > 0.5
    assert not posterior.converged and "The chains disagree" in str(posterior)


@pytest.mark.slow
def test_what_cannot_be_tempered_is_said():
    """No possible particle, too few powers and options out of range are refused in a sentence that says what to try."""

    def needle(x):
        return jnp.where(jnp.max(jnp.abs(x)) < 1e-9, 0.0, -jnp.inf)

    with pytest.raises(InputError, match="2 powers led to .* of 1; take more, or a lower `reach`"):
        drawn(Box(jnp.asarray(0.0)), [1.0, 0.0], TemperedSMC(lines=4, length=4, thin=1, powers=2, reach=100.0))
    with pytest.raises(InputError, match="None of the first 8 particles .* lower the `reach`"):
        drawn(needle, [0.0, 0.0], TemperedSMC(lines=4, length=2, thin=1))
    for wrong, sentence in (
        (lambda: TemperedSMC(keep=1.0), "`keep` between 0 and 1, but was given 1.0"),
        (lambda: TemperedSMC(reach=0.0), "`reach` and `dof` above 0, but was given 0.0"),
        (lambda: TemperedSMC(runs=1), "`runs` of at least 2, a whole number, but was given 1"),
    ):
        with pytest.raises(InputError, match=sentence):
            wrong()
