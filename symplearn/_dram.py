"""Delayed rejection adaptive Metropolis within Gibbs. Dissertation Algorithm 3, corrected; Haario et al. (2006).

The released code adds the squared distance of the second stage where half of it is subtracted (R1), keeps one log
posterior for each block and does not refresh it when other blocks move (R2), and takes an upper Cholesky factor for a
lower one after adaptation (R3). Here the ratio is the printed algorithm's, one log density is kept of the whole vector,
and factors are lower.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from ._blocks import Course
from ._chains import AbstractKernel, Plan, run_chains
from ._errors import InputError
from ._importance import AdaptiveImportance
from ._parameters import flatten, named_parameters, partition
from ._sampler import AbstractBlockSampler, Drawn, LogDensity, possible, refuse_counts
from ._scout import SCOUT
from ._whitening import Whitening


class Adapted(NamedTuple):
    """What one block has learnt of its own draws: their mean and scatter, and the covariance of its first proposals."""

    mean: Float[Array, " entry"]
    scatter: Float[Array, "entry entry"]
    given: Float[Array, "entry entry"]


class DRAMState(NamedTuple):
    """Where a chain is: its position, the log density there, the sweeps done, and a record for each block."""

    position: Float[Array, " parameter"]
    log_density: Float[Array, ""]
    sweeps: Int[Array, ""]
    blocks: tuple[Adapted, ...]


class DRAMInfo(NamedTuple):
    """Which stage of which block was accepted in a sweep."""

    first: Bool[Array, " block"]
    second: Bool[Array, " block"]


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
        refuse_counts(self, chains=2, thin=1, steps=4 * self.thin, patience=1)
        if not 0 < self.shrinkage < 1:
            raise InputError(f"`DRAM` needs `shrinkage` between 0 and 1, but was given {self.shrinkage}.")

    def draw_in(self, course: Course, density: LogDensity, start: Whitening, key: PRNGKeyArray) -> Drawn:
        blocks = _checked(self.blocks, start.centre.size)
        plan = Plan(self.steps // 4, self.steps // self.thin, self.thin)
        sweep = _Sweep(density, blocks, self.patience, self.shrinkage)

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


def _checked(blocks: Any, size: int) -> tuple[tuple[int, ...], ...]:
    blocks = (tuple(range(size)),) if blocks is None else blocks
    places = [place for block in blocks for place in block]
    if not places or len(set(places)) < len(places) or not all(0 <= place < size for place in places):
        raise InputError(f"`DRAM`'s blocks must be disjoint places in a vector of {size}, but are {blocks}.")
    return blocks


class _Sweep(eqx.Module):
    """The kernel: `init` and `step`, as blackjax has them."""

    density: Any
    blocks: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    patience: int = eqx.field(static=True, default=200)
    shrinkage: float = eqx.field(static=True, default=0.01)

    def init(self, position: Float[Array, " parameter"], covariance: Float[Array, "parameter parameter"]) -> DRAMState:
        """The state at a position, with the covariance that proposals have at first."""
        records = []
        for block in self.blocks:
            at = np.array(block)
            given = covariance[np.ix_(at, at)] * (2.4**2 / len(block))
            records.append(Adapted(position[at], jnp.zeros_like(given), given))
        return DRAMState(position, possible(self.density(position)), jnp.zeros((), int), tuple(records))

    def step(self, key: PRNGKeyArray, state: DRAMState) -> tuple[DRAMState, DRAMInfo]:
        """One sweep through the blocks."""
        position, log_density = state.position, state.log_density
        records, firsts, seconds = [], [], []
        keys = jax.random.split(key, len(self.blocks))
        for key, block, record in zip(keys, self.blocks, state.blocks, strict=True):
            at = np.array(block)
            root = jnp.linalg.cholesky(self._proposal(record, state.sweeps))
            position, log_density, first, second = self._move(key, at, root, position, log_density)
            records.append(_learnt(record, position[at], state.sweeps))
            firsts.append(first)
            seconds.append(second)
        new = DRAMState(position, log_density, state.sweeps + 1, tuple(records))
        return new, DRAMInfo(jnp.stack(firsts), jnp.stack(seconds))

    def _proposal(self, record, sweeps):
        """The covariance of a block's proposals: as given, then of the chain itself."""
        size = record.mean.shape[0]
        # The share of the given covariance keeps a chain that has not moved yet from proposing to stay.
        own = record.scatter * (2.4**2 / size) / jnp.maximum(sweeps, 1) + 1e-10 * record.given
        return jnp.where(sweeps >= self.patience, own, record.given)

    def _move(self, key, at, root, x, lp):
        """Two stages of Metropolis in one block. Algorithm 3, lines 4 to 14."""
        keys = jax.random.split(key, 4)
        stages = [jax.random.normal(k, at.shape) for k in keys[:2]]
        levels = [jnp.log(jax.random.uniform(k)) for k in keys[2:]]
        y1 = x.at[at].add(root @ stages[0])
        y2 = x.at[at].add(self.shrinkage**0.5 * root @ stages[1])
        lp1, lp2 = possible(self.density(y1)), possible(self.density(y2))
        first = levels[0] < lp1 - lp
        second = ~first & (
            levels[1] < second_stage(lp, lp1, lp2, _half_square(root, (y1 - x)[at]), _half_square(root, (y1 - y2)[at]))
        )
        x = jnp.where(first, y1, jnp.where(second, y2, x))
        return x, jnp.where(first, lp1, jnp.where(second, lp2, lp)), first, second


def second_stage(lp: Array, lp1: Array, lp2: Array, from_x: Array, from_y2: Array) -> Array:
    """The log ratio of a second stage, from log densities at x, y1 and y2, and half the squared distances of y1.

    [lp(y2) + q(y1|y2) + log(1 - a(y2, y1))] - [lp(x) + q(y1|x) + log(1 - a(x, y1))], a(u, v) = min(1, pi(v) / pi(u)).
    """
    return (lp2 - from_y2 + _log_refusal(lp1 - lp2)) - (lp - from_x + _log_refusal(lp1 - lp))


def _log_refusal(log_ratio: Array) -> Array:
    """log(1 - min(1, exp(log_ratio))); -inf where the step would surely be taken, or nothing is known."""
    below = log_ratio < 0
    return jnp.where(below, jnp.log1p(-jnp.exp(jnp.where(below, log_ratio, -1.0))), -jnp.inf)


def _half_square(root: Array, step: Array) -> Array:
    return 0.5 * jnp.sum(jax.scipy.linalg.solve_triangular(root, step, lower=True) ** 2)


def _learnt(record: Adapted, x: Array, sweeps: Array) -> Adapted:
    """Welford's mean and scatter with one draw more."""
    mean = record.mean + (x - record.mean) / (sweeps + 2)
    return Adapted(mean, record.scatter + jnp.outer(x - record.mean, x - mean), record.given)


class _State(NamedTuple):
    """The chains, and the sum after warm-up of the shares of moves accepted."""

    states: DRAMState
    accepted: Array


class _Sweeps(AbstractKernel):
    """The sweeps of all chains; what is in no block stays at `centre`."""

    sweep: _Sweep
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
