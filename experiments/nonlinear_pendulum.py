"""Section 3.3.2: the nonlinear pendulum by a linear model, and whether its noises have two modes.

    python -m experiments.nonlinear_pendulum [--quick] [--out DIR] [--seed N] [--scheduler ADDRESS]

Cells and settings of specification 5.4: 24 readings in 4 s with noise 0.1 and 1, and 26 with 0.1; `learn` and `sample`
as in `linear_pendulum`. Estimates: the posterior predictive mean (2.19), the MAP, and the most probable model of the
dominant mode (sec. 3.3.2.1), by `modes` of the draws.

For the first data sets of each cell the posterior of both variances is laid out on a grid, and its hills are counted:
of the joint density with A at its best, and of the marginal one; over variances, standard deviations and logarithms;
under priors of variances and of standard deviations; with the first reading and without, with the start known and
unknown. Where the joint density has two hills, each is climbed, and its model's error told; and a chain of a thousand
samples, the dissertation's number, begins at the top of the measurement noise's. The truth is DOP853's.

Blocks of data sets leave files, and a run that was stopped goes on where it was. A full run takes
thirty minutes of one core, by an estimate from a twentieth of it.
"""

import importlib
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from symplearn._fit import Estimate, fit
from symplearn._modes import modes
from symplearn._objectives import TimeSeries

from . import _noise_landscape as noise
from ._command import Run, command
from ._noise_chain import LENGTH, chain_from
from ._nonlinear_pendulum_figures import landscapes, spreads, states
from ._nonlinear_pendulum_results import METHODS, metrics, report
from ._pendulum_case import (
    FALLBACK,
    HORIZON,
    NONLINEAR,
    SAMPLER,
    Cell,
    decompositions,
    each_block,
    learnt,
    matrices,
    model,
    posterior,
    pushed,
    recording,
    squared_error,
    variances,
)
from ._pendulum_figures import Shown

CELLS = (Cell(24, 0.1), Cell(24, 1.0), Cell(26, 0.1))
FULL, QUICK, BLOCK = 500, 10, {False: 25, True: 10}
# Data sets of each cell whose landscape is laid out, and with an unknown start too.
LAID_OUT, UNKNOWN_START = {False: 100, True: 5}, {False: 25, True: 1}
# Two ends of a climb are one if their log posteriors are so near, in nats.
_SAME = 0.05


def settings(quick: bool) -> str:
    """What a data set's results hang on besides its seed."""
    laid_out = (
        f"{LAID_OUT[quick]} and {UNKNOWN_START[quick]} landscapes of {noise.GRID.size} points, chains of {LENGTH}"
    )
    return f"begun at DMD and its residuals, {SAMPLER}, {FALLBACK}, predicted to {HORIZON:g} s, {laid_out}"


def numbered(seed: int, quick: bool, cell: Cell, k: int) -> dict[str, Any]:
    """Data set k of a cell, its noise and its draws from the seed."""
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), k), cell.n)
    return dataset(cell, recording(NONLINEAR, cell, seed, k), key, k, quick)


def dataset(cell: Cell, series: TimeSeries, key: PRNGKeyArray, k: int, quick: bool) -> dict[str, Any]:
    """Everything that is kept of data set k; the first keeps its draws for the figures."""
    estimate = learnt(series, NONLINEAR.start)
    found = posterior(estimate, key)
    hills, noises = modes(found), variances(found)
    values = {"map": _dynamics(estimate)} | decompositions(series)
    if hills and hills[0].estimate is not None:
        values["dominant"] = _dynamics(hills[0].estimate)
    told: dict[str, Any] = {
        "modes_of_draws": len(hills),
        "share_of_dominant_mode": hills[0].share if hills else 0.0,
        "share_more_measurement_than_process_noise": float(np.mean(noises[:, 1] > noises[:, 0])),
        "process_noise": float(np.median(noises[:, 0])),
        "measurement_noise": float(np.median(noises[:, 1])),
        "converged": estimate.converged,
        "posterior_converged": found.converged,
    }
    if k < LAID_OUT[quick]:
        laid_out, tops = _laid_out(series, estimate, k < UNKNOWN_START[quick], np.random.default_rng([k, cell.n]))
        told |= laid_out
        values |= tops
    if k == 0:
        told["shown"] = {"draws": matrices(found).tolist(), "variances": noises.tolist()}
        told["shown"] |= {name: values[name].tolist() for name in ("map", "dmd", "tdmd")}
    return told | judged(cell, matrices(found), values)


def _dynamics(estimate: Estimate) -> np.ndarray:
    return np.asarray(estimate.values()["dynamics.A"])


def _laid_out(
    series: TimeSeries, estimate: Estimate, unknown_start: bool, random: np.random.Generator
) -> tuple[dict[str, Any], dict[str, Any]]:
    """How many hills the landscape has in each way of looking, and A at the tops of the joint density's."""
    land = noise.landscape(series, NONLINEAR.start, _dynamics(estimate))
    away = float(np.sum((np.asarray(series.readings)[0] - NONLINEAR.start) ** 2))
    counts = _counts(land, away)
    if unknown_start:
        other = noise.densities_read(noise.landscape(series, None, _dynamics(estimate)), 0.0)
        counts |= {f"unknown_start_{name}": len(noise.hills(other[name])) for name in other if "first" not in name}
    joint = noise.hills(land.height)
    tops = [noise.summit(hill, land, series, NONLINEAR.start) for hill in joint]
    told: dict[str, Any] = {"hills": counts, "published_start": _published_start(series, tops)}
    values: dict[str, Any] = {}
    for hill, top in zip(joint, tops, strict=True):
        name = "process_mode" if hill.of_process_noise else "measurement_mode"
        if name in values:  # the higher one has come first
            continue
        values[name] = _dynamics(top)
        told[name] = {"below": tops[0].log_posterior - top.log_posterior, "rises": min(hill.prominence, 1e3)}
        told[name] |= {"mass": noise.masses(land.marginal, hill.cells), "log10_variances": hill.variances}
        if name == "measurement_mode" and top is not tops[0]:
            chain = chain_from(top, land.curvature[land.at(hill.variances)], len(series.times), random)
            told[name] |= {"left_after": chain.left_after, "chain_share": chain.share_of_process_noise}
    return told, values


def _counts(land: noise.Landscape, away: float) -> dict[str, int]:
    found = noise.densities_read(land, away)
    return {name: len(noise.hills(values)) for name, values in found.items()}


def _published_start(series: TimeSeries, tops: Sequence[Estimate]) -> str:
    """Where a descent over the variances ends that begins at A = 0 and variances of 0.1: the dissertation's start."""
    end = fit(model(NONLINEAR.start, np.zeros((2, 2))), series, prior=noise.PRIOR).log_posterior
    near = [k for k, top in enumerate(tops) if abs(top.log_posterior - end) < _SAME]
    return "elsewhere" if not near else "highest" if near[0] == 0 else "lesser"


def judged(cell: Cell, draws: np.ndarray, values: dict[str, np.ndarray]) -> dict[str, float]:
    """Mean squared errors of every method while readings last and after, and the share of true states in the bands."""
    true = NONLINEAR.states(cell.times(HORIZON))
    steps = len(true) - 1
    paths = {name: pushed(A, NONLINEAR.start, steps) for name, A in values.items()}
    drawn = pushed(draws, NONLINEAR.start, steps)
    low, middle, high = np.quantile(drawn, [0.025, 0.5, 0.975], axis=0)
    paths |= {"bayes": drawn.mean(axis=0), "median": middle}
    inside = ((low <= true) & (true <= high))[1:]
    found = {"coverage": float(inside[: cell.n].mean()), "forecast_coverage": float(inside[cell.n :].mean())}
    for name in METHODS:
        if name in paths:
            found[f"mse_{name}"] = squared_error(paths[name][: cell.n + 1], true[: cell.n + 1])
            found[f"forecast_mse_{name}"] = squared_error(paths[name][cell.n :], true[cell.n :])
    return found


def experiment(run: Run) -> None:
    """Every data set of every cell, the metrics, the tables and the figures."""
    datasets, one = QUICK if run.quick else FULL, partial(numbered, run.seed, run.quick)
    results = each_block(run, list(CELLS), datasets, BLOCK[run.quick], settings(run.quick), one)
    found = metrics(results)
    run.write(found)
    _draw(run, results)
    report(found, run.quick)


def _draw(run: Run, results: dict[Cell, list[dict[str, Any]]]) -> None:
    """The first data set of each cell: its landscape with its draws, and its motions; and the spread over all."""
    shown = []
    for cell in CELLS:
        kept = {name: np.array(value) for name, value in results[cell][0]["shown"].items()}
        shown.append(Shown(NONLINEAR, cell, np.asarray(recording(NONLINEAR, cell, run.seed, 0).readings), **kept))
    lands = [noise.landscape(recording(NONLINEAR, one.cell, run.seed, 0), NONLINEAR.start, one.map) for one in shown]
    run.save(landscapes(shown, lands), "noises.png")
    run.save(states(shown), "trajectories.png")
    run.save(spreads(results), "spreads.png")


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    command("nonlinear_pendulum", "Section 3.3.2: a nonlinear pendulum by a linear model.", experiment, arguments, True)


if __name__ == "__main__":
    # Under its own name, by which the workers of a cluster find it.
    importlib.import_module("experiments.nonlinear_pendulum").main()
