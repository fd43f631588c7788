"""One sweep of delayed rejection adaptive Metropolis within Gibbs. Dissertation Algorithm 3, corrected.

The released code adds the squared distance of the second stage where half of it is subtracted (R1), keeps one log
posterior for each block and does not refresh it when other blocks move (R2), and takes an upper Cholesky factor for a
lower one after adaptation (R3). Here the ratio is the printed algorithm's, one log density is kept of the whole vector,
and factors are lower.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray

from ._blackjax import blackjax
from ._counts import refuse_count
from ._errors import InputError
from ._sampler import possible


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


def dram(
    log_density: Callable[[Array], Array],
    covariance: Float[ArrayLike, "parameter parameter"],
    blocks: Sequence[Sequence[int]] | None = None,
    *,
    patience: int = 200,
    shrinkage: float = 0.01,
) -> Any:
    """Delayed rejection adaptive Metropolis within Gibbs as blackjax has its kernels: `init(position)` and
    `step(key, state)`, for blackjax's own loops.

    **Arguments:** `log_density` - of a vector (parameter,), in nats; `covariance` - what the target's is thought to be,
    which proposals have, times 2.4^2 / size of the block, until `patience` sweeps; then that of the chain itself;
    `blocks` - places that move together, as `blocks_of` gives them, or None for one block of all, and what is in none
    stays; `shrinkage` - the share of its covariance that a second proposal has.

    **Returns:** a `blackjax.base.SamplingAlgorithm`, whose states are `DRAMState` and whose infos are `DRAMInfo`.

    **Raises:** `InputError` where a place is in two blocks or not in the vector, or a number is out of range. Haario et
    al. (2006); Algorithm 3.
    """
    given = jnp.asarray(covariance, dtype=float)
    sweep = Sweep(log_density, checked_blocks(blocks, len(given)), patience, shrinkage)

    def init(position: ArrayLike, rng_key: Any = None) -> DRAMState:
        # On whole numbers a walk would be cut down to them.
        return sweep.init(jnp.asarray(position, dtype=float), given)

    return blackjax().base.SamplingAlgorithm(init, sweep.step)


def checked_blocks(blocks: Sequence[Sequence[int]] | None, size: int) -> tuple[tuple[int, ...], ...]:
    """The blocks as tuples; one of all for None."""
    blocks = (range(size),) if blocks is None else blocks
    places = [place for block in blocks for place in block]
    if not places or len(set(places)) < len(places) or not all(0 <= place < size for place in places):
        raise InputError(f"`DRAM`'s blocks must be disjoint places in a vector of {size}, but are {blocks}.")
    return tuple(tuple(int(place) for place in block) for block in blocks)


class Sweep(eqx.Module):
    """The kernel. Raises `InputError` where a number is out of range."""

    density: Any
    blocks: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    patience: int = eqx.field(static=True)
    shrinkage: float = eqx.field(static=True)

    def __check_init__(self):
        refuse_count("DRAM", "patience", self.patience)
        if not 0 < self.shrinkage < 1:
            raise InputError(f"DRAM needs `shrinkage` between 0 and 1, but was given {self.shrinkage}.")

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
