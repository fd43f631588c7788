"""What the data sets of `linear_pendulum` come to: the map of error ratios, its cells, and the tables."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ._command import print_table
from ._pendulum_case import Cell
from ._realisations import print_spreads, spread

METHODS = ("bayes", "median", "map", "dmd", "tdmd")
OTHERS = ("dmd", "tdmd")
SPREADS = (
    *(f"mse_{name}" for name in METHODS),
    *(f"forecast_mse_{name}" for name in METHODS),
    *("coverage", "forecast_coverage", "process_noise", "measurement_noise"),
)
# The dissertation's claim of Fig. 3.2: the logarithm is below zero in every cell.
PUBLISHED = {"share_of_cells_won_over_dmd": 1.0, "share_of_cells_won_over_tdmd": 1.0}
_RESAMPLES = 200


def kept_mean(errors: np.ndarray) -> np.ndarray:
    """The mean of the errors (..., data set) without the largest one."""
    return np.sort(errors, axis=-1)[..., :-1].mean(axis=-1)


def log_ratio(ours: np.ndarray, theirs: np.ndarray) -> tuple[float, float]:
    """log10 of the ratio of mean errors, each without its largest, and its standard error by the bootstrap."""
    rows = np.random.default_rng(0).integers(len(ours), size=(_RESAMPLES, len(ours)))
    again = np.log10(kept_mean(ours[rows]) / kept_mean(theirs[rows]))
    return float(np.log10(kept_mean(ours) / kept_mean(theirs))), float(again.std(ddof=1))


def metrics(results: Mapping[Cell, Sequence[dict[str, Any]]], detailed: Sequence[Cell]) -> dict[str, Any]:
    """The cells' ratios, in how many the predictive mean wins, and the detailed cells' spreads."""
    cells = [of_cell(cell, runs) for cell, runs in results.items()]
    found: dict[str, Any] = {"cells": cells, "published": PUBLISHED, "cells_counted": len(cells)}
    found["datasets_per_cell"] = min(len(runs) for runs in results.values())
    for other in OTHERS:
        for ours in ("bayes", "median", "map"):
            won = sum(one[f"log10_{ours}_over_{other}"] < 0 for one in cells)
            found[f"cells_won_over_{other}" + ("" if ours == "bayes" else f"_by_{ours}")] = won
        found[f"share_of_cells_won_over_{other}"] = found[f"cells_won_over_{other}"] / len(cells)
        ratios = [one[f"log10_bayes_over_{other}"] for one in cells]
        found[f"largest_log10_bayes_over_{other}"] = max(ratios)
    found["learnt_without_failure"] = sum(one["learnt_without_failure"] for one in cells)
    found["posteriors_converged"] = sum(one["posteriors_converged"] for one in cells)
    for cell in detailed:
        for key in SPREADS:
            found[f"{key}_{cell.name}"] = spread([one[key] for one in results[cell]])
    return found


def of_cell(cell: Cell, runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """A cell's mean errors, each without its largest, their medians, and the ratios."""
    errors = {name: np.array([one[f"mse_{name}"] for one in runs]) for name in METHODS}
    found: dict[str, Any] = {"n": cell.n, "sigma": cell.sigma}
    for name, values in errors.items():
        found[f"mean_mse_{name}"], found[f"median_mse_{name}"] = float(kept_mean(values)), float(np.median(values))
    for other in OTHERS:
        for ours in ("bayes", "median", "map"):
            ratio, error = log_ratio(errors[ours], errors[other])
            found[f"log10_{ours}_over_{other}"], found[f"log10_{ours}_over_{other}_se"] = ratio, error
        found[f"datasets_won_over_{other}"] = float(np.mean(errors["bayes"] < errors[other]))
    found["coverage"] = float(np.mean([one["coverage"] for one in runs]))
    found["learnt_without_failure"] = sum(one["converged"] for one in runs)
    found["posteriors_converged"] = sum(one["posterior_converged"] for one in runs)
    return found


def report(found: dict[str, Any], quick: bool) -> None:
    """Print the maps, the detailed cells, and in how many cells the predictive mean wins."""
    for other in OTHERS:
        print(f"log10 of mean squared error, Bayes over {other.upper()} +- standard error (published: below 0 in all)")
        print_table(*_map(found["cells"], other))
    print_spreads(found, {})
    count = found["cells_counted"]
    for other in OTHERS:
        print(
            f"Bayes below {other.upper()} in {found[f'cells_won_over_{other}']} of {count} cells by the mean, "
            f"{found[f'cells_won_over_{other}_by_median']} by the predictive median, "
            f"{found[f'cells_won_over_{other}_by_map']} by the MAP (published: all, by the mean)"
        )
    everything = count * found["datasets_per_cell"]
    print(f"{found['datasets_per_cell']} data sets in each cell; the largest error of each method in a cell is dropped")
    print(f"of {everything} posteriors {found['posteriors_converged']} passed every check of their draws")
    if quick:
        print("quick: 6 cells of 25, and 20 data sets of 500 in each")


def _map(cells: Sequence[dict[str, Any]], other: str) -> list[list[str]]:
    """Rows of n, columns of sigma."""
    key = f"log10_bayes_over_{other}"
    noises, numbers = sorted({one["sigma"] for one in cells}), sorted({one["n"] for one in cells})
    at = {(one["n"], one["sigma"]): f"{one[key]:.2f} +- {one[key + '_se']:.2f}" for one in cells}
    head = ["n"] + [f"sigma {sigma:g}" for sigma in noises]
    return [head] + [[str(n)] + [at[n, sigma] for sigma in noises] for n in numbers]
