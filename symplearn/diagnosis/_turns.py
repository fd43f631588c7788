"""Angles that were recorded within one turn: they jump by a whole one where the motion passes the end of it.

A reading that is an angle of its own, c q + d of a coordinate whose whole turns change nothing, is counted on over the
turns. One that the simulation itself keeps within a turn, c atan2(y, x) + d, cannot be: beside a jump noise decides on
which side a reading falls, and the two on both sides are left out.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import sympy

from .._effects import COULOMB, FORCING, GYROSCOPIC, IMPULSE, POWERS, QUADRATIC, RELATIVE, VISCOUS
from .._expression import symbol
from .._recording import Recording
from .._simulation_records import SimulationFile
from .._vocabulary import COLUMN, PARAMETER, VOCABULARY

# A step between neighbours of more than this share of a turn is one across its end, if all readings lie within a turn
# and this share of another; a swing of most of a turn, read twice in a period, steps less far.
_STEP, _BEYOND = 0.8, 0.02
# Of more than this share of the steps none is: what turns so fast is read too rarely to be counted.
_OFTEN = 0.25
# Forces on a coordinate that do not hang on where it is.
_PLACELESS = frozenset(
    one.name for one in (VISCOUS, QUADRATIC, COULOMB, RELATIVE, GYROSCOPIC, POWERS[0], FORCING, IMPULSE)
)
# Phase points, in which what a turn leaves as it is differs by round-off alone.
_PLACES, _ROUND_OFF = (0.3, 1.1, -0.7), 1e-9


def unwrapped(file: SimulationFile, recordings: Sequence[Recording]) -> tuple[list[Recording], list[str]]:
    """The recordings with their angles counted on over whole turns, and what was done, in sentences."""
    out, told = list(recordings), []
    for j, (column, expression) in enumerate(file.recording.observe.items()):
        arcs = expression.tree.atoms(sympy.atan2)
        turn, coordinate = _kept(file, expression.tree, arcs) if arcs else _counted(file, expression.tree)
        jumps = [_jumps(r.readings[:, j], turn) for r in out] if turn else []
        number = sum(map(len, jumps))
        # Whether turns change anything is asked last: a long Hamiltonian takes its time.
        if turn is None or not number or (coordinate and not _is_cyclic(file, coordinate)):
            continue
        one = _counted_on if coordinate else _without_sides
        out = [replace(r, readings=one(r.readings, j, at, turn)) for r, at in zip(out, jumps, strict=True)]
        done = "it was counted on over whole turns" if coordinate else "the readings on both sides were left out"
        times = "once" if number == 1 else f"{number} times"
        told.append(f"{column} jumps {times} by a whole turn ({turn:.6g}), as an angle does at its end: {done}")
    return out, told


def _kept(file: SimulationFile, tree: sympy.Expr, arcs: Iterable[sympy.Expr]) -> tuple[float | None, None]:
    """What a whole turn is to a reading that the simulation keeps within one, by a single arc."""
    first, *others = arcs
    angle = sympy.Dummy(real=True)
    return None if others else _slope(file, tree.subs(first, angle), angle), None


def _counted(file: SimulationFile, tree: sympy.Expr) -> tuple[float | None, str | None]:
    """What a whole turn of a coordinate adds to a reading, and that coordinate; None where it is no angle."""
    moved = [q for q in file.coordinates if symbol(q) in tree.free_symbols]
    return (_slope(file, tree, symbol(moved[0])), moved[0]) if len(moved) == 1 else (None, None)


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
    # A column or a parameter may have the coordinate's name.
    pushes = [term for term in file.terms if VOCABULARY[term.effect].target not in (COLUMN, PARAMETER)]
    if any(coordinate in term.target and term.effect not in _PLACELESS for term in pushes if not term.expression):
        return False

    def changed(tree: sympy.Expr) -> sympy.Expr:
        return tree.subs(q, q + 2 * sympy.pi) - tree

    forces = [*file.forces.values(), *(term.expression for term in file.terms if term.expression is not None)]
    energy = changed(file.hamiltonian.tree)  # of which a constant moves nothing
    moved = [sympy.diff(energy, symbol(name)) for name in file.states]
    return all(_is_nothing(one) for one in [*moved, *(changed(push.tree) for push in forces)])


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
