"""Section 3.2.2.1: Markov parameters by least squares, weighted or not, and by the marginal likelihood.

    python -m experiments.markov_parameters [--quick] [--out DIR] [--seed N] [--scheduler ADDRESS]

Random systems with A = I, of two sizes (specification 5.5), are recorded once; 18 Markov parameters come from the first
K equations by LS (3.13), by GLS with the true weights (3.15), and by the MAP of a linear model. The error is the
spectral norm of all of them less the exact ones (Fig. 3.1). Beside them stand two in closed form: an autoregression
with inputs, which the MAP starts from, and a floor by one who knows that A = I. No start knows the truth.

A quick run has the small systems only. A gradient of the large ones' likelihood takes some 0.1 ms a reading, so of
those the MAP is found in LARGE_MAP repeats, for the least noise and up to 1000 equations only. Groups of repeats leave
files, and a run that was stopped goes on where it was.
"""

import importlib
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from ._command import Run, command
from ._markov_parameters_case import NOISES, SIZES, case, floor, spectral_error
from ._markov_parameters_estimates import FIRST, LAST, PAST, autoregression, gls, ls, maxima, parameters_of
from ._markov_parameters_figures import errors_against_equations
from ._markov_parameters_results import metrics, report
from ._realisations import kept, realisations

# Numbers of equations K for each size. The least are d_u times the lag, where least squares is determined at all.
QUICK = {"small": (154, 500, 1000)}
FULL = {"small": (54, 154, 354, 654, 1000, 2000), "large": (90, 190, 490, 1000, 2000)}
# Repeats of each size in a full run, and how many of them are one file.
REPEATS, QUICK_REPEATS, GROUP = {"small": 50, "large": 10}, 3, 10
# Of the large systems: repeats, noises and equations that the MAP is found for.
LARGE_MAP, LARGE_MAP_NOISES, LARGE_MAP_EQUATIONS = 2, (0.25,), 1000
CLOSED = {
    "ls": ls,
    "gls": gls,
    "autoregression": lambda given: autoregression(given)[0],
    "floor": floor,
}


def group(seed: int, size: str, noise: float, repeats: Sequence[int], counts: Sequence[int]) -> dict[str, Any]:
    """Errors by method and number of equations (repeat,), and how the descents ended."""
    longest = [case(seed, size, noise, k, max(counts)) for k in repeats]
    found: dict[str, Any] = {method: {} for method in (*CLOSED, "map")}
    found |= {"settled": {}, "won_by": {}}
    before = None
    for count in counts:
        cases = [one.first(count) for one in longest]
        for method, estimate in CLOSED.items():
            found[method][str(count)] = [spectral_error(estimate(one), one.exact) for one in cases]
        chosen = mapped(size, noise, count, cases)
        if not chosen:
            continue
        before, places, won = maxima(chosen, before)
        errors = [spectral_error(b, one.exact) for b, one in zip(parameters_of(before), chosen, strict=True)]
        found["map"][str(count)] = np.minimum(errors, 1e300).tolist()
        found["settled"][str(count)] = LAST.settled(places).tolist()
        found["won_by"][str(count)] = won.tolist()
    return found


def mapped(size: str, noise: float, count: int, cases: list[Any]) -> list[Any]:
    """The cases whose MAP is found."""
    if size == "small":
        return cases
    return cases[:LARGE_MAP] if noise in LARGE_MAP_NOISES and count <= LARGE_MAP_EQUATIONS else []


def realisation(run: Run, size: str, noise: float, number: int, repeats: Sequence[int]) -> dict[str, Any]:
    """One group's results, from its file if there is one."""
    counts = (QUICK if run.quick else FULL)[size]
    settings = (
        f"repeats {repeats[0]} to {repeats[-1]}, K {counts}, past {PAST}, {FIRST.rounds} and {LAST.rounds} rounds, "
        f"{(LARGE_MAP, LARGE_MAP_NOISES, LARGE_MAP_EQUATIONS) if size == 'large' else 'all'}"
    )
    name = f"{size}_noise{noise:.2f}"
    return kept(run, name, number, settings, lambda: group(run.seed, size, noise, repeats, counts))


def experiment(run: Run) -> None:
    """Every group of every size and noise, the metrics, the table and the figure."""
    todo = []
    for size in QUICK if run.quick else FULL:
        repeats = QUICK_REPEATS if run.quick else REPEATS[size]
        groups = [range(first, min(first + GROUP, repeats)) for first in range(0, repeats, GROUP)]
        todo += [(size, noise, k, one) for noise in NOISES for k, one in enumerate(groups)]
    jobs = [partial(realisation, size=size, noise=noise, number=k, repeats=one) for size, noise, k, one in todo]
    made = realisations(run, jobs, threads=1)
    results: dict[tuple[str, float], list[dict[str, Any]]] = {}
    for (size, noise, *_), group_found in zip(run.each("groups of repeats", todo), made, strict=True):
        results.setdefault((size, noise), []).append(group_found)
    found = metrics(results)
    run.write(found)
    for size in SIZES:
        if any(key[0] == size for key in results):
            run.save(errors_against_equations(found, size), f"errors_{size}.png")
    report(found, run.quick)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    command("markov_parameters", "Section 3.2.2.1: Markov parameters by LS, GLS and MAP.", experiment, arguments, True)


if __name__ == "__main__":
    # Under its own name, by which the workers of a cluster find it.
    importlib.import_module("experiments.markov_parameters").main()
