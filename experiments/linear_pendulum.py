"""Section 3.3.1: the linear pendulum by a linear model, against dynamic mode decomposition.

    python -m experiments.linear_pendulum [--quick] [--out DIR] [--seed N] [--scheduler ADDRESS]

Five hundred data sets for each number of readings in 4 s and each noise (specification 5.3); both states are read, the
start is known. A has four free entries, and both noises one variance each; `learn` starts at DMD's A and residuals, and
`sample` draws. The estimate is the posterior predictive mean (2.19) of a thousand draws, without process noise; the
errors are those at the times of the readings. Of each method's errors in a cell the largest is dropped, as in the
dissertation. Beyond it: the pointwise median of the draws' motions, and the MAP.

Each block of fifty data sets leaves a file, and a run that was stopped goes on where it was. A full run takes some
seventy minutes of one core, by an estimate from a tenth of it.
"""

import importlib
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from symplearn._objectives import TimeSeries

from ._command import Run, command
from ._linear_pendulum_results import METHODS, metrics, report
from ._pendulum_case import (
    FALLBACK,
    HORIZON,
    LINEAR,
    SAMPLER,
    Cell,
    decompositions,
    each_block,
    learnt,
    matrices,
    posterior,
    pushed,
    recording,
    squared_error,
    variances,
)
from ._pendulum_figures import Shown, detail, ratios

DETAILED = (Cell(8, 0.01), Cell(40, 0.1))
NUMBERS, NOISES = (8, 16, 24, 32, 40), (0.001, 0.01, 0.03, 0.1, 0.3)
FULL_CELLS = [Cell(n, sigma) for n in NUMBERS for sigma in NOISES]
QUICK_CELLS = [Cell(n, sigma) for n in (8, 24, 40) for sigma in (0.01, 0.1)]
FULL, QUICK, BLOCK = 500, 20, {False: 50, True: 20}
SETTINGS = f"begun at DMD and its residuals, {SAMPLER}, {FALLBACK}, predicted to {HORIZON:g} s"


def numbered(seed: int, cell: Cell, k: int) -> dict[str, Any]:
    """Data set k of a cell, its noise and its draws from the seed."""
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), k), cell.n)
    return dataset(cell, recording(LINEAR, cell, seed, k), key, k == 0 and cell in DETAILED)


def dataset(cell: Cell, series: TimeSeries, key: PRNGKeyArray, shown: bool) -> dict[str, Any]:
    """Everything that is kept of one data set; `shown` ones keep their draws for the figures."""
    estimate = learnt(series, LINEAR.start)
    found = posterior(estimate, key)
    noises = variances(found)
    values = {"map": np.asarray(estimate.values()["dynamics.A"])} | decompositions(series)
    told = judged(cell, matrices(found), values) | {
        "process_noise": float(np.median(noises[:, 0])),
        "measurement_noise": float(np.median(noises[:, 1])),
        "converged": estimate.converged,
        "posterior_converged": found.converged,
        "pareto_k": found.drawn.pareto_k,
    }
    if shown:
        told["shown"] = {"draws": matrices(found).tolist(), "variances": noises.tolist()}
        told["shown"] |= {name: A.tolist() for name, A in values.items()}
    return told


def judged(cell: Cell, draws: np.ndarray, values: dict[str, np.ndarray]) -> dict[str, float]:
    """Mean squared errors of every method while readings last and after, and the share of true states in the bands."""
    steps = len(cell.times(HORIZON)) - 1
    true = LINEAR.states(cell.times(HORIZON))
    paths = {name: pushed(A, LINEAR.start, steps) for name, A in values.items()}
    drawn = pushed(draws, LINEAR.start, steps)
    low, middle, high = np.quantile(drawn, [0.025, 0.5, 0.975], axis=0)
    paths |= {"bayes": drawn.mean(axis=0), "median": middle}
    inside = ((low <= true) & (true <= high))[1:]
    found: dict[str, float] = {}
    for name in METHODS:
        found[f"mse_{name}"] = squared_error(paths[name][: cell.n + 1], true[: cell.n + 1])
        found[f"forecast_mse_{name}"] = squared_error(paths[name][cell.n :], true[cell.n :])
    return found | {
        "coverage": float(inside[: cell.n].mean()),
        "forecast_coverage": float(inside[cell.n :].mean()),
    }


def experiment(run: Run) -> None:
    """Every data set of every cell, the metrics, the tables and the figures."""
    cells, datasets = (QUICK_CELLS, QUICK) if run.quick else (FULL_CELLS, FULL)
    results = each_block(run, cells, datasets, BLOCK[run.quick], SETTINGS, partial(numbered, run.seed))
    found = metrics(results, DETAILED)
    run.write(found)
    _draw(run, found, results)
    report(found, run.quick)


def _draw(run: Run, found: dict[str, Any], results: dict[Cell, list[dict[str, Any]]]) -> None:
    """The maps of ratios, and the first data set of each detailed cell."""
    run.save(ratios(found["cells"]), "ratios.png")
    for cell in DETAILED:
        shown = {name: np.array(value) for name, value in results[cell][0]["shown"].items()}
        series = recording(LINEAR, cell, run.seed, 0)
        run.save(detail(Shown(LINEAR, cell, np.asarray(series.readings), **shown)), f"{cell.name}.png")


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    command("linear_pendulum", "Section 3.3.1: a linear pendulum, against DMD.", experiment, arguments, sweep=True)


if __name__ == "__main__":
    # Under its own name, by which the workers of a cluster find it.
    importlib.import_module("experiments.linear_pendulum").main()
