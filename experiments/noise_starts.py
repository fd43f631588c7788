"""Noise levels without tuning: `learn` from starts of both noises up to six decades off, on a zoo of problems.

    python -m experiments.noise_starts [--quick] [--out DIR] [--seed N]

For each problem five data sets and for each of them twenty starts (two and two in a quick run), whose process and
measurement variances are independently 10^u times the true ones, u ~ U[-6, 6]; where the truth has no process noise,
times some millionth of the readings' square. What learns of the dynamics starts at zero. `reached_*` is the share of
the starts whose maximum a posteriori is within 0.5 nat of the best known: of all starts on that data set, and of one
from the truth. `reached_straight_*` is the share of one descent from the noises as given. `identifiable_*` is the share
of data sets whose likelihood bounds a variance on both sides: the others cannot tell that noise from none.

A file is left for each data set, and a run that was stopped goes on where it was.
"""

import importlib
from collections.abc import Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import numpy as np
from matplotlib.figure import Figure

from symplearn._fit import Estimate
from symplearn._learn import learn
from symplearn._parameters import resolve
from symplearn._profile_likelihood import profile_likelihood

from ._command import Run, command, print_table
from ._noise_zoo import ZOO, Problem
from ._realisations import kept, realisations, spread

DECADES, NEAR = 6.0, 0.5
SETS, STARTS = {True: 2, False: 5}, {True: 2, False: 20}
# Of the nats that a descent may leave: far below NEAR.
TOLERANCE = 1e-3


def measured(run: Run, name: str, k: int) -> dict[str, Any]:
    """What became of every start on one data set, and the profiles of the best."""
    problem, rng = ZOO[name], np.random.default_rng([run.seed, k, len(name)])
    series, key = problem.recording(run.seed, k), jax.random.fold_in(jax.random.key(run.seed), k)
    offsets = rng.uniform(-DECADES, DECADES, size=(STARTS[run.quick], 2))
    found = []
    for i, (process, measurement) in enumerate(10.0**offsets):
        begin = problem.model(problem.process * process, problem.measurement * measurement)
        found.append(learn(begin, series, prior=problem.prior, key=jax.random.fold_in(key, i), tolerance=TOLERANCE))
    known = [*found, *_from_truth(problem, series, key)]
    best = max(known, key=lambda one: one.log_posterior)
    return {
        "offsets": offsets.tolist(),
        "best": best.log_posterior,
        "below": [best.log_posterior - one.log_posterior for one in found],
        "straight_below": [best.log_posterior - _straight(one) for one in found],
        "noises": [_noises(one) for one in found],
        "best_noises": _noises(best),
        "profiles": {which: _profile(best, which) for which in ("process", "measurement")},
    }


def _from_truth(problem: Problem, series: Any, key: Any) -> list[Estimate]:
    """The estimate from a start at the truth, where there is one."""
    if problem.best is None:
        return []
    begin = problem.model(problem.process, problem.measurement)
    begin = eqx.tree_at(_coefficients, begin, jax.numpy.asarray(problem.best))
    return [learn(begin, series, prior=problem.prior, key=key, tolerance=TOLERANCE)]


def _coefficients(model: Any) -> Any:
    return model.dynamics.system.coefficients


def _straight(estimate: Estimate) -> float:
    """Where one descent from the start as given ended; far below where it was impossible."""
    one = next(one for one in estimate.attempts if one[:2] == ("as given", "straight"))
    return -1e15 if one.log_posterior is None else one.log_posterior


def _variance_label(estimate: Estimate, which: str) -> str:
    return next(name for name in estimate.values() if name.startswith(which))


def _noises(estimate: Estimate) -> list[float]:
    """The process and the measurement variance, as variances whatever they are written in."""
    model = resolve(estimate.model)
    return [float(noise.covariance(None)[0, 0]) for noise in (model.process_noise, model.measurement_noise)]


def _profile(estimate: Estimate, which: str) -> dict[str, Any]:
    found = profile_likelihood(estimate, _variance_label(estimate, which))
    return {
        "lower": found.lower,
        "upper": found.upper,
        "identifiable": found.identifiable,
        "values": found.values.tolist(),
        "drop": np.minimum(found.drop, 1e6).tolist(),
    }


def data_set(run: Run, name: str, k: int) -> dict[str, Any]:
    """One data set's results, from its file if there is one."""
    prior = eqx.tree_pformat(ZOO[name].prior, short_arrays=False, width=1000)
    words = f"{STARTS[run.quick]} starts, {DECADES} decades, tolerance {TOLERANCE}, {prior}"
    return kept(run, name, k, words, partial(measured, run, name, k))


def metrics(results: dict[str, list[dict[str, Any]]]) -> dict[str, Any]:
    """The shares, how far below the best the starts ended, and what the likelihood says of each variance."""
    found: dict[str, Any] = {"decades": DECADES, "near": NEAR, "data_sets": len(results["cherry"])}
    for name, sets in results.items():
        for way, key in (("", "below"), ("straight_", "straight_below")):
            below = np.concatenate([one[key] for one in sets])
            found[f"reached_{way}{name}"] = float(np.mean(below < NEAR))
            found[f"below_{way}{name}"] = spread(np.minimum(below, 1e6))
        found[f"starts_{name}"] = sum(len(one["below"]) for one in sets)
        for i, which in enumerate(("process", "measurement")):
            profiles = [one["profiles"][which] for one in sets]
            found[f"identifiable_{which}_{name}"] = float(np.mean([one["identifiable"] for one in profiles]))
            found[f"variance_{which}_{name}"] = spread([one["best_noises"][i] for one in sets])
            found[f"profile_{which}_{name}"] = [[one["lower"], one["upper"]] for one in profiles]
    return found


def figure(results: dict[str, list[dict[str, Any]]]) -> Figure:
    """Every start by its offsets in decades, and whether it ended at the best known: above straight, below `learn`."""
    drawn = Figure(figsize=(2.6 * len(results), 5.6), layout="constrained")
    axes = drawn.subplots(2, len(results), sharex=True, sharey=True, squeeze=False)
    for column, (name, sets) in enumerate(results.items()):
        offsets = np.concatenate([one["offsets"] for one in sets])
        for row, key in enumerate(("straight_below", "below")):
            near = np.concatenate([one[key] for one in sets]) < NEAR
            ax = axes[row, column]
            ax.scatter(*offsets[near].T, s=14, color="tab:blue", label="at the best optimum")
            ax.scatter(*offsets[~near].T, s=18, color="tab:red", marker="x", label="elsewhere")
            ax.set_title(f"{name}\n{('one descent', 'learn')[row]}: {near.mean():.0%}", fontsize=9)
    axes[0, 0].legend(fontsize=7)
    drawn.supxlabel("start of the process variance over the truth, decades")
    drawn.supylabel("start of the measurement variance, decades")
    return drawn


def report(found: dict[str, Any], quick: bool) -> None:
    """The table, and which noise a recording cannot tell."""
    rows: list[Sequence[Any]] = [["problem", "starts", "learn", "one descent", "Sigma", "Gamma"]]
    for name in ZOO:
        told = [f"bounded in {found[f'identifiable_{which}_{name}']:.0%}" for which in ("process", "measurement")]
        shares = [f"{found[f'reached_{way}{name}']:.0%}" for way in ("", "straight_")]
        rows.append([name, found[f"starts_{name}"], *shares, *told])
    print_table(*rows)
    print(f"share of starts, up to {DECADES:g} decades off, that end within {NEAR:g} nat of the best optimum known;")
    print("Sigma, Gamma: share of data sets whose likelihood bounds that variance on both sides")
    if quick:
        print("quick: fewer data sets and starts")


def experiment(run: Run) -> None:
    """Every problem on every data set, the metrics, the figure and the table."""
    results: dict[str, list[dict[str, Any]]] = {name: [] for name in ZOO}
    # The longest first.
    todo = [(k, name) for k in range(SETS[run.quick]) for name in reversed(ZOO)]
    made = realisations(run, [partial(data_set, name=name, k=k) for k, name in todo])
    for (_, name), one in zip(run.each("data sets", todo), made, strict=True):
        results[name].append(one)
    found = metrics(results)
    run.write(found)
    run.save(figure(results), "noise_starts.png")
    report(found, run.quick)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    command("noise_starts", "Noise levels found from starts six decades off.", experiment, arguments, sweep=True)


if __name__ == "__main__":
    # Under its own name, by which the workers of a cluster find it.
    importlib.import_module("experiments.noise_starts").main()
