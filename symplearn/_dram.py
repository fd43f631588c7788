"""Chains of delayed rejection adaptive Metropolis within Gibbs. Dissertation Algorithm 3; Haario et al. (2006)."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray, PyTree

from ._blocks import Course
from ._chains import AbstractKernel, Plan, run_chains
from ._dram_sweep import DRAMState, Sweep, checked_blocks
from ._errors import InputError
from ._importance import AdaptiveImportance
from ._parameters import flatten, named_parameters, partition
from ._sampler import AbstractBlockSampler, Drawn, LogDensity, refuse_counts
from ._scout import SCOUT
from ._whitening import Whitening


class DRAM(AbstractBlockSampler):
    """Delayed rejection adaptive Metropolis within Gibbs: the dissertation's own sampler, corrected.

    In each sweep every block of `blocks` is moved in turn, the others held; `blocks` are tuples of places in the free
    vector, as `blocks_of` gives them, and None is one block of all. **What is in no block stays where it starts.** A
    proposal that is rejected is tried again with `shrinkage` times its covariance. After `patience` sweeps a
    proposal's covariance is 2.4^2 / size times that of the chain so far, which is Algorithm 3's; before, that of a
    short importance sampling run, `scout`, at draws of which the chains start. Every `thin`-th of the `steps` sweeps is
    kept, after a quarter as many that are not.

    **Raises:** `InputError` where a number is too small, or a place is in two blocks or in none of the vector.
    """

    blocks: tuple[tuple[int, ...], ...] | None = eqx.field(static=True, default=None)
    chains: int = 4
    steps: int = 20_000
    thin: int = 10
    patience: int = 200
    shrinkage: float = 0.01
    scout: AdaptiveImportance = SCOUT

    def __check_init__(self):
        refuse_counts(self, chains=2, thin=1, patience=1)
        refuse_counts(self, steps=4 * self.thin)
        if not 0 < self.shrinkage < 1:
            raise InputError(f"`DRAM` needs `shrinkage` between 0 and 1, but was given {self.shrinkage}.")

    @property
    def by_place(self) -> bool:
        return self.blocks is not None

    def draw_in(self, course: Course, density: LogDensity, start: Whitening, key: PRNGKeyArray) -> Drawn:
        blocks = checked_blocks(self.blocks, start.centre.size)
        plan = Plan(self.steps // 4, self.steps // self.thin, self.thin)
        sweep = Sweep(density, blocks, self.patience, self.shrinkage)

        def kernel_in(whitening: Whitening) -> _Sweeps:
            return _Sweeps(sweep, whitening, start.centre, plan.warm_up)

        run = run_chains(course, plan, kernel_in, self.scout, density, start, self.chains, key)
        free, log_density = run.draws(plan)
        return Drawn(
            free,
            log_density,
            evaluations=int(run.scouting) + 2 * int(run.steps) * self.chains * len(blocks),
            accepted=float(run.state.accepted) / max(1, int(run.steps) - plan.warm_up),
            stopped=course.interrupted,
            remarks=run.remarks(plan),
        )


def blocks_of(model: PyTree, *groups: str | Sequence[str]) -> tuple[tuple[int, ...], ...]:
    """Places in the free vector of groups of leaves, each group a beginning of names or several of them.

    `blocks_of(model, "initial", "dynamics", ("process_noise", "measurement_noise"))` are the dissertation's groups
    {x0}, {Psi}, {Sigma, Gamma}; the observation, which is named in none of them, is held at the MAP.

    **Raises:** `InputError` where a group names nothing that learns.
    """
    vector, rebuild = flatten(model)
    numbered = rebuild(jnp.arange(vector.size, dtype=vector.dtype))
    places = {
        name: np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(partition(leaf)[0])]).astype(int)
        for name, leaf in named_parameters(numbered).items()
    }
    found = []
    for group in groups:
        starts = (group,) if isinstance(group, str) else tuple(group)
        inside = [places[name] for name in places if any(name == s or name.startswith(s + ".") for s in starts)]
        if not inside:
            raise InputError(
                f"No leaf that learns begins with {' or '.join(starts)}; what learns is: {', '.join(places)}."
            )
        found.append(tuple(int(i) for i in np.concatenate(inside)))
    return tuple(found)


class _State(NamedTuple):
    """The chains, and the sum after warm-up of the shares of moves accepted."""

    states: DRAMState
    accepted: Array


class _Sweeps(AbstractKernel):
    """The sweeps of all chains; what is in no block stays at `centre`."""

    sweep: Sweep
    whitening: Whitening
    centre: Array
    warm_up: int

    def begin(self, z):
        held = np.setdiff1d(np.arange(self.centre.size), np.concatenate(self.sweep.blocks))
        free = self.whitening.free(z).at[:, held].set(self.centre[held])
        root = self.whitening.root
        states = jax.vmap(self.sweep.init, in_axes=(0, None))(free, root @ root.T)
        return _State(states, jnp.zeros(()))

    def step(self, state, k, key):
        keys = jax.random.split(key, len(state.states.log_density))
        states, info = jax.vmap(self.sweep.step)(keys, state.states)
        accepted = jnp.mean(info.first | info.second)
        return _State(states, state.accepted + jnp.where(k < self.warm_up, 0.0, accepted))

    def kept(self, state):
        return state.states.position, state.states.log_density
