"""Which sampler for which posterior, by measurement: the dissertation's four posteriors, every sampler, one run.

    python -m experiments.samplers [--quick] [--out DIR] [--seed N] [--scheduler ADDRESS]

The posteriors are those of the linear pendulum (specification 5.3), of a linear model of the nonlinear pendulum (5.4),
of Henon-Heiles (5.15) and of Cherry's problem (5.16, one recording). `learn` finds each maximum; `compare_samplers`
then draws twice by every sampler, once to compile and once on the processor's clock, and chooses, among those whose
draws can be trusted, the most effective draws a second. Keys are MEASURE_POSTERIOR_SAMPLER, of the second draw: `ess`,
`seconds`, `ess_per_second`, `ess_per_1000_evaluations` (a gradient counts as two evaluations more), `trusted`, and
`off_by`, how far the means are from those of all that are trusted, in standard deviations. A quick run leaves out the
slow samplers, and says so.

A file is left for each posterior, and a run that was stopped goes on where it was. With `--scheduler` the seconds are
those of the worker's machine, one for each posterior.
"""

import importlib
from collections.abc import Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import numpy as np
from matplotlib.figure import Figure

from symplearn._compare_samplers import Comparison, compare_samplers
from symplearn._dram import DRAM
from symplearn._importance import AdaptiveImportance
from symplearn._learn import learn
from symplearn._mclmc import MCLMC
from symplearn._nuts import NUTS
from symplearn._pathfinder import Pathfinder
from symplearn._random_walk import RandomWalk
from symplearn._sampler import AbstractSampler
from symplearn._tempered_smc import TemperedSMC
from symplearn._variational import VariationalInference

from ._command import Run, command, print_table
from ._noise_zoo import ZOO
from ._realisations import kept, realisations

POSTERIORS = ("linear_pendulum", "nonlinear_pendulum", "henon_heiles", "cherry")
FAST: tuple[AbstractSampler, ...] = (AdaptiveImportance(), RandomWalk(steps=4000))
SLOW: tuple[AbstractSampler, ...] = (
    NUTS(draws=200, warm_up=200),
    MCLMC(draws=400, warm_up=200),
    DRAM(steps=8000),
    TemperedSMC(),
    Pathfinder(),
    VariationalInference(),
)
TOLD = ("ess", "seconds", "with_compiling", "ess_per_second", "ess_per_1000_evaluations", "off_by", "trusted")


def samplers(run: Run) -> tuple[AbstractSampler, ...]:
    """Those that are compared."""
    return FAST if run.quick else FAST + SLOW


def compared(run: Run, name: str) -> dict[str, Any]:
    """The comparison on one posterior."""
    # The programs of all samplers on all posteriors together would take more memory maps than a process may have.
    jax.clear_caches()
    problem, key = ZOO[name], jax.random.key(run.seed)
    begin = problem.model(problem.process, problem.measurement)
    estimate = learn(begin, problem.recording(run.seed, 0), prior=problem.prior, key=key)
    comparison = compare_samplers(estimate, samplers(run), key=key)
    return {"table": str(comparison), "trials": _trials(comparison), "choice": _choice(comparison)}


def posterior(run: Run, name: str) -> dict[str, Any]:
    """One posterior's comparison, from its file if there is one."""
    words = eqx.tree_pformat(samplers(run), width=1000)
    prior = eqx.tree_pformat(ZOO[name].prior, short_arrays=False, width=1000)
    return kept(run, name, 0, f"{words}, {prior}", partial(compared, run, name))


def _trials(comparison: Comparison) -> dict[str, dict[str, float]]:
    return {
        one.name.split("(")[0]: dict(
            zip(
                TOLD,
                (
                    one.ess,
                    one.seconds,
                    one.first,
                    one.per_second,
                    1000 * one.per_evaluation,
                    one.distance,
                    float(one.posterior.converged),
                ),
                strict=True,
            )
        )
        for one in comparison.trials
    }


def _choice(comparison: Comparison) -> str | None:
    return None if comparison.best is None else comparison.best.name.split("(")[0]


def metrics(results: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """One number for each measure, posterior and sampler, and what was chosen for each posterior."""
    found: dict[str, Any] = {}
    for name, one in results.items():
        found[f"choice_{name}"] = one["choice"]
        for sampler, told in one["trials"].items():
            found |= {f"{measure}_{name}_{sampler}": told[measure] for measure in TOLD}
    return found


def figure(results: dict[str, dict[str, Any]]) -> Figure:
    """Effective draws a second of each sampler on each posterior; hollow where the draws cannot be trusted."""
    drawn = Figure(figsize=(8.0, 4.5), layout="constrained")
    ax = drawn.subplots()
    known = list(dict.fromkeys(sampler for one in results.values() for sampler in one["trials"]))
    for k, sampler in enumerate(known):
        for at, one in enumerate(results.values()):
            told = one["trials"].get(sampler)
            if told is not None and told["ess_per_second"] > 0:
                face = f"C{k}" if told["trusted"] else "none"
                ax.scatter(at + 0.08 * (k - len(known) / 2), told["ess_per_second"], ec=f"C{k}", fc=face, s=50)
        ax.scatter([], [], color=f"C{k}", label=sampler)
    ax.set_xticks(np.arange(len(results)), [name.replace("_", " ") for name in results])
    ax.set(yscale="log", ylabel="effective draws per CPU second", title="hollow: the draws cannot be trusted")
    ax.legend(fontsize=8, bbox_to_anchor=(1.0, 1.0), loc="upper left")
    return drawn


def report(results: dict[str, dict[str, Any]], quick: bool) -> None:
    """The tables, and a choice for each posterior with its reason."""
    for name, one in results.items():
        print(f"{name}:\n{one['table']}\n")
    print_table(["posterior", "choice"], *([name, one["choice"] or "none"] for name, one in results.items()))
    if quick:
        print("quick: the samplers that take minutes are left out: " + ", ".join(type(one).__name__ for one in SLOW))


def experiment(run: Run) -> None:
    """Every posterior, the metrics, the figure and the tables."""
    # One at a time, for each is timed.
    made = realisations(run, [partial(posterior, name=name) for name in POSTERIORS], threads=1)
    results = dict(zip(run.each("posteriors", POSTERIORS), made, strict=True))
    run.write(metrics(results))
    run.save(figure(results), "samplers.png")
    report(results, run.quick)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    command("samplers", "Every sampler on the dissertation's four posteriors.", experiment, arguments, sweep=True)


if __name__ == "__main__":
    # Under its own name, by which the workers of a cluster find it.
    importlib.import_module("experiments.samplers").main()
