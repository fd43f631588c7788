"""The figures of `cherry`: the dissertation's 5.5 to 5.7 for one realisation, and the spread over all."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ._cherry_case import (
    HORIZON,
    LEGENDRE,
    MONOMIALS,
    READ_UNTIL,
    TEST_UNTIL,
    energies,
    fine_times,
    predictions,
    several,
    single,
    true_energy,
    truth,
)
from ._command import Run

COLOURS = {"symplectic": "tab:blue", "rk2": "tab:red", "order4_step_8_times_larger": "tab:green"}
NAMES = {
    "symplectic": "Tao",
    "rk2": "Runge-Kutta 2",
    "order4_step_8_times_larger": "order 4,\n8 times the step",
    "bayes": "draws'\nmean",
    "map": "MAP",
    "map_order4_step_40_times_larger": "MAP,\norder 4,\nlarge\nsteps",
    "map_multiplicative_noise": "MAP,\nnoise\nas it is",
    "ls": "least\nsquares",
}


def draw(run: Run, results: dict[str, list[dict[str, Any]]], found: dict[str, Any]) -> None:
    """All figures, in the run's folder."""
    run.save(hamiltonians(results), "hamiltonians.png")
    run.save(reconstructions(run, results), "reconstructions.png")
    run.save(training(run, results["several"][0]), "training.png")
    run.save(testing(results["several"][0]), "testing.png")
    run.save(spreads(results, found["published"]), "spreads.png")


def hamiltonians(results: dict[str, list[dict[str, Any]]]) -> Figure:
    """Figure 5.5: the learnt energies of the first realisation, draws and MAP."""
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    ends = [0.0, TEST_UNTIL]
    panels = figure.subplots(1, 2, sharey=True)
    for panel, name in zip(panels, ("symplectic", "rk2"), strict=True):
        one = results[name][0]
        if one["draws"]:
            for level in energies(one["draws"], MONOMIALS):
                panel.plot(ends, [level] * 2, color=COLOURS[name], lw=0.5, alpha=0.3)
        panel.plot(ends, [one["H"]] * 2, color=COLOURS[name], lw=2, label="MAP")
        panel.axhline(true_energy(), color="black", ls="--", label="truth")
        panel.axvline(READ_UNTIL, color="magenta", lw=1)
        panel.set(title=f"learnt with {NAMES[name]}", xlabel="t (s)")
        panel.legend(loc="center right")
    panels[0].set_ylabel("H")
    return figure


def reconstructions(run: Run, results: dict[str, list[dict[str, Any]]]) -> Figure:
    """Figure 5.6: q1 of the first realisation's MAP, of draws, and of the truth."""
    times = fine_times()
    times = times[times <= TEST_UNTIL]
    true, series = truth(times), single(run.seed, 0)
    figure = Figure(figsize=(11, 7), layout="constrained")
    for panel, name in zip(figure.subplots(2, 1, sharex=True, sharey=True), ("symplectic", "rk2"), strict=True):
        one = results[name][0]
        if one["draws"]:
            paths = predictions(one["draws"], MONOMIALS, times)[:, :, 0]
            panel.plot(times, paths.T, color=COLOURS[name], lw=0.4, alpha=0.3)
        best = predictions([one["coefficients"]], MONOMIALS, times)[0]
        panel.plot(times, best[:, 0], color=COLOURS[name], lw=1.6, label="MAP")
        _truth(panel, times, true[:, 0])
        panel.plot(series.times, np.asarray(series.readings)[:, 0], ".", color="tab:purple", ms=7, label="readings")
        panel.axvline(READ_UNTIL, color="magenta", lw=1)
        panel.set(ylabel="q1", ylim=_limits(true[:, 0]), xlim=(0, TEST_UNTIL))
        panel.set_title(f"learnt with {NAMES[name]}: e(train) = {one['e_train']:.4f}, e(test) = {one['e_test']:.4f}")
    panel.set_xlabel("t (s)")
    panel.legend(loc="lower left", ncols=4)
    return figure


def training(run: Run, one: dict[str, Any]) -> Figure:
    """Figure 5.7, left: three training recordings, with the MAP and least squares from their first readings."""
    figure = Figure(figsize=(12, 8), layout="constrained")
    times = fine_times()
    times = times[times <= READ_UNTIL]
    for column, series in zip(figure.subplots(4, 3, sharex=True).T, several(run.seed, 0)[:3], strict=True):
        start = np.asarray(series.readings)[0]
        best, squares = (predictions([one[part]["coefficients"]], LEGENDRE, times, start)[0] for part in ("map", "ls"))
        for panel, d in zip(column, range(4), strict=True):
            panel.plot(times, best[:, d], color="tab:blue", label="MAP")
            panel.plot(times, squares[:, d], color="tab:red", label="least squares")
            panel.plot(series.times, np.asarray(series.readings)[:, d], ".", color="tab:purple", label="readings")
            panel.set(ylim=_limits(np.asarray(series.readings)[:, d]), ylabel=("q1", "q2", "p1", "p2")[d])
        column[-1].set_xlabel("t (s)")
    panel.legend(loc="lower left", fontsize="small")
    figure.suptitle("three of the five recordings, predicted from their first readings")
    return figure


def testing(one: dict[str, Any]) -> Figure:
    """Figure 5.7, right: the test start, by draws, their mean, the MAP and least squares."""
    times = fine_times()
    true, paths = truth(times), predictions(one["draws"], LEGENDRE, times)
    best, squares = (predictions([one[part]["coefficients"]], LEGENDRE, times)[0] for part in ("map", "ls"))
    figure = Figure(figsize=(12, 9), layout="constrained")
    panels = figure.subplots(4, 1, sharex=True)
    for panel, d in zip(panels, range(4), strict=True):
        panel.plot(times, paths[:, :, d].T, color="tab:blue", lw=0.4, alpha=0.25)
        panel.plot(times, paths[:, :, d].mean(axis=0), color="tab:blue", lw=1.8, label="mean of draws")
        panel.plot(times, best[:, d], color="tab:cyan", lw=1.0, label="MAP")
        panel.plot(times, squares[:, d], color="tab:red", lw=1.2, label="least squares")
        _truth(panel, times, true[:, d])
        panel.axvline(one["mean"]["horizon"], color="tab:blue", ls=":")
        panel.axvline(one["ls"]["horizon"], color="tab:red", ls=":")
        panel.set(ylabel=("q1", "q2", "p1", "p2")[d], ylim=_limits(true[:, d]), xlim=(0, HORIZON))
    panels[0].set_title(
        f"relative error below 10 % for {one['mean']['horizon']:.2f} s (draws' mean), {one['ls']['horizon']:.2f} s "
        "(least squares)"
    )
    panel.set_xlabel("t (s)")
    panel.legend(loc="lower left", ncols=4)
    return figure


def spreads(results: dict[str, list[dict[str, Any]]], published: dict[str, float]) -> Figure:
    """What one lucky seed hides: the errors of one recording and the horizons of several, in every realisation."""
    figure = Figure(figsize=(17, 5), layout="constrained")
    panels = figure.subplots(1, 4)
    for panel, key in zip(panels, ("e_train", "e_test", "H"), strict=False):
        values = {name: [one[key] for one in results[name]] for name in COLOURS}
        _dots(panel, values, {name: published.get(f"{key}_{name}") for name in COLOURS})
        panel.set_title(f"{key}, one recording")
    panels[2].axhline(true_energy(), color="black", ls="--", lw=1)
    for panel in panels[:2]:
        panel.set_yscale("log")
    parts = {"bayes": "mean", "map": "map", "map_order4_step_40_times_larger": "order4", "ls": "ls"}
    values = {name: [one[part]["horizon"] for one in results["several"]] for name, part in parts.items()}
    values = {"map_multiplicative_noise": [one["horizon"] for one in results["several_multiplicative"]]} | values
    _dots(panels[3], values, {name: published.get(f"horizon_{name}") for name in values})
    panels[3].set_title(f"horizon (s, at most {HORIZON:g}), several")
    return figure


def _dots(panel: Axes, values: dict[str, list[float]], published: dict[str, float | None]) -> None:
    """A dot for each realisation, a bar at the median, a star at the published number."""
    for place, (name, each) in enumerate(values.items()):
        colour = COLOURS.get(name, "tab:red" if name == "ls" else "tab:blue")
        panel.plot(place + np.linspace(-0.2, 0.2, len(each)), each, "o", color=colour, alpha=0.6, ms=5)
        panel.plot([place - 0.3, place + 0.3], [np.median(each)] * 2, color=colour, lw=2)
        if published[name] is not None:
            label = None if "published" in panel.get_legend_handles_labels()[1] else "published"
            panel.plot(place, published[name], "*", color="black", ms=11, label=label)
    panel.set_xticks(range(len(values)), [NAMES[name] for name in values], fontsize=8)
    panel.legend()


def _truth(panel: Axes, times: np.ndarray, true: np.ndarray) -> None:
    panel.plot(times, true, color="black", lw=1.0, ls="--", label="truth")


def _limits(values: np.ndarray) -> tuple[float, float]:
    """Room of half the range around what is there."""
    low, high = np.min(values), np.max(values)
    return float(low - 0.5 * (high - low)), float(high + 0.5 * (high - low))
