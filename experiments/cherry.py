"""Section 5.4.2: Cherry's problem learnt with Tao's method, with Runge-Kutta's of its order, and by least squares.

    python -m experiments.cherry [--quick] [--out DIR] [--seed N]

One recording (5.4.2.1): 21 readings in 8 s from a known start, normal noise 0.01, monomials, steps of 0.05. `H_*`,
`e_train_*` (8 s) and `e_test_*` (8 s more), the relative errors (5.24), are of the MAP, predicting by Tao's method in
steps of 0.01. Several recordings (5.4.2.2): five random starts, noise multiplied and uniform but modelled as added
and normal, Legendre polynomials, steps of 0.01. `horizon_*` is how long the relative error (5.24) of all states so far
stays below 10 % from the test start: `bayes` of the mean of 50 draws' predictions, `map`, and `ls` of (5.12)-(5.14).
The truth is DOP853's. 34 coefficients and two variances learn by `learn`, from zero coefficients; of several
recordings in cheap large steps first, from whose MAP `fit` goes on in smaller ones.

Beyond the dissertation: a propagator of order 4, Suzuki's composition of Tao's method, in one step per data interval,
8 and 40 times larger; and the noise of several recordings modelled as it is, multiplied. `horizon_expected` is how long
a draw stays with the MAP in the median: what the posterior itself expects of the MAP's horizon.

Each noise realisation leaves a file, and a run that was stopped goes on where it was.
"""

import importlib
from collections.abc import Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PRNGKeyArray

import integrators as ig
from symplearn._distributions import Uniform
from symplearn._fit import Estimate, fit
from symplearn._hamiltonian_objectives import hamiltonian_least_squares
from symplearn._hamiltonians import AbstractBasis, Polynomial
from symplearn._importance import AdaptiveImportance
from symplearn._learn import learn
from symplearn._model import Propagator
from symplearn._noise import Multiplicative
from symplearn._prior import Prior
from symplearn._sample import sample

from ._cherry_case import (
    HORIZON,
    LEGENDRE,
    MONOMIALS,
    PRIOR,
    RELATIVE_NOISE,
    SideBySide,
    energies,
    errors,
    fine_times,
    horizon,
    model,
    predictions,
    several,
    single,
    truth,
)
from ._cherry_figures import draw
from ._cherry_results import metrics, report
from ._command import Run, command
from ._realisations import kept, realisations

DRAWS = 50
QUICK, FULL = 5, 20
SAMPLERS = {
    True: AdaptiveImportance(draws=2000, target=600, batch=500, rounds=16),
    False: AdaptiveImportance(rounds=40),
}
# One step of order 4 per data interval: an error of 3e-5 in 0.4 s, that of Tao's method in steps of 0.05 is 2e-5.
ORDER4 = (ig.suzuki4(ig.Tao(5.0)), 1)
SINGLE: dict[str, tuple[Any, int]] = {
    "symplectic": (ig.Tao(20.0), 8),
    "rk2": (ig.RK2.midpoint(), 8),
    "order4_step_8_times_larger": ORDER4,
}
# Of several recordings: the propagator of `learn`, and that to which `fit` goes on from there. Tao's method in steps of
# 0.2 is too coarse for the first: its faster oscillator is off by 0.7 %, and so is a Hamiltonian that makes up for it.
SEVERAL: dict[bool, list[tuple[Any, int]]] = {False: [ORDER4, (ig.Tao(20.0), 40)], True: [ORDER4]}
# Under a Laplace prior BFGS stalls at the kinks: the descent that `fit` ends with is made for them.
_BFGS_STEPS = 20
# Nats that a descent may leave; a hundredth moves no digit that is told.
TOLERANCES = {True: 1e-2, False: 1e-5}
# The longest first, so that both threads have work to the end.
KINDS = ("several", "several_multiplicative", *SINGLE)
# Noise as it is; its law is known then, and nothing of it learns.
AS_IT_IS = Multiplicative(Uniform(1 - RELATIVE_NOISE, 1 + RELATIVE_NOISE, dim=4))
PRIOR_AS_IT_IS = Prior({name: one for name, one in PRIOR.densities.items() if name != "measurement_noise"})


def learnt_from_one(
    name: str, series: Any, sampler: AdaptiveImportance | None, tolerance: float, key: PRNGKeyArray
) -> dict[str, Any]:
    """Everything that is kept of one recording under one propagator; draws only where a sampler is given."""
    estimate = learn(model(*SINGLE[name]), series, prior=PRIOR, tolerance=tolerance)
    found = judged(_coefficients(estimate), MONOMIALS) | _of(estimate)
    if sampler is None:
        return found | {"draws": []}
    posterior = sample(estimate, sampler=sampler, key=key)
    return found | {"draws": _drawn(posterior).tolist(), "posterior_converged": posterior.converged}


def learnt_from_several(
    recordings: Any,
    propagators: Sequence[tuple[Any, int]],
    sampler: AdaptiveImportance,
    tolerance: float,
    key: PRNGKeyArray,
) -> dict[str, Any]:
    """Everything that is kept of several recordings: least squares, the MAP of each propagator, draws of the first.

    Its MAP's horizon is no different from the last's, and it asks for an eighth as many gradients of H.
    """
    squares: Any = hamiltonian_least_squares(Polynomial(2, 3, None, LEGENDRE), recordings)
    estimates = [learn(model(*propagators[0], LEGENDRE), recordings, SideBySide(), prior=PRIOR, tolerance=tolerance)]
    for propagator in propagators[1:]:
        begin = estimates[-1].model
        finer = eqx.tree_at(lambda m: m.dynamics, begin, Propagator(begin.dynamics.system, *propagator))
        estimates.append(fit(finer, recordings, SideBySide(), prior=PRIOR, max_steps=_BFGS_STEPS))
    posterior = sample(estimates[0], sampler=sampler, key=key)
    drawn = _drawn(posterior)
    maps = [judged(_coefficients(one), LEGENDRE) | _of(one) for one in estimates]
    return {
        "ls": judged(np.asarray(squares.coefficients), LEGENDRE),
        "order4": maps[0],
        "map": maps[-1],
        "draws": drawn.tolist(),
        "expected": _expected(_coefficients(estimates[0]), drawn),
        "posterior_converged": posterior.converged,
        "pareto_k": posterior.drawn.pareto_k,
    } | _predictive(drawn)


def _predictive(drawn: np.ndarray) -> dict[str, Any]:
    times = fine_times()
    paths, true = predictions(drawn, LEGENDRE, times), truth(times)
    return {"mean": errors(paths.mean(axis=0), true, times), "median": errors(np.median(paths, axis=0), true, times)}


def _expected(best: np.ndarray, drawn: np.ndarray) -> float:
    """How long a draw stays with the MAP, in the median: the horizon that the posterior itself expects of it."""
    times = fine_times()
    of_best, *of_draws = predictions(np.concatenate([best[None], drawn]), LEGENDRE, times)
    return float(np.median([horizon(one, of_best, times) for one in of_draws]))


def _drawn(posterior: Any) -> np.ndarray:
    return np.asarray(posterior.models(DRAWS).dynamics.system.coefficients)


def _coefficients(estimate: Estimate) -> np.ndarray:
    return np.asarray(estimate.values()["dynamics.system.coefficients"])


def _of(estimate: Estimate) -> dict[str, Any]:
    values, best = estimate.values(), estimate.log_posterior
    return {
        **{
            name.split(".")[0]: float(value)
            for name, value in values.items()
            if name.endswith("noise.structure.variance")
        },
        "log_posterior": best,
        "converged": estimate.converged,
        "starts": len(estimate.attempts),
        "starts_within_half_a_nat": sum(
            one.log_posterior is not None and best - one.log_posterior < 0.5 for one in estimate.attempts
        ),
    }


def judged(coefficients: np.ndarray, basis: AbstractBasis) -> dict[str, Any]:
    """The energy of learnt coefficients at the test start, and the errors of their prediction from there."""
    times = fine_times()
    found = errors(predictions(coefficients[None], basis, times)[0], truth(times), times)
    return {"coefficients": coefficients.tolist(), "H": float(energies(coefficients[None], basis)[0])} | found


def learnt(run: Run, kind: str, k: int) -> dict[str, Any]:
    """One realisation's results of one kind."""
    key, sampler = jax.random.fold_in(jax.random.key(run.seed), k), _sampler(kind, k, run.quick)
    if kind == "several_multiplicative":
        begin = model(*ORDER4, LEGENDRE, AS_IT_IS)
        estimate = learn(
            begin, several(run.seed, k), SideBySide(), prior=PRIOR_AS_IT_IS, tolerance=TOLERANCES[run.quick]
        )
        return judged(_coefficients(estimate), LEGENDRE) | _of(estimate)
    if kind == "several":
        assert sampler is not None  # for type checkers
        return learnt_from_several(several(run.seed, k), SEVERAL[run.quick], sampler, TOLERANCES[run.quick], key)
    return learnt_from_one(kind, single(run.seed, k), sampler, TOLERANCES[run.quick], key)


def settings(kind: str, k: int, quick: bool) -> str:
    """What a realisation's results hang on besides its seed; a file of other settings is made anew."""
    propagators = {"several": SEVERAL[quick], "several_multiplicative": (ORDER4, AS_IT_IS)} | SINGLE
    used = (propagators[kind], _sampler(kind, k, quick), TOLERANCES[quick], PRIOR, HORIZON)
    # Arrays are written out, or a file of another prior would pass for this one's.
    return eqx.tree_pformat(used, short_arrays=False, width=1000)


def _sampler(kind: str, k: int, quick: bool) -> AdaptiveImportance | None:
    """Of one recording draws are for the figures of the first realisation alone, and not in a quick run."""
    return SAMPLERS[quick] if kind == "several" or (k == 0 and not quick) else None


def realisation(run: Run, kind: str, k: int) -> dict[str, Any]:
    """One realisation's results, from its file if there is one."""
    return kept(run, kind, k, settings(kind, k, run.quick), lambda: learnt(run, kind, k))


def experiment(run: Run) -> None:
    """Every kind on every realisation, the metrics, the table and the figures."""
    todo = [(k, kind) for k in range(QUICK if run.quick else FULL) for kind in KINDS]
    results: dict[str, list[dict[str, Any]]] = {kind: [] for kind in KINDS}
    made = realisations(run, [partial(realisation, kind=kind, k=k) for k, kind in todo])
    for (_, kind), found in zip(run.each("realisations", todo), made, strict=True):
        results[kind].append(found)
    found = metrics(results)
    run.write(found)
    draw(run, results, found)
    report(found, run.quick)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    about = "Section 5.4.2: Tao's method against Runge-Kutta and least squares."
    command("cherry", about, experiment, arguments, sweep=True)


if __name__ == "__main__":
    # Under its own name, by which the workers of a cluster find it.
    importlib.import_module("experiments.cherry").main()
