"""The forces that were added, along the motion."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from ._words import side, targets


@dataclass(frozen=True, eq=False)
class Motion:
    """The motion that a force is drawn along: times, positions and velocities of all coordinates."""

    times: Float[np.ndarray, " time"]
    position: Float[np.ndarray, "time coordinate"]
    velocity: Float[np.ndarray, "time coordinate"]


@dataclass(frozen=True, eq=False)
class _Along:
    """What a law may depend on, seen from one of its coordinates; `turn` is -1 from the second of a pair."""

    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    q2: np.ndarray
    v2: np.ndarray
    turn: int
    lower: bool


def added_force(
    findings: Iterable[Mapping[str, Any]],
    coordinates: Sequence[str],
    coordinate: str,
    motion: Motion,
    recording: int,
) -> Float[np.ndarray, " time"] | None:
    """Sum of the findings that are forces on `coordinate` in this recording; `None` where there is none.

    An effect that is no function of positions, velocities and time (a jump, a hidden coordinate, a changed parameter)
    is not counted.
    """
    here = [
        finding
        for finding in findings
        if coordinate in targets(finding)
        and finding["effect"] in _FORCES
        and recording in (finding.get("recordings") or [recording])
        and set(targets(finding)) <= set(coordinates)
    ]
    if not here:
        return None
    with np.errstate(all="ignore"):  # a motion that diverged is drawn as far as it goes
        return sum((_force(one, coordinates, coordinate, motion) for one in here), np.zeros(len(motion.times)))


def _force(finding: Mapping[str, Any], coordinates: Sequence[str], coordinate: str, motion: Motion) -> np.ndarray:
    names = targets(finding)
    other = names[1 - names.index(coordinate)] if len(names) == 2 else coordinate
    i, j = coordinates.index(coordinate), coordinates.index(other)
    q, v, turn = motion.position, motion.velocity, -1 if coordinate != names[0] else 1
    along = _Along(motion.times, q[:, i], v[:, i], q[:, j], v[:, j], turn, side(finding) == "lower")
    values = {name: value["mean"] for name, value in finding["coefficients"].items() if isinstance(value, Mapping)}
    return _FORCES[finding["effect"]](along, values)


def _contact(x: _Along, c: Mapping[str, float]) -> np.ndarray:
    return c["k"] * (np.maximum(c["a"] - x.q, 0.0) if x.lower else -np.maximum(x.q - c["a"], 0.0))


# The contract's laws, section 3.
_FORCES: dict[str, Callable[[_Along, Mapping[str, float]], np.ndarray]] = {
    "viscous_damping": lambda x, c: -c["c"] * x.v,
    "quadratic_drag": lambda x, c: -c["c"] * np.abs(x.v) * x.v,
    "coulomb_friction": lambda x, c: -c["f"] * np.sign(x.v),
    "relative_damping": lambda x, c: -c["c"] * (x.v - x.v2),
    "self_excitation": lambda x, c: c["c"] * (1 - x.q**2 / c["a"] ** 2) * x.v,
    "constant_force": lambda x, c: np.full(len(x.t), c["f"]),
    "linear_stiffness": lambda x, c: -c["k"] * x.q,
    "quadratic_stiffness": lambda x, c: -c["k"] * x.q**2,
    "cubic_stiffness": lambda x, c: -c["k"] * x.q**3,
    "coupling_spring": lambda x, c: -c["k"] * (x.q - x.q2),
    "contact_stop": _contact,
    "central_correction": lambda x, c: -3 * c["b"] * x.q / np.hypot(x.q, x.q2) ** 5,
    "gyroscopic_coupling": lambda x, c: x.turn * c["b"] * x.v2,
    "periodic_forcing": lambda x, c: c["a"] * np.cos(c["omega"] * x.t + c["phi"]),
}
