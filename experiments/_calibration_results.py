"""What the simulations and repeats of `calibration` come to: p-values, coverages with their spreads, and the tables."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool

from ._calibration_bands import System
from ._calibration_models import WRONG
from ._calibration_ranks import LEVEL, NARROWED, uniformity
from ._calibration_systems import system_called
from ._command import print_table
from ._realisations import spread

# The share of the true motion that bands of 90 % shall hold.
LEAST, MOST = 0.85, 0.95
# A repeat with a coverage below this has lost the motion for half of the time.
LOST = 0.5
Held = Bool[np.ndarray, "repeat time channel"]


def rank_metrics(studies: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """By model: p-values, the verdict, whether what is wrong was seen, and what a posterior cost."""
    found: dict[str, Any] = {}
    smallest, tests = 1.0, 0
    for name, one in studies.items():
        told = uniformity(one["ranks"])
        found[f"sbc_pvalues_{name}"] = told["p_values"]
        found[f"sbc_smallest_p_corrected_{name}"] = told["corrected"]
        found[f"sbc_uniform_{name}"] = told["uniform"]
        found[f"sbc_simulations_{name}"] = len(one["converged"])
        found[f"sbc_posteriors_converged_{name}"] = int(np.sum(one["converged"]))
        for share in NARROWED:
            judged = uniformity(one[f"narrowed_{share:g}"])
            found[f"sbc_rejected_{name}_narrowed_to_{share:g}"] = not judged["uniform"]
        if name not in WRONG:
            pairs = [p for each in told["p_values"].values() for p in each.values()]
            smallest, tests = min([smallest, *pairs]), tests + len(pairs)
    found["sbc_tests"] = tests
    found["sbc_smallest_p_corrected"] = min(1.0, tests * smallest)
    found["sbc_uniform"] = bool(tests * smallest >= LEVEL)
    found["sbc_wrong_is_rejected"] = not any(found[f"sbc_uniform_{name}"] for name in WRONG)
    return found


def coverage_metrics(repeats: Mapping[str, Sequence[Mapping[str, Any]]]) -> dict[str, Any]:
    """By system, way of predicting and stretch of time: coverages over the repeats and over the times."""
    found: dict[str, Any] = {}
    for name, each in repeats.items():
        system = system_called(name)
        found[f"repeats_{name}"] = len(each)
        found[f"posteriors_converged_{name}"] = int(sum(one["converged"] for one in each))
        found[f"process_noise_median_{name}"] = float(np.median([one["process_noise"] for one in each]))
        for way in system.ways:
            for stretch, part in stretches(system).items():
                key = "_".join(filter(None, (stretch, name, way)))
                found |= _coverages(held(each, way)[:, part], key)
                found[f"band_width_{key}"] = spread([one["widths"][way][stretch] for one in each])
    return found


def stretches(system: System) -> dict[str, np.ndarray]:
    """Which times lie within the readings, and which after them."""
    trained = system.times <= system.read_until + 1e-9
    return {"trained": trained, "predicted": ~trained}


def held(each: Sequence[Mapping[str, Any]], way: str) -> Held:
    """Whether the band of each repeat held the truth; kept as strings of 0 and 1, one for each channel."""
    rows = [[[c == "1" for c in channel] for channel in one["inside"][way]] for one in each]
    return np.array(rows).transpose(0, 2, 1)


def _coverages(inside: Held, key: str) -> dict[str, Any]:
    """Over time, by repeat; and over the repeats, by time and channel."""
    by_repeat, by_time = inside.mean(axis=(1, 2)), inside.mean(axis=0)
    mean, goal = float(by_repeat.mean()), (by_time >= LEAST) & (by_time <= MOST)
    return {
        f"coverage_{key}": spread(by_repeat.tolist()),
        f"coverage_mean_{key}": mean,
        f"coverage_mean_error_{key}": float(by_repeat.std(ddof=1) / np.sqrt(len(by_repeat))),
        f"coverage_in_goal_{key}": bool(LEAST <= mean <= MOST),
        f"coverage_pointwise_{key}": spread(np.ravel(by_time).tolist()),
        f"share_of_times_in_goal_{key}": float(goal.mean()),
        f"share_of_repeats_at_least_{LEAST:g}_{key}": float(np.mean(by_repeat >= LEAST)),
        f"share_of_repeats_below_{LOST:g}_{key}": float(np.mean(by_repeat < LOST)),
    }


def report(found: Mapping[str, Any], quick: bool) -> None:
    """Print the verdicts on the ranks, and the coverages."""
    _report_ranks(found)
    rows: list[Sequence[Any]] = [["90 % bands hold, on average over", "readings", "after them", "repeats", "at worst"]]
    names = [key.removeprefix("repeats_") for key in found if key.startswith("repeats_")]
    for name in names:
        for way in system_called(name).ways:
            keys = ["_".join(filter(None, (stretch, name, way))) for stretch in ("trained", "predicted")]
            means = [f"{found[f'coverage_mean_{k}']:.3f} +- {found[f'coverage_mean_error_{k}']:.3f}" for k in keys]
            worst = [f"{found[f'coverage_pointwise_{k}']['smallest']:.2f}" for k in keys]
            rows.append([" ".join(filter(None, (name, way))), *means, found[f"repeats_{name}"], ", ".join(worst)])
    print_table(*rows)
    print(f"Goal: {LEAST:g} to {MOST:g}. At worst: the least coverage over the repeats at one time in one channel.")
    if quick:
        print("quick: fewer simulations and repeats, and fewer systems than in a full run")


def _report_ranks(found: Mapping[str, Any]) -> None:
    rows: list[Sequence[Any]] = [
        ["ranks", "simulations", "smallest p, corrected", "uniform", "rejected if narrowed to"]
    ]
    names = [key.removeprefix("sbc_simulations_") for key in found if key.startswith("sbc_simulations_")]
    for name in names:
        seen = [f"{share:g}" for share in NARROWED if found[f"sbc_rejected_{name}_narrowed_to_{share:g}"]]
        numbers = (found[f"sbc_simulations_{name}"], found[f"sbc_smallest_p_corrected_{name}"])
        rows.append([name, *numbers, found[f"sbc_uniform_{name}"], ", ".join(seen) or "none"])
    print_table(*rows)
    print(f"All right models together, {found['sbc_tests']} tests: p = {found['sbc_smallest_p_corrected']:.3g}")
