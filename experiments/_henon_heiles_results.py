"""What the noise realisations of `henon_heiles` come to: spreads, what helps beyond the dissertation, and the table."""

from typing import Any

import numpy as np

from ._henon_heiles_case import ENERGY, HORIZON, PROPAGATORS
from ._realisations import print_spreads, spread

PUBLISHED = {
    "H_symplectic": 0.1219,
    "H_rk2": 0.1211,
    "tracking_time_symplectic": 150.0,
    "tracking_time_rk2": 20.0,
    "process_noise_ratio_rk2_over_symplectic": 10.0,
}
SPREADS = (
    "H",
    "H_posterior_mean",
    "tracking_time",
    "tracking_time_stepped_as_learnt",
    "tracking_time_posterior_mean",
    "tracking_time_predictive_median",
    "tracking_time_expected",
    "coverage_trained",
    "coverage_predicted",
    "band_width_trained",
    "band_width_predicted",
)
HELPS, HURTS, UNCLEAR = "helps", "hurts", "makes no clear difference"
# Something helps that tracks for longer, by a twentieth, in three realisations of four.
_MOST, _CLEARLY = 0.75, 1.05
# What goes beyond the dissertation: in words, the propagator, and its tracking time.
BEYOND = {
    "order4_step_5_times_larger": (
        "order 4 in steps five times larger",
        "order4_step_5_times_larger",
        "tracking_time",
    ),
    "stepped_as_learnt": (
        "leapfrog's MAP predicting in the steps it was learnt in",
        "symplectic",
        "tracking_time_stepped_as_learnt",
    ),
    "posterior_mean": (
        "the posterior mean of leapfrog's coefficients",
        "symplectic",
        "tracking_time_posterior_mean",
    ),
    "predictive_median": (
        "the median of leapfrog's posterior predictions",
        "symplectic",
        "tracking_time_predictive_median",
    ),
}
_ORDER_4 = "order4_step_5_times_larger"


def metrics(results: dict[str, list[dict[str, Any]]]) -> dict[str, Any]:
    """The keys of the issue, each a spread over the realisations, and what helps beyond the dissertation."""
    found: dict[str, Any] = {"H_true": ENERGY, "published": PUBLISHED, "realisations": len(results["symplectic"])}
    medians = {name: np.array([one["process_noise_median"] for one in runs]) for name, runs in results.items()}
    for name, runs in results.items():
        for key in SPREADS:
            found[f"{key}_{name}"] = spread([one[key] for one in runs])
        found[f"H_error_{name}"] = spread([abs(one["H"] - ENERGY) for one in runs])
        found[f"H_in_95_percent_interval_{name}"] = int(sum(_holds(one) for one in runs))
        found[f"process_noise_{name}"] = spread(medians[name].tolist())
        found[f"learnt_without_failure_{name}"] = int(sum(one["converged"] for one in runs))
        found[f"posteriors_converged_{name}"] = int(sum(one["posterior_converged"] for one in runs))
        if name != "symplectic":
            ratio = medians[name] / medians["symplectic"]
            found[f"process_noise_ratio_{name}_over_symplectic"] = spread(ratio.tolist())
    return found | {"beyond": beyond(results)}


def _holds(one: dict[str, Any]) -> bool:
    return one["H_quantiles"][0] <= ENERGY <= one["H_quantiles"][2]


def beyond(results: dict[str, list[dict[str, Any]]]) -> dict[str, Any]:
    """Each way beyond the dissertation against leapfrog's MAP on the same realisations, by tracking time."""
    before = np.array([one["tracking_time"] for one in results["symplectic"]])
    found: dict[str, Any] = {}
    for way, (_, name, key) in BEYOND.items():
        times = np.array([one[key] for one in results[name]])
        longer, shorter = int(np.sum(times > _CLEARLY * before)), int(np.sum(before > _CLEARLY * times))
        gain = float(np.median(times) - np.median(before))
        helps, hurts = longer >= _MOST * len(times) and gain > 0, shorter >= _MOST * len(times) and gain < 0
        found[way] = {
            "tracking_time": float(np.median(times)),
            "longer_in": longer,
            "shorter_in": shorter,
            "verdict": HELPS if helps else HURTS if hurts else UNCLEAR,
        }
    return found


def slopes(propagator: str, merged: bool = False) -> int:
    """Evaluations of dU/dq per data interval: two for each step of a method that does not say. Were the last kick of a
    step `merged` with the next one's first, one less."""
    integrator, substeps = PROPAGATORS[propagator]
    return substeps * (getattr(integrator, "slopes", 2) - merged)


def report(found: dict[str, Any], quick: bool) -> None:
    """Print the published numbers beside ours, and what helps."""
    print_spreads(found, PUBLISHED)
    print(f"true H = {found['H_true']:.4f}; {found['realisations']} noise realisations; tracking ends at {HORIZON:g} s")
    _say_what_helps(found)
    if quick:
        print("quick: fewer realisations, and the posteriors are drawn coarser")


def _say_what_helps(found: dict[str, Any]) -> None:
    """A line for each way beyond the dissertation, and one sentence that sums them up."""
    before, count = found["tracking_time_symplectic"]["median"], found["realisations"]
    for way, (words, _, _) in BEYOND.items():
        one = found["beyond"][way]
        print(
            f"beyond: {words}: {one['tracking_time']:.0f} s in the median against {before:.0f} s of leapfrog's MAP; "
            f"longer in {one['longer_in']} and shorter in {one['shorter_in']} of {count} realisations"
        )
    order4, leapfrog = (found[f"H_error_{name}"]["median"] for name in (_ORDER_4, "symplectic"))
    ours, theirs = ([slopes(name, merged) for merged in (False, True)] for name in (_ORDER_4, "symplectic"))
    print(
        f"beyond: order 4 is off in H by {order4:.2g} in the median, leapfrog by {leapfrog:.2g}; "
        f"it takes {ours[0]} slopes of U per data interval, leapfrog {theirs[0]}; were neighbouring kicks merged, "
        f"{ours[1]} and {theirs[1]}"
    )
    parts = []
    for verdict in (HELPS, HURTS, UNCLEAR):
        names = [words for way, (words, _, _) in BEYOND.items() if found["beyond"][way]["verdict"] == verdict]
        parts.append(f"what {verdict}: {', '.join(names) or 'nothing'}")
    print(f"Counting what changes the tracking time by 5 % in three realisations of four, {'; '.join(parts)}.")
