"""What the cells of `controlled_pendulum` come to: grids, the spread in the noisy cell, and the table."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ._command import print_table
from ._realisations import print_spreads, spread

METHODS = ("map", "ls_era_printed", "ls_era_corrected")
PERIODS = ("train", "test")
# Data interval and noise ratio: many and noisy readings; few and noiseless ones.
NOISY, SPARSE = (0.1, 0.2), (0.5, 0.0)
DETAILED = (NOISY, SPARSE)
PUBLISHED = {
    "mean_train_map": 4.47e-4,
    "std_train_map": 3.65e-4,
    "std_test_map": 5.56e-4,
    "std_train_ls_era_printed": 1.72e-2,
    "std_test_ls_era_printed": 2.58e-2,
    "best_train_ls_era_printed": 2.86e-4,
    "posterior_mean_on_best_ls_era": 4.74e-4,
}
# Colour axes of the dissertation's figure 3.12, log10.
PUBLISHED_RANGES = {"map": (-12, -3), "ls_era_printed": (-2, -1)}
Cells = dict[tuple[float, float], dict[str, Any]]


def average(errors: Sequence[float], method: str) -> tuple[float, float]:
    """Mean and standard deviation as published: LS + ERA without its worst data set, the MAP with all."""
    kept = np.sort(errors) if method == "map" else np.sort(errors)[:-1]
    return float(kept.mean()), float(kept.std())


def metrics(cells: Cells, draws: dict[str, Any]) -> dict[str, Any]:
    """Grids over the cells, the noisy cell's numbers, and the posterior's."""
    spacings, ratios = (sorted({place[i] for place in cells}) for i in (0, 1))
    count = len(cells[NOISY]["settled"])
    found: dict[str, Any] = {
        "spacings": spacings,
        "ratios": ratios,
        "data_sets": count,
        "published": PUBLISHED,
        "published_log10_ranges": PUBLISHED_RANGES,
    }
    for method in METHODS:
        for period in PERIODS:
            grid = [[_log10_mean(cells[s, r], method, period) for r in ratios] for s in spacings]
            found[f"log10_mean_{period}_{method}"] = grid
            medians = [[float(np.log10(np.median(cells[s, r][method][period]))) for r in ratios] for s in spacings]
            found[f"log10_median_{period}_{method}"] = medians
        found[f"log10_range_{method}"] = _ends(found, method)
    for method in METHODS[1:]:
        shares = [[_wins(cells[s, r], method) for r in ratios] for s in spacings]
        found[f"map_below_{method}"] = shares
    found["settled"] = [[float(np.mean(cells[s, r]["settled"])) for r in ratios] for s in spacings]
    return found | _noisy(cells[NOISY]) | _shown(cells, draws) | {"posterior": _told(draws)}


def _log10_mean(one: dict[str, Any], method: str, period: str) -> float:
    return float(np.log10(average(one[method][period], method)[0]))


def _ends(found: dict[str, Any], method: str) -> list[float]:
    both = np.array([found[f"log10_mean_{period}_{method}"] for period in PERIODS])
    return [float(both.min()), float(both.max())]


def _wins(one: dict[str, Any], method: str) -> float:
    """The share of data sets in which the MAP's test error is the smaller."""
    return float(np.mean(np.array(one["map"]["test"]) < np.array(one[method]["test"])))


def _noisy(one: dict[str, Any]) -> dict[str, Any]:
    """Mean, deviation and spread of every method in the noisy cell."""
    found: dict[str, Any] = {}
    for method in METHODS:
        for period in PERIODS:
            errors = one[method][period]
            found[f"mean_{period}_{method}"], found[f"std_{period}_{method}"] = average(errors, method)
            found[f"{period}_{method}"] = spread(errors)
        found[f"best_train_{method}"] = float(np.min(one[method]["train"]))
    return found


def _shown(cells: Cells, draws: dict[str, Any]) -> dict[str, Any]:
    """Errors over all 40 s on the data set of each detailed cell on which the published LS + ERA does best."""
    found: dict[str, Any] = {}
    for name, place in (("noisy", NOISY), ("sparse", SPARSE)):
        one = cells[place]
        shown = int(np.argmin(one["ls_era_printed"]["train"]))
        found[f"shown_{name}"] = {
            method: 0.5 * (one[method]["train"][shown] + one[method]["test"][shown]) for method in METHODS
        } | {"data_set": shown}
    found["shown_noisy"]["posterior_mean"] = draws["posterior_mean_error"]
    found["posterior_mean_on_best_ls_era"] = draws["posterior_mean_error"]
    return found


def _told(draws: dict[str, Any]) -> dict[str, Any]:
    """What the samplers say: effective draws, convergence, and how far their means are apart."""
    return {
        name: {key: one[key] for key in ("least_ess", "largest_r_hat", "converged", "evaluations", "mean", "sd")}
        for name, one in draws["samplers"].items()
    } | {"largest_difference_of_means_in_sd": draws["largest_difference_of_means_in_sd"]}


def report(found: dict[str, Any], quick: bool) -> None:
    """Print the published numbers beside ours."""
    print(f"data interval 0.1 s, noise ratio 0.2: mean squared errors over {found['data_sets']} data sets")
    print_spreads(found, {})
    rows: list[Sequence[Any]] = [["the same cell", "published", "ours"]]
    rows += [[key, value, found[key]] for key, value in PUBLISHED.items()]
    rows += [[f"mean_train_{method}", "", found[f"mean_train_{method}"]] for method in METHODS[1:]]
    print_table(*rows)
    for method in METHODS:
        low, high = found[f"log10_range_{method}"]
        published = PUBLISHED_RANGES.get(method)
        print(f"log10 of the mean error over the grid, {method}: {low:.2f} .. {high:.2f}, published {published}")
        _print_grid(found, f"log10_mean_test_{method}")
    for method in METHODS[1:]:
        shares = np.array(found[f"map_below_{method}"])
        print(f"the MAP's test error is below that of {method} in {shares.mean():.0%} of all data sets")
    _print_samplers(found["posterior"])
    if quick:
        print("quick: nine cells of 81, fewer data sets in each, shorter chains")


def _print_grid(found: dict[str, Any], key: str) -> None:
    head = [f"{key}: s \\ ratio", *(f"{ratio:g}" for ratio in found["ratios"])]
    rows = [[f"{s:g}", *(f"{x:.2f}" for x in row)] for s, row in zip(found["spacings"], found[key], strict=True)]
    print_table(head, *rows)


def _print_samplers(told: dict[str, Any]) -> None:
    rows: list[Sequence[Any]] = [
        ["sampler", "least ESS", "largest R-hat", "evaluations", "trusted", "det A", "trace A"]
    ]
    for name, one in told.items():
        if isinstance(one, dict):
            pairs = [f"{mean:.4f} ({sd:.4f})" for mean, sd in zip(one["mean"], one["sd"], strict=True)]
            rows.append([name, one["least_ess"], one["largest_r_hat"], one["evaluations"], one["converged"], *pairs])
    print_table(*rows)
    apart = told["largest_difference_of_means_in_sd"]
    print(f"in the observable form the samplers' means differ by {apart:.3f} posterior standard deviations at most")
