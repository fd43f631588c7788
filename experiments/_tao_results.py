"""What the trainings on Tao's example came to: metrics, the table and Figures 5.8 to 5.11."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ._command import print_table
from ._ensemble import Spread

POSTERIOR, L1, MEAN = WAYS = ("posterior", "l1", "posterior_mean_of_copies")
NOISES, COUNTS = tuple(round(0.01 * i, 2) for i in range(11)), tuple(range(300, 1001, 100))
# The journal's abstract of the chapter (CMAME 2024); the dissertation has heat maps alone.
PUBLISHED_GAIN, PUBLISHED_WON = 724.0, "nearly all"
Cell = tuple[float, int]


class Judged(NamedTuple):
    """The trainings of one way at one n: errors (cell, repeat, 2) by (5.26) and (5.27), and of each cell the free runs
    (cell, 2, 2n, 2) with the median and the least error."""

    errors: np.ndarray
    runs: np.ndarray


class Outcome(NamedTuple):
    """One way on one data set: (5.26) and (5.27) of all repeats, and the two free runs."""

    mse: np.ndarray
    off: np.ndarray
    runs: np.ndarray

    @property
    def of_least(self) -> float:
        """(5.27) of the model with the least (5.26), as in Figure 5.11."""
        return float(self.off[np.argmin(self.mse)])


Outcomes = dict[tuple[str, Cell], Outcome]


def outcomes(cells: dict[str, Sequence[Cell]], results: dict[int, dict[str, Judged]]) -> Outcomes:
    """By way and data set, of what is done."""
    found: Outcomes = {}
    for way in WAYS:
        for n, ways in results.items():
            for i, cell in enumerate(cell for cell in cells[way] if cell[1] == n):
                errors = np.asarray(ways[way].errors[i])
                found[way, cell] = Outcome(errors[:, 0], errors[:, 1], np.asarray(ways[way].runs[i]))
    return found


# What is mapped over the grid, for each way: the names of the metrics and their values.
_MAPPED = {
    "mse_median": lambda one: np.median(one.mse),
    "mse_minimum": lambda one: one.mse.min(),
    "mse_low": lambda one: np.quantile(one.mse, 0.1),
    "mse_high": lambda one: np.quantile(one.mse, 0.9),
    "hamiltonian_mse_median": lambda one: np.median(one.off),
    "hamiltonian_mse_low": lambda one: np.quantile(one.off, 0.1),
    "hamiltonian_mse_high": lambda one: np.quantile(one.off, 0.9),
    "hamiltonian_mse_minimum": lambda one: one.off.min(),
    "hamiltonian_mse_of_minimum_mse": lambda one: one.of_least,
}


def grid(found: Outcomes, way: str, value: Any) -> np.ndarray:
    """A number of each data set, (8, 11) over n and a; NaN where there is none."""
    table = np.full((len(COUNTS), len(NOISES)), np.nan)
    for (own, (a, n)), one in found.items():
        if own == way:
            table[COUNTS.index(n), NOISES.index(a)] = value(one)
    return table


def metrics(found: Outcomes, cells: Sequence[Cell]) -> dict[str, Any]:
    """The keys of `metrics.json`; null in a map is a data set that was not asked for, or is in `missing`.

    A gain is how many times lower an error of the likelihood is than that of L1, or of `beyond` than of the likelihood.
    """
    numbers: dict[str, Any] = {"noises": NOISES, "counts": COUNTS}
    done = [cell for cell in cells if (L1, cell) in found]
    for way in (POSTERIOR, L1):
        for name, value in _MAPPED.items():
            table = grid({key: one for key, one in found.items() if key[1] in done}, way, value)
            numbers[f"{name}_{way}"] = np.where(np.isnan(table), None, table).tolist()
    numbers |= {"cells": len(done), "missing": [list(cell) for cell in cells if cell not in done]}
    pairs = [(found[POSTERIOR, cell], found[L1, cell]) for cell in done]
    numbers["cells_won_median"] = sum(bool(np.median(p.mse) < np.median(o.mse)) for p, o in pairs)
    numbers["cells_won_minimum"] = sum(bool(p.mse.min() < o.mse.min()) for p, o in pairs)
    gains = [o.of_least / p.of_least for p, o in pairs]
    middle = [float(np.median(o.off) / np.median(p.off)) for p, o in pairs]
    numbers["best_gain_hamiltonian_mse"] = max(gains, default=None)
    numbers["gain_hamiltonian_mse"] = _over_cells(gains)
    numbers["gain_hamiltonian_mse_medians"] = _over_cells(middle)
    numbers["published_best_gain_hamiltonian_mse"] = PUBLISHED_GAIN
    return numbers | _mean_of_copies(found) | _noisier(found)


def _over_cells(values: Sequence[float]) -> Spread | None:
    return Spread.of(values) if len(values) else None


def _mean_of_copies(found: Outcomes) -> dict[str, Any]:
    """Mean of copies against first copy in the filter, repeat by repeat."""
    parts, every = [], []
    for way, cell in found:
        if way != MEAN:
            continue
        mean, first = found[MEAN, cell], found[POSTERIOR, cell]
        gain = {"mse": first.mse / mean.mse, "hamiltonian_mse": first.off / mean.off}
        every.append(gain["hamiltonian_mse"])
        parts.append({"a": cell[0], "n": cell[1]} | {f"gain_{k}": Spread.of(v)._asdict() for k, v in gain.items()})
    together = Spread.of(np.concatenate(every)) if every else None
    return {"beyond_mean_of_copies": parts, "beyond_mean_of_copies_gain_hamiltonian_mse": together}


def _noisier(found: Outcomes) -> dict[str, Any]:
    """The likelihood at a = 10 % against L1 at 1 %, of each n for which both are done."""
    pairs = [(n, found.get((POSTERIOR, (0.1, n))), found.get((L1, (0.01, n)))) for n in COUNTS]
    parts = [
        {
            "n": n,
            "gain_mse": float(np.median(quiet.mse) / np.median(noisy.mse)),
            "gain_hamiltonian_mse": float(np.median(quiet.off) / np.median(noisy.off)),
        }
        for n, noisy, quiet in pairs
        if noisy is not None and quiet is not None
    ]
    won = sum(part["gain_mse"] > 1.0 for part in parts)
    return {"beyond_noise_ten_times": parts, "beyond_noise_ten_times_won": won}


def show(found: Outcomes, numbers: dict[str, Any]) -> None:
    """Print the table of the data sets and what they say together."""
    heads = ("a", "n", "way", "median MSE", "least MSE", "median H MSE", "H MSE of least")
    rows = [
        (a, n, way, float(np.median(one.mse)), float(one.mse.min()), float(np.median(one.off)), one.of_least)
        for (way, (a, n)), one in sorted(found.items(), key=lambda item: (item[0][1], item[0][0]))
    ]
    print_table(heads, *rows)
    of = numbers["cells"]
    print(f"\nposterior below L1: median MSE {numbers['cells_won_median']} of {of} data sets, ", end="")
    print(f"least MSE {numbers['cells_won_minimum']} of {of} (published: {PUBLISHED_WON} of 88)")
    gain = numbers["best_gain_hamiltonian_mse"]
    if gain is not None:
        print(f"best gain in Hamiltonian MSE: {gain:.4g} (published: up to {PUBLISHED_GAIN:g})")
        print(f"gain in Hamiltonian MSE over the data sets: {numbers['gain_hamiltonian_mse']}")
    together, noisier = numbers["beyond_mean_of_copies_gain_hamiltonian_mse"], numbers["beyond_noise_ten_times"]
    if together is not None:
        where = f"{len(numbers['beyond_mean_of_copies'])} data sets"
        print(f"beyond, mean of copies in the filter: Hamiltonian MSE falls {together} times ({where}): ", end="")
        print(together.verdict)
    if noisier:
        each = ", ".join(f"{part['gain_mse']:.3g} at n = {part['n']}" for part in noisier)
        won = f"in {numbers['beyond_noise_ten_times_won']} of {len(noisier)}"
        print(f"beyond, noise ten times larger: median MSE of L1 at 1 % over the posterior's at 10 %: {each}; ", end="")
        print(f"the posterior bears ten times the noise at no more error {won}")


def maps(found: Outcomes) -> Figure:
    """Figures 5.8 and 5.11: log10 of the median and least MSE, and of the Hamiltonian MSE, both objectives."""
    names = {
        "mse_median": "median MSE",
        "mse_minimum": "least MSE",
        "hamiltonian_mse_of_minimum_mse": "H MSE of least MSE",
    }
    figure = Figure(figsize=(10.0, 11.0), layout="constrained")
    panels = figure.subplots(3, 2)
    for row, (name, words) in zip(panels, names.items(), strict=True):
        tables = [np.log10(np.maximum(grid(found, way, _MAPPED[name]), 1e-16)) for way in (POSTERIOR, L1)]
        known = np.concatenate(tables)[np.isfinite(np.concatenate(tables))]
        low, high = (known.min(), known.max()) if known.size else (0.0, 1.0)
        for axes, table, way in zip(row, tables, ("-log posterior", "L1"), strict=True):
            image = axes.imshow(table, origin="lower", aspect="auto", vmin=low, vmax=high, cmap="viridis")
            axes.set(xticks=range(len(NOISES)), yticks=range(len(COUNTS)), yticklabels=COUNTS)
            axes.set_xticklabels([f"{100 * a:.0f}" for a in NOISES])
            axes.set(xlabel="noise a in %", ylabel="n", title=f"log10 {words}: {way}")
            for j, i in np.argwhere(np.isfinite(table)):
                dark = table[j, i] < 0.5 * (low + high)
                axes.text(i, j, f"{table[j, i]:.1f}", ha="center", va="center", fontsize=7, color="wk"[not dark])
        figure.colorbar(image, ax=row, shrink=0.9)
    return figure


def runs(found: Outcomes, cells: Sequence[Cell], which: int, truth: np.ndarray, step: float) -> Figure:
    """Figures 5.9 (`which` 0, the models of the median MSE) and 5.10 (1, the least MSE): p in time and the orbit."""
    figure = Figure(figsize=(11.0, 2.3 * len(cells)), layout="constrained")
    panels = figure.subplots(len(cells), 2, width_ratios=(3, 1), squeeze=False)
    for (in_time, in_space), cell in zip(panels, cells, strict=True):
        a, n = cell
        _curve(in_time, in_space, truth[: 2 * n], step, "truth", "0.6", 3.0)
        for way, colour in ((L1, "tab:red"), (POSTERIOR, "tab:blue")):
            _curve(in_time, in_space, found[way, cell].runs[which], step, way, colour, 1.2)
        in_time.axvline(step * n, color="0.8", linewidth=1.0)
        in_time.set(ylabel="p", title=f"a = {100 * a:.0f} %, n = {n}; data end at the line")
        in_space.set(xlabel="q", ylabel="p")
    panels[0][0].legend(fontsize=8, loc="upper right")
    panels[-1][0].set_xlabel("time")
    return figure


def _curve(in_time: Axes, in_space: Axes, xs: np.ndarray, step: float, name: str, colour: str, width: float) -> None:
    in_time.plot(step * np.arange(len(xs)), xs[:, 1], color=colour, linewidth=width, label=name)
    in_space.plot(xs[:, 0], xs[:, 1], color=colour, linewidth=width)
