"""Known terms of a simulation file that are written into its equations: those that do not merely add.

An effect of one coefficient stays an entry of the augmented model's vector, to which the search adds; the others become
part of the Hamiltonian, the forces or the parameters (contract, section 3). A calibrated coefficient, and a mask for a
term that is not in every recording, are further parameters.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import prod

import sympy

from ._errors import InputError
from ._expression import symbol
from ._kinks import Maximum, Step
from ._simulation_records import Quantity, SimulationFile, Term
from ._symbolic import derivative

_TIME = symbol("t")
# Effects that change how readings scatter, and no equation.
_SCATTER = ("sensor_noise", "sensor_outliers")


@dataclass(frozen=True)
class Further:
    """A parameter that a term brings along: its value, the recordings where it is not zero, its name in sentences."""

    symbol: sympy.Symbol
    quantity: Quantity
    recordings: tuple[int, ...] | None
    name: str


@dataclass
class Mechanics:
    """The expressions of a simulation: Hamiltonian, force on every momentum, and reading of every column.

    The first `declared` coordinates are the file's own; known hidden oscillators follow them, and what known forces
    remember, of which only the momentum has a meaning: a number with a rate of change.
    """

    coordinates: list[sympy.Symbol]
    momenta: list[sympy.Symbol]
    hamiltonian: sympy.Expr
    forces: list[sympy.Expr]
    readings: dict[str, sympy.Expr]
    start: float  # time of the first row used
    declared: int = 0
    impulses: list[tuple[int, sympy.Expr, sympy.Expr]] = field(default_factory=list)
    further: list[Further] = field(default_factory=list)
    remembered: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.declared = self.declared or len(self.coordinates)

    def place(self, coordinate: str) -> int:
        return self.coordinates.index(symbol(coordinate))

    def velocity(self, place: int) -> sympy.Expr:
        return derivative(self.hamiltonian, self.momenta[place])


def mechanics(file: SimulationFile, start: float) -> Mechanics:
    """The expressions of a file with its known terms written in; `start` is the time of the first row used."""
    zero = sympy.Integer(0)
    built = Mechanics(
        [symbol(q) for q in file.coordinates],
        [symbol(p) for p in file.momenta],
        file.hamiltonian.tree,
        [file.forces[p].tree if p in file.forces else zero for p in file.momenta],
        {column: h.tree for column, h in file.recording.observe.items()},
        start,
    )
    for number, term in enumerate(file.terms, start=1):
        _check(file, term, number)
    names = calibrated_names(file.terms)
    # What scales a parameter does so wherever it stands, in forces of terms that come later, too.
    for written in (_ADDED, _SCALED):
        for number, term in enumerate(file.terms, start=1):
            if term.effect in written:
                written[term.effect](built, term, _numbers(built, term, number, names))
    return built


def calibrated_names(terms: Sequence[Term]) -> dict[tuple[int, str], str]:
    """What every calibrated coefficient is called, by the number of its term, from 1, and its own name; the number
    is said where two would be called the same."""
    spoken = {
        (number, name): f"{term.effect}({', '.join(term.target)}).{name}"
        for number, term in enumerate(terms, start=1)
        for name, quantity in term.coefficients.items()
        if not quantity.known
    }
    shared = Counter(spoken.values())
    return {key: f"{one} of [[terms]] {key[0]}" if shared[one] > 1 else one for key, one in spoken.items()}


def _numbers(built: Mechanics, term: Term, number: int, names: Mapping[tuple[int, str], str]) -> "_Numbers":
    """A term's coefficients: numbers where they are known, else parameters; the first is masked by recording."""
    out: _Numbers = {}
    for name, quantity in term.coefficients.items():
        out[name] = sympy.Float(quantity.value)
        if not quantity.known:
            out[name] = sympy.Symbol(f"term{number}.{name}", real=True)
            built.further.append(Further(out[name], quantity, None, names[number, name]))
    if term.recordings is not None:
        mask = sympy.Symbol(f"term{number}.on", real=True)
        built.further.append(Further(mask, Quantity(1.0), term.recordings, ""))
        out["on"] = mask
    return out


def noise_factor(file: SimulationFile, column: str) -> float:
    """By how much `sensor_noise` terms widen the noise of a column; NaN where one of them is calibrated."""
    own = [t.coefficients["s"] for t in file.terms if t.effect == "sensor_noise" and t.target == (column,)]
    return prod((s.value if s.known else float("nan") for s in own), start=1.0)


def _check(file: SimulationFile, term: Term, number: int) -> None:
    if term.effect in _SCATTER and term.recordings is not None:
        raise InputError(
            f"{file.name}: [[terms]] {number}: {term.effect} can only be in all recordings; leave `recordings` out, "
            "or diagnose the recordings one by one"
        )


_Numbers = dict[str, sympy.Expr]


def _on(c: _Numbers) -> sympy.Expr:
    """One, or the mask of a term that is not in every recording."""
    return c.get("on", sympy.Integer(1))


def _push(built: Mechanics, coordinate: str, force: sympy.Expr) -> None:
    built.forces[built.place(coordinate)] += force


def _self_excitation(built: Mechanics, term: Term, c: _Numbers) -> None:
    i = built.place(term.target[0])
    push = c["c"] * (1 - built.coordinates[i] ** 2 / c["a"] ** 2) * built.velocity(i)
    _push(built, term.target[0], _on(c) * push)


def _contact_stop(built: Mechanics, term: Term, c: _Numbers) -> None:
    q = symbol(term.target[0])
    depth = c["a"] - q if term.side == "lower" else q - c["a"]
    push = _on(c) * c["k"] * Maximum(depth, sympy.Integer(0))
    _push(built, term.target[0], push if term.side == "lower" else -push)


def _periodic_forcing(built: Mechanics, term: Term, c: _Numbers) -> None:
    _push(built, term.target[0], _on(c) * c["a"] * sympy.cos(c["omega"] * _TIME + c["phi"]))


def _impulse(built: Mechanics, term: Term, c: _Numbers) -> None:
    built.impulses.append((built.place(term.target[0]), _on(c) * c["j"], c["t_star"]))


def _unseen(built: Mechanics, name: str) -> tuple[sympy.Symbol, sympy.Symbol]:
    """A further coordinate and its momentum."""
    number = len(built.coordinates) - built.declared + 1
    z, momentum = (sympy.Symbol(f"{one}{number}*", real=True) for one in (name, f"{name}_momentum"))
    built.coordinates.append(z)
    built.momenta.append(momentum)
    built.forces.append(sympy.Integer(0))
    return z, momentum


def _hidden_oscillator(built: Mechanics, term: Term, c: _Numbers) -> None:
    z, momentum = _unseen(built, "hidden")
    coupling = _on(c) * c["kappa"] * symbol(term.target[0]) * z
    built.hamiltonian += momentum**2 / 2 + c["omega"] ** 2 * z**2 / 2 - coupling


def _unnamed_force(built: Mechanics, term: Term, c: _Numbers) -> None:
    assert term.expression is not None  # the file was checked
    named: dict[sympy.Expr, sympy.Expr] = {}
    for name in term.memory:
        built.remembered.append(len(built.coordinates))
        _, named[symbol(name)] = _unseen(built, "memory")
    for name, rate in term.memory.items():
        built.forces[built.momenta.index(named[symbol(name)])] = rate.tree.xreplace(named)
    _push(built, term.target[0], _on(c) * term.expression.tree.xreplace(named))


def _scaled(change: Callable[[Mechanics, _Numbers], sympy.Expr]) -> Callable[[Mechanics, Term, _Numbers], None]:
    """A term that multiplies a parameter by 1 + `change` wherever it stands."""

    def write(built: Mechanics, term: Term, c: _Numbers) -> None:
        parameter = symbol(term.target[0])
        changed: Mapping[sympy.Expr, sympy.Expr] = {parameter: parameter * (1 + _on(c) * change(built, c))}
        built.hamiltonian = built.hamiltonian.xreplace(changed)
        built.forces = [force.xreplace(changed) for force in built.forces]
        built.readings = {column: h.xreplace(changed) for column, h in built.readings.items()}

    return write


_ADDED: dict[str, Callable[[Mechanics, Term, _Numbers], None]] = {
    "self_excitation": _self_excitation,
    "contact_stop": _contact_stop,
    "periodic_forcing": _periodic_forcing,
    "impulse": _impulse,
    "hidden_oscillator": _hidden_oscillator,
    "unnamed_force": _unnamed_force,
}
_SCALED: dict[str, Callable[[Mechanics, Term, _Numbers], None]] = {
    "parametric_modulation": _scaled(lambda built, c: c["a"] * sympy.cos(c["omega"] * _TIME + c["phi"])),
    "regime_change": _scaled(lambda built, c: c["d"] * Step(_TIME - c["t_star"])),
}
