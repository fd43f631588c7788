"""Chains of a kernel in blocks of one compiled program, so that they can be told of, stopped and resumed."""

import abc
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from ._blocks import Course, run_blocks
from ._importance import AdaptiveImportance
from ._sampler import LogDensity
from ._scout import scouted
from ._whitening import Whitening

# Fewer draws of a chain than this have no R-hat and are not given back.
_FEWEST = 4


class AbstractKernel(eqx.Module):
    """What moves all chains by one step. `step` must depend on its arguments alone, the number of the step included."""

    @abc.abstractmethod
    def begin(self, z: Float[Array, "chain parameter"]) -> PyTree:
        """The chains' state at whitened coordinates."""

    @abc.abstractmethod
    def step(self, state: PyTree, k: Int[Array, ""], key: PRNGKeyArray) -> PyTree:
        """The state after step `k`, counted from 0, warm-up included."""

    @abc.abstractmethod
    def kept(self, state: PyTree) -> PyTree:
        """What of a state is kept as a draw: arrays with the leading axis (chain,)."""


class Plan(NamedTuple):
    """Steps of warm-up, draws of each chain, and how many steps apart these are."""

    warm_up: int
    draws: int
    thin: int = 1

    @property
    def steps(self) -> int:
        return self.warm_up + self.draws * self.thin


class Chains(eqx.Module):
    """Chains on their way: the coordinates, what scouting cost, the kernel's state, the draws (draw, chain, ...) so far
    with zeros for those to come, and the steps done."""

    centre: Float[Array, " parameter"]
    root: Float[Array, "parameter parameter"]
    scouting: Int[Array, ""]
    state: PyTree
    kept: PyTree
    steps: Int[Array, ""]

    @property
    def whitening(self) -> Whitening:
        return Whitening(self.centre, self.root)

    def count(self, plan: Plan) -> int:
        """How many draws each chain has."""
        return max(0, int(self.steps) - plan.warm_up) // plan.thin

    def draws(self, plan: Plan) -> PyTree:
        """What is kept so far, (chain, draw, ...)."""
        count = self.count(plan)
        return jax.tree.map(lambda rows: jnp.swapaxes(rows[:count], 0, 1), self.kept)

    def remarks(self, plan: Plan) -> tuple[str, ...]:
        """What to say of chains that were stopped."""
        count = self.count(plan)
        return () if count == plan.draws else (f"Stopped by Ctrl-C after {count} of {plan.draws} draws of each chain.",)


def run_chains(
    course: Course,
    plan: Plan,
    kernel_in: Callable[[Whitening], AbstractKernel],
    scout: AdaptiveImportance,
    density: LogDensity,
    start: Whitening,
    chains: int,
    key: PRNGKeyArray,
) -> Chains:
    """Chains from draws of a short importance sampling run to the end of the plan, or to Ctrl-C.

    `kernel_in` gives the kernel in whitened coordinates. A run that goes on from its file does not scout again.

    **Raises:** `KeyboardInterrupt` where Ctrl-C came before four draws.
    """
    scout_key, chain_key = jax.random.split(key)
    size = start.centre.size

    def begin(centre: Array, root: Array, z: Array, evaluations: Any) -> Chains:
        return _begin(kernel_in(Whitening(centre, root)), plan, centre, root, z, evaluations)

    def shape() -> Any:
        numbers = jax.ShapeDtypeStruct((chains, size), start.centre.dtype)
        return eqx.filter_eval_shape(begin, start.centre, start.root, numbers, jnp.zeros((), int))

    state = course.resumed(shape)
    if state is None:
        scouting = scouted(scout, density, start, chains, scout_key)
        whitening = scouting.whitening
        state = begin(whitening.centre, whitening.root, scouting.z, jnp.asarray(scouting.evaluations))
    pace = _Pace(kernel_in(state.whitening), plan, chain_key)
    state = run_blocks(course, pace.advance, state, lambda state: int(state.steps), plan.steps, pace.line)
    if course.interrupted and state.count(plan) < _FEWEST:
        raise KeyboardInterrupt
    return state


class _Pace:
    """Advances chains, and tells how far they are and how long the rest takes at the pace of the last block."""

    def __init__(self, kernel: AbstractKernel, plan: Plan, key: PRNGKeyArray):
        self.kernel, self.plan, self.key = kernel, plan, key
        self.blocks, self.each = 0, 0.0

    def advance(self, chains: Chains, count: Array) -> Chains:
        began = time.monotonic()
        chains = jax.block_until_ready(_advance(self.kernel, self.plan, chains, self.key, count))
        self.blocks, self.each = self.blocks + 1, (time.monotonic() - began) / int(count)
        return chains

    def line(self, chains: Chains) -> str:
        done, total = int(chains.steps), self.plan.steps
        stage = ", of warm-up" if done < self.plan.warm_up else ""
        # The first block holds the compilation.
        left = f", about {self.each * (total - done):.0f} s left" if self.blocks > 1 else ""
        return f"step {done} of {total}{stage}{left}"


@eqx.filter_jit
def _begin(kernel, plan, centre, root, z, evaluations):
    state = kernel.begin(z)
    kept = jax.tree.map(lambda one: jnp.zeros((plan.draws, *one.shape), one.dtype), jax.eval_shape(kernel.kept, state))
    chains = Chains(centre, root, evaluations, state, kept, jnp.zeros((), int))
    # Strong types: with weak ones a state from a file would compile anew.
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, leaf.dtype), chains)


@eqx.filter_jit
def _advance(kernel, plan, chains, key, count):
    """Some steps more. A step's random numbers hang on its number alone, so blocks of any size are the same run."""

    def step(_, chains):
        state = kernel.step(chains.state, chains.steps, jax.random.fold_in(key, chains.steps))
        # Each draw is overwritten until its last step; a row past the end is dropped.
        row = jnp.where(chains.steps < plan.warm_up, plan.draws, (chains.steps - plan.warm_up) // plan.thin)
        kept = jax.tree.map(lambda rows, new: rows.at[row].set(new, mode="drop"), chains.kept, kernel.kept(state))
        return Chains(chains.centre, chains.root, chains.scouting, state, kept, chains.steps + 1)

    return jax.lax.fori_loop(0, count, step, chains)
