"""Estimates for the data sets of one cell of `controlled_pendulum`: LS + ERA with both Hankel matrices, and the MAP.

The maximum a posteriori of (3.21) is the best of several descents. They start where the readings alone say: ERA on
Markov parameters of several lags, noise variances by a coarse search (`realised_model`).
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from symplearn._descent import put, stacked, start
from symplearn._markov_estimators import least_squares_markov
from symplearn._model import Gaussian, LinearDynamics, LinearObservation, StateSpaceModel
from symplearn._noise import AdditiveGaussian, Diagonal, LogVariance, ScaledIdentity
from symplearn._objectives import TimeSeries
from symplearn._parameters import Learnt
from symplearn._prior import Flat, HalfNormal, LogDensity, Prior
from symplearn._realisation import AbstractHankel, CorrectedHankel, PrintedHankel, realise, realised_model

from ._controlled_pendulum_case import DataSets, Systems
from ._descents import Descents, best_of

LAG, ORDER = 18, 2
HANKELS: dict[str, AbstractHankel] = {"ls_era_printed": PrintedHankel(9, 8), "ls_era_corrected": CorrectedHankel(9, 8)}
# Lags of the LS + ERA that descents start from.
LAGS = (18, 12, 8)
PROCESS, MEASUREMENT = HalfNormal(1e-6), HalfNormal(1.0)
# Densities of the variances, as printed, though their logarithms learn: without the Jacobian the maximum is the
# dissertation's.
PRIOR = Prior(
    {
        "dynamics": Flat(),
        "observation": Flat(),
        "initial": Flat(),
        "process_noise": LogDensity(lambda log: PROCESS.log_density(jnp.exp(log))),
        "measurement_noise": LogDensity(lambda log: MEASUREMENT.log_density(jnp.exp(log))),
    }
)
# Of each start, and of the best one after.
FIRST, LAST = Descents(PRIOR, rounds=4, width=50), Descents(PRIOR, rounds=12, width=50)


def series_of(data: DataSets, k: int) -> TimeSeries:
    """The training rows of data set k."""
    rows = slice(0, data.trained + 1)
    return TimeSeries(data.times[rows], data.readings[k, rows, None], data.inputs[k, rows, None])


def ls_era(data: DataSets) -> dict[str, Systems]:
    """LS + ERA of every data set, with each Hankel matrix."""
    found: dict[str, list[Any]] = {name: [] for name in HANKELS}
    for k in range(len(data.inputs)):
        parameters = least_squares_markov(series_of(data, k), LAG)
        for name, hankel in HANKELS.items():
            one = realise(parameters, ORDER, hankel)
            found[name].append((one.dynamics.A, one.dynamics.B, one.observation.matrix, one.observation.feedthrough))
    return {name: _systems(rows) for name, rows in found.items()}


def _systems(rows: list[Any]) -> Systems:
    A, B, H, D = (np.array([np.asarray(row[i]) for row in rows]) for i in range(4))
    return Systems(A, B[:, :, 0], H[:, 0], D[:, 0, 0], np.zeros((len(A), ORDER)))


def starting_model(series: TimeSeries, lag: int) -> StateSpaceModel:
    """(3.21) where LS + ERA with this lag and the coarse search of noise variances put it, from rest."""
    found = realised_model(series, lag, ORDER)
    process, measurement = (
        one.structure.variance.log_variance.free for one in (found.process_noise, found.measurement_noise)
    )
    return StateSpaceModel(
        LinearDynamics(found.dynamics.A, found.dynamics.B),
        LinearObservation(found.observation.matrix),
        AdditiveGaussian(Diagonal(LogVariance(Learnt(jnp.full(ORDER, process))))),
        AdditiveGaussian(ScaledIdentity(LogVariance(Learnt(measurement)), 1)),
        Gaussian(Learnt(jnp.zeros(ORDER)), jnp.zeros((ORDER, ORDER))),
    )


class Maxima(NamedTuple):
    """The most probable (3.21) of each data set: `systems`, `scores` (set,) in nats, and how the descents ended.

    `settled` (set,) says that a quadratic model promises no more; where readings have no noise the
    likelihood has no maximum, and none settles. `won_by` (set,) is the lag of the start.
    """

    systems: Systems
    scores: np.ndarray
    settled: np.ndarray
    won_by: np.ndarray


def maxima(data: DataSets) -> Maxima:
    """The best of a descent from each of LAGS, for every data set; the best one is then taken further."""
    count = len(data.inputs)
    series = stacked([series_of(data, k) for k in range(count)])
    models = [stacked([starting_model(series_of(data, k), lag) for k in range(count)]) for lag in LAGS]
    best, won = best_of([FIRST.run(one, start(one), series) for one in models])
    # The models differ in their free coordinates alone.
    best = LAST.run(models[0], best, series)
    systems = _as_systems(put(models[0], best.free))
    return Maxima(systems, np.asarray(best.score), LAST.settled(best), np.array(LAGS)[won])


def _as_systems(models: Any) -> Systems:
    dynamics, start_mean = models.dynamics, np.asarray(models.initial.mean.free)
    A, B, H = (np.asarray(m) for m in (dynamics.A, dynamics.B[:, :, 0], models.observation.matrix[:, 0]))
    return Systems(A, B, H, np.zeros(len(A)), start_mean)
