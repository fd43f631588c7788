"""Known terms of a simulation file that are written into its equations: everything but the nine searched effects.

A searched effect stays a coefficient of the augmented model; the others, with known numbers, become part of the
Hamiltonian, the forces, the parameters or the readings (contract, section 3).
"""

from collections.abc import Callable
from dataclasses import dataclass

import sympy

from ._effects import EFFECTS
from ._errors import InputError
from ._expression import symbol
from ._kinks import Maximum, Step
from ._simulation_records import SimulationFile, Term
from ._symbolic import derivative

_TIME = symbol("t")


@dataclass
class Mechanics:
    """The expressions of a simulation: Hamiltonian, force on every momentum, reading and drift of every column."""

    coordinates: list[sympy.Symbol]
    momenta: list[sympy.Symbol]
    hamiltonian: sympy.Expr
    forces: list[sympy.Expr]
    readings: dict[str, sympy.Expr]
    drifts: dict[str, sympy.Expr]
    start: float  # time of the first row used

    def place(self, coordinate: str) -> int:
        return self.coordinates.index(symbol(coordinate))

    def velocity(self, place: int) -> sympy.Expr:
        return derivative(self.hamiltonian, self.momenta[place])


def mechanics(file: SimulationFile, start: float) -> Mechanics:
    """The expressions of a file with its known terms written in; `start` is the time of the first row used.

    `InputError` for a term that cannot be simulated.
    """
    zero = sympy.Integer(0)
    built = Mechanics(
        [symbol(q) for q in file.coordinates],
        [symbol(p) for p in file.momenta],
        file.hamiltonian.tree,
        [file.forces[p].tree if p in file.forces else zero for p in file.momenta],
        {column: h.tree for column, h in file.recording.observe.items()},
        {column: zero for column in file.recording.observe},
        start,
    )
    for number, term in enumerate(file.terms, start=1):
        if term.effect not in EFFECTS:
            _check(file, term, number)
            if term.effect in _WRITTEN:
                _WRITTEN[term.effect](built, term, {n: sympy.Float(q.value) for n, q in term.coefficients.items()})
    return built


def noise_factor(file: SimulationFile, column: str) -> float:
    """By how much known `sensor_noise` terms widen the noise of a column."""
    factor = 1.0
    for term in file.terms:
        if term.effect == "sensor_noise" and term.target == (column,):
            factor *= term.coefficients["s"].value
    return factor


def _check(file: SimulationFile, term: Term, number: int) -> None:
    place = f"{file.name}: [[terms]] {number}: {term.effect}"
    if term.effect not in _WRITTEN and term.effect != "sensor_noise":
        raise InputError(f"{place} cannot be simulated by this version; leave it out, or write its force into [forces]")
    if not all(q.known for q in term.coefficients.values()):
        raise InputError(f"{place} can only have known coefficients in this version; give plain numbers")
    if term.recordings is not None:
        raise InputError(f"{place} can only be in all recordings in this version; leave `recordings` out")


_Numbers = dict[str, sympy.Expr]


def _push(built: Mechanics, coordinate: str, force: sympy.Expr) -> None:
    built.forces[built.place(coordinate)] += force


def _relative_damping(built: Mechanics, term: Term, c: _Numbers) -> None:
    i, j = (built.place(q) for q in term.target)
    force = -c["c"] * (built.velocity(i) - built.velocity(j))
    _push(built, term.target[0], force)
    _push(built, term.target[1], -force)


def _self_excitation(built: Mechanics, term: Term, c: _Numbers) -> None:
    i = built.place(term.target[0])
    _push(built, term.target[0], c["c"] * (1 - built.coordinates[i] ** 2 / c["a"] ** 2) * built.velocity(i))


def _coupling_spring(built: Mechanics, term: Term, c: _Numbers) -> None:
    q, r = (symbol(name) for name in term.target)
    built.hamiltonian += c["k"] * (q - r) ** 2 / 2


def _contact_stop(built: Mechanics, term: Term, c: _Numbers) -> None:
    q = symbol(term.target[0])
    depth = c["a"] - q if term.side == "lower" else q - c["a"]
    push = c["k"] * Maximum(depth, sympy.Integer(0))
    _push(built, term.target[0], push if term.side == "lower" else -push)


def _central_correction(built: Mechanics, term: Term, c: _Numbers) -> None:
    q, r = (symbol(name) for name in term.target)
    built.hamiltonian += -c["b"] * (q**2 + r**2) ** sympy.Rational(-3, 2)


def _gyroscopic_coupling(built: Mechanics, term: Term, c: _Numbers) -> None:
    i, j = (built.place(q) for q in term.target)
    along = built.velocity(i), built.velocity(j)
    _push(built, term.target[0], c["b"] * along[1])
    _push(built, term.target[1], -c["b"] * along[0])


def _periodic_forcing(built: Mechanics, term: Term, c: _Numbers) -> None:
    _push(built, term.target[0], c["a"] * sympy.cos(c["omega"] * _TIME + c["phi"]))


def _unnamed_force(built: Mechanics, term: Term, c: _Numbers) -> None:
    assert term.expression is not None  # the file was checked
    _push(built, term.target[0], term.expression.tree)


def _sensor_drift(built: Mechanics, term: Term, c: _Numbers) -> None:
    built.drifts[term.target[0]] += c["r"] * (_TIME - built.start)


def _scaled(factor: Callable[[Mechanics, _Numbers], sympy.Expr]) -> Callable[[Mechanics, Term, _Numbers], None]:
    """A term that multiplies a parameter wherever it stands."""

    def write(built: Mechanics, term: Term, c: _Numbers) -> None:
        parameter = symbol(term.target[0])
        change = {parameter: parameter * factor(built, c)}
        built.hamiltonian = built.hamiltonian.xreplace(change)
        built.forces = [force.xreplace(change) for force in built.forces]
        built.readings = {column: h.xreplace(change) for column, h in built.readings.items()}

    return write


_WRITTEN: dict[str, Callable[[Mechanics, Term, _Numbers], None]] = {
    "relative_damping": _relative_damping,
    "self_excitation": _self_excitation,
    "coupling_spring": _coupling_spring,
    "contact_stop": _contact_stop,
    "central_correction": _central_correction,
    "gyroscopic_coupling": _gyroscopic_coupling,
    "periodic_forcing": _periodic_forcing,
    "unnamed_force": _unnamed_force,
    "sensor_drift": _sensor_drift,
    "parametric_modulation": _scaled(lambda built, c: 1 + c["a"] * sympy.cos(c["omega"] * _TIME + c["phi"])),
    "parameter_drift": _scaled(lambda built, c: 1 + c["r"] * (_TIME - built.start)),
    "regime_change": _scaled(lambda built, c: 1 + c["d"] * Step(_TIME - c["t_star"])),
    "parameter_error": _scaled(lambda built, c: 1 + c["d"]),
}
