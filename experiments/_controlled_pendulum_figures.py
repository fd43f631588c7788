"""The figures of `controlled_pendulum`: the dissertation's 3.12, 3.13 and 2.2, and the errors of the noisy cell."""

from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from ._controlled_pendulum_case import DataSets

COLOURS = {"map": "tab:blue", "ls_era_printed": "tab:red", "ls_era_corrected": "tab:orange"}
NAMES = {"map": "MAP", "ls_era_printed": "LS + ERA, as printed", "ls_era_corrected": "LS + ERA, corrected"}


class View(NamedTuple):
    """What is drawn of one data set: its cell, each method's path and impulse response, and the posterior's or None."""

    place: tuple[float, float]
    data: DataSets
    shown: int
    paths: dict[str, np.ndarray]
    responses: dict[str, np.ndarray]
    draws: dict[str, Any] | None


def contours(found: dict[str, Any]) -> Figure:
    """Figure 3.12: log10 of the mean error over the grid, each method in training and in testing."""
    figure = Figure(figsize=(12, 7), layout="constrained")
    panels = figure.subplots(2, 3, sharex=True, sharey=True)
    for row, period in enumerate(("train", "test")):
        for panel, (method, name) in zip(panels[row], NAMES.items(), strict=True):
            grid = np.array(found[f"log10_mean_{period}_{method}"]).T
            drawn = panel.contourf(found["spacings"], found["ratios"], grid, levels=12)
            figure.colorbar(drawn, ax=panel)
            panel.set_title(f"{name}, {period}")
        panels[row, 0].set_ylabel("noise ratio")
    for panel in panels[1]:
        panel.set_xlabel("data interval (s)")
    figure.suptitle("log10 of the mean squared error")
    return figure


def details(views: list[View]) -> Figure:
    """Figure 3.13: paths and impulse responses where the published LS + ERA does best."""
    figure = Figure(figsize=(12, 7), layout="constrained")
    panels = figure.subplots(2, len(views), squeeze=False)
    for (upper, lower), view in zip(panels.T, views, strict=True):
        times, truth = view.data.times, view.data.truth[view.shown]
        rows = slice(0, view.data.trained + 1)
        upper.plot(times[rows], view.data.readings[view.shown, rows], ".", color="grey", ms=3, label="readings")
        upper.plot(times, truth, color="black", lw=1.5, label="truth")
        lags = times[: len(next(iter(view.responses.values())))]
        if view.draws is not None:
            low, high = np.array(view.draws["band"])
            upper.fill_between(times, low, high, color="tab:blue", alpha=0.2, label="95 % of the draws")
            upper.plot(times, view.draws["mean_path"], "--", color="tab:purple", lw=1, label="posterior mean")
            low, high = np.quantile(np.array(view.draws["responses"])[:, : len(lags)], [0.025, 0.975], axis=0)
            lower.fill_between(lags, low, high, color="tab:blue", alpha=0.2)
        for method, path in view.paths.items():
            upper.plot(times, path, color=COLOURS[method], lw=0.8, label=NAMES[method])
            lower.plot(lags, view.responses[method], color=COLOURS[method], lw=0.8)
        upper.set(title=f"data interval {view.place[0]:g} s, noise ratio {view.place[1]:g}", xlabel="time (s)")
        upper.set_ylim(1.5 * truth.min(), 1.5 * truth.max())
        lower.set(xlabel="time after the impulse (s)")
    panels[0, 0].set_ylabel("angle")
    panels[1, 0].set_ylabel("response of the angle")
    panels[0, 0].legend(fontsize="small", ncols=2)
    return figure


def spreads(one: dict[str, Any]) -> Figure:
    """The errors of all data sets of the noisy cell."""
    figure = Figure(figsize=(10, 4), layout="constrained")
    for panel, period in zip(figure.subplots(1, 2, sharey=True), ("train", "test"), strict=True):
        for height, method in enumerate(NAMES):
            errors = np.array(one[method][period])
            panel.plot(errors, np.full(len(errors), height), "|", color=COLOURS[method], ms=16)
            panel.plot(np.median(errors), height, "k|", ms=26, mew=2)
        panel.set(xscale="log", title=f"{period}, data interval 0.1 s, noise ratio 0.2", xlabel="mean squared error")
        panel.set_yticks(range(len(NAMES)), NAMES.values())
        panel.set_ylim(-0.6, len(NAMES) - 0.4)
    return figure


def marginals(draws: dict[str, Any]) -> Figure:
    """Figure 2.2: det A and trace A by each sampler, and A itself in the printed coordinates, B and H held."""
    figure = Figure(figsize=(15, 6.5), layout="constrained")
    panels = figure.subplots(2, 4)
    for panel, (name, points) in zip(panels[0], draws["points"].items(), strict=True):
        panel.plot(*np.array(points).T, ".", ms=2, alpha=0.5)
        one = draws["samplers"][name]
        panel.set(title=f"{name}\nleast ESS {one['least_ess']:.0f}", xlabel="det A")
        panel.sharex(panels[0, 0])
        panel.sharey(panels[0, 0])
    panels[0, 0].set_ylabel("trace A")
    A = np.array(draws["A"])
    for panel, (i, j) in zip(panels[1], ((0, 1), (0, 2), (1, 2), (2, 3)), strict=True):
        panel.plot(A[:, i], A[:, j], ".", ms=2, alpha=0.5, color="tab:green")
        panel.set(xlabel=_ENTRIES[i], ylabel=_ENTRIES[j], title="B and H held")
    return figure


_ENTRIES = ("A[0, 0]", "A[0, 1]", "A[1, 0]", "A[1, 1]")
