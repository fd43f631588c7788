"""Simple laws of force that have no word in the vocabulary: what a physicist would try next."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
import sympy

from .._effects import Nameless
from .._kinks import Absolute
from .._simulation_records import SimulationFile
from .._symbolic import derivative

# Coordinates up to which forces between some of them are tried: there are fifteen for every two.
_FEW = 3
# Share of the prior of what has no name that simple laws have; the rest is of what none of them tells.
_SHARE = 0.5
# Families that some are of.
_LOSS, _STORE = "dissipation", "conservative"
# Keeps the slope of a speed a number at rest.
_TINY = sympy.Float(1e-300)


def laws(file: SimulationFile) -> list[Nameless]:
    """Forces on coordinates, or between two, that the simulation may lack.

    Powers of place and speed that the vocabulary does not have, damping that hangs on place, inertia that does;
    energies and gyroscopic forces of two coordinates, what one of them does to the other and not back, and what goes
    with the speed of both. What a swing hardly tells from a word is not among them: two dampings one way only took the
    probability of a viscous one, a force that grows with time that of a sensor's drift.
    """
    states, number = file.symbols, range(len(file.coordinates))
    q = [states[name] for name in file.coordinates]
    v = [derivative(file.hamiltonian.tree, states[p]) for p in file.momenta]
    listed = [law for i in number for law in _own(i, file.coordinates[i], q[i], v[i])]
    if len(q) <= _FEW:
        listed += [law for pair in combinations(number, 2) for law in _between(pair, file.coordinates, q, v)]
        listed += [_of_three(three, file.coordinates, q) for three in combinations(number, 3)]
    return listed


def priced(listed: Sequence[Nameless]) -> list[Nameless]:
    """The same, each of which is one choice of all: together they have a share of what has no name."""
    return [replace(law, choices=float(np.log(len(listed) / _SHARE))) for law in listed]


def _own(i: int, name: str, q: sympy.Expr, v: sympy.Expr) -> Iterator[Nameless]:
    """On one coordinate by itself."""
    for kind, words, term in (
        (_LOSS, "goes with the third power of its speed", -(v**3)),
        (_LOSS, f"goes with its speed and the square of {name}", -(q**2) * v),
        ("", f"goes with its speed and {name}", q * v),
        ("", f"goes with {name} and the square of its speed, as where the inertia hangs on place", q * v**2),
        (_STORE, f"goes with the fifth power of {name}", -(q**5)),
    ):
        yield Nameless((i,), ((term,),), words=words, kind=kind)


def _between(
    pair: tuple[int, int], names: tuple[str, ...], q: Sequence[sympy.Expr], v: Sequence[sympy.Expr]
) -> Iterator[Nameless]:
    """On two coordinates, or on one of them by the other."""
    i, j = pair
    a, b, first, second = q[i], q[j], names[i], names[j]
    for energy, shown in (
        (a * b**2, f"{first} {second}^2"),
        (a**2 * b, f"{first}^2 {second}"),
        (a**2 * b**2 / 2, f"{first}^2 {second}^2"),
        ((a - b) ** 4 / 4, f"({first} - {second})^4"),
    ):
        pushes = (-derivative(energy, a),), (-derivative(energy, b),)
        yield Nameless(pair, pushes, words=f"comes from a potential energy that goes with {shown}", kind=_STORE)
    for place, name in ((a, first), (b, second)):
        pushes = (place * v[j],), (-place * v[i],)
        yield Nameless(pair, pushes, words=f"acts across the motion, with its speed and {name}", kind="gyroscopic")
    words = f"turns {first} towards {second} and {second} away from {first}, as where a shaft rubs in itself"
    yield Nameless(pair, ((b,), (-a,)), words=words)
    apart, speed = v[i] - v[j], sympy.sqrt(v[i] ** 2 + v[j] ** 2 + _TINY)
    drag = Absolute(apart) * apart
    words = "acts between them with the square of their relative speed"
    yield Nameless(pair, ((-drag,), (drag,)), words=words, kind=_LOSS)
    along = (-speed * v[i],), (-speed * v[j],)
    words = f"acts along the motion in {first} and {second}, with the square of its speed"
    yield Nameless(pair, along, words=words, kind=_LOSS)
    for k, m in ((i, j), (j, i)):
        yield Nameless((k,), ((q[m],),), words=f"goes with {names[m]}, which feels nothing of it")
        yield Nameless((k,), ((v[m],),), words=f"goes with the speed of {names[m]}, which feels nothing of it")
        yield Nameless((k,), ((q[m] * v[k],),), words=f"goes with its speed and {names[m]}")


def _of_three(three: tuple[int, int, int], names: tuple[str, ...], q: Sequence[sympy.Expr]) -> Nameless:
    """Of the energy that three coordinates have together, as three waves do."""
    energy = sympy.Mul(*(q[i] for i in three))
    pushes = tuple((-derivative(energy, q[i]),) for i in three)
    shown = " ".join(names[i] for i in three)
    return Nameless(three, pushes, words=f"comes from a potential energy that goes with {shown}", kind=_STORE)
