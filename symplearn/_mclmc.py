"""Microcanonical Hamiltonian trajectories with a Metropolis test, in whitened coordinates."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, PRNGKeyArray

from ._blackjax import blackjax
from ._blocks import Course
from ._chains import AbstractKernel, Plan, run_chains
from ._errors import InputError
from ._importance import AdaptiveImportance
from ._sampler import AbstractBlockSampler, Drawn, LogDensity, refuse_counts, whitened
from ._scout import SCOUT
from ._whitening import Whitening


class MCLMC(AbstractBlockSampler):
    """Microcanonical Hamiltonian Monte Carlo, with a Metropolis test, by blackjax. Robnik et al. (2023), JMLR 24, 311.

    The momentum has a fixed length and only turns. Chains start at draws of a short importance sampling run, `scout`,
    in coordinates whitened by its covariance; in `warm_up` proposals one step for all chains is tuned to an
    `acceptance`. A proposal is 1 to 2 `length` - 1 steps, each of two gradients, and all chains take equally many, so
    that none waits. No energy is drawn anew, hence there is no E-BFMI.

    Without the test, as in the Langevin variant, the draws would be off by an amount that depends on the step, and
    nothing in them would say by how much.

    **Raises:** `InputError` where a number is too small, `acceptance` is not between 0 and 1, or there is but one
    parameter.
    """

    chains: int = 8
    draws: int = 1000
    warm_up: int = 300
    acceptance: float = 0.9
    length: int = 2
    scout: AdaptiveImportance = SCOUT

    def __check_init__(self):
        refuse_counts(self, chains=2, draws=4, warm_up=20, length=1)
        if not 0 < self.acceptance < 1:
            raise InputError(f"`MCLMC` needs `acceptance` between 0 and 1, but was given {self.acceptance}.")

    def draw_in(self, course: Course, density: LogDensity, start: Whitening, key: PRNGKeyArray) -> Drawn:
        if start.centre.size < 2:
            raise InputError("`MCLMC` needs two parameters to turn in, but there is one; sample with `NUTS`.")
        plan = Plan(self.warm_up, self.draws)

        def kernel_in(whitening: Whitening) -> _Trajectories:
            return _Trajectories(density, whitening, self.warm_up, self.acceptance, self.length)

        run = run_chains(course, plan, kernel_in, self.scout, density, start, self.chains, key)
        z, log_density, divergent, accepted = run.draws(plan)
        return Drawn(
            run.whitening.free(z),
            log_density - run.whitening.log_volume,
            evaluations=int(run.scouting),
            gradients=2 * self.chains * int(run.state.steps),
            accepted=float(jnp.mean(accepted)),
            divergent=divergent,
            stopped=course.interrupted,
            remarks=run.remarks(plan),
        )


class _State(NamedTuple):
    """The chains, blackjax's record of the step's tuning, facts of their last trajectories, and the steps so far."""

    places: Any
    averaging: Any
    divergent: Array
    accepted: Array
    steps: Array


class _Trajectories(AbstractKernel):
    density: Any
    whitening: Whitening
    warm_up: int
    acceptance: float
    length: int

    def begin(self, z):
        count, size = z.shape
        places = jax.vmap(
            lambda z: blackjax().mcmc.adjusted_mclmc_dynamic.init(z, self._log_density, jnp.zeros((), int))
        )(z)
        averaging = jax.tree.map(jnp.asarray, self._averaging[0](0.5 * size**0.5))
        return _State(places, averaging, jnp.zeros(count, bool), jnp.zeros(count), jnp.zeros((), int))

    def step(self, state, k, key):
        # blackjax's own tuning learns a diagonal mass too, which is one here, and compiles the kernel three times.
        _, update, end = self._averaging
        warm = k < self.warm_up
        size = jnp.where(warm, jnp.exp(state.averaging.log_step_size), end(state.averaging))
        kernel = blackjax().mcmc.adjusted_mclmc_dynamic.build_kernel(self._steps, next_random_arg_fn=lambda k: k + 1)
        keys = jax.random.split(key, len(state.accepted))
        places, info = jax.vmap(lambda key, place: kernel(key, place, self._log_density, size))(keys, state.places)
        learnt = update(state.averaging, jnp.mean(info.acceptance_rate))
        averaging = jax.tree.map(lambda new, old: jnp.where(warm, new, old), learnt, state.averaging)
        steps = state.steps + info.num_integration_steps[0]
        return _State(places, averaging, info.is_divergent, info.acceptance_rate, steps)

    def kept(self, state):
        return state.places.position, state.places.logdensity, state.divergent, state.accepted

    @property
    def _log_density(self):
        return whitened(self.density, self.whitening, slopes=True)

    @property
    def _averaging(self):
        return blackjax().adaptation.step_size.dual_averaging_adaptation(self.acceptance)

    def _steps(self, k):
        """How many steps proposal `k` has: 1 to 2 length - 1, `length` on average, by van der Corput's sequence."""
        # blackjax's sequence has a zero in every 1024.
        return jnp.maximum(blackjax().mcmc.adjusted_mclmc_dynamic.trajectory_length(k, float(self.length)), 1).astype(
            int
        )
