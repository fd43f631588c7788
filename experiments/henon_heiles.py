"""Section 5.4.1: Henon-Heiles learnt with leapfrog, with Runge-Kutta's method of its order, and with one of order 4.

    python -m experiments.henon_heiles [--quick] [--out DIR] [--seed N]

Twenty readings of the full state in 100 s, noise 0.05, start known (specification 5.15, E41); nine coefficients and two
variances learn in steps of 0.25, those of order 4 in 1.25, by `learn`, from zero coefficients, and `sample` draws the
posterior. Every learnt potential predicts 200 s by leapfrog in steps of 0.01. The truth is DOP853's, not an integrator
of ours. Each noise realisation leaves a file, and a run that was stopped goes on where it was.

`H_*` and `tracking_time_*` are of the MAP estimate, as in the dissertation. Beyond it: `stepped_as_learnt` keeps the
propagator and the steps of the learning, `posterior_mean` takes the mean of the coefficients, `predictive_median` the
median of the draws' predictions, and `expected` is how long a draw stays with the MAP in the median: what the posterior
itself expects of the MAP.
"""

import importlib
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from symplearn._fit import Estimate
from symplearn._importance import AdaptiveImportance
from symplearn._learn import learn
from symplearn._posterior import Posterior
from symplearn._sample import sample

from ._command import Run, command
from ._henon_heiles_case import (
    ENERGY,
    HORIZON,
    PRIOR,
    PROPAGATORS,
    READ_UNTIL,
    amplitude,
    energies_at_start,
    model,
    predictions,
    recording,
    shown_times,
    stepped_as_learnt,
    tracking_time,
    truth,
)
from ._henon_heiles_figures import View, hamiltonians, phases, spreads, trajectories, variances
from ._henon_heiles_results import PUBLISHED, metrics, report
from ._realisations import kept, realisations

DRAWS = 200
QUICK, FULL = 5, 20
SAMPLERS = {True: AdaptiveImportance(draws=1600, target=500, batch=500), False: AdaptiveImportance()}
# A coordinate beyond this, some sixteen amplitudes, has escaped, and is taken to stay there.
ESCAPED = 10.0


def learnt(propagator: str, series: Any, sampler: AdaptiveImportance, key: PRNGKeyArray) -> dict[str, Any]:
    """Everything that is kept of one realisation under one propagator."""
    estimate = learn(model(propagator), series, prior=PRIOR)
    posterior = sample(estimate, sampler=sampler, key=key)
    values = estimate.values()
    best = np.asarray(values["dynamics.system.coefficients"])
    found = {
        "process_noise": float(values["process_noise.structure.variance"]),
        "measurement_noise": float(values["measurement_noise.structure.variance"]),
        "log_posterior": estimate.log_posterior,
        "converged": estimate.converged,
        "won_by": " ".join(estimate.attempts[0][:2]),
        "starts_within_half_a_nat": _near(estimate),
        "starts": len(estimate.attempts),
    }
    return found | _noises(posterior) | judged(propagator, best, *_coefficients(posterior))


def _near(estimate: Estimate) -> int:
    best = estimate.log_posterior
    return sum(one.log_posterior is not None and best - one.log_posterior < 0.5 for one in estimate.attempts)


def _noises(posterior: Posterior) -> dict[str, Any]:
    process = np.ravel(posterior.values["process_noise.structure.variance"])
    measurement = np.ravel(posterior.values["measurement_noise.structure.variance"])
    return {
        "process_noise_draws": process[:: max(1, len(process) // 1000)].tolist(),
        "process_noise_median": float(np.median(process)),
        "measurement_noise_median": float(np.median(measurement)),
        "posterior_converged": posterior.converged,
        "pareto_k": posterior.drawn.pareto_k,
    }


def _coefficients(posterior: Posterior) -> tuple[np.ndarray, np.ndarray]:
    """Their posterior mean, and evenly spaced draws of them."""
    every = np.asarray(posterior.values["dynamics.system.coefficients"])
    every = every.reshape(-1, every.shape[-1])
    return every.mean(axis=0), every[np.arange(DRAWS) * len(every) // DRAWS]


def judged(propagator: str, best: np.ndarray, mean: np.ndarray, drawn: np.ndarray) -> dict[str, Any]:
    """Energies, tracking times and bands of the MAP, of the posterior mean and of the draws."""
    times, rows = shown_times(), np.concatenate([[best, mean], drawn])
    true, size, energies = truth(times), amplitude(), energies_at_start(rows)
    paths = predictions(rows, times)
    escaping = int(np.sum(~np.isfinite(paths[2:]).all(axis=(1, 2))))
    paths = np.clip(np.nan_to_num(paths, nan=ESCAPED), -ESCAPED, ESCAPED)
    of_best, of_mean, of_draws = paths[0], paths[1], paths[2:]
    stepped = stepped_as_learnt(propagator, best)
    steps = np.asarray(stepped.ts)
    return {
        "coefficients": best.tolist(),
        "draws": drawn.tolist(),
        "posterior_mean": mean.tolist(),
        "H": float(energies[0]),
        "H_posterior_mean": float(energies[1]),
        "H_quantiles": np.quantile(energies[2:], [0.025, 0.5, 0.975]).tolist(),
        "tracking_time": tracking_time(of_best, true, times, size),
        "tracking_time_stepped_as_learnt": tracking_time(np.asarray(stepped.xs), truth(steps), steps, size),
        "tracking_time_posterior_mean": tracking_time(of_mean, true, times, size),
        "tracking_time_predictive_median": tracking_time(np.median(of_draws, axis=0), true, times, size),
        "tracking_time_expected": float(np.median([tracking_time(one, of_best, times, size) for one in of_draws])),
        "escaping_draws": escaping,
    } | _bands(of_draws, true, times <= READ_UNTIL)


def _bands(paths: np.ndarray, true: np.ndarray, trained: np.ndarray) -> dict[str, float]:
    """Share of the true states that the bands of 95 % hold, and the bands' mean width."""
    low, high = np.quantile(paths, [0.025, 0.975], axis=0)
    inside, width = (low <= true) & (true <= high), high - low
    return {
        "coverage_trained": float(inside[trained].mean()),
        "coverage_predicted": float(inside[~trained].mean()),
        "band_width_trained": float(width[trained].mean()),
        "band_width_predicted": float(width[~trained].mean()),
    }


def settings(propagator: str, quick: bool) -> str:
    """What a realisation's results hang on besides its seed; a file of other settings is made anew."""
    return f"{PROPAGATORS[propagator]}, {SAMPLERS[quick]}, predicted to {HORIZON:g} s"


def realisation(run: Run, propagator: str, k: int) -> dict[str, Any]:
    """One realisation's results, from its file if there is one."""

    def make() -> dict[str, Any]:
        key = jax.random.fold_in(jax.random.key(run.seed), k)
        return learnt(propagator, recording(run.seed, k), SAMPLERS[run.quick], key)

    return kept(run, propagator, k, settings(propagator, run.quick), make)


def experiment(run: Run) -> None:
    """Every propagator on every realisation, the metrics, the table and the figures."""
    todo = [(k, name) for k in range(QUICK if run.quick else FULL) for name in PROPAGATORS]
    results: dict[str, list[dict[str, Any]]] = {name: [] for name in PROPAGATORS}
    made = realisations(run, [partial(realisation, propagator=name, k=k) for k, name in todo], threads=1)
    for (_, name), one in zip(run.each("realisations", todo), made, strict=True):
        results[name].append(one)
    found = metrics(results)
    run.write(found)
    _draw(run, results)
    report(found, run.quick)


def _draw(run: Run, results: dict[str, list[dict[str, Any]]]) -> None:
    """The dissertation's figures for the first realisation, and the spread over all."""
    times, series = shown_times(), recording(run.seed, 0)
    true, views = truth(times), [_view(name, results[name][0], times) for name in ("symplectic", "rk2")]
    run.save(phases(true, views, series), "phases.png")
    run.save(hamiltonians(times, views, ENERGY, READ_UNTIL), "hamiltonians.png")
    run.save(trajectories(times, true, views, series, READ_UNTIL), "trajectories.png")
    run.save(variances(views), "process_noise.png")
    run.save(spreads(results, ENERGY, PUBLISHED), "spreads.png")


def _view(name: str, one: dict[str, Any], times: np.ndarray) -> View:
    rows = np.array([one["coefficients"], one["posterior_mean"], *one["draws"]])
    paths, energies, stepped = predictions(rows, times), energies_at_start(rows), stepped_as_learnt(name, rows[0])
    shown = np.asarray(stepped.ts) <= READ_UNTIL
    return View(
        name,
        paths[0],
        paths[2:],
        energies[2:],
        np.asarray(stepped.ts)[shown],
        np.asarray(stepped.energies)[shown],
        np.array(one["process_noise_draws"]),
        one["tracking_time"],
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    command("henon_heiles", "Section 5.4.1: leapfrog against Runge-Kutta.", experiment, arguments, sweep=True)


if __name__ == "__main__":
    # Under its own name, by which the workers of a cluster find it.
    importlib.import_module("experiments.henon_heiles").main()
