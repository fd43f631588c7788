"""The figures of `henon_heiles`: the dissertation's 5.1 to 5.4 for one realisation, and the spread over all."""

from collections.abc import Sized
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from symplearn._objectives import TimeSeries

COLOURS = {"symplectic": "tab:blue", "rk2": "tab:red", "order4_step_5_times_larger": "tab:green"}
NAMES = {
    "symplectic": "leapfrog",
    "rk2": "Runge-Kutta 2",
    "order4_step_5_times_larger": "order 4,\n5 times the step",
}


class View(NamedTuple):
    """What is drawn of one propagator: the MAP's path and those of draws, their energies, and the noise's draws.

    `steps` and `as_learnt` are the times and energies of the MAP stepped by the propagator it was learnt with.
    """

    name: str
    path: np.ndarray
    paths: np.ndarray
    levels: np.ndarray
    steps: np.ndarray
    as_learnt: np.ndarray
    noise: np.ndarray
    tracked: float


def phases(true: np.ndarray, views: list[View], series: TimeSeries) -> Figure:
    """Figure 5.1: both phase planes of the truth and of each MAP, 200 s by leapfrog in fine steps."""
    figure = Figure(figsize=(12, 8), layout="constrained")
    panels = figure.subplots(2, 3, sharex="row", sharey="row")
    readings = np.asarray(series.readings)
    columns = [("truth", true, "black")]
    columns += [(f"learnt with {NAMES[view.name]}", view.path, COLOURS[view.name]) for view in views]
    for column, (title, path, colour) in enumerate(columns):
        for d in range(2):
            panel = panels[d, column]
            panel.plot(path[:, d], path[:, 2 + d], color=colour, lw=0.5)
            panel.plot(readings[:, d], readings[:, 2 + d], ".", color="tab:purple", ms=6, label="readings")
            panel.set(xlabel=f"q{d + 1}", ylabel=f"p{d + 1}" if column == 0 else "")
        panels[0, column].set_title(title)
    panels[0, 0].legend(loc="upper right")
    return figure


def hamiltonians(times: np.ndarray, views: list[View], true: float, until: float) -> Figure:
    """Figure 5.2: the learnt energies, and what becomes of them under the propagator they were learnt with."""
    figure = Figure(figsize=(12, 4.5), layout="constrained")
    levels, stepped = figure.subplots(1, 2)
    for view in views:
        colour, name = COLOURS[view.name], NAMES[view.name]
        low, high = np.quantile(view.levels, [0.025, 0.975])
        levels.fill_between([0, times[-1]], low, high, color=colour, alpha=0.2, label=f"{name}, 95 % of draws")
        levels.plot([0, times[-1]], [view.as_learnt[0]] * 2, color=colour, label=f"{name}, MAP")
        stepped.plot(view.steps, view.as_learnt, color=colour, label=f"{name}, stepped as it was learnt")
    for panel in (levels, stepped):
        panel.axhline(true, color="black", ls="--", label="truth")
        panel.set(xlabel="t (s)", ylabel="H")
    levels.axvline(until, color="magenta", lw=1, label="last reading")
    levels.set_title("(a) learnt energy, kept by leapfrog in fine steps")
    stepped.set_title("(b) the same models in the steps they were learnt in")
    levelled = np.concatenate([view.as_learnt for view in views])
    top = np.quantile(levelled[np.isfinite(levelled)], 0.98)  # Runge-Kutta's may leave the finite numbers
    stepped.set_ylim(0.9 * true, max(1.5 * true, 1.1 * top))
    stepped.legend(loc="upper left")
    low, high = levels.get_ylim()
    levels.set_ylim(low, high + 0.5 * (high - low))  # room for the legend
    levels.legend(loc="upper left", ncols=2, framealpha=1.0)
    return figure


def trajectories(times: np.ndarray, true: np.ndarray, views: list[View], series: TimeSeries, until: float) -> Figure:
    """Figure 5.3: q1 of the MAP, of a hundred draws, and the band that holds 95 % of them."""
    figure = Figure(figsize=(13, 3.6 * len(views)), layout="constrained")
    readings = np.asarray(series.readings)
    for panel, view in zip(figure.subplots(len(views), 1, sharex=True, sharey=True), views, strict=True):
        colour, q1 = COLOURS[view.name], np.nan_to_num(view.paths[:, :, 0], nan=np.inf)
        band = np.clip(np.quantile(q1, [0.025, 0.975], axis=0), -10, 10)
        panel.fill_between(times, *band, color=colour, alpha=0.25, label="95 % of draws")
        panel.plot(times, np.clip(q1[::2], -10, 10).T, color=colour, lw=0.3, alpha=0.15)
        panel.plot(times, view.path[:, 0], color=colour, lw=1.4, label="MAP")
        panel.plot(times, true[:, 0], color="black", lw=1.0, ls="--", label="truth")
        panel.plot(series.times, readings[:, 0], ".", color="tab:purple", ms=7, label="readings")
        panel.axvline(until, color="magenta", lw=1, label="last reading")
        panel.axvline(view.tracked, color="grey", lw=1, ls=":")
        panel.set(ylabel="q1", ylim=(-0.95, 0.7), xlim=(0, times[-1]))
        panel.set_title(
            f"learnt with {NAMES[view.name]}; error above a fifth of the amplitude from {view.tracked:.1f} s"
        )
    panel.set_xlabel("t (s)")
    panel.legend(loc="lower left", ncols=5, framealpha=1.0)
    return figure


def variances(views: list[View]) -> Figure:
    """Figure 5.4: the marginal posterior of the process noise."""
    figure = Figure(figsize=(8, 4), layout="constrained")
    panel = figure.subplots()
    logs = [np.log10(view.noise) for view in views]
    low, high = np.quantile(np.concatenate(logs), [0.002, 0.998])
    for view, log in zip(views, logs, strict=True):
        label = f"{NAMES[view.name]}, median {10 ** np.median(log):.1e}"
        panel.hist(log, np.linspace(low, high, 60), density=True, alpha=0.5, color=COLOURS[view.name], label=label)
    panel.set(xlabel="log10 of the process noise's variance", ylabel="density")
    panel.legend()
    return figure


def spreads(results: dict[str, list[dict[str, Any]]], true: float, published: dict[str, float]) -> Figure:
    """What one lucky seed hides: energy, tracking time and process noise in every noise realisation."""
    figure = Figure(figsize=(14, 4.8), layout="constrained")
    energy, tracking, noise = figure.subplots(1, 3)
    _dots(energy, results, "H", published)
    energy.axhline(true, color="black", ls="--", lw=1, label="truth")
    energy.legend()
    _dots(tracking, results, "tracking_time", published)
    for place, runs in enumerate(results.values()):
        values = [one["tracking_time_stepped_as_learnt"] for one in runs]
        label = None if place else "in the steps of learning"
        tracking.plot(_aside(place, values), values, "x", color="grey", ms=4, label=label)
    tracking.set_ylim(0, 260)  # room for the legend
    tracking.legend(loc="upper right")
    _dots(noise, results, "process_noise_median", {})
    noise.set_yscale("log")
    energy.set(title="learnt energy H")
    tracking.set(title="tracking time (s), at most 200")
    noise.set(title="posterior median of the process noise")
    return figure


def _dots(panel: Axes, results: dict[str, list[dict[str, Any]]], key: str, published: dict[str, float]) -> None:
    """A dot for each realisation, a bar at the median, a star at the published number."""
    for place, (name, runs) in enumerate(results.items()):
        values = np.array([one[key] for one in runs])
        panel.plot(_aside(place, values), values, "o", color=COLOURS[name], alpha=0.6, ms=5)
        panel.plot([place - 0.3, place + 0.3], [np.median(values)] * 2, color=COLOURS[name], lw=2)
        if f"{key}_{name}" in published:
            label = None if "published" in panel.get_legend_handles_labels()[1] else "published"
            panel.plot(place, published[f"{key}_{name}"], "*", color="black", ms=11, label=label)
    panel.set_xticks(range(len(results)), [NAMES[name] for name in results])


def _aside(place: int, values: Sized) -> np.ndarray:
    """Abscissae side by side around a place."""
    return place + np.linspace(-0.2, 0.2, len(values))
