"""Forces that remember the motion and fade: with time, as of a spring and a damper in series, or with the way gone."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import sympy
from jaxtyping import Float

from .._effects import MEMORIES, RELAXING, SLIPPING, YIELDING, Memory, Nameless
from .._expression import Expression, symbol
from .._kinks import Absolute
from .._simulation_records import SimulationFile
from .._simulation_text import worded
from .._symbolic import derivative
from ._motion import rms

# Share of the prior of what has no name that they have, beside that of simple laws.
_SHARE = 0.125
# What fades with the way does so within twice the whole swing, or a twentieth of it.
_WAYS = 0.5, 20.0
_WORDS = {
    RELAXING: "fades with time, as of a spring and a damper in series",
    SLIPPING: "fades with the way gone, as where a friction gives before it slips",
    YIELDING: "fades with the way gone while it is loaded, as of a part that yields",
}


def memories(file: SimulationFile) -> list[Nameless]:
    """Every force that fades, on every coordinate, each one choice of all."""
    choices = float(np.log(len(MEMORIES) * len(file.coordinates) / _SHARE))
    listed = [(i, f"remembers: it grows against the motion of {q} and {words}", memory)
              for memory, words in _WORDS.items() for i, q in enumerate(file.coordinates)]  # fmt: skip
    return [Nameless((i,), (), choices, words, "dissipation", memory) for i, words, memory in listed]


@dataclass(frozen=True)
class Span:
    """Between which values the fading of a force may lie."""

    low: float
    high: float


def fading(memory: Memory, q: Sequence[Float[np.ndarray, " _"]], times: Sequence[Float[np.ndarray, " _"]]) -> Span:
    """How fast a force may fade: from once in a recording to what its rows show; by recording."""
    if memory.by_way:
        way = max(float(np.ptp(one)) for one in q)
        return Span(*(number / way for number in _WAYS)) if way > 0 else Span(np.nan, np.nan)
    span, gap = max(float(np.ptp(t)) for t in times), float(np.median(np.concatenate([np.diff(t) for t in times])))
    return Span(1 / span, max(np.pi / (2 * gap), 2 / span))


def stiffness(force: float, q: Sequence[Float[np.ndarray, " _"]]) -> float:
    """What gives as much force as is there."""
    return force / rms(np.concatenate([one - one.mean() for one in q]))


def written_memory(
    file: SimulationFile, memory: Memory, coordinate: str, values: Sequence[float]
) -> tuple[Expression, Mapping[str, Expression]]:
    """The force as an expression, and what changes the name that it has beside those of the simulation."""
    taken = {*file.names, "t", *(name for term in file.terms for name in term.memory)}
    name = next(
        name for name in ("w", "w_force", *(f"w_force{n}" for n in range(2, len(taken) + 3))) if name not in taken
    )
    momentum = file.momenta[file.coordinates.index(coordinate)]
    w, v = symbol(name), derivative(file.hamiltonian.tree, file.symbols[momentum])
    kappa, lasting = (sympy.Float(float(f"{value:.6g}"), 8) for value in values)
    tree = kappa * v - memory.lost(v, Absolute(v), w, Absolute(w)) / lasting
    return worded(-w), {name: worded(tree)}
