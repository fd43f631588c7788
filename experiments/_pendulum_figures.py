"""Figures of the pendulum experiments: maps of error ratios, and one data set in detail."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from ._pendulum_case import HORIZON, READ_UNTIL, Cell, Pendulum, pushed

COLOURS = {"bayes": "tab:blue", "dmd": "tab:orange", "tdmd": "tab:green"}


class Shown(NamedTuple):
    """One data set: its readings, the draws of A and of both variances, and the A of the MAP and of the others."""

    pendulum: Pendulum
    cell: Cell
    readings: np.ndarray
    draws: np.ndarray
    variances: np.ndarray
    map: np.ndarray
    dmd: np.ndarray
    tdmd: np.ndarray


def ratios(cells: Sequence[dict[str, Any]]) -> Figure:
    """Fig. 3.2: log10 of the ratio of mean squared errors, over n and sigma; blue where Bayes has the smaller one."""
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    noises, numbers = sorted({one["sigma"] for one in cells}), sorted({one["n"] for one in cells})
    for axes, other in zip(figure.subplots(1, 2), ("dmd", "tdmd"), strict=True):
        grid = np.full((len(noises), len(numbers)), np.nan)
        for one in cells:
            grid[noises.index(one["sigma"]), numbers.index(one["n"])] = one[f"log10_bayes_over_{other}"]
        image = axes.imshow(grid, origin="lower", aspect="auto", cmap="RdBu_r", vmin=-2.5, vmax=2.5)
        for (i, j), value in np.ndenumerate(grid):
            colour = "white" if abs(value) > 1.6 else "black"
            axes.text(j, i, f"{value:.2f}", ha="center", va="center", color=colour)
        axes.set_xticks(range(len(numbers)), [str(n) for n in numbers])
        axes.set_yticks(range(len(noises)), [f"{sigma:g}" for sigma in noises])
        axes.set(xlabel="readings in 4 s, n", ylabel="noise, sigma", title=f"log10 MSE, Bayes over {other.upper()}")
        figure.colorbar(image, ax=axes)
    return figure


def detail(shown: Shown) -> Figure:
    """Figs. 3.3 to 3.6 of one data set: both states with the band of 95 %, eigenvalues, and the noises."""
    figure = Figure(figsize=(12, 8), layout="constrained")
    axes = figure.subplots(2, 2)
    trajectories(axes[0], shown)
    _eigenvalues(axes[1, 0], shown)
    _noises(axes[1, 1], shown)
    figure.suptitle(f"{shown.pendulum.name} pendulum, n = {shown.cell.n}, sigma = {shown.cell.sigma:g}")
    return figure


def trajectories(pair: Sequence[Any], shown: Shown) -> None:
    """Angle and angular velocity: truth, readings, the predictive mean and its band, DMD and TDMD."""
    times, fine = shown.cell.times(HORIZON), np.linspace(0.0, HORIZON, 400)
    start, true = shown.pendulum.start, shown.pendulum.states(fine)
    drawn = pushed(shown.draws, start, len(times) - 1)
    low, high = np.quantile(drawn, [0.025, 0.975], axis=0)
    paths = {"bayes": drawn.mean(axis=0)}
    paths |= {name: pushed(getattr(shown, name), start, len(times) - 1) for name in ("dmd", "tdmd")}
    for i, (axes, label) in enumerate(zip(pair, ("angle", "angular velocity"), strict=True)):
        axes.plot(fine, true[:, i], "k-", lw=1, label="truth")
        axes.plot(times[: len(shown.readings)], shown.readings[:, i], "k.", ms=5, label="readings")
        axes.fill_between(times, low[:, i], high[:, i], color=COLOURS["bayes"], alpha=0.25, label="95 %")
        for name, path in paths.items():
            axes.plot(times, path[:, i], "o-", ms=2.5, lw=1, color=COLOURS[name], label=name)
        axes.axvline(READ_UNTIL, color="grey", lw=0.8)
        size = 1.8 * np.abs(true[:, i]).max()
        axes.set(xlabel="time (s)", ylabel=label, ylim=(-size, size))
    pair[0].legend(fontsize=8, ncols=3, loc="upper right")


def _eigenvalues(axes: Any, shown: Shown) -> None:
    """Eigenvalues of the continuous generator, log(eigenvalue of A) / dt, of the draws and of the others."""
    step = READ_UNTIL / shown.cell.n

    def rates(A: np.ndarray) -> np.ndarray:
        return np.log(np.linalg.eigvals(A).astype(complex)).ravel() / step

    drawn = rates(shown.draws)
    axes.plot(drawn.real, drawn.imag, ".", ms=2, alpha=0.3, color=COLOURS["bayes"], label="draws")
    for name in ("dmd", "tdmd"):
        one = rates(getattr(shown, name))
        axes.plot(one.real, one.imag, "s", ms=6, color=COLOURS[name], label=name)
    if shown.pendulum.name == "linear":
        axes.plot([0, 0], [9.81**0.5, -(9.81**0.5)], "k+", ms=12, label="truth")
    axes.set(xlabel="real part (1/s)", ylabel="imaginary part (1/s)", title="eigenvalues")
    axes.legend(fontsize=8)


def _noises(axes: Any, shown: Shown) -> None:
    logs = np.log10(shown.variances)
    axes.plot(logs[:, 0], logs[:, 1], ".", ms=3, alpha=0.4, color=COLOURS["bayes"])
    axes.axhline(2 * np.log10(shown.cell.sigma), color="tab:red", lw=1, label="true variance of the readings")
    axes.set(xlabel="log10 process noise variance", ylabel="log10 measurement noise variance", title="draws of both")
    axes.legend(fontsize=8)
