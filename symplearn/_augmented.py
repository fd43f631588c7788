"""The simulation with every word of the vocabulary built in, each behind amplitudes that may be zero."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import jax
import numpy as np
import sympy
from jaxtyping import Array

from ._effects import CENTRAL, SPRING, Candidate, Effect, Memory, Nameless, PowerForce, vocabulary
from ._separable import is_separable
from ._symbolic import derivative, jax_function
from ._symbolic_slopes import with_slopes
from ._terms import Further, Mechanics

# Keeps a central force and its slopes finite where both coordinates are zero; its amplitude is then zero as well.
_TINY = sympy.Float(1e-60)


@dataclass(frozen=True, eq=False)
class Equations:
    """The compiled right-hand sides of an augmented simulation, all functions of one argument vector.

    The vector is `[q, p, parameters, inputs, t, coefficients]`; the file's parameters come first, then those that its
    terms bring along. `candidates` tell where theirs stand among the coefficients. With `hidden`, phase points hold one
    unseen coordinate more than there are coordinates here.
    """

    coordinates: tuple[str, ...]
    momenta: tuple[str, ...]
    parameters: tuple[str, ...]
    inputs: tuple[str, ...]
    columns: tuple[str, ...]
    candidates: tuple[Candidate, ...]
    separable: bool
    hidden: bool
    delayed: bool
    start: float  # time of the first row used, from which drifts count
    origin: float  # time that phases inside count from
    declared: int  # coordinates of the file; the others are known hidden oscillators, and what known forces remember
    remembered: tuple[int, ...]  # coordinates that only stand for what a known force remembers, their momentum
    fades: bool  # whether forces that fade are built in, on every coordinate of the file
    jumping: tuple[int, ...]  # coordinates with known impulses
    further: tuple[Further, ...]  # parameters that the file's terms bring along
    energy: Callable[[Array], Array]
    slope: Callable[[Array], Array]  # dH/dq minus the known forces that no velocity enters
    velocity: Callable[[Array], Array]
    softness: Callable[[Array], Array]  # d2H/dp_i2, by which a momentum turns into a velocity
    kick: Callable[[Array], Array] | None  # known forces that a velocity or momentum enters
    parts: Callable[[Array], Array]  # what the known forces are sums of, end to end
    pushed: tuple[int, ...]  # the coordinate of every part
    readings: Callable[[Array], Array]  # what the columns show without errors of their sensors
    impulses: Callable[[Array], Array]  # size and time of every known impulse, end to end

    @cached_property
    def dim(self) -> int:
        """Degrees of freedom that the simulation knows."""
        return len(self.coordinates)

    @cached_property
    def width(self) -> int:
        """Degrees of freedom of a phase point."""
        return self.dim + self.hidden

    @property
    def momentum(self) -> slice:
        """Where the momenta that the simulation knows stand in a phase point."""
        return slice(self.width, self.width + self.dim)

    @cached_property
    def size(self) -> int:
        """Length of the coefficient vector."""
        last = self.candidates[-1]
        return last.first + last.effect.entries

    def firsts(self, effect: Effect, side: str | None = None) -> np.ndarray:
        """Where the values of an effect start in the coefficient vector, by target."""
        return np.array([c.first for c in self.candidates if c.effect is effect and c.side == side], int)

    def pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """First and second coordinate of every pair."""
        places = np.array([c.places for c in self.candidates if c.effect is SPRING], int).reshape(-1, 2)
        return places[:, 0], places[:, 1]


def equations(
    known: Mechanics,
    parameters: Sequence[sympy.Symbol],
    inputs: Sequence[sympy.Symbol],
    hidden: bool = True,
    delayed: bool = True,
    origin: float | None = None,
    nameless: Sequence[Nameless] = (),
) -> Equations:
    """Build the augmented simulation from parsed expressions.

    **Arguments:** - `hidden`, `delayed`: whether an unseen oscillator and delays of sensors are built in. - `origin`:
    time that phases inside count from; the first row's by default. - `nameless`: forces without a name.
    """
    coordinates, momenta, names = known.coordinates, known.momenta, [str(q) for q in known.coordinates]
    varying = {str(p): k for k, p in enumerate(parameters)}
    candidates = vocabulary(names[: known.declared], list(known.readings), varying, nameless)
    size = sum(one.effect.entries for one in candidates)
    c = [sympy.Symbol(f"c{index}*", real=True) for index in range(size)]
    stored = [one for one in candidates if isinstance(one.effect, PowerForce) or one.effect in (SPRING, CENTRAL)]
    energy = known.hamiltonian + sum(c[one.first] * _potential(one, coordinates) for one in stored)
    forces = list(known.forces)
    for one in candidates:
        for place, terms in zip(one.places, one.nameless.pushes if one.nameless else (), strict=False):
            forces[place] += sympy.Add(*(c[one.first + k] * term for k, term in enumerate(terms)))
    parts = [(place, part) for place, force in enumerate(known.forces) for part in _summands(force)]
    parts = parts or [(0, sympy.Integer(0))]
    still, driven = zip(*(f.as_independent(*momenta, as_Add=True) for f in forces), strict=True)
    every = [*parameters, *(one.symbol for one in known.further)]
    arguments = [*coordinates, *momenta, *every, *inputs, sympy.Symbol("t", real=True), *c]

    def compiled(expressions: Sequence[sympy.Expr]) -> Callable[[Array], Array]:
        return jax.jit(with_slopes(expressions, arguments))  # so that a tree is walked once, wherever it is called

    return Equations(
        coordinates=tuple(names),
        momenta=tuple(str(p) for p in momenta),
        parameters=tuple(str(p) for p in every),
        inputs=tuple(str(u) for u in inputs),
        columns=tuple(known.readings),
        candidates=candidates,
        separable=is_separable(known.hamiltonian, coordinates, momenta),
        hidden=hidden,
        delayed=delayed,
        start=known.start,
        origin=known.start if origin is None else origin,
        declared=known.declared,
        further=tuple(known.further),
        remembered=tuple(known.remembered),
        fades=any(isinstance(one.effect, Memory) for one in candidates),
        jumping=tuple(place for place, _, _ in known.impulses),
        energy=compiled([energy]),
        slope=compiled([derivative(energy, q) - f for q, f in zip(coordinates, still, strict=True)]),
        velocity=compiled([derivative(known.hamiltonian, p) for p in momenta]),
        softness=compiled([derivative(derivative(known.hamiltonian, p), p) for p in momenta]),
        kick=compiled(driven) if any(f != 0 for f in driven) else None,
        parts=jax.jit(jax_function([part for _, part in parts], arguments)),  # which nobody differentiates
        pushed=tuple(place for place, _ in parts),
        readings=compiled(list(known.readings.values())),
        impulses=compiled([value for _, size, when in known.impulses for value in (size, when)]),
    )


def _summands(force: sympy.Expr) -> list[sympy.Expr]:
    """What a force is a sum of, none of a force that is zero."""
    return [part for part in sympy.Add.make_args(sympy.expand_mul(force)) if part != 0]


def _potential(one: Candidate, coordinates: Sequence[sympy.Symbol]) -> sympy.Expr:
    """Potential energy of an effect per unit amplitude."""
    q = [coordinates[place] for place in one.places]
    if isinstance(one.effect, PowerForce):
        return one.effect.potential(q[0])
    if one.effect is SPRING:
        return (q[0] - q[1]) ** 2 / 2
    return -((q[0] ** 2 + q[1] ** 2 + _TINY) ** sympy.Rational(-3, 2))
