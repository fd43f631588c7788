"""Random-walk Metropolis: many chains at once, steps scaled to the posterior's covariance."""

import math

import blackjax
import equinox as eqx
import jax
import jax.numpy as jnp
from blackjax.mcmc.random_walk import normal as normal_step
from jaxtyping import PRNGKeyArray

from ._importance import AdaptiveImportance
from ._sampler import AbstractSampler, Drawn, LogDensity, refuse_counts, whitened
from ._scout import SCOUT, scouted
from ._whitening import Whitening

# The best share of accepted steps in many dimensions. Roberts, Gelman and Gilks (1997).
_ACCEPTED = 0.234


class RandomWalk(AbstractSampler):
    """Random-walk Metropolis with normal steps, by blackjax; all chains are one vmapped program.

    The chains start at draws of a short importance sampling run, `scout`, whose covariance gives the steps their
    shape; a quarter as many steps again go before, in which the length of the steps is tuned to 23.4 % acceptance and
    which are thrown away. Every `thin`-th of the `steps` is kept. It needs no gradient, and no posterior defeats it;
    but the steps needed grow with the number of parameters.

    **Raises:** `InputError` where a number is too small.
    """

    chains: int = 16
    steps: int = 10_000
    thin: int = 10
    scout: AdaptiveImportance = SCOUT

    def __check_init__(self):
        refuse_counts(self, chains=2, thin=1, steps=4 * self.thin)

    def draw(self, density: LogDensity, start: Whitening, key: PRNGKeyArray) -> Drawn:
        scout_key, walk_key = jax.random.split(key)
        scouting = scouted(self.scout, density, start, self.chains, scout_key)
        z, log_density, accepted = _walk(self, density, scouting.whitening, scouting.z, walk_key)
        taken = self.chains * (self.steps // 4 + self.steps // self.thin * self.thin)
        return Drawn(
            scouting.whitening.free(z),
            log_density - scouting.whitening.log_volume,
            evaluations=scouting.evaluations + taken,
            accepted=float(accepted),
        )


@eqx.filter_jit
def _walk(options, density, whitening, z, key):
    log_density = whitened(density, whitening)
    size = z.shape[1]

    def step(states, scale, key):
        kernel = blackjax.additive_step_random_walk(log_density, normal_step(scale * jnp.ones(size)))
        return jax.vmap(kernel.step)(jax.random.split(key, len(z)), states)

    def tune(carry, data):
        states, log_scale = carry
        k, key = data
        states, info = step(states, jnp.exp(log_scale), key)
        # Robbins and Monro (1951): ever smaller corrections.
        correction = (jnp.mean(info.acceptance_rate) - _ACCEPTED) * (k + 1.0) ** -0.6
        return (states, log_scale + correction), None

    def keep(states, key):
        def one(states, key):
            states, info = step(states, scale, key)
            return states, jnp.mean(info.acceptance_rate)

        states, accepted = jax.lax.scan(one, states, jax.random.split(key, options.thin))
        return states, (states.position, states.logdensity, jnp.mean(accepted))

    init = blackjax.additive_step_random_walk(log_density, normal_step(jnp.ones(size))).init
    tune_key, keep_key = jax.random.split(key)
    count = options.steps // 4
    begin = jax.vmap(init)(z), jnp.asarray(math.log(2.38 / math.sqrt(size)))
    (states, log_scale), _ = jax.lax.scan(tune, begin, (jnp.arange(count), jax.random.split(tune_key, count)))
    scale = jnp.exp(log_scale)
    keys = jax.random.split(keep_key, options.steps // options.thin)
    _, (positions, heights, accepted) = jax.lax.scan(keep, states, keys)
    return jnp.swapaxes(positions, 0, 1), heights.T, jnp.mean(accepted)
