"""Random-walk Metropolis: many chains at once, steps scaled to the posterior's covariance."""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, PRNGKeyArray

from ._blackjax import blackjax
from ._blocks import Course
from ._chains import AbstractKernel, Plan, run_chains
from ._importance import AdaptiveImportance
from ._sampler import AbstractBlockSampler, Drawn, LogDensity, refuse_counts, whitened
from ._scout import SCOUT
from ._whitening import Whitening

# The best share of accepted steps in many dimensions. Roberts, Gelman and Gilks (1997).
_ACCEPTED = 0.234


class RandomWalk(AbstractBlockSampler):
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
        refuse_counts(self, chains=2, thin=1)
        refuse_counts(self, steps=4 * self.thin)

    def draw_in(self, course: Course, density: LogDensity, start: Whitening, key: PRNGKeyArray) -> Drawn:
        plan = Plan(self.steps // 4, self.steps // self.thin, self.thin)

        def kernel_in(whitening: Whitening) -> _Walk:
            return _Walk(density, whitening, plan.warm_up)

        run = run_chains(course, plan, kernel_in, self.scout, density, start, self.chains, key)
        z, log_density = run.draws(plan)
        return Drawn(
            run.whitening.free(z),
            log_density - run.whitening.log_volume,
            evaluations=int(run.scouting) + self.chains * int(run.steps),
            accepted=float(run.state.accepted) / max(1, int(run.steps) - plan.warm_up),
            stopped=course.interrupted,
            remarks=run.remarks(plan),
        )


class _State(NamedTuple):
    """The chains, the logarithm of the length of their steps, and the sum of the shares accepted after warm-up."""

    walk: Any
    log_scale: Array
    accepted: Array


class _Walk(AbstractKernel):
    density: Any
    whitening: Whitening
    warm_up: int

    def begin(self, z):
        walk = jax.vmap(self._algorithm(jnp.ones(z.shape[1])).init)(z)
        return _State(walk, jnp.asarray(math.log(2.38 / math.sqrt(z.shape[1]))), jnp.zeros(()))

    def step(self, state, k, key):
        count, size = state.walk.position.shape
        kernel = self._algorithm(jnp.exp(state.log_scale) * jnp.ones(size))
        walk, info = jax.vmap(kernel.step)(jax.random.split(key, count), state.walk)
        accepted = jnp.mean(info.acceptance_rate)
        # Robbins and Monro (1951): ever smaller corrections.
        correction = (accepted - _ACCEPTED) * (k + 1.0) ** -0.6
        tunes = k < self.warm_up
        return _State(
            walk, state.log_scale + jnp.where(tunes, correction, 0.0), state.accepted + jnp.where(tunes, 0.0, accepted)
        )

    def kept(self, state):
        return state.walk.position, state.walk.logdensity

    def _algorithm(self, scale):
        kernels = blackjax()
        step = kernels.mcmc.random_walk.normal(scale)
        return kernels.additive_step_random_walk(whitened(self.density, self.whitening), step)
