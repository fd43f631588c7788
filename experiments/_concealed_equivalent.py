"""Forms that no recording of the kind at hand can tell apart, each with its reason; the scorer takes either name.

Only exact equivalences stand here. What is merely hard to tell apart is decided by the oracle's fits.
"""

from collections.abc import Callable, Iterable, Mapping
from itertools import permutations
from typing import Any, NamedTuple

Key = tuple[str, str]
Answer = Mapping[str, Any]
LINEAR = ("driven_spring", "coupled")


class Equivalence(NamedTuple):
    """Two forms, when they are the same, and why."""

    when: Callable[[Answer, Key, Key], bool]
    why: str


def _one_position(a: Answer) -> bool:
    return len(a["columns"]) == 1 and a["columns"][0] in ("q_m", "x1_m", "x2_m", "gap_m") and not a["initial"]


# Parameters that multiply the force an effect adds: (system, word, target) -> parameter.
OWNERS = {
    ("duffing", "linear_stiffness", "q"): "k", ("duffing", "cubic_stiffness", "q"): "b",
    ("double_well", "linear_stiffness", "q"): "a", ("double_well", "cubic_stiffness", "q"): "b",
    ("driven_spring", "linear_stiffness", "q"): "k", ("coupled", "linear_stiffness", "x1"): "k1",
    ("coupled", "linear_stiffness", "x2"): "k2", ("coupled", "coupling_spring", "x1,x2"): "kc",
    ("elastic_pendulum", "constant_force", "r"): "l",
}  # fmt: skip


# A lone sensor's gain scales the motion, and these systems scale by one parameter.
SCALED_BY = {"duffing": "b", "double_well": "b", "henon_heiles": "lam", "orbit": "mu", "driven_spring": "gain"}
_CURVED = ("volts",)  # a reading that is not in proportion to the motion


def owner(a: Answer, one: Key) -> str | None:
    """The parameter whose error has the same consequences as an effect."""
    if one[0] == "parameter_error":
        # The angle of a pendulum with a free start hangs on g/l alone.
        angles = a["system"] == "pendulum" and set(a["columns"]) <= {"angle_rad", "rate"}
        return "g" if angles and one[1] == "l" else one[1]
    if one[0] == "sensor_gain" and len(a["columns"]) == 1 and not a["initial"] and one[1] not in _CURVED:
        return SCALED_BY.get(a["system"])
    return OWNERS.get((a["system"], *one))


def _owned(a: Answer, one: Key, other: Key) -> bool:
    return owner(a, one) is not None and owner(a, one) == owner(a, other)


def _rest_moved(a: Answer, one: Key, other: Key) -> bool:
    words = {one[0], other[0]}
    return a["system"] in LINEAR and _one_position(a) and words <= {"constant_force", "sensor_bias"}


def _ratio(a: Answer, one: Key, other: Key) -> bool:
    both = one[0] == other[0] == "sensor_gain" and len(a["columns"]) == 2
    return both and a["system"] == "coupled" and not a["initial"]


TABLE = (
    Equivalence(_owned, "both are an error of one parameter: a force it multiplies, a scale it sets, a pendulum's g/l"),
    Equivalence(_rest_moved, "a constant force moves a linear spring's rest, as a bias of its only sensor does"),
    Equivalence(_ratio, "an undriven linear system with a free start has any size: two sensors tell a ratio"),
)  # fmt: skip


def equivalent(answer: Answer, one: Key, other: Key) -> bool:
    """Whether two names mean the same in a case."""
    if one == other:
        return True
    return any(rule.when(answer, one, other) or rule.when(answer, other, one) for rule in TABLE)


def same(answer: Answer, truth: Iterable[Key], found: Iterable[Key]) -> bool:
    """Whether two combinations have the same members, in any order, up to equivalence."""
    truth, found = tuple(truth), tuple(found)
    if len(truth) != len(found) or len(truth) > 5:
        return False
    return any(
        all(equivalent(answer, a, b) for a, b in zip(truth, order, strict=True)) for order in permutations(found)
    )


def swallowed(answer: Answer, key: Key) -> bool:
    """Whether the calibration owns an effect: then nothing is left to find, and `consistent` is the right answer.

    An effect whose parameter has a flat prior; the gain of the only sensor of an undriven linear system with a free
    start; the delay of the only sensor of an undriven system with a free start, which begins at another time; a
    constant force on a linear system of which only speeds are read.
    """
    flat = {name for name, _, sd in answer["free"] if sd is None}
    lone = len(answer["columns"]) == 1 and not answer["initial"]
    everywhere = not any(e["recordings"] for e in answer["effects"])
    if everywhere and owner(answer, key) in flat:
        return True
    if key[0] == "constant_force" and not answer["initial"]:
        return answer["system"] in LINEAR and set(answer["columns"]) <= {"speed", "v1", "v2"}
    if key[0] == "sensor_gain":
        return lone and answer["system"] == "coupled"
    return key[0] == "sensor_delay" and lone and answer["system"] != "driven_spring"
