"""Angles that were recorded within one turn: they jump by a whole one where the motion passes the end of it.

A reading that is an angle of its own, c q + d of a coordinate whose whole turns change nothing, is counted on over the
turns. One that the simulation itself keeps within a turn, c atan2(y, x) + d, cannot be: beside a jump noise decides on
which side a reading falls, and the two on both sides are left out.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import sympy

from .._expression import symbol
from .._recording import Recording
from .._simulation_records import SimulationFile

# A step between neighbours of more than this share of a turn is one across its end, if all readings lie within a turn
# and this share of another; a swing of most of a turn, read twice in a period, steps less far.
_STEP, _BEYOND = 0.8, 0.02
# Of more than this share of the steps none is: what turns so fast is read too rarely to be counted.
_OFTEN = 0.25
# Phase points, in which what a turn leaves as it is differs by round-off alone.
_PLACES, _ROUND_OFF = (0.3, 1.1, -0.7), 1e-9


def unwrapped(file: SimulationFile, recordings: Sequence[Recording]) -> tuple[list[Recording], list[str]]:
    """The recordings with their angles counted on over whole turns, and what was done, in sentences."""
    out, told = list(recordings), []
    for j, (column, turn, is_kept) in enumerate(_turns(file)):
        if turn is None:
            continue
        jumps = [_jumps(r.readings[:, j], turn) for r in out]
        if number := sum(map(len, jumps)):
            one = _without_sides if is_kept else _counted_on
            out = [replace(r, readings=one(r.readings, j, at, turn)) for r, at in zip(out, jumps, strict=True)]
            done = "the readings on both sides were left out" if is_kept else "it was counted on over whole turns"
            times = "once" if number == 1 else f"{number} times"
            told.append(f"{column} jumps {times} by a whole turn ({turn:.6g}), as an angle does at its end: {done}")
    return out, told


def _turns(file: SimulationFile) -> Iterator[tuple[str, float | None, bool]]:
    """Of every column what a whole turn adds to its reading, None where it is no angle, and whether the simulation
    keeps it within one."""
    for column, expression in file.recording.observe.items():
        tree = expression.tree
        arcs = tree.atoms(sympy.atan2)
        if len(arcs) == 1:
            angle = sympy.Dummy(real=True)
            yield column, _slope(file, tree.subs(next(iter(arcs)), angle), angle), True
            continue
        moved = [q for q in file.coordinates if symbol(q) in tree.free_symbols]
        is_angle = len(moved) == 1 and _is_cyclic(file, moved[0])
        yield column, _slope(file, tree, symbol(moved[0])) if is_angle else None, False


def _slope(file: SimulationFile, tree: sympy.Expr, angle: sympy.Symbol) -> float | None:
    """2 pi c of c times an angle plus a constant, both known; None of anything else."""
    given = {symbol(name): one.value for name, one in file.parameters.items() if one.known}
    slope, rest = sympy.diff(tree, angle).subs(given), tree.subs(angle, 0).subs(given)
    if not (slope.is_number and rest.is_number):
        return None
    turn = 2 * np.pi * abs(float(slope))
    return turn if np.isfinite(turn) and turn > 0 else None


def _is_cyclic(file: SimulationFile, coordinate: str) -> bool:
    """Whether whole turns of a coordinate change nothing that moves it."""
    q = symbol(coordinate)
    if any(term.effect.endswith("stiffness") and coordinate in term.target for term in file.terms):
        return False

    def changed(tree: sympy.Expr) -> sympy.Expr:
        return tree.subs(q, q + 2 * sympy.pi) - tree

    pushes = [*file.forces.values(), *(term.expression for term in file.terms if term.expression is not None)]
    energy = changed(file.hamiltonian.tree)  # of which a constant moves nothing
    moved = [sympy.diff(energy, symbol(name)) for name in file.states]
    return all(_is_nothing(one) for one in [*moved, *(changed(push.tree) for push in pushes)])


def _is_nothing(tree: sympy.Expr) -> bool:
    """Whether an expression is zero at a few places."""
    names = sorted(tree.free_symbols, key=str)
    for place in _PLACES:
        value = complex(tree.subs({s: place + 0.1 * k for k, s in enumerate(names)}).evalf())
        if not abs(value) < _ROUND_OFF:
            return False
    return True


def _jumps(readings: np.ndarray, turn: float) -> np.ndarray:
    """Which of the readings that are there come a jump after the one before."""
    seen = readings[np.isfinite(readings)]
    if len(seen) < 2 or np.ptp(seen) > (1 + _BEYOND) * turn:
        return np.zeros(0, int)
    jumps = np.flatnonzero(np.abs(np.diff(seen)) > _STEP * turn) + 1
    return jumps if len(jumps) <= _OFTEN * len(seen) else np.zeros(0, int)


def _counted_on(readings: np.ndarray, j: int, jumps: np.ndarray, turn: float) -> np.ndarray:
    out = readings.copy()
    seen = np.isfinite(out[:, j])
    out[seen, j] = np.unwrap(out[seen, j], period=turn)
    return out


def _without_sides(readings: np.ndarray, j: int, jumps: np.ndarray, turn: float) -> np.ndarray:
    out = readings.copy()
    seen = np.flatnonzero(np.isfinite(out[:, j]))
    out[seen[np.concatenate([jumps - 1, jumps]).astype(int)], j] = np.nan
    return out
