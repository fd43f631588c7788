"""What the repeats of `markov_parameters` come to: a spread of the error for each size, noise, K and method."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ._command import print_table
from ._realisations import spread

METHODS = ("ls", "gls", "map", "autoregression", "floor")
# The dissertation has figures only. Means and standard deviations of ten repeats by a separate program in NumPy
# (specification 5.5): size, noise, K.
BEFORE = {
    ("small", 0.25, 154): {"ls": (9.5, 5.4), "gls": (8.7, 4.8)},
    ("small", 0.25, 1000): {"ls": (6.6, None), "gls": (5.3, None)},
    ("small", 0.25, 2000): {"ls": (5.6, None), "gls": (4.4, None), "floor": (0.13, None)},
    ("small", 1.0, 2000): {"ls": (9.7, None), "gls": (5.6, None)},
    ("large", 0.25, 190): {"ls": (22.7, None), "gls": (19.3, None)},
    ("large", 0.25, 2000): {"ls": (11.3, None), "gls": (10.5, None), "floor": (0.28, None)},
}


def name_of(size: str, noise: float, count: int, method: str) -> str:
    """The key of a spread among the metrics."""
    return f"error_{size}_noise_{noise:g}_K_{count}_{method}"


def metrics(results: dict[tuple[str, float], list[dict[str, Any]]]) -> dict[str, Any]:
    """A spread with mean and deviation for each size, noise, number of equations and method."""
    found: dict[str, Any] = {"noises": sorted({noise for _, noise in results}), "methods": list(METHODS)}
    settled: list[bool] = []
    for (size, noise), groups in results.items():
        counts = [int(count) for count in groups[0]["ls"]]
        found[f"K_{size}"] = counts
        for count in counts:
            for method in METHODS:
                errors = [e for one in groups for e in one[method].get(str(count), [])]
                if errors:
                    numbers = {"mean": float(np.mean(errors)), "std": float(np.std(errors)), "repeats": len(errors)}
                    found[name_of(size, noise, count, method)] = spread(errors) | numbers
        settled += [flag for one in groups for flags in one["settled"].values() for flag in flags]
        found[f"map_lowest_{size}_noise_{noise:g}"] = _lowest(groups)
    return found | {"descents_settled": float(np.mean(settled))}


def _lowest(groups: list[dict[str, Any]]) -> dict[str, float]:
    """The share of repeats, by K, in which the MAP's error is below those of LS and GLS."""
    shares = {}
    for count in groups[0]["map"]:
        best = [np.minimum(one["ls"][count], one["gls"][count])[: len(one["map"][count])] for one in groups]
        shares[count] = float(np.mean(np.concatenate([one["map"][count] for one in groups]) < np.concatenate(best)))
    return shares


def report(found: dict[str, Any], quick: bool) -> None:
    """Print mean and deviation of every method beside those of the earlier program, and the medians."""
    rows: list[Sequence[Any]] = [["size", "noise", "K", *METHODS, "median MAP", "before"]]
    for size in ("small", "large"):
        for noise in found["noises"]:
            for count in found.get(f"K_{size}", []):
                row = [found.get(name_of(size, noise, count, method)) for method in METHODS]
                cells = [f"{one['mean']:.3g} ({one['std']:.2g})" if one else "not run" for one in row]
                median = f"{row[2]['median']:.3g}" if row[2] else ""
                before = BEFORE.get((size, noise, count), {})
                told = ", ".join(f"{method} {mean:g}" for method, (mean, _) in before.items())
                rows.append([size, f"{noise:g}", count, *cells, median, told])
    print("spectral norm of the error of 18 Markov parameters: mean (standard deviation) over the repeats")
    print_table(*rows)
    print(f"{found['descents_settled']:.0%} of the MAP's descents settled")
    print(_told(found))
    if quick:
        print("quick: the small systems only, three repeats, three numbers of equations")
    elif "K_large" in found:
        print("the MAP of the large systems: few repeats, the least noise and the fewer equations only (its cost)")


def _told(found: dict[str, Any]) -> str:
    """One sentence that says how often the MAP was the best of the three published methods."""
    parts = []
    for key in sorted(found):
        if key.startswith("map_lowest_"):
            shares = list(found[key].values())
            if shares:
                parts.append(f"{np.mean(shares):.0%} ({key.removeprefix('map_lowest_')})")
    return f"the MAP's error is below those of LS and GLS in {', '.join(parts)} of the repeats"
