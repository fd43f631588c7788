"""What was read and what is computed: the whole recording, the held-out part from close, the residuals."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from ..diagnosis._record import Diagnosis, Series
from ._palette import AFTER, READING, SHADE
from ._panel import Panel, dots, first_look, labels, legend, limits, line, panel, with_unit
from ._units import time_unit

_CYCLES = 10  # in a close-up


@dataclass(frozen=True, eq=False)
class Channel:
    """One column of one recording, as it is drawn. `after` is `None` where nothing was added."""

    times: Float[np.ndarray, " time"]
    reading: Float[np.ndarray, " time"]
    before: Float[np.ndarray, " time"]
    after: Float[np.ndarray, " time"] | None
    boundary: float
    time_label: str
    column: str
    unit: str | None

    @property
    def best(self) -> Float[np.ndarray, " time"]:
        """The motion as it is now understood."""
        return self.before if self.after is None else self.after

    @property
    def held_out(self) -> bool:
        """Whether any row was kept from the fits."""
        return bool(self.times.size) and self.boundary < float(self.times[-1])


def channel(diagnosis: Diagnosis, series: Series, column: str) -> Channel:
    """The column of that name of one recording. For `consistent` before and after are one."""
    place = diagnosis.columns.index(column)
    changed = diagnosis.document["verdict"] != "consistent"
    return Channel(
        series.times,
        series.readings[:, place],
        series.before[:, place],
        series.after[:, place] if changed else None,
        series.boundary,
        with_unit("time", time_unit(diagnosis)),
        column,
        diagnosis.units.get(column),
    )


def motion_panels(one: Channel, detail: bool) -> list[Panel]:
    """Overview and close-up; with `detail` the residuals too."""
    drawn = [panel(lambda axes: overview(axes, one), f"Readings and simulation: {one.column}")]
    drawn.append(panel(lambda axes: close_up(axes, one), f"From close, after the last fitted row: {one.column}"))
    if detail:
        drawn.append(panel(lambda axes: _residuals(axes, one), f"Reading minus simulation: {one.column}"))
    if detail and one.after is not None:
        drawn.append(panel(lambda axes: _remainder(axes, one), f"Reading minus simulation, after: {one.column}"))
    return drawn


def overview(axes: Axes, one: Channel) -> None:
    """The whole recording."""
    _motion(axes, one, np.ones(len(one.times), bool), width=0.9)


def close_up(axes: Axes, one: Channel) -> None:
    """The last cycles of the held-out rows, or of all rows where none is held out."""
    first, last = close_up_window(one)
    _motion(axes, one, (one.times >= first) & (one.times <= last), width=1.4)
    if last > first:
        axes.set_xlim(first, last)


def close_up_window(one: Channel) -> tuple[float, float]:
    """The held-out rows, or their last ten cycles; all rows where at most one is held out."""
    rows = one.times > one.boundary
    if rows.sum() < 2:
        rows = np.ones(len(one.times), bool)
    times, motion = one.times[rows], one.best[rows]
    motion = np.where(np.isfinite(motion), motion, np.nan)
    above = motion > np.nanmean(motion) if np.isfinite(motion).any() else np.zeros(len(motion), bool)
    rises = np.flatnonzero(above[1:] & ~above[:-1])
    first = rises[-_CYCLES - 1] if len(rises) > _CYCLES else 0
    return float(times[first]), float(times[-1])


def _motion(axes: Axes, one: Channel, rows: np.ndarray, width: float) -> None:
    t, best = one.times[rows], one.best[rows]
    axes.set_ylim(limits(one.reading[rows], one.before[rows], best))
    _shade(axes, one)
    dots(axes, t, one.reading[rows], color=READING, label="reading")
    line(axes, t, one.before[rows], linewidth=width, **first_look(one.after is not None))
    if one.after is not None:
        line(axes, t, best, color=AFTER, linewidth=width, label="after")
    labels(axes, one.time_label, with_unit(one.column, one.unit))
    legend(axes, columns=4)


def _shade(axes: Axes, one: Channel) -> None:
    if one.held_out:
        axes.axvspan(one.boundary, float(one.times[-1]), color=SHADE, linewidth=0, label="held out", zorder=0)


def _residuals(axes: Axes, one: Channel) -> None:
    before, after = one.reading - one.before, one.reading - one.best
    axes.set_ylim(limits(np.concatenate([before, after])))
    _shade(axes, one)
    dots(axes, one.times, before, **first_look(one.after is not None))
    if one.after is not None:
        dots(axes, one.times, after, color=AFTER, label="after")
    labels(axes, one.time_label, with_unit(f"reading − {one.column}", one.unit))
    legend(axes)


def _remainder(axes: Axes, one: Channel) -> None:
    """The residuals after, on their own scale."""
    after = one.reading - one.best
    axes.set_ylim(limits(after))
    _shade(axes, one)
    dots(axes, one.times, after, color=AFTER, label="after, own scale")
    labels(axes, one.time_label, with_unit(f"reading − {one.column}", one.unit))
    legend(axes)
