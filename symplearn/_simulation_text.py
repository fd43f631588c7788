"""A simulation file's record -> TOML text that reads back as an equal record."""

import re
from collections.abc import Iterator, Mapping
from typing import Any

import sympy

from ._expression import Expression
from ._kinks import Sign, Step
from ._simulation_records import Quantity, SimulationFile, Term

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_ESCAPES = {'"': '\\"', "\\": "\\\\", "\n": "\\n", "\r": "\\r", "\t": "\\t"}


def simulation_text(simulation: SimulationFile) -> str:
    """The TOML text of a simulation. Expressions are the user's own words; numbers are exact (repr)."""
    return "\n".join(_lines(simulation)) + "\n"


def worded(tree: sympy.Expr) -> Expression:
    """A tree in words that are read back: a step, which slopes of `min` and `max` leave, is half of one and a sign."""
    if tree.has(Step):
        tree = tree.replace(Step, lambda arg: (1 + Sign(arg)) / 2)
    return Expression(str(tree), tree)


def _lines(simulation: SimulationFile) -> Iterator[str]:
    if simulation.title:
        yield f"title = {_text(simulation.title)}"
        yield ""
    yield "[system]"
    yield f"coordinates = {_value(simulation.coordinates)}"
    yield f"momenta = {_value(simulation.momenta)}"
    yield f"hamiltonian = {_value(simulation.hamiltonian)}"
    yield from _section("parameters", simulation.parameters)
    yield from _section("initial", simulation.initial)
    yield from _section("forces", simulation.forces)
    yield from _recording(simulation)
    yield from _section("units", simulation.units)
    yield from _section("integrator", _given(simulation.integrator, name="auto", step=None))
    for term in simulation.terms:
        yield from _term(term)


def _section(name: str, entries: Mapping[str, Any]) -> Iterator[str]:
    if entries:
        yield ""
        yield f"[{name}]"
        yield from (f"{_key(key)} = {_value(value)}" for key, value in entries.items())


def _given(record: Any, /, **defaults: Any) -> dict[str, Any]:
    """The fields of a record that differ from their defaults."""
    return {name: getattr(record, name) for name, value in defaults.items() if getattr(record, name) != value}


def _recording(simulation: SimulationFile) -> Iterator[str]:
    recording = simulation.recording
    defaults: dict[str, Any] = {
        "inputs": (),
        "interpolation": "hold",
        "start": None,
        "end": None,
        "group": (),
        "where": {},
    }
    yield from _section("recording", {"time": recording.time} | _given(recording, **defaults))
    yield from _section("recording.observe", recording.observe)
    yield from _section("recording.noise", recording.noise)


def _term(term: Term) -> Iterator[str]:
    yield ""
    yield "[[terms]]"
    yield f"effect = {_text(term.effect)}"
    yield f"target = {_value(term.target if len(term.target) > 1 else term.target[0])}"
    entries = dict(term.coefficients) | _given(term, side=None, expression=None, recordings=None, memory={})
    yield from (f"{_key(key)} = {_value(value)}" for key, value in entries.items())


def _value(value: Any) -> str:
    if isinstance(value, Quantity):
        return _value(value.value) if value.known else _value(_calibrated(value))
    if isinstance(value, Expression):
        return _text(value.text)
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, tuple):
        return "[" + ", ".join(map(_value, value)) + "]"
    # NumPy's own floats would print as np.float64(...).
    return repr(value if isinstance(value, int) else float(value))


def _calibrated(quantity: Quantity) -> dict[str, Any]:
    return {"value": quantity.value} | _given(quantity, sd=None, positive=False, lower=None, upper=None)


def _key(key: str) -> str:
    return key if _BARE_KEY.fullmatch(key) else _text(key)


def _text(text: str) -> str:
    """A basic TOML string; control characters are escaped."""
    return (
        '"'
        + "".join(_ESCAPES.get(c) or (c if ord(c) >= 32 and c != "\x7f" else f"\\u{ord(c):04x}") for c in text)
        + '"'
    )
