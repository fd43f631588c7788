"""Section 3.3.3: a damped pendulum with random inputs, learnt by the marginal likelihood and by LS + ERA.

    python -m experiments.controlled_pendulum [--quick] [--out DIR] [--seed N] [--scheduler ADDRESS]

A grid of data intervals and noise ratios, up to a hundred data sets in each cell (specification 5.7). The maximum a
posteriori of (3.21) stands against least-squares Markov parameters with the eigensystem realisation algorithm, both
with the Hankel matrix that the dissertation prints and its code uses, which starts at G_0 (E20), and with the corrected
one. Errors are mean squares against the noiseless angle, over the 20 s of training and the 20 s after. As published,
the average of LS + ERA leaves its worst data set out and that of the MAP keeps all. No start knows the truth.

For the data set of the noisy cell on which the published LS + ERA does best the posterior is drawn by three samplers:
Algorithm 3 in one block and in its three, and importance sampling; and, to be looked at, in the coordinates of
Fig. 2.2, which leave one direction free. Each cell leaves a file, and a run that was stopped goes on where it was. With
`--scheduler` the cells are done by the workers, and the posterior here.
"""

import importlib
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from ._command import Run, command
from ._controlled_pendulum_case import RATIOS, SPACINGS, Systems, data_sets, impulse_response, mean_squares, outputs
from ._controlled_pendulum_estimates import FIRST, LAGS, LAST, ls_era, maxima
from ._controlled_pendulum_figures import View, contours, details, marginals, spreads
from ._controlled_pendulum_posterior import drawn, sampler_names
from ._controlled_pendulum_results import DETAILED, NOISY, metrics, report
from ._realisations import kept, realisations

# Data intervals, noise ratios and data sets of a cell.
QUICK = ((0.1, 0.3, 0.5), (0.0, 0.1, 0.2), 20)
FULL = (SPACINGS, RATIOS, 100)


def cell(seed: int, spacing: float, ratio: float, count: int) -> dict[str, Any]:
    """Everything that is kept of one cell: each method's errors and systems, and how the descents ended."""
    data = data_sets(seed, spacing, ratio, count)
    best, estimates = maxima(data), ls_era(data)
    found: dict[str, Any] = {
        "negative_log_posterior": best.scores.tolist(),
        "settled": best.settled.tolist(),
        "won_by_lag": best.won_by.tolist(),
    }
    for name, systems in {"map": best.systems, **estimates}.items():
        trained, tested = mean_squares(systems, data)
        # An unstable estimate may overflow; what is written must be finite.
        found[name] = {
            "train": np.minimum(trained, 1e300).tolist(),
            "test": np.minimum(tested, 1e300).tolist(),
            "systems": [part.tolist() for part in systems],
        }
    return found


def systems_of(found: dict[str, Any], name: str) -> Systems:
    """The systems of a method in a cell's file."""
    return Systems(*(np.array(part) for part in found[name]["systems"]))


def realisation(run: Run, number: int, spacing: float, ratio: float, count: int) -> dict[str, Any]:
    """One cell's results, from its file if there is one."""
    settings = f"{count} data sets, lags {LAGS}, {FIRST.rounds} and {LAST.rounds} rounds of {LAST.evaluations}"
    name = f"spacing{spacing:.2f}_ratio{ratio:.3f}"
    return kept(run, name, number, settings, lambda: cell(run.seed, spacing, ratio, count))


def posterior(run: Run, found: dict[str, Any]) -> dict[str, Any]:
    """The posterior of the data set of the noisy cell on which the published LS + ERA does best."""
    spacing, ratio = NOISY
    shown = int(np.argmin(found["ls_era_printed"]["train"]))
    data = data_sets(run.seed, spacing, ratio, shown + 1)

    def make() -> dict[str, Any]:
        return drawn(data, shown, run.seed, run.quick)

    return kept(run, "posterior", shown, sampler_names(run.quick), make)


def experiment(run: Run) -> None:
    """Every cell, the posterior of one data set, the metrics, the table and the figures."""
    spacings, ratios, count = QUICK if run.quick else FULL
    grid = [(spacing, ratio) for spacing in spacings for ratio in ratios]
    jobs = [partial(realisation, number=k, spacing=s, ratio=r, count=count) for k, (s, r) in enumerate(grid)]
    cells = dict(zip(run.each("cells", grid), realisations(run, jobs, threads=1), strict=True))
    draws = posterior(run, cells[NOISY])
    found = metrics(cells, draws)
    run.write(found)
    _draw(run, cells, draws, found)
    report(found, run.quick)


def _draw(run: Run, cells: dict[Any, dict[str, Any]], draws: dict[str, Any], found: dict[str, Any]) -> None:
    """Figures 3.12, 3.13 and 2.2, and the spread of the errors in the noisy cell."""
    run.save(contours(found), "contours.png")
    run.save(details([_view(run, cells[place], place, draws) for place in DETAILED]), "details.png")
    run.save(spreads(cells[NOISY]), "spreads.png")
    run.save(marginals(draws), "marginals.png")


def _view(run: Run, one: dict[str, Any], place: tuple[float, float], draws: dict[str, Any]) -> View:
    shown = int(np.argmin(one["ls_era_printed"]["train"]))
    data = data_sets(run.seed, *place, shown + 1)
    every = {name: systems_of(one, name) for name in ("map", "ls_era_printed", "ls_era_corrected")}
    systems = {name: Systems(*(part[[shown]] for part in many)) for name, many in every.items()}
    count = round(5.0 / place[0])
    paths = {name: outputs(system, data.inputs[[shown]])[0] for name, system in systems.items()}
    responses = {name: impulse_response(system, count)[0] for name, system in systems.items()}
    return View(place, data, shown, paths, responses, draws if place == NOISY else None)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    about = "Section 3.3.3: a pendulum with inputs, by MAP and LS + ERA."
    command("controlled_pendulum", about, experiment, arguments, sweep=True)


if __name__ == "__main__":
    # Under its own name, by which the workers of a cluster find it.
    importlib.import_module("experiments.controlled_pendulum").main()
