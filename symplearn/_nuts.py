"""The no-U-turn sampler in coordinates whitened by the posterior's covariance."""

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


class NUTS(AbstractBlockSampler):
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

    def draw_in(self, course: Course, density: LogDensity, start: Whitening, key: PRNGKeyArray) -> Drawn:
        plan = Plan(self.warm_up, self.draws)

        def kernel_in(whitening: Whitening) -> _Trajectories:
            return _Trajectories(density, whitening, self.warm_up, self.acceptance, self.doublings)

        run = run_chains(course, plan, kernel_in, self.scout, density, start, self.chains, key)
        z, log_density, divergent, energy, accepted = run.draws(plan)
        return Drawn(
            run.whitening.free(z),
            log_density - run.whitening.log_volume,
            evaluations=int(run.scouting),
            gradients=int(jnp.sum(run.state.gradients)),
            accepted=float(jnp.mean(accepted)),
            divergent=divergent,
            energy=energy,
            stopped=course.interrupted,
            remarks=run.remarks(plan),
        )


class _Tuning(NamedTuple):
    """What the warm-up adapts, in blackjax's records, and what of it the trajectories use now."""

    averaging: Any
    mass: Any
    step_size: Array
    inverse_mass: Array


class _State(NamedTuple):
    """The chains, each with its tuning, facts of their last trajectories, and the gradients so far."""

    place: Any
    tuning: _Tuning
    divergent: Array
    energy: Array
    accepted: Array
    gradients: Array


class _Trajectories(AbstractKernel):
    density: Any
    whitening: Whitening
    warm_up: int
    acceptance: float
    doublings: int

    def begin(self, z):
        def one(z):
            averaging, mass = self._averaging[0](1.0), self._mass[0](z.shape[0])
            tuning = _Tuning(averaging, mass, jnp.ones(()), mass.inverse_mass_matrix)
            place, none = blackjax().nuts.init(z, self._log_density), jnp.zeros(())
            return _State(place, tuning, jnp.zeros((), bool), none, none, jnp.zeros((), int))

        return jax.vmap(one)(z)

    def step(self, state, k, key):
        kernel, log_density = blackjax().nuts.build_kernel(), self._log_density

        def one(state, key):
            tuning = state.tuning
            place, info = kernel(
                key, state.place, log_density, tuning.step_size, tuning.inverse_mass, max_num_doublings=self.doublings
            )
            tuning = jax.lax.cond(
                k < self.warm_up,
                lambda: self._tuned(tuning, k, place.position, info.acceptance_rate),
                lambda: tuning,
            )
            gradients = state.gradients + info.num_integration_steps
            return _State(place, tuning, info.is_divergent, info.energy, info.acceptance_rate, gradients)

        return jax.vmap(one)(state, jax.random.split(key, len(state.energy)))

    def kept(self, state):
        return state.place.position, state.place.logdensity, state.divergent, state.energy, state.accepted

    @property
    def _log_density(self):
        return whitened(self.density, self.whitening, slopes=True)

    @property
    def _averaging(self):
        return blackjax().adaptation.step_size.dual_averaging_adaptation(self.acceptance)

    @property
    def _mass(self):
        return blackjax().adaptation.mass_matrix.mass_matrix_adaptation(is_diagonal_matrix=True)

    def _tuned(self, tuning, k, position, accepted):
        """Step `k` of Stan's windows, as `blackjax.window_adaptation` takes it, which runs only as a whole."""
        (begin, update, end), (_, learn, conclude) = self._averaging, self._mass
        in_window, ends_window = blackjax().adaptation.staged_adaptation.build_schedule(self.warm_up)[k]
        averaging = update(tuning.averaging, accepted)
        mass = jax.lax.cond(in_window == 1, lambda: learn(tuning.mass, position), lambda: tuning.mass)
        averaging, mass = jax.lax.cond(
            ends_window == 1, lambda: (begin(end(averaging)), conclude(mass)), lambda: (averaging, mass)
        )
        last = k == self.warm_up - 1
        step_size = jnp.where(last, end(averaging), jnp.exp(averaging.log_step_size))
        return _Tuning(averaging, mass, step_size, mass.inverse_mass_matrix)
