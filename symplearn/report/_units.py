"""The unit of a coefficient, from the units of the coordinate, its momentum, the time and the column."""

from collections.abc import Mapping
from typing import Any

from .._effects import EFFECTS, Drag, PowerForce
from ..diagnosis._record import Diagnosis


def coefficient_unit(finding: Mapping[str, Any], diagnosis: Diagnosis) -> str | None:
    """The unit of a finding's coefficient; `None` where a unit it is made of was not given."""
    effect, target, units = EFFECTS.get(finding["effect"]), finding["target"], diagnosis.units
    if finding["effect"] == "sensor_bias":
        return units.get(target)
    if not isinstance(effect, Drag | PowerForce):
        return None
    momentum = dict(zip(diagnosis.augmented.coordinates, diagnosis.augmented.momenta, strict=True)).get(target, "")
    known = units.get(momentum), units.get(target), time_unit(diagnosis)
    # Force is p / t, and speed q / t.
    powers = (1, -effect.power, effect.power - 1) if isinstance(effect, Drag) else (1, -effect.power, -1)
    if any(unit is None for unit, power in zip(known, powers, strict=True) if power):
        return None
    return _product([(unit or "", power) for unit, power in zip(known, powers, strict=True)])


def time_unit(diagnosis: Diagnosis) -> str | None:
    """The unit of `t`, or of the column of times."""
    return diagnosis.units.get("t", diagnosis.units.get(diagnosis.augmented.recording.time))


def force_unit(coordinate: str, diagnosis: Diagnosis) -> str | None:
    """The unit of dp/dt."""
    return coefficient_unit({"effect": "constant_force", "target": coordinate}, diagnosis)


def _product(factors: list[tuple[str, int]]) -> str:
    """`a·b²/(c·d)`."""
    above = [_power(unit, power) for unit, power in factors if power > 0]
    below = [_power(unit, -power) for unit, power in factors if power < 0]
    text = "·".join(above) or "1"
    return text + (f"/{below[0]}" if len(below) == 1 else f"/({'·'.join(below)})" if below else "")


def _power(unit: str, power: int) -> str:
    unit = unit if unit.isalpha() else f"({unit})"
    return unit + {1: "", 2: "²", 3: "³"}.get(power, f"^{power}")
