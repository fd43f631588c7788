"""The forces that were added, along the motion."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from .._effects import EFFECTS, Drag, PowerForce


def added_force(
    findings: Iterable[Mapping[str, Any]],
    coordinate: str,
    q: Float[np.ndarray, " time"],
    v: Float[np.ndarray, " time"],
    recording: int,
) -> Float[np.ndarray, " time"] | None:
    """Sum of the findings that are forces on `coordinate` in this recording; `None` where there is none.

    An effect that is no function of this position and velocity alone is not counted.
    """
    here = [
        finding
        for finding in findings
        if finding["target"] == coordinate
        and isinstance(EFFECTS.get(finding["effect"]), Drag | PowerForce)
        and recording in (finding.get("recordings") or [recording])
    ]
    with np.errstate(over="ignore", invalid="ignore"):  # a motion that diverged is drawn as far as it goes
        return sum((_force(finding, q, v) for finding in here), np.zeros(len(q))) if here else None


def _force(finding: Mapping[str, Any], q: np.ndarray, v: np.ndarray) -> np.ndarray:
    effect = EFFECTS[finding["effect"]]
    size = finding["coefficients"][effect.coefficient]["mean"]
    if isinstance(effect, Drag):
        return -size * np.abs(v) ** effect.power * np.sign(v)
    assert isinstance(effect, PowerForce)
    return effect.sign * size * q**effect.power
