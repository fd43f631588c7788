"""The unit of a coefficient, from the units of the coordinate, its momentum, the time and the column."""

from collections.abc import Mapping
from typing import Any

from ..diagnosis import _units as units
from ..diagnosis._record import Diagnosis
from ._words import targets


def coefficient_unit(finding: Mapping[str, Any], diagnosis: Diagnosis, name: str) -> str | None:
    """The unit of one coefficient of a finding, `""` for a pure number.

    `None` where a unit it is made of was not given, or the effect has no such coefficient.
    """
    momenta = dict(zip(diagnosis.augmented.coordinates, diagnosis.augmented.momenta, strict=True))
    return units.coefficient_units(
        finding["effect"], targets(finding), diagnosis.units, momenta, time_unit(diagnosis)
    ).get(name)


def time_unit(diagnosis: Diagnosis) -> str | None:
    """The unit of `t`, or of the column of times."""
    return units.time_unit(diagnosis.units, diagnosis.augmented.recording.time)


def force_unit(coordinate: str, diagnosis: Diagnosis) -> str | None:
    """The unit of dp/dt."""
    return coefficient_unit({"effect": "constant_force", "target": coordinate}, diagnosis, "f")
