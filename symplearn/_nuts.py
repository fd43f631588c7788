"""The no-U-turn sampler in coordinates whitened by the posterior's covariance."""

from typing import NamedTuple

import blackjax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PRNGKeyArray

from ._errors import InputError
from ._importance import AdaptiveImportance
from ._sampler import AbstractSampler, Drawn, LogDensity, refuse_counts, whitened
from ._scout import SCOUT, scouted
from ._whitening import Whitening


class NUTS(AbstractSampler):
    """The no-U-turn sampler, by blackjax. Hoffman and Gelman (2014), JMLR 15, 1593.

    Chains start at draws of a short importance sampling run, `scout`, in coordinates whitened by its covariance; a
    `warm_up` by Stan's windows tunes the step to an `acceptance`, and one mass for each whitened coordinate. A
    trajectory has at most 2^`doublings` steps. Divergent trajectories and the mixing of the energy are in the
    diagnostics. Chains are vmapped: each waits for the longest trajectory.

    **Raises:** `InputError` where a number is too small or `acceptance` is not between 0 and 1.
    """

    chains: int = 4
    draws: int = 500
    warm_up: int = 300
    acceptance: float = 0.9
    doublings: int = 8
    scout: AdaptiveImportance = SCOUT

    def __check_init__(self):
        refuse_counts(self, chains=2, draws=4, warm_up=20, doublings=1)
        if not 0 < self.acceptance < 1:
            raise InputError(f"`NUTS` needs `acceptance` between 0 and 1, but was given {self.acceptance}.")

    def draw(self, density: LogDensity, start: Whitening, key: PRNGKeyArray) -> Drawn:
        scout_key, chain_key = jax.random.split(key)
        scouting = scouted(self.scout, density, start, self.chains, scout_key)
        run = _run(self, density, scouting.whitening, scouting.z, chain_key)
        return Drawn(
            scouting.whitening.free(run.z),
            run.log_density - scouting.whitening.log_volume,
            evaluations=scouting.evaluations,
            gradients=int(jnp.sum(run.steps)),
            accepted=float(jnp.mean(run.accepted)),
            divergent=run.divergent,
            energy=run.energy,
        )


class _Run(NamedTuple):
    z: Array
    log_density: Array
    divergent: Array
    energy: Array
    accepted: Array
    steps: Array  # of a chain in all, warm-up included


@eqx.filter_jit
def _run(options, density, whitening, z, key):
    log_density = whitened(density, whitening, slopes=True)
    limits = {"max_num_doublings": options.doublings}

    def chain(z, key):
        warm_key, draw_key = jax.random.split(key)
        adaptation = blackjax.window_adaptation(
            blackjax.nuts,
            log_density,
            target_acceptance_rate=options.acceptance,
            adaptation_info_fn=lambda state, info, _: info.num_integration_steps,
            **limits,
        )
        (state, tuned), warm_steps = adaptation.run(warm_key, z, options.warm_up)
        kernel = blackjax.nuts(log_density, **tuned)

        def step(state, key):
            state, info = kernel.step(key, state)
            kept = (state.position, state.logdensity, info.is_divergent, info.energy, info.acceptance_rate)
            return state, (*kept, info.num_integration_steps)

        _, (*kept, steps) = jax.lax.scan(step, state, jax.random.split(draw_key, options.draws))
        position, height, divergent, energy, accepted = kept
        return _Run(position, height, divergent, energy, accepted, jnp.sum(steps) + jnp.sum(warm_steps))

    return jax.vmap(chain)(z, jax.random.split(key, len(z)))
