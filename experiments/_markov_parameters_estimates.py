"""Estimates of Markov parameters for many recordings: LS, GLS with the true weights, and the MAP of a linear model.

A, B, H, D and x_0 learn under flat priors, with one variance for each noise. Descents start where the readings say: at
ERA on the least-squares parameters, at ERA on the parameters of an autoregression with inputs (observer and Kalman
filter identification, Juang et al. 1993), and at the MAP of fewer readings; the best objective is taken.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from symplearn._descent import Place, put, stacked, start
from symplearn._markov_estimators import generalised_least_squares_markov, least_squares_markov
from symplearn._markov_parameters import MarkovParameters, impulse_response
from symplearn._model import Gaussian, LinearDynamics, LinearObservation, StateSpaceModel
from symplearn._noise import AdditiveGaussian, LogVariance, ScaledIdentity
from symplearn._objectives import TimeSeries
from symplearn._parameters import Learnt
from symplearn._prior import Flat, HalfNormal, LogDensity, Prior
from symplearn._realisation import realise

from ._descents import Descents, best_of
from ._markov_parameters_case import LAG, Case

# Readings and inputs of the past that the autoregression has.
PAST = 4
DEVIATION = HalfNormal(1.0)
# Densities of the standard deviations, as printed, though their logarithms learn: no Jacobian.
_NOISE = LogDensity(lambda log: DEVIATION.log_density(jnp.exp(0.5 * log)))
PRIOR = Prior(
    {
        "dynamics": Flat(),
        "observation": Flat(),
        "initial": Flat(),
        "process_noise": _NOISE,
        "measurement_noise": _NOISE,
    }
)
FIRST = Descents(PRIOR, rounds=1, width=10, tolerance=1e-4)
LAST = Descents(PRIOR, rounds=8, width=10, tolerance=1e-4)


def series_of(given: Case, first: int = 0) -> TimeSeries:
    """The recording from row `first` on."""
    times = np.arange(float(len(given.readings) - first))
    return TimeSeries(times, given.readings[first:], given.inputs[first:])


def ls(given: Case) -> np.ndarray:
    """(3.13)."""
    return np.asarray(least_squares_markov(series_of(given), LAG).blocks)


def gls(given: Case) -> np.ndarray:
    """(3.15) with the weights of the true system."""
    states = len(given.B)
    variances = given.noise**2
    model = StateSpaceModel(
        LinearDynamics(jnp.eye(states), jnp.asarray(given.B)),
        LinearObservation(jnp.asarray(given.H), jnp.asarray(given.D)),
        AdditiveGaussian(ScaledIdentity(variances, states)),
        AdditiveGaussian(ScaledIdentity(variances, len(given.D))),
        Gaussian(jnp.zeros(states), jnp.zeros((states, states))),
    )
    return np.asarray(generalised_least_squares_markov(series_of(given), LAG, model).blocks)


def autoregression(given: Case) -> tuple[np.ndarray, float]:
    """Markov parameters (lag, channel, input) of y_k = sum a_i y_{k-i} + sum b_i u_{k-i}, and the residual's variance.

    Feeding readings back makes the past short even where A forgets nothing.
    """
    ys, us = given.readings[LAG - 1 :], given.inputs[LAG - 1 :]
    past = [np.concatenate([ys[PAST - i : -i], us[PAST - i : -i]], axis=1) for i in range(1, PAST + 1)]
    design = np.concatenate([us[PAST:], *past], axis=1)
    found, *_ = np.linalg.lstsq(design, ys[PAST:], rcond=None)
    inputs, channels = us.shape[1], ys.shape[1]
    blocks = [found[:inputs].T]
    back = found[inputs:].reshape(PAST, channels + inputs, channels).transpose(0, 2, 1)
    for k in range(1, LAG):
        fed = sum((back[i, :, :channels] @ blocks[k - 1 - i] for i in range(min(k, PAST))), np.zeros_like(blocks[0]))
        blocks.append(fed + (back[k - 1, :, channels:] if k <= PAST else 0.0))
    return np.array(blocks), float(np.mean((ys[PAST:] - design @ found) ** 2))


def starting_model(blocks: np.ndarray, variance: float, given: Case) -> StateSpaceModel:
    """The model that ERA makes of Markov parameters; half of `variance` is given to each noise, in readings."""
    states, channels = len(given.B), len(given.D)
    system = realise(MarkovParameters(blocks), states)
    H, D = (np.asarray(m) for m in (system.observation.matrix, system.observation.feedthrough))
    gain = np.mean(np.sum(H**2, axis=1))
    x0 = np.linalg.pinv(H) @ (given.readings[LAG - 1] - D @ given.inputs[LAG - 1])
    return StateSpaceModel(
        system.dynamics,
        system.observation,
        AdditiveGaussian(ScaledIdentity(LogVariance(Learnt(np.log(0.5 * variance / gain))), states)),
        AdditiveGaussian(ScaledIdentity(LogVariance(Learnt(np.log(0.5 * variance))), channels)),
        Gaussian(Learnt(x0), 1e-16 * jnp.eye(states)),
    )


def maxima(cases: list[Case], before: Any = None) -> tuple[Any, Place, np.ndarray]:
    """The MAP for each recording from the rows after the first LAG - 1: models, places, and which start won.

    `before` are the models of fewer readings, or None.
    """
    series = stacked([series_of(given, LAG - 1) for given in cases])
    starts = []
    for blocks_of in (autoregression, lambda given: (ls(given), None)):
        made = []
        for given in cases:
            variance = autoregression(given)[1]
            made.append(starting_model(blocks_of(given)[0], variance, given))
        starts.append(stacked(made))
    if before is not None:
        starts.append(before)
    best, won = best_of([FIRST.run(one, start(one), series) for one in starts])
    best = LAST.run(starts[0], best, series)
    return put(starts[0], best.free), best, won


def parameters_of(models: Any) -> np.ndarray:
    """Markov parameters (case, lag, channel, input) of stacked models."""
    A, B, H, D = models.dynamics.A, models.dynamics.B, models.observation.matrix, models.observation.feedthrough
    return np.asarray(jax.vmap(lambda *matrices: impulse_response(*matrices, lag=LAG).blocks)(A, B, H, D))
