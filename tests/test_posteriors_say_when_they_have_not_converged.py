"""A posterior whose draws cannot be trusted says so, says why and says what to try."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from symplearn._convergence import diagnose_draws
from symplearn._errors import InputError
from symplearn._importance import AdaptiveImportance
from symplearn._nuts import NUTS
from symplearn._posterior import posterior_of
from symplearn._random_walk import RandomWalk
from symplearn._sample import sample_density
from symplearn._sampler import Drawn

SCOUT = AdaptiveImportance(batch=100, target=100, rounds=4)


def normal(x):
    return -0.5 * jnp.sum(x**2)


def of(draws, **facts):
    """A posterior of given draws (chain, draw, parameter)."""
    drawn = Drawn(jnp.asarray(draws), jnp.zeros(draws.shape[:2]), evaluations=1, **facts)
    return posterior_of(None, drawn, "the test")


def good(chains=4, draws=1000):
    return np.random.default_rng(0).normal(size=(chains, draws, 2))


def test_good_draws_are_silent():
    """Independent normal draws have converged, and their diagnostics are those of theory."""
    posterior = of(good(), pareto_k=0.2, largest_weight=0.01)
    assert posterior.converged and "Converged." in str(posterior)
    # 4000 independent draws: the estimate of their effective size scatters by a few per cent.
    assert 3000 < posterior.diagnostics.least_ess < 4500
    assert posterior.diagnostics.worst_r_hat < 1.01


@pytest.mark.parametrize("sampler", [RandomWalk(chains=4, steps=60, thin=1, scout=SCOUT)], ids=str)
def test_few_steps_are_too_few(sampler):
    """A chain of a few steps is worth too few independent draws, and is told so."""
    posterior = sample_density(normal, jnp.zeros(5), sampler=sampler, key=jax.random.key(0))
    assert not posterior.converged
    assert "NOT CONVERGED" in str(posterior) and "draw more" in str(posterior)


def test_chains_in_two_places_disagree():
    """Chains that each stay in a mode of their own are found by R-hat, which names the value."""
    draws = good()
    draws[2:, :, 1] += 5.0
    posterior = of(draws)
    assert not posterior.converged
    assert "The chains disagree: R-hat of `x[1]`" in str(posterior)


def test_a_stuck_chain_is_seen():
    """A chain that never moves is counted, though its own autocorrelation is not a number."""
    draws = good()
    draws[1] = draws[1, :1]
    posterior = of(draws)
    assert posterior.diagnostics.stuck == 1
    assert "1 of 4 chains never moved" in str(posterior)
    everything = of(np.zeros((4, 100, 2)))
    assert not everything.converged and "4 of 4 chains never moved" in str(everything)


def test_divergences_energy_and_weights_are_judged():
    """Divergent trajectories, slow energy and heavy weights each have a sentence of their own."""
    divergent = jnp.zeros((4, 1000), bool).at[0, :100].set(True)
    slow = jnp.cumsum(jnp.asarray(good()[..., 0]), axis=1)
    posterior = of(good(), divergent=divergent, energy=slow, pareto_k=0.9, largest_weight=0.2)
    text = str(posterior)
    assert "100 of 4000 trajectories diverged" in text
    assert "The energy mixes slowly" in text
    assert "Pareto k 0.90, above 0.7" in text
    assert len(posterior.diagnostics.problems) == 3


def test_importance_sampling_of_a_wrong_start_says_so():
    """Importance sampling that has had one round, far from the mode, does not claim a posterior."""
    sampler = AdaptiveImportance(draws=400, batch=100, rounds=1)
    posterior = sample_density(
        lambda x: -0.5 * jnp.sum((x - 6.0) ** 2), jnp.zeros(6), sampler=sampler, key=jax.random.key(1)
    )
    assert not posterior.converged


def test_effective_size_of_resampled_weights_is_kish():
    """Copies of one draw lie side by side, so the effective size of resampled draws is that of the weights."""
    sampler = AdaptiveImportance(draws=4000, batch=2000, rounds=1, components=1)
    posterior = sample_density(
        lambda x: -0.5 * jnp.sum(x**2 / jnp.array([0.04, 1.0])), jnp.zeros(2), sampler=sampler, key=jax.random.key(2)
    )
    kish = 1.0 / (posterior.log_evidence_sd**2 + 1 / 2000)
    ess = float(np.mean(posterior.diagnostics.ess_bulk["x"]))
    # Two estimates, each of some 10 %; duplicates counted as independent would give 4000.
    assert 0.75 * kish < ess < 1.25 * kish


def test_bad_options_are_one_sentence():
    """Numbers that no sampler can work with are refused before anything is computed."""
    for wrong, sentence in (
        (lambda: RandomWalk(chains=1), "`RandomWalk` needs `chains` of at least 2, a whole number, but was given 1."),
        (lambda: NUTS(acceptance=1.0), "`acceptance` between 0 and 1"),
        (lambda: AdaptiveImportance(dof=2.0), "`dof` above 2"),
        (lambda: sample_density(normal, 0.0, key=jax.random.key(0)), "a vector to start from"),
        (lambda: sample_density(lambda x: jnp.log(x[0]), [-1.0], key=jax.random.key(0)), "start where it is finite"),
    ):
        with pytest.raises(InputError, match=sentence):
            wrong()


def test_diagnostics_are_values():
    """Diagnostics come by name, with a number for each entry of a value."""
    values = {"a": good()[..., 0], "b": good()}
    facts = diagnose_draws(values, Drawn(jnp.asarray(good()), jnp.zeros((4, 1000)), evaluations=1))
    assert facts.r_hat["a"].shape == () and facts.ess_tail["b"].shape == (2,)
    assert facts.divergences is None and facts.e_bfmi is None and facts.converged
