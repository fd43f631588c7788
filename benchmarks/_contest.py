"""Contenders on the same work: compiled apart, checked to agree, then timed in turns."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from symplearn._lane_loops import left_to_xla

from ._row import Disagreement, Effort, tell

# Rounds that a median takes.
_FEWEST = 3


class Spread(NamedTuple):
    """The median of some numbers, the middle half of them, and the least and the largest."""

    median: float
    lower: float
    upper: float
    least: float
    largest: float

    @classmethod
    def of(cls, values: Sequence[float]) -> "Spread":
        least, lower, median, upper, largest = np.quantile(np.asarray(values, dtype=float), (0, 0.25, 0.5, 0.75, 1))
        return cls(float(median), float(lower), float(upper), float(least), float(largest))


def paired_ratios(others: Sequence[float], ours: Sequence[float]) -> Spread:
    """How many times longer others took than we did, round by round: both numbers of a ratio met the same machine."""
    return Spread.of([other / own for other, own in zip(others, ours, strict=True)])


class Contender(NamedTuple):
    """A function and its arguments, ready to be called: `compiling` in seconds and `memory` in bytes where it is XLA's.

    `memory` is what XLA plans for beside arguments and results.
    """

    call: Callable[[], Any]
    compiling: float | None = None
    memory: int | None = None

    def __call__(self) -> Any:
        return jax.block_until_ready(self.call())


def compiled(function: Callable[..., Any], *arguments: Any) -> Contender:
    """The function compiled for these arguments, without any cache, and how long that took."""
    jax.clear_caches()
    began = time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile()
    seconds = time.perf_counter() - began
    return Contender(lambda: program(*arguments), seconds, planned_bytes(program))


def compiled_by_xla(function: Callable[..., Any], *arguments: Any) -> Contender:
    """The same without machine code of symplearn's own."""
    with left_to_xla():
        return compiled(function, *arguments)


def planned_bytes(program: Any) -> int | None:
    """What XLA plans for beside arguments and results, where it tells."""
    plan = program.memory_analysis()
    return None if plan is None else int(plan.temp_size_in_bytes)


class Check(NamedTuple):
    """How near another contender's value must be, relative, and each entry of its gradient, by the largest one."""

    value: float
    gradient: float = 1e-5

    def __call__(self, name: str, found: Any, expected: Any) -> None:
        """**Raises:** `Disagreement` where it is not."""
        pairs = zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True)
        kinds = (("value", self.value), ("gradient", self.gradient))
        for (one, other), (what, tolerance) in zip(pairs, kinds, strict=False):  # a plain value has no gradient
            off = float(np.max(np.abs(np.asarray(one) - np.asarray(other))) / np.max(np.abs(np.asarray(other))))
            # Not `>`: NaN is no agreement.
            if not off <= tolerance:
                raise Disagreement(f"the {what} of {name} is off by {off:.2g}, more than {tolerance:g}")


DYNAMAX = Check(1e-6)  # it adds 1e-9 to the diagonal of what it inverts
FILTERPY = Check(1e-10)


def contest(
    what: str, contenders: Mapping[str, Callable[[], Contender]], checks: Mapping[str, Check], effort: Effort
) -> dict[str, Any]:
    """The times of all, and the ratios of all the others to the first, whose value they must have. For JSON."""
    ready = {}
    for name, make in contenders.items():
        tell(f"{what}: compiling {name}")
        ready[name] = make()
    (ours, first), *others = ready.items()
    expected = first()
    for name, one in others:
        if name in checks:
            checks[name](name, one(), expected)
    tell(f"{what}: values agree; timing")
    wall, cpu = timed(ready, effort)
    return {
        "rounds": len(wall[ours]),
        "contenders": {
            name: {
                "seconds": Spread.of(wall[name])._asdict(),
                "cpu_seconds": Spread.of(cpu[name])._asdict(),
                "compiling_seconds": one.compiling,
                "memory_bytes": one.memory,
            }
            for name, one in ready.items()
        },
        "ratios": {name: paired_ratios(wall[name], wall[ours])._asdict() for name, _ in others},
        "cpu_ratios": {name: paired_ratios(cpu[name], cpu[ours])._asdict() for name, _ in others},
    }


Times = dict[str, list[float]]


def timed(ready: Mapping[str, Contender], effort: Effort, block: float | None = None) -> tuple[Times, Times]:
    """Seconds a call of each contender, round by round, on the wall and on the processor's clock.

    Every round has each contender once, for some calls on end; every other round in the opposite order, so that a
    machine that slows down favours nobody. A turn lasts `block` seconds, or as long as the effort says.
    """
    length = effort.block if block is None else block
    calls = {name: calls_of(one, length) for name, one in ready.items()}
    wall: Times = {name: [] for name in ready}
    cpu: Times = {name: [] for name in ready}
    end = time.monotonic() + effort.seconds
    for count in range(effort.rounds):
        if count >= _FEWEST and time.monotonic() > end:
            break
        for name in list(ready) if count % 2 == 0 else reversed(list(ready)):
            seconds, processor = clocked(ready[name], calls[name])
            wall[name].append(seconds)
            cpu[name].append(processor)
    return wall, cpu


def calls_of(contender: Contender, block: float) -> int:
    """How many calls on end are a contender's turn of so many seconds."""
    return max(1, math.ceil(block / clocked(contender, 1)[0]))


def clocked(contender: Contender, calls: int) -> tuple[float, float]:
    """Seconds a call, on the wall and on the processor."""
    began, worked = time.perf_counter(), time.process_time()
    for _ in range(calls):
        contender()
    return (time.perf_counter() - began) / calls, (time.process_time() - worked) / calls
