"""Whether posteriors are calibrated, measured: ranks of truths that the prior drew, and bands against true motions.

    python -m experiments.calibration [--quick] [--out DIR] [--seed N]

Ranks (simulation-based calibration): a truth is drawn from the prior, a recording from the truth, a posterior from the
recording by `infer`; over many of them the truth's rank among the draws is uniform if nothing between density and
sampler is wrong. Each quantity is tested by chi-square and by the largest deviation of the distribution
function; `sbc_uniform_*` is at 1 % for all quantities of a model together, by Bonferroni's correction. That the test
can see anything is measured too: on draws narrowed to 0.7, 0.8 and 0.9 of their spread, and on a model that is told
half of the noise.

Coverage: over many noise realisations, how often the middle 90 % of the posterior's motions, without process noise,
hold the true motion, which is SciPy's. Each batch of simulations and each repeat leaves a file, and a run that was
stopped goes on where it was.
"""

import importlib
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax

from ._calibration_bands import DRAWS, band, inside, process_noise, told
from ._calibration_figures import coverages, deviations, histograms
from ._calibration_models import STUDIES, WRONG, Study
from ._calibration_ranks import RANKED, batch_of, joined
from ._calibration_results import coverage_metrics, rank_metrics, report, stretches
from ._calibration_systems import system_called
from ._command import Run, command
from ._realisations import kept, realisations

BATCH = 50
# Simulations of each model, quick and full.
SIMULATIONS = {True: 50, False: 300}
# Repeats on each system, quick and full; fewer of the slow ones. A quick run leaves out Cherry's problem and what tells
# why a band is too wide.
REPEATS = {
    "henon_heiles": (2, 100),
    "henon_heiles_order4": (0, 20),
    "henon_heiles_order4_log": (0, 20),
    "cherry": (0, 100),
    "cherry_log": (0, 100),
    "cherry_none": (0, 100),
    "pendulum_flat": (10, 100),
    "pendulum_laplace_0.1": (0, 100),
    "pendulum_flat_log": (10, 100),
    "pendulum_flat_none": (0, 100),
    "double_well": (5, 100),
    "double_well_log": (0, 100),
    "double_well_log_learnt_start": (0, 100),
    "double_well_none_learnt_start": (0, 100),
}


def study_settings(study: Study) -> str:
    """What a batch's ranks hang on besides its seed; a file of other settings is made anew."""
    return told(study.prior, study.samplers, dict(study.begin), RANKED)


def batch(run: Run, name: str, study: Study, k: int) -> dict[str, Any]:
    """One batch of simulations, from its file if there is one."""
    numbers = range(k * BATCH, (k + 1) * BATCH)
    return kept(run, f"sbc_{name}", k, study_settings(study), lambda: batch_of(study, name, run.seed, numbers))


def batch_called(run: Run, name: str, k: int) -> dict[str, Any]:
    """One batch of the study of this name: the name alone is sent to a worker."""
    return batch(run, name, (STUDIES | WRONG)[name], k)


def all_ranks(run: Run) -> dict[str, dict[str, Any]]:
    """The simulations of every model, those of the wrong one among them."""
    studies = STUDIES | WRONG
    todo = [(name, k) for k in range(SIMULATIONS[run.quick] // BATCH) for name in studies]
    batches: dict[str, list[dict[str, Any]]] = {name: [] for name in studies}
    made = realisations(run, [partial(batch_called, name=name, k=k) for name, k in todo])
    for (name, _), found in zip(run.each("batches", todo), made, strict=True):
        batches[name].append(found)
    return {name: joined(each) for name, each in batches.items()}


def repeated(run: Run, name: str, k: int) -> dict[str, Any]:
    """One repeat on one system: where its bands hold the truth, and how wide they are."""
    system = system_called(name)
    posterior, paths = system.predicted(run.seed, k, jax.random.fold_in(jax.random.key(run.seed), k))
    found: dict[str, Any] = {
        "converged": posterior.converged,
        "process_noise": process_noise(posterior),
        "inside": {},
        "widths": {},
    }
    for way, each in paths.items():
        (low, high), rows = band(each), inside(each, system.truth()).T
        found["inside"][way] = ["".join("01"[int(one)] for one in channel) for channel in rows]
        found["widths"][way] = {key: float((high - low)[part].mean()) for key, part in stretches(system).items()}
    return found


def repeat_settings(name: str) -> str:
    """What a repeat's bands hang on besides its seed."""
    return f"{DRAWS} draws, {system_called(name).settings}"


def repeat(run: Run, name: str, k: int) -> dict[str, Any]:
    """One repeat, from its file if there is one."""
    return kept(run, f"coverage_{name}", k, repeat_settings(name), lambda: repeated(run, name, k))


def all_repeats(run: Run) -> dict[str, list[dict[str, Any]]]:
    """The repeats of every system that has some."""
    counts = {name: each[0 if run.quick else 1] for name, each in REPEATS.items()}
    counts = {name: count for name, count in counts.items() if count}
    todo = [(name, k) for k in range(max(counts.values())) for name in counts if k < counts[name]]
    repeats: dict[str, list[dict[str, Any]]] = {name: [] for name in counts}
    made = realisations(run, [partial(repeat, name=name, k=k) for name, k in todo])
    for (name, _), found in zip(run.each("repeats", todo), made, strict=True):
        repeats[name].append(found)
    return repeats


def experiment(run: Run) -> None:
    """Ranks, coverage, the metrics, the tables and the figures."""
    studies, repeats = all_ranks(run), all_repeats(run)
    found = rank_metrics(studies) | coverage_metrics(repeats)
    run.write(found)
    draw(run, studies, repeats)
    report(found, run.quick)


def draw(run: Run, studies: dict[str, dict[str, Any]], repeats: dict[str, list[dict[str, Any]]]) -> None:
    """The figures."""
    run.save(histograms(studies), "ranks.png")
    run.save(deviations(studies), "rank_deviations.png")
    run.save(coverages(repeats), "coverage.png")


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    about = "Calibration: simulation-based, and coverage of true motions."
    command("calibration", about, experiment, arguments, sweep=True)


if __name__ == "__main__":
    # Under its own name, by which the workers of a cluster find it.
    importlib.import_module("experiments.calibration").main()
