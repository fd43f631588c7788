"""What nature can leave out of a simulation: every word of the contract, and some that it has no word for.

Formulas are elementwise, so that coefficients may be numbers or an array with one entry for each lane of a batch.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ._concealed_systems import System, Values

FAMILY = {
    "viscous_damping": "dissipation", "quadratic_drag": "dissipation", "coulomb_friction": "dissipation",
    "relative_damping": "dissipation", "self_excitation": "activity", "constant_force": "conservative",
    "linear_stiffness": "conservative", "quadratic_stiffness": "conservative", "cubic_stiffness": "conservative",
    "coupling_spring": "conservative", "contact_stop": "conservative", "central_correction": "conservative",
    "gyroscopic_coupling": "gyroscopic", "periodic_forcing": "forcing", "impulse": "forcing",
    "parametric_modulation": "time variation", "parameter_drift": "time variation",
    "regime_change": "time variation", "hidden_oscillator": "hidden degree of freedom",
    "parameter_error": "calibration", "sensor_noise": "sensor", "sensor_bias": "sensor", "sensor_gain": "sensor",
    "sensor_drift": "sensor", "sensor_delay": "sensor", "sensor_outliers": "sensor",
}  # fmt: skip
SENSOR = tuple(word for word, family in FAMILY.items() if family == "sensor")
PARAMETRIC = ("parametric_modulation", "parameter_drift", "regime_change", "parameter_error")
PAIRED = ("relative_damping", "coupling_spring", "central_correction", "gyroscopic_coupling")
# No word of the contract means these.
OUTSIDE = (
    "cubic_damping", "saturating_friction", "quintic_stiffness", "position_damping", "hysteresis", "delayed_force",
    "burst",
)  # fmt: skip
# What each coefficient is scaled by to make the effect stronger; the others are its shape.
STRENGTH = {
    "coulomb_friction": "f", "constant_force": "f", "linear_stiffness": "k", "quadratic_stiffness": "k",
    "cubic_stiffness": "k", "coupling_spring": "k", "contact_stop": "k", "central_correction": "b",
    "gyroscopic_coupling": "b", "periodic_forcing": "a", "impulse": "j", "parametric_modulation": "a",
    "parameter_drift": "r", "regime_change": "d", "hidden_oscillator": "kappa", "parameter_error": "d",
    "sensor_noise": "s", "sensor_bias": "b", "sensor_gain": "g", "sensor_drift": "r", "sensor_delay": "tau",
    "sensor_outliers": "e", "quintic_stiffness": "k", "hysteresis": "k", "delayed_force": "k", "burst": "f",
    "ripple": "a",
}  # fmt: skip


@dataclass(frozen=True)
class Effect:
    """One effect: its word, what it acts on, its coefficients, and the recordings (from 1) it is in; empty: all."""

    word: str
    target: str | tuple[str, ...]
    values: Mapping[str, Any]
    recordings: tuple[int, ...] = ()

    @property
    def key(self) -> tuple[str, str]:
        """Word and target as one text."""
        return self.word, self.target if isinstance(self.target, str) else ",".join(self.target)

    @property
    def strength(self) -> str:
        """The coefficient that makes it stronger."""
        return STRENGTH.get(self.word, "c")

    def with_values(self, **values: Any) -> "Effect":
        """The same with some coefficients replaced."""
        return replace(self, values=dict(self.values) | values)

    def scaled(self, factor: float) -> "Effect":
        """The same, so much stronger. What a hidden oscillator does goes with kappa squared."""
        power = 0.5 if self.word == "hidden_oscillator" else 1.0
        name = self.strength
        return self.with_values(**{name: self.values[name] * factor**power})


@dataclass(frozen=True)
class Inputs:
    """An input column at the rows, and how it runs between them."""

    times: np.ndarray
    values: np.ndarray
    linear: bool = False

    def at(self, t: Any, since: float) -> Any:
        """Its value at t, or at as many times, within the interval between rows that holds `since`."""
        if self.linear:
            return np.interp(t, self.times, self.values)
        place = np.searchsorted(self.times, since, side="right") - 1
        return float(self.values[max(int(place), 0)])


@dataclass(frozen=True)
class World:
    """What moves in one recording: a system, its parameters, effects, inputs, and the time of its first row."""

    system: System
    values: Values
    effects: tuple[Effect, ...] = ()
    inputs: Inputs | None = None
    origin: float = 0.0

    @property
    def extra(self) -> int:
        """Number of states beyond coordinates and momenta."""
        return sum(_EXTRA.get(e.word, 0) for e in self.effects)

    def parameters(self, t: Any, modes: "Modes") -> Values:
        """The parameters at a time."""
        found = dict(self.values)
        for k, effect in enumerate(self.effects):
            if effect.word in PARAMETRIC:
                name = str(effect.target)
                found[name] = found[name] * (1 + _VARIES[effect.word](t - self.origin, t, effect.values, modes, k))
        return found


@dataclass
class Modes:
    """What is discrete: the side on which each friction acts (0: it holds), regimes begun, and the interval's start."""

    since: float = 0.0
    side: dict[int, Any] = field(default_factory=dict)
    begun: dict[int, Any] = field(default_factory=dict)
    past: Callable[[Any], Any] | None = None


_VARIES: dict[str, Callable[..., Any]] = {
    "parametric_modulation": lambda dt, t, c, modes, k: c["a"] * np.cos(c["omega"] * t + c["phi"]),
    "parameter_drift": lambda dt, t, c, modes, k: c["r"] * dt,
    "regime_change": lambda dt, t, c, modes, k: c["d"] * modes.begun.get(k, 0.0),
    "parameter_error": lambda dt, t, c, modes, k: c["d"],
}
_EXTRA = {"hidden_oscillator": 2, "hysteresis": 1}


def _contact(c: Values, q: Any) -> Any:
    if c["side"] == "lower":
        return c["k"] * np.maximum(c["a"] - q, 0.0)
    return -c["k"] * np.maximum(q - c["a"], 0.0)


# Force on one coordinate from its own position and velocity.
_OWN: dict[str, Callable[[Values, Any, Any, Any], Any]] = {
    "viscous_damping": lambda c, q, v, t: -c["c"] * v,
    "quadratic_drag": lambda c, q, v, t: -c["c"] * np.abs(v) * v,
    "self_excitation": lambda c, q, v, t: c["c"] * (1 - q**2 / c["a"] ** 2) * v,
    "constant_force": lambda c, q, v, t: c["f"],
    "linear_stiffness": lambda c, q, v, t: -c["k"] * q,
    "quadratic_stiffness": lambda c, q, v, t: -c["k"] * q**2,
    "cubic_stiffness": lambda c, q, v, t: -c["k"] * q**3,
    "contact_stop": lambda c, q, v, t: _contact(c, q),
    "periodic_forcing": lambda c, q, v, t: c["a"] * np.cos(c["omega"] * t + c["phi"]),
    "cubic_damping": lambda c, q, v, t: -c["c"] * v**3,
    "saturating_friction": lambda c, q, v, t: -c["c"] * np.tanh(v / c["w"]),
    "quintic_stiffness": lambda c, q, v, t: -c["k"] * q**5,
    "position_damping": lambda c, q, v, t: -c["c"] * q**2 * v,
}


def _pair(effect: Effect, q: Any, v: Any, i: int, j: int) -> tuple[Any, Any]:
    """Forces on both coordinates of a pair."""
    c = effect.values
    if effect.word == "relative_damping":
        one = -c["c"] * (v[i] - v[j])
        return one, -one
    if effect.word == "coupling_spring":
        one = -c["k"] * (q[i] - q[j])
        return one, -one
    if effect.word == "gyroscopic_coupling":
        return c["b"] * v[j], -c["b"] * v[i]
    pull = -3 * c["b"] * (q[i] ** 2 + q[j] ** 2) ** -2.5  # minus the slope of -b/r^3
    return pull * q[i], pull * q[j]


def rates(t: Any, x: Any, world: World, modes: Modes) -> list[Any]:
    """Time derivative of coordinates, momenta and extra states."""
    system, d = world.system, world.system.dof
    q, p = x[:d], x[d : 2 * d]
    values = world.parameters(t, modes)
    v, force = system.velocity(q, p, values), list(system.force(q, p, values))
    if system.drive is not None and world.inputs is not None:
        force = [f + g for f, g in zip(force, system.drive(q, p, values, world.inputs.at(t, modes.since)), strict=True)]
    extra: list[Any] = []
    for effect in world.effects:
        _add(effect, system, t, x[2 * d + len(extra) :], q, v, force, extra, modes)
    for k, effect in enumerate(world.effects):
        if effect.word == "coulomb_friction":
            _rub(effect, system.coordinates.index(str(effect.target)), force, modes.side.get(k, 0.0))
    return [*v, *force, *extra]


def _add(effect: Effect, system: System, t: Any, z: Any, q: Any, v: Any, force: Any, extra: Any, modes: Modes) -> None:
    """Add one effect to the forces, and its own states' rates to `extra`."""
    c, word = effect.values, effect.word
    if word in PAIRED:
        i, j = (system.coordinates.index(name) for name in effect.target)
        one, other = _pair(effect, q, v, i, j)
        force[i], force[j] = force[i] + one, force[j] + other
        return
    if effect.target not in system.coordinates:
        return
    i = system.coordinates.index(str(effect.target))
    if word in _OWN:
        force[i] = force[i] + _OWN[word](c, q[i], v[i], t)
    elif word == "hidden_oscillator":
        force[i] = force[i] + c["kappa"] * z[0]
        extra += [z[1], -(c["omega"] ** 2) * z[0] + c["kappa"] * q[i]]
    elif word == "hysteresis":
        force[i] = force[i] - c["k"] * z[0]
        extra += [(v[i] - 0.5 * np.abs(v[i]) * z[0] / c["w"] - 0.5 * v[i] * np.abs(z[0]) / c["w"])]
    elif word == "delayed_force" and modes.past is not None:
        force[i] = force[i] - c["k"] * modes.past(t - c["tau"])[i]
    elif word == "burst":
        force[i] = force[i] + c["f"] * ((modes.since >= c["t_on"]) & (modes.since < c["t_off"]))


def _rub(effect: Effect, i: int, force: Any, side: Any) -> None:
    """Dry friction: against the motion while it slides, and as much as the other forces while it holds."""
    force[i] = np.where(side == 0, 0.0, force[i] - effect.values["f"] * side)


def other_forces(t: Any, x: Any, world: World, modes: Modes, k: int) -> Any:
    """The force on the coordinate of friction k without that friction."""
    i = world.system.coordinates.index(str(world.effects[k].target))
    sliding = replace_side(modes, k, 1.0)
    return rates(t, x, world, sliding)[world.system.dof + i] + world.effects[k].values["f"]


def replace_side(modes: Modes, k: int, side: Any) -> Modes:
    """The same modes with one friction on a given side."""
    return Modes(modes.since, modes.side | {k: side}, modes.begun, modes.past)
