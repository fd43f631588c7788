"""Nature's zoo: closed forms of the systems that the concealed cases are drawn from. NumPy alone; no code of symplearn.

Every function takes states and parameters elementwise, so that one motion or many lanes of it use the same lines.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

Values = Mapping[str, Any]
Generator = np.random.Generator


@dataclass(frozen=True)
class Reading:
    """A sensor that a system offers: column, expression, the same in NumPy, and the coordinates that it sees."""

    column: str
    text: str
    see: Callable[[Sequence[Any], Sequence[Any], Values], Any]
    sees: tuple[int, ...]
    kind: str  # position, velocity or nonlinear


@dataclass(frozen=True)
class System:
    """A Hamiltonian system, its closed-form equations of motion, and how its parameters and starts are drawn."""

    name: str
    title: str
    coordinates: tuple[str, ...]
    momenta: tuple[str, ...]
    hamiltonian: str
    energy: Callable[[Sequence[Any], Sequence[Any], Values], Any]
    velocity: Callable[[Sequence[Any], Sequence[Any], Values], list[Any]]
    force: Callable[[Sequence[Any], Sequence[Any], Values], list[Any]]
    draw: Callable[[Generator], dict[str, float]]
    start: Callable[[Generator, Values], np.ndarray]
    period: Callable[[Values], float]
    readings: tuple[Reading, ...]
    varied: tuple[str, ...]  # parameters whose change the motion shows
    always_known: tuple[str, ...] = ()
    quick: float = 1.0  # how much faster than `period` the fastest motion may be
    diagonal: bool = True  # p_i = m_i v_i, so that dry friction holds at p_i = 0
    alike: bool = True  # two coordinates in one unit, so that springs and dampers between them make sense
    around_origin: bool = False  # never near r = 0, so that a central correction makes sense
    forces: Mapping[str, str] = field(default_factory=dict)  # the known drive, as text
    drive: Callable[[Sequence[Any], Sequence[Any], Values, Any], list[Any]] | None = None

    @property
    def dof(self) -> int:
        """Number of coordinates."""
        return len(self.coordinates)

    def mentions(self, parameter: str, reading: Reading) -> bool:
        """Whether a sensor's expression holds a parameter."""
        return re.search(rf"\b{parameter}\b", reading.text) is not None


def log_uniform(rng: Generator, low: float, high: float) -> float:
    """A positive number whose logarithm is uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _sign(rng: Generator) -> float:
    return float(rng.choice([-1.0, 1.0]))


def position(i: int, name: str, column: str) -> Reading:
    """A sensor of one coordinate."""
    return Reading(column, name, lambda q, p, P, i=i: q[i] + 0.0, (i,), "position")


def _turned(amplitude: float, rng: Generator, stiffness: float, mass: float) -> np.ndarray:
    """A start of a given amplitude: at rest at its turning point in half of the draws, otherwise on the way."""
    angle = 0.0 if rng.random() < 0.5 else rng.uniform(-np.pi, np.pi)
    return np.array([amplitude * np.cos(angle), amplitude * np.sin(angle) * np.sqrt(stiffness * mass)])


PENDULUM = System(
    "pendulum",
    "Pendulum",
    ("theta",),
    ("p_theta",),
    "p_theta**2/(2*m*l**2) - m*g*l*cos(theta)",
    energy=lambda q, p, P: p[0] ** 2 / (2 * P["m"] * P["l"] ** 2) - P["m"] * P["g"] * P["l"] * np.cos(q[0]),
    velocity=lambda q, p, P: [p[0] / (P["m"] * P["l"] ** 2)],
    force=lambda q, p, P: [-P["m"] * P["g"] * P["l"] * np.sin(q[0])],
    draw=lambda rng: {"m": log_uniform(rng, 0.05, 1.0), "g": 9.81, "l": log_uniform(rng, 0.2, 1.5)},
    start=lambda rng, P: np.array([_sign(rng) * rng.uniform(0.3, 2.0), 0.0]),
    period=lambda P: 2 * np.pi * np.sqrt(P["l"] / P["g"]),
    readings=(
        position(0, "theta", "angle_rad"),
        Reading("rate", "p_theta/(m*l**2)", lambda q, p, P: p[0] / (P["m"] * P["l"] ** 2), (0,), "velocity"),
        Reading("x_m", "l*sin(theta)", lambda q, p, P: P["l"] * np.sin(q[0]), (0,), "nonlinear"),
    ),
    varied=("l", "g"),
    always_known=("m",),
)


def _duffing_parameters(rng: Generator) -> dict[str, float]:
    k = log_uniform(rng, 1.0, 20.0)
    return {"m": log_uniform(rng, 0.3, 3.0), "k": k, "b": k * rng.uniform(0.1, 1.0)}


DUFFING = System(
    "duffing",
    "Duffing oscillator",
    ("q",),
    ("p",),
    "p**2/(2*m) + k*q**2/2 + b*q**4/4",
    energy=lambda q, p, P: p[0] ** 2 / (2 * P["m"]) + P["k"] * q[0] ** 2 / 2 + P["b"] * q[0] ** 4 / 4,
    velocity=lambda q, p, P: [p[0] / P["m"]],
    force=lambda q, p, P: [-P["k"] * q[0] - P["b"] * q[0] ** 3],
    draw=_duffing_parameters,
    start=lambda rng, P: _turned(rng.uniform(0.5, 1.4), rng, P["k"], P["m"]),
    period=lambda P: 2 * np.pi * np.sqrt(P["m"] / P["k"]),
    readings=(
        position(0, "q", "q_m"),
        Reading("speed", "p/m", lambda q, p, P: p[0] / P["m"], (0,), "velocity"),
        Reading("volts", "tanh(0.8*q)", lambda q, p, P: np.tanh(0.8 * q[0]), (0,), "nonlinear"),
    ),
    varied=("k", "b", "m"),
    always_known=("m",),
    quick=1.5,
)


def _well_start(rng: Generator, P: Values) -> np.ndarray:
    """Within one well, or over the barrier in a third of the draws; never close to the separatrix."""
    well = np.sqrt(P["a"] / P["b"])
    if rng.random() < 1 / 3:
        return np.array([_sign(rng) * well * rng.uniform(1.55, 1.8), 0.0])
    return np.array([_sign(rng) * well * rng.uniform(1.08, 1.3), 0.0])


DOUBLE_WELL = System(
    "double_well",
    "Particle in a double well",
    ("q",),
    ("p",),
    "p**2/(2*m) - a*q**2/2 + b*q**4/4",
    energy=lambda q, p, P: p[0] ** 2 / (2 * P["m"]) - P["a"] * q[0] ** 2 / 2 + P["b"] * q[0] ** 4 / 4,
    velocity=lambda q, p, P: [p[0] / P["m"]],
    force=lambda q, p, P: [P["a"] * q[0] - P["b"] * q[0] ** 3],
    draw=lambda rng: {"m": 1.0, "a": rng.uniform(0.7, 2.0), "b": rng.uniform(0.5, 2.0)},
    start=_well_start,
    period=lambda P: 2 * np.pi * np.sqrt(P["m"] / (2 * P["a"])),
    readings=(
        position(0, "q", "q_mm"),
        Reading("speed", "p/m", lambda q, p, P: p[0] / P["m"], (0,), "velocity"),
    ),
    varied=("a", "b"),
    always_known=("m",),
    quick=1.7,
)

DRIVEN_SPRING = System(
    "driven_spring",
    "Mass on a spring, driven by a motor",
    ("q",),
    ("p",),
    "p**2/(2*m) + k*q**2/2",
    energy=lambda q, p, P: p[0] ** 2 / (2 * P["m"]) + P["k"] * q[0] ** 2 / 2,
    velocity=lambda q, p, P: [p[0] / P["m"]],
    force=lambda q, p, P: [-P["k"] * q[0]],
    draw=lambda rng: {"m": log_uniform(rng, 0.3, 3.0), "k": (k := log_uniform(rng, 1.0, 20.0)), "gain": 0.4 * k},
    start=lambda rng, P: _turned(rng.uniform(0.3, 1.0), rng, P["k"], P["m"]),
    period=lambda P: 2 * np.pi * np.sqrt(P["m"] / P["k"]),
    readings=(
        position(0, "q", "q_m"),
        Reading("speed", "p/m", lambda q, p, P: p[0] / P["m"], (0,), "velocity"),
    ),
    varied=("k", "gain"),
    always_known=("m",),
    forces={"p": "gain*u"},
    drive=lambda q, p, P, u: [P["gain"] * u],
)

MORSE = System(
    "morse",
    "Diatomic bond after Morse",
    ("x",),
    ("p",),
    "p**2/(2*m) + D*(1 - exp(-a*x))**2",
    energy=lambda q, p, P: p[0] ** 2 / (2 * P["m"]) + P["D"] * (1 - np.exp(-P["a"] * q[0])) ** 2,
    velocity=lambda q, p, P: [p[0] / P["m"]],
    force=lambda q, p, P: [-2 * P["D"] * P["a"] * (1 - np.exp(-P["a"] * q[0])) * np.exp(-P["a"] * q[0])],
    draw=lambda rng: {
        "m": log_uniform(rng, 0.5, 2.0),
        "D": log_uniform(rng, 1.0, 5.0),
        "a": rng.uniform(0.6, 1.4),
    },
    start=lambda rng, P: np.array([-np.log(1 - np.sqrt(rng.uniform(0.08, 0.45))) / P["a"], 0.0]),
    period=lambda P: 2 * np.pi * np.sqrt(P["m"] / (2 * P["D"] * P["a"] ** 2)),
    readings=(
        position(0, "x", "x_A"),
        Reading("speed", "p/m", lambda q, p, P: p[0] / P["m"], (0,), "velocity"),
        Reading("dipole", "x*exp(-0.3*x)", lambda q, p, P: q[0] * np.exp(-0.3 * q[0]), (0,), "nonlinear"),
    ),
    varied=("D", "a"),
    always_known=("m",),
    quick=1.6,
)

LINE = (PENDULUM, DUFFING, DOUBLE_WELL, DRIVEN_SPRING, MORSE)
