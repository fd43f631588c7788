"""Pictures of the gallery: motion before and after, the missing force, and held-out errors of many diagnoses."""

import tomllib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from symplearn.report._palette import AFTER, BEFORE, READING, SHADE
from symplearn.report._panel import dots, first_look, legend, limits, line, render, with_unit

from ._gallery_results import Result
from ._gallery_words import pooled_errors

WIDTH = 9.0  # inches, at 100 pixels to the inch
SMALL = 0.03  # of the readings' range: what is left before is then drawn by itself, as no eye sees it beside the motion
NEAR = 8  # periods of the held-out part that are shown from close, about


def write_motion(results: Sequence[Result], path: Path) -> None:
    """A row for each result: one recording as a whole, and its held-out rows from close."""

    def draw(figure: Figure) -> None:
        rows = figure.subplots(len(results), 2, width_ratios=(3, 2), squeeze=False)
        for (whole, near), result in zip(rows, results, strict=True):
            _motion_row(whole, near, result)
            if len(results) > 1:
                whole.set_title(result.case.label or result.case.name, fontsize=9, loc="right")
            if result is not results[0]:
                whole.get_legend().remove()

    _write(path, draw, (WIDTH, 3.6 if len(results) == 1 else 2.6 * len(results)))


def write_force(result: Result, path: Path) -> None:
    """The missing force on the first coordinate: over the time of one recording, and against velocity in all."""

    def draw(figure: Figure) -> None:
        over_time, against = figure.subplots(1, 2, width_ratios=(3, 2), sharey=True)
        _force_over_time(over_time, result)
        _force_against_velocity(against, result)

    _write(path, draw, (WIDTH, 3.2))


def write_errors(results: Sequence[Result], path: Path) -> None:
    """Held-out errors before and after of many diagnoses, one line for each."""
    _write(path, lambda figure: _errors(figure.add_subplot(), results), (WIDTH, 0.9 + 0.28 * len(results)))


def has_force(result: Result) -> bool:
    """Whether a missing force was followed that can be drawn."""
    force = result.series.get(f"{result.case.picture}/force_before")
    return force is not None and bool(np.isfinite(force).any())


def recordings_of(series: Mapping[str, np.ndarray]) -> list[int]:
    """The numbers of the recordings in a result's series."""
    return sorted({int(name.split("/")[0]) for name in series if "/" in name})


def _write(path: Path, draw: Callable[[Figure], None], size: tuple[float, float]) -> None:
    png = render(draw, size, dpi=100)
    unfinished = path.with_suffix(".part")
    unfinished.write_bytes(png)
    unfinished.replace(path)  # whole or not at all


def _motion_row(whole: Axes, near: Axes, result: Result) -> None:
    one, k = result.series, result.case.picture
    times, boundary = one[f"{k}/times"], float(one[f"{k}/boundary"])
    first = boundary if boundary < times[-1] else times[0]
    _motion(whole, result, np.ones(len(times), bool))
    if _is_small(result):
        _remainders(near, result)
        return
    _motion(near, result, times >= max(first, times[-1] - _close(times, one[f"{k}/readings"][:, 0])))
    if near.get_legend():
        near.get_legend().remove()
    near.set_ylabel("")
    near.set_title("the end of the held-out rows" if boundary < times[-1] else "the end", fontsize=9, loc="left")


def _is_small(result: Result) -> bool:
    """Whether the readings leave the simulation before by a small part of the motion, where it is drawn."""
    reading, before = (result.series[f"{result.case.picture}/{name}"][:, 0] for name in ("readings", "before"))
    return bool(np.nanmax(np.abs(reading - before)) < SMALL * (np.nanmax(reading) - np.nanmin(reading)))


def _remainders(axes: Axes, result: Result) -> None:
    """Reading minus simulation in all recordings, by the time since their first row."""
    one, changed = result.series, result.document["verdict"] != "consistent"
    for name, look in (("before", first_look(changed)), ("after", {"color": AFTER}))[: 1 + changed]:
        for k in recordings_of(one):
            off = (one[f"{k}/readings"] - one[f"{k}/{name}"])[:, 0]
            axes.plot(one[f"{k}/times"] - one[f"{k}/times"][0], off, color=look["color"], linewidth=0.8)
    starts = [float(one[f"{k}/boundary"] - one[f"{k}/times"][0]) for k in recordings_of(one)]
    axes.axvspan(max(starts), axes.get_xlim()[1], color=SHADE, linewidth=0, zorder=0)
    axes.margins(x=0)
    axes.set_xlabel(with_unit("time since the first row", _units(result).get("t")))
    axes.locator_params(axis="x", nbins=5)
    several = ", all recordings" if len(starts) > 1 else ""
    axes.set_title(f"reading minus simulation{several}", fontsize=9, loc="left")


def _close(times: np.ndarray, reading: np.ndarray) -> float:
    """The length of a few periods of the motion, by its crossings of the mean."""
    seen = np.isfinite(reading)
    t, y = times[seen], reading[seen] - reading[seen].mean()
    crossings = t[1:][(y[1:] > 0) & (y[:-1] <= 0)]
    return float(NEAR * np.median(np.diff(crossings))) if len(crossings) > 2 else float(times[-1] - times[0])


def _motion(axes: Axes, result: Result, rows: np.ndarray) -> None:
    one, k = result.series, result.case.picture
    times, boundary = one[f"{k}/times"], float(one[f"{k}/boundary"])
    reading, before, after = (one[f"{k}/{name}"][:, 0] for name in ("readings", "before", "after"))
    changed = result.document["verdict"] != "consistent"
    axes.set_ylim(limits(reading[rows], before[rows], after[rows]))
    if boundary < times[-1]:
        axes.axvspan(boundary, float(times[-1]), color=SHADE, linewidth=0, label="held out", zorder=0)
    dots(axes, times[rows], reading[rows], color=READING, label="reading")
    line(axes, times[rows], before[rows], linewidth=1.0, **first_look(changed))
    if changed:
        line(axes, times[rows], after[rows], color=AFTER, linewidth=1.0, label="after")
    axes.set_xlim(float(times[rows][0]), float(times[rows][-1]))
    axes.set_xlabel(with_unit("time", _units(result).get("t")))
    column = str(one["columns"][0])
    axes.set_ylabel(with_unit(column, _units(result).get(column)))
    legend(axes, columns=4)


def _units(result: Result) -> Mapping[str, str]:
    return tomllib.loads(result.simulation).get("units", {})


def _force_over_time(axes: Axes, result: Result) -> None:
    one, k = result.series, result.case.picture
    times, before, after = (one[f"{k}/{name}"] for name in ("fitted_times", "force_before", "force_after"))
    changed = result.document["verdict"] != "consistent"
    axes.set_ylim(limits(before[:, 0]))
    line(axes, times, before[:, 0], linewidth=1.0, **first_look(changed))
    if changed:
        line(axes, times, after[:, 0], color=AFTER, linewidth=1.0, label="after")
    axes.set_xlabel(with_unit("time", _units(result).get("t")))
    axes.set_ylabel(f"missing force on {one['coordinates'][0]}")
    legend(axes)


def _force_against_velocity(axes: Axes, result: Result) -> None:
    changed = result.document["verdict"] != "consistent"
    numbers = recordings_of(result.series)
    speed, before, after = (
        np.concatenate([result.series[f"{k}/{name}"][:, 0] for k in numbers])
        for name in ("velocity", "force_before", "force_after")
    )
    some = np.linspace(0, len(speed) - 1, min(len(speed), 1500)).astype(int)
    look = {"linestyle": "none", "marker": "o", "markersize": 2.0, "markeredgewidth": 0}
    axes.plot(speed[some], before[some], color=BEFORE if changed else AFTER, **look)
    if changed:
        axes.plot(speed[some], after[some], color=AFTER, **look)
    axes.set_xlabel(f"velocity of {result.series['coordinates'][0]}")


def _errors(axes: Axes, results: Sequence[Result]) -> None:
    told = [(r, *pooled_errors(r.document)) for r in results if not r.failure]
    told = [(r, before, after) for r, before, after in told if before and after]
    for place, (_, before, after) in enumerate(told):
        axes.plot([before, after], [place, place], color=READING, linewidth=0.8, zorder=1)
    places = range(len(told))
    axes.plot([b for _, b, _ in told], places, "o", color=BEFORE, label="before", markersize=4)
    axes.plot([a for _, _, a in told], places, "o", color=AFTER, label="after, or nothing added", markersize=4)
    axes.set_xscale("log")
    for axis in (axes.xaxis.set_major_formatter, axes.xaxis.set_minor_formatter):
        axis(lambda value, place: f"{value:g}" if f"{value:e}"[0] in "125" else "")
    axes.set_yticks(list(places), [r.case.label or r.case.name for r, _, _ in told])
    axes.invert_yaxis()
    axes.set_xlabel("held-out error, in the column's unit")
    legend(axes)
