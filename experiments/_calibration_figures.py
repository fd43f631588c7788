"""The figures of `calibration`: rank histograms, their distribution functions, and coverage over time."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import binom

from ._calibration_bands import LEVEL
from ._calibration_models import WRONG
from ._calibration_ranks import BINS, RANKED
from ._calibration_results import LEAST, MOST, held
from ._calibration_systems import system_called

_SHORT = {
    "dynamics.": "",
    "system.": "",
    "measurement_noise.structure.variance": "error's variance",
    "process_noise.structure.variance": "process noise",
    "initial.mean": "start",
}


def _short(quantity: str) -> str:
    for long, short in _SHORT.items():
        quantity = quantity.replace(long, short)
    return quantity


def histograms(studies: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Ranks of every quantity of every model, with the middle 99 % of what a uniform one gives in a bin."""
    columns = max(len(one["ranks"]) for one in studies.values())
    figure = Figure(figsize=(2.3 * columns, 1.7 * len(studies)), layout="constrained")
    axes = figure.subplots(len(studies), columns, squeeze=False)
    for row, (name, one) in zip(axes, studies.items(), strict=True):
        for ax in row[len(one["ranks"]) :]:
            ax.set_axis_off()
        for ax, (quantity, ranks) in zip(row, one["ranks"].items(), strict=False):
            _histogram(ax, ranks, "tab:red" if name in WRONG else "tab:blue")
            ax.set_title(_short(quantity), fontsize=8)
        row[0].set_ylabel(name.replace("_", " "), fontsize=7)
    figure.suptitle(f"Ranks of the truth among {RANKED} draws; grey: 99 % of uniform bins; red: a model told wrongly")
    return figure


def _histogram(ax: Axes, ranks: Sequence[int], colour: str) -> None:
    low, high = binom.ppf([0.005, 0.995], len(ranks), 1.0 / BINS)
    ax.axhspan(low, high, color="0.85")
    ax.hist(ranks, bins=np.linspace(-0.5, RANKED + 0.5, BINS + 1).tolist(), color=colour, alpha=0.8)
    ax.set_xticks([0, RANKED])
    ax.tick_params(labelsize=7)


def deviations(studies: Mapping[str, Mapping[str, Any]]) -> Figure:
    """How far the ranks' distribution functions are from the uniform one, with Kolmogorov's 99 % of a single one."""
    figure = Figure(figsize=(3.2 * len(studies), 3.2), layout="constrained")
    for ax, (name, one) in zip(
        figure.subplots(1, len(studies), sharey=True, squeeze=False)[0], studies.items(), strict=True
    ):
        levels = np.arange(RANKED + 1)
        for quantity, ranks in one["ranks"].items():
            below = np.searchsorted(np.sort(ranks), levels, side="right") / len(ranks)
            ax.plot(levels, below - (levels + 1) / (RANKED + 1), label=_short(quantity), linewidth=1)
        # 1.63 over the root of the number is the 99 % point of Kolmogorov's distribution.
        limit = 1.63 / np.sqrt(len(next(iter(one["ranks"].values()))))
        ax.axhspan(-limit, limit, color="0.9")
        ax.set_title(name.replace("_", " "), fontsize=8)
        ax.set_xlabel("rank")
        ax.legend(fontsize=6)
    figure.axes[0].set_ylabel("distribution function less uniform")
    return figure


def coverages(repeats: Mapping[str, Sequence[Mapping[str, Any]]]) -> Figure:
    """The share of repeats whose bands hold the truth, over time, averaged over the channels and in each."""
    figure = Figure(figsize=(11, 2.6 * ((len(repeats) + 1) // 2)), layout="constrained")
    axes = np.ravel(figure.subplots((len(repeats) + 1) // 2, 2))
    for ax in axes[len(repeats) :]:
        ax.set_axis_off()
    for ax, (name, each) in zip(axes, repeats.items(), strict=False):
        system = system_called(name)
        ax.axhspan(LEAST, MOST, color="0.9")
        ax.axhline(LEVEL, color="0.6", linewidth=0.8)
        ax.axvline(system.read_until, color="k", linestyle=":", linewidth=0.8)
        for way, colour in zip(system.ways, ("tab:blue", "tab:red"), strict=False):
            by_time = held(each, way).mean(axis=0)
            ax.plot(system.times, by_time, color=colour, alpha=0.25, linewidth=0.6)
            ax.plot(system.times, by_time.mean(axis=1), color=colour, label=way.replace("_", " ") or "as predicted")
        ax.set_ylim(0.4, 1.02)
        ax.set_title(f"{name.replace('_', ' ')}, {len(each)} repeats", fontsize=9)
        if len(system.ways) > 1:
            ax.legend(fontsize=7, loc="lower left")
        ax.set_xlabel("time in s", fontsize=8)
    figure.suptitle("Share of repeats whose 90 % band holds the true motion; dotted: the last reading")
    return figure
