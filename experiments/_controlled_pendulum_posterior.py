"""The posterior of (3.21) for one data set, by three samplers, and in the coordinates of section 2.3.3.1 (Fig. 2.2).

Under flat priors the coordinates of the state are free and the mass is infinite. Holding B and H at the MAP, as the
dissertation does, does not end that: I + a v w' with H v = 0 and w' B = 0 changes A and x0 alone, for any a, and
without process noise no reading. The samplers are therefore compared in the observable form, H = [1, 0] and
A = [[0, 1], row], which every observable system of two states has exactly once; `row` is (-det A, trace A). The printed
coordinates are sampled too, to be looked at.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from symplearn._dram import DRAM, blocks_of
from symplearn._fit import Estimate, fit
from symplearn._importance import AdaptiveImportance
from symplearn._model import AbstractAffine, Gaussian, LinearDynamics, LinearObservation, StateSpaceModel
from symplearn._noise import AdditiveGaussian, Diagonal, ScaledIdentity
from symplearn._objectives import TimeSeries
from symplearn._parameters import Frozen, Learnt, Positive
from symplearn._posterior import Posterior
from symplearn._prior import Flat, Prior
from symplearn._sample import sample
from symplearn._sampler import AbstractSampler

from ._controlled_pendulum_case import DataSets, Systems, impulse_response, outputs
from ._controlled_pendulum_estimates import MEASUREMENT, ORDER, PRIOR, PROCESS, series_of, starting_model

ONE_BLOCK, GIBBS, IMPORTANCE, PRINTED = "DRAM, one block", "DRAM within Gibbs", "importance sampling", "B and H held"
SAMPLERS = (ONE_BLOCK, GIBBS, IMPORTANCE, PRINTED)
GROUPS = ("initial", "dynamics", ("process_noise", "measurement_noise"))
# What is simulated, and how many draws are kept for the figure.
DRAWS, POINTS = 100, 1000
PROPER = Prior({"dynamics": Flat(), "initial": Flat(), "process_noise": PROCESS, "measurement_noise": MEASUREMENT})
# Sweeps of the chains; the dissertation took 1e6 in blocks and 1e7 without.
SWEEPS = {True: 4000, False: 8000}


class ObservableForm(AbstractAffine):
    """x' = [[0, 1], row] x + B u, of a single input."""

    row: Array
    B: Array

    def slope(self, x: Array) -> Array:
        return jnp.stack([jnp.array([0.0, 1.0]), self.row])

    def __call__(self, x: Array, interval: Any = None) -> Array:
        return self.slope(x) @ x + self.B @ interval.input


def sampler_names(quick: bool) -> str:
    """What the posterior's file hangs on."""
    return f"{', '.join(SAMPLERS)}, {SWEEPS[quick]} sweeps, observable form"


def maximum(series: TimeSeries) -> StateSpaceModel:
    """The MAP of (3.21) from the shortest lag's start."""
    return fit(starting_model(series, 8), series, prior=PRIOR).model


def observable(best: StateSpaceModel, series: TimeSeries) -> Estimate:
    """The MAP in the observable form, found again there: what was free in its coordinates no longer is."""
    A, B, H = _matrices(best)
    to = np.concatenate([H, H @ A])
    dynamics = ObservableForm(jnp.asarray((to @ A @ np.linalg.inv(to))[1]), jnp.asarray(to @ B))
    return _found(dynamics, np.array([[1.0, 0.0]]), to @ _start(best), best, series)


def printed(best: StateSpaceModel, series: TimeSeries) -> Estimate:
    """The same with A free and B and H held, in the coordinates of the observable form."""
    A, B, H = _matrices(best)
    to = np.concatenate([H, H @ A])
    dynamics = LinearDynamics(jnp.asarray(to @ A @ np.linalg.inv(to)), Frozen(jnp.asarray(to @ B)))
    return _found(dynamics, np.array([[1.0, 0.0]]), to @ _start(best), best, series)


def _matrices(model: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.asarray(model.dynamics.A), np.asarray(model.dynamics.B), np.asarray(model.observation.matrix)


def _start(model: Any) -> np.ndarray:
    return np.asarray(model.initial.mean.free)


def _found(dynamics: Any, H: np.ndarray, x0: np.ndarray, best: Any, series: TimeSeries) -> Estimate:
    measurement = jnp.exp(best.measurement_noise.structure.variance.log_variance.free)
    model = StateSpaceModel(
        dynamics,
        LinearObservation(Frozen(jnp.asarray(H))),
        # Within the prior: log variances have a maximum even where the readings see no process noise.
        AdditiveGaussian(Diagonal(Positive(jnp.full(ORDER, 1e-4)))),
        AdditiveGaussian(ScaledIdentity(Positive(measurement), 1)),
        Gaussian(Learnt(x0), jnp.zeros((ORDER, ORDER))),
    )
    return fit(model, series, prior=PROPER)


def drawn(data: DataSets, shown: int, seed: int, quick: bool) -> dict[str, Any]:
    """Everything that is kept of the posterior of data set `shown`."""
    series, sweeps = series_of(data, shown), SWEEPS[quick]
    best = maximum(series)
    proper, held = observable(best, series), printed(best, series)
    every: dict[str, tuple[Estimate, AbstractSampler]] = {
        ONE_BLOCK: (proper, DRAM(steps=sweeps, thin=sweeps // 1000)),
        GIBBS: (proper, DRAM(blocks_of(proper.model, *GROUPS), steps=sweeps, thin=sweeps // 1000)),
        IMPORTANCE: (proper, AdaptiveImportance()),
        PRINTED: (held, DRAM(blocks_of(held.model, *GROUPS), steps=sweeps, thin=sweeps // 1000)),
    }
    posteriors = {
        name: sample(estimate, sampler=sampler, key=jax.random.key(1000 * seed + number))
        for number, (name, (estimate, sampler)) in enumerate(every.items())
    }
    told = {name: _summary(posterior) for name, posterior in posteriors.items()}
    means = np.array([told[name]["mean"] for name in (ONE_BLOCK, GIBBS, IMPORTANCE)])
    return {
        "data_set": shown,
        "samplers": told,
        "points": {name: _evenly(invariants(posterior)) for name, posterior in posteriors.items()},
        "A": _evenly(matrices_of(posteriors[PRINTED]).reshape(-1, ORDER * ORDER)),
        "largest_difference_of_means_in_sd": float(np.max(np.ptp(means, axis=0) / np.array(told[GIBBS]["sd"]))),
    } | _predicted(posteriors[GIBBS], data, shown)


def matrices_of(posterior: Posterior, count: int | None = None) -> np.ndarray:
    """A (draw, 2, 2) of all draws, or of some."""
    models = posterior.models(count)
    if isinstance(models.dynamics, ObservableForm):
        row = np.asarray(models.dynamics.row)
        return np.stack([np.broadcast_to([0.0, 1.0], row.shape), row], axis=1)
    return np.asarray(models.dynamics.A)


def invariants(posterior: Posterior) -> np.ndarray:
    """det A and trace A (draw, 2), which no coordinates change."""
    A = matrices_of(posterior)
    return np.stack([np.linalg.det(A), np.trace(A, axis1=1, axis2=2)], axis=1)


def _evenly(rows: np.ndarray) -> list[Any]:
    return rows[np.linspace(0, len(rows) - 1, min(POINTS, len(rows))).astype(int)].tolist()


def _summary(posterior: Posterior) -> dict[str, Any]:
    """Whether the draws are to be trusted, and what they say of det A and trace A."""
    found = invariants(posterior)
    return {
        "least_ess": float(np.nan_to_num(posterior.diagnostics.least_ess)),
        "largest_r_hat": float(np.nan_to_num(posterior.diagnostics.worst_r_hat, nan=1e3)),
        "converged": bool(posterior.converged),
        "evaluations": int(posterior.drawn.evaluations),
        "mean": found.mean(axis=0).tolist(),
        "sd": found.std(axis=0).tolist(),
    }


def _predicted(posterior: Posterior, data: DataSets, shown: int) -> dict[str, Any]:
    """Draws simulated without noise over all 40 s, their mean's error there, and their impulse responses."""
    models = posterior.models(DRAWS)
    B, x0 = np.asarray(models.dynamics.B)[:, :, 0], np.asarray(models.initial.mean)
    H = np.asarray(models.observation.matrix)[:, 0]
    systems = Systems(matrices_of(posterior, DRAWS), B, H, np.zeros(len(B)), x0)
    paths = outputs(systems, np.broadcast_to(data.inputs[shown], (len(B), data.inputs.shape[1])))
    mean, truth = paths.mean(axis=0), data.truth[shown]
    low, high = np.quantile(paths, [0.025, 0.975], axis=0)
    return {
        "posterior_mean_error": float(np.mean((mean - truth)[1:] ** 2)),
        "median_error_of_a_draw": float(np.median(np.mean((paths - truth)[:, 1:] ** 2, axis=1))),
        "coverage_of_95_percent": float(np.mean(((low <= truth) & (truth <= high))[1:])),
        "mean_path": mean.tolist(),
        "band": [low.tolist(), high.tolist()],
        "responses": impulse_response(systems, 50).tolist(),
    }
