"""What the data sets of `nonlinear_pendulum` come to: errors of every estimate, and how often there are two modes."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ._command import print_table
from ._linear_pendulum_results import kept_mean
from ._pendulum_case import Cell
from ._realisations import print_spreads, spread

METHODS = ("bayes", "median", "map", "dominant", "process_mode", "measurement_mode", "dmd", "tdmd")
MODES = ("process_mode", "measurement_mode")
PUBLISHED = {"tdmd_over_dominant_n26_sigma0.1": 1.3}
_SPREADS = ("coverage", "forecast_coverage", "process_noise", "measurement_noise", "share_of_dominant_mode")


def metrics(results: Mapping[Cell, Sequence[dict[str, Any]]]) -> dict[str, Any]:
    """Of every cell: errors, TDMD's error over the dominant mode's, and in how many data sets there are two modes."""
    found: dict[str, Any] = {"published": PUBLISHED, "datasets_per_cell": min(len(runs) for runs in results.values())}
    found["published_in_words"] = "bimodal at low noise, unimodal at high, in one data set of each"
    for cell, runs in results.items():
        found |= {f"{key}_{cell.name}": value for key, value in of_cell(runs).items()}
    return found


def of_cell(runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """One cell's metrics."""
    found: dict[str, Any] = {}
    for name in METHODS:
        for kind in ("mse", "forecast_mse"):
            errors = [one[f"{kind}_{name}"] for one in runs if f"{kind}_{name}" in one]
            if errors:
                found[f"{kind}_{name}"] = spread(errors)
            if len(errors) > 1:
                found[f"mean_{kind}_{name}"] = float(kept_mean(np.array(errors)))
    found |= {key: spread([one[key] for one in runs]) for key in _SPREADS}
    dominant = np.array([one["mse_dominant"] for one in runs])
    for other in ("dmd", "tdmd"):
        theirs = np.array([one[f"mse_{other}"] for one in runs])
        found[f"{other}_over_dominant"] = spread((theirs / dominant).tolist())
        found[f"{other}_over_dominant_of_means"] = float(kept_mean(theirs) / kept_mean(dominant))
        mean = np.array([one["mse_bayes"] for one in runs])
        found[f"{other}_over_predictive_mean_of_means"] = float(kept_mean(theirs) / kept_mean(mean))
        found[f"share_won_over_{other}_by_dominant"] = float(np.mean(dominant < theirs))
        found[f"share_won_over_{other}_by_mean"] = float(np.mean(mean < theirs))
    found["share_with_two_modes_of_draws"] = float(np.mean([one["modes_of_draws"] > 1 for one in runs]))
    found["posteriors_converged"] = sum(one["posterior_converged"] for one in runs)
    found["learnt_without_failure"] = sum(one["converged"] for one in runs)
    return found | _of_landscapes([one for one in runs if "hills" in one])


def _of_landscapes(runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """In what share of the landscapes there are two hills, by way of looking, and how much the lesser one holds."""
    found: dict[str, Any] = {"landscapes": len(runs), "two_hills": {}}
    for way in sorted({name for one in runs for name in one["hills"]}):
        counts = [one["hills"][way] for one in runs if way in one["hills"]]
        found["two_hills"][way] = {"share": float(np.mean(np.array(counts) > 1)), "of": len(counts)}
    for name in MODES:
        with_it = [one for one in runs if f"mse_{name}" in one]
        if with_it:
            ratios = [one["mse_tdmd"] / one[f"mse_{name}"] for one in with_it]
            found[f"tdmd_over_{name}"] = spread(ratios)
    both = [one for one in runs if all(name in one for name in MODES)]
    found["two_modes_process_and_measurement"] = len(both) / len(runs)
    if both:
        found["measurement_mode_below_process_mode"] = spread(
            [one["measurement_mode"]["below"] - one["process_mode"]["below"] for one in both]
        )
        chains = [one["measurement_mode"] for one in both if "left_after" in one["measurement_mode"]]
        if chains:
            found["chain_leaves_measurement_mode_after"] = spread([one["left_after"] for one in chains])
            found["chain_share_of_process_noise"] = spread([one["chain_share"] for one in chains])
        for prior in both[0]["measurement_mode"]["mass"]:
            masses = [one["measurement_mode"]["mass"][prior] for one in both]
            found[f"mass_of_measurement_mode_{prior}"] = spread(masses)
    ends = [one["published_start"] for one in runs]
    found["published_start_ends"] = {end: ends.count(end) for end in ("highest", "lesser", "elsewhere")}
    return found


def report(found: dict[str, Any], quick: bool) -> None:
    """Print the spreads, the published ratio beside ours, and where there are two hills."""
    print_spreads(found, PUBLISHED)
    cells = [key.removeprefix("two_hills_") for key in found if key.startswith("two_hills_")]
    print("mean of squared errors, the largest of each method dropped")
    names = [name for name in METHODS if any(f"mean_mse_{name}_{cell}" in found for cell in cells)]
    rows = [[name] + [found.get(f"mean_mse_{name}_{cell}", "") for cell in cells] for name in names]
    print_table(["method", *cells], *rows)
    print("share of data sets with two hills of the density of both noise variances")
    ways = sorted({way for cell in cells for way in found[f"two_hills_{cell}"]})
    print_table(
        ["density", *cells], *[[way] + [_share(found[f"two_hills_{cell}"], way) for cell in cells] for way in ways]
    )
    for cell in cells:
        print(f"{cell}: the dissertation's start ends {found[f'published_start_ends_{cell}']}")
    ratio = found["tdmd_over_dominant_n26_sigma0.1"]["median"]
    means = found["tdmd_over_dominant_of_means_n26_sigma0.1"]
    better = found["tdmd_over_predictive_mean_of_means_n26_sigma0.1"]
    print(
        f"TDMD's error over the dominant mode's at n = 26, sigma = 0.1: {ratio:.2f} in the median, {means:.2f} of the "
        f"means (published: 1.3); over the predictive mean's {better:.2f} of the means"
    )
    if quick:
        print("quick: 10 data sets of 500 in each cell, and 5 landscapes of 100")


def _share(of_ways: dict[str, Any], way: str) -> str:
    one = of_ways.get(way)
    return "" if one is None else f"{one['share']:.2f} of {one['of']}"
