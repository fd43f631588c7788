"""The missing force over time, against velocity and against position, and the energy along the motion."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from ..diagnosis._record import Diagnosis, Series
from ._decimate import evenly
from ._law import Motion, added_force
from ._palette import AFTER, LAW
from ._panel import Panel, finite, first_look, labels, legend, limits, line, panel, with_unit
from ._units import force_unit, time_unit

_LAW = 30.0  # ranges of the estimate that a law may lie outside of it and is in the picture still
_AWAY = 100.0  # times its middle half that an energy ranges over at most, unless it runs away


@dataclass(frozen=True, eq=False)
class Missing:
    """The missing force on one coordinate of one recording, as it is drawn."""

    times: Float[np.ndarray, " fitted"]
    position: Float[np.ndarray, " fitted"]
    velocity: Float[np.ndarray, " fitted"]
    before: Float[np.ndarray, " fitted"]
    after: Float[np.ndarray, " fitted"] | None
    law: Float[np.ndarray, " fitted"] | None
    time_label: str
    position_label: str
    velocity_label: str
    force_label: str


def missing(diagnosis: Diagnosis, series: Series, number: int, coordinate: str) -> Missing:
    """The missing force on a coordinate in recording `number`, counted from 1."""
    i, units, time = diagnosis.coordinates.index(coordinate), diagnosis.units, time_unit(diagnosis)
    q, v = series.position[:, i], series.velocity[:, i]
    motion = Motion(series.fitted_times, series.position, series.velocity)
    unit = units.get(coordinate)
    changed = diagnosis.document["verdict"] != "consistent"
    return Missing(
        series.fitted_times,
        q,
        v,
        series.force_before[:, i],
        series.force_after[:, i] if changed else None,
        added_force(diagnosis.document["findings"], diagnosis.coordinates, coordinate, motion, number),
        with_unit("time", time),
        with_unit(coordinate, unit),
        with_unit(f"velocity of {coordinate}", f"{unit}/{time}" if unit and time else None),
        with_unit(f"missing force on {coordinate}", force_unit(coordinate, diagnosis)),
    )


def force_panels(one: Missing, coordinate: str) -> list[Panel]:
    """Over time, against velocity, against position; none where no force was estimated."""
    if not finite(one.before).size:
        return []
    alt = f"Missing force on {coordinate}"
    return [
        panel(lambda axes: _over_time(axes, one), f"{alt} over time"),
        panel(lambda axes: _against(axes, one, one.velocity, one.velocity_label), f"{alt} against velocity"),
        panel(lambda axes: _against(axes, one, one.position, one.position_label), f"{alt} against position"),
    ]


def _force_limits(one: Missing) -> tuple[float, float]:
    low, high = limits(one.before, *([] if one.after is None else [one.after]))
    if one.law is None:
        return low, high
    # Where nothing reads a coordinate, the estimate is far smaller than the force that the law says.
    return limits(np.array([low, high]), one.law, most=_LAW)


def _over_time(axes: Axes, one: Missing) -> None:
    axes.set_ylim(_force_limits(one))
    line(axes, one.times, one.before, linewidth=1.0, **first_look(one.after is not None))
    if one.law is not None:
        line(axes, one.times, one.law, color=LAW, linewidth=1.0, linestyle="--", label="what was added")
    if one.after is not None:
        line(axes, one.times, one.after, color=AFTER, linewidth=1.0, label="after")
    labels(axes, one.time_label, one.force_label)
    legend(axes)


def _against(axes: Axes, one: Missing, x: Float[np.ndarray, " fitted"], label: str) -> None:
    axes.set_xlim(limits(x))
    axes.set_ylim(_force_limits(one))
    some = evenly(len(x))
    look: dict[str, Any] = {"linestyle": "none", "marker": "o", "markersize": 2.2, "markeredgewidth": 0}
    axes.plot(x[some], one.before[some], **first_look(one.after is not None), **look)
    if one.after is not None:
        axes.plot(x[some], one.after[some], color=AFTER, label="after", **look)
    if one.law is not None:
        axes.plot(x[some], one.law[some], color=LAW, label="what was added", **look)
    labels(axes, label, one.force_label)
    legend(axes)


def energy_panels(diagnosis: Diagnosis, series: Series) -> list[Panel]:
    """The Hamiltonian along the motion, before and after."""
    if not finite(series.energy_before).size:
        return []
    return [panel(lambda axes: _energy(axes, diagnosis, series), "Energy along the motion")]


def energy_limits(*every: Float[np.ndarray, " fitted"]) -> tuple[float, float]:
    """The range of energies but for those that run away: one that is lost, or fed in, ranges farther than one that is
    kept by any number of times."""
    steady = [one for one in every if _is_steady(finite(one))]
    return limits(np.concatenate(steady or [every[0]]), *every)


def _is_steady(values: Float[np.ndarray, " kept"]) -> bool:
    """Whether all values are not too far from their middle half."""
    return bool(values.size) and float(np.ptp(values)) <= _AWAY * float(np.ptp(np.quantile(values, [0.25, 0.75])))


def _energy(axes: Axes, diagnosis: Diagnosis, series: Series) -> None:
    t, changed = series.fitted_times, diagnosis.document["verdict"] != "consistent"
    axes.set_ylim(energy_limits(series.energy_before, *([series.energy_after] if changed else [])))
    line(axes, t, series.energy_before, linewidth=1.0, **first_look(changed))
    if changed:
        line(axes, t, series.energy_after, color=AFTER, linewidth=1.4, label="after")
    labels(axes, with_unit("time", time_unit(diagnosis)), with_unit("energy H", diagnosis.units.get("H")))
    legend(axes)
