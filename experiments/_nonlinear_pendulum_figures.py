"""Figures of `nonlinear_pendulum`: the noises' posterior, the motions, and the errors over the data sets."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ._noise_landscape import GRID, Landscape, finer
from ._nonlinear_pendulum_results import METHODS
from ._pendulum_case import Cell
from ._pendulum_figures import Shown, trajectories

# Nats below the highest point at which contours are drawn.
_LEVELS = np.array([-30, -20, -15, -12, -10, -8, -6, -4, -3, -2, -1, -0.5, -0.1])


def landscapes(shown: Sequence[Shown], lands: Sequence[Landscape]) -> Figure:
    """Fig. 3.10: the density over both variances, A at its best and A integrated out, with the posterior's draws."""
    figure = Figure(figsize=(4.5 * len(shown), 8.5), layout="constrained")
    grid = np.linspace(GRID[0], GRID[-1], finer(lands[0].height).shape[0])
    rows = figure.subplots(2, len(shown), sharex=True, sharey=True)
    for row, title in zip(rows, ("A at its best", "A integrated out"), strict=True):
        for axes, one, land in zip(row, shown, lands, strict=True):
            fine = finer(land.height if title == "A at its best" else land.marginal)
            contours = axes.contourf(grid, grid, (fine - fine.max()).T, levels=[*_LEVELS, 0], cmap="viridis")
            logs = np.log10(one.variances)
            axes.plot(logs[:, 0], logs[:, 1], ".", ms=2, alpha=0.4, color="tab:red")
            axes.axhline(2 * np.log10(one.cell.sigma), color="white", lw=1, ls="--")
            axes.set(title=f"{title}, n = {one.cell.n}, sigma = {one.cell.sigma:g}", xlim=(-6, 1), ylim=(-5, 1))
            axes.set(xlabel="log10 process noise variance", ylabel="log10 measurement noise variance")
        figure.colorbar(contours, ax=row, label="nats below the highest, over variances")
    return figure


def states(shown: Sequence[Shown]) -> Figure:
    """Figs. 3.8, 3.9 and 3.11: truth, readings, the predictive mean with its band, DMD and TDMD."""
    figure = Figure(figsize=(12, 3.5 * len(shown)), layout="constrained")
    for row, one in zip(figure.subplots(len(shown), 2), shown, strict=True):
        trajectories(row, one)
        row[0].set_title(f"n = {one.cell.n}, sigma = {one.cell.sigma:g}")
    return figure


def spreads(results: Mapping[Cell, Sequence[dict[str, Any]]]) -> Figure:
    """Every method's error over the data sets of each cell."""
    figure = Figure(figsize=(4.5 * len(results), 4.5), layout="constrained")
    for axes, (cell, runs) in zip(figure.subplots(1, len(results)), results.items(), strict=True):
        errors = [[one[f"mse_{name}"] for one in runs if f"mse_{name}" in one] for name in METHODS]
        axes.boxplot(errors, whis=(5, 95), showfliers=False)
        axes.set_xticks(range(1, len(METHODS) + 1), METHODS, rotation=60)
        axes.set(yscale="log", ylabel="mean squared error", title=f"n = {cell.n}, sigma = {cell.sigma:g}")
    return figure
