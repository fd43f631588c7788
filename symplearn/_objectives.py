"""What a model is scored by: minus a log density, in nats, so that priors add and objectives compare."""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from ._errors import InputError
from ._filter import STANDARD, Filtered, UnscentedTransform, log_likelihood, unscented_filter
from ._model import FullState, Gaussian, StateSpaceModel, intervals_between
from ._parameters import resolve


class TimeSeries(eqx.Module):
    """The least a recording is: increasing `times` (time,) and `readings` (time, channel), NaN if missing.

    Wherever a recording is asked for, anything with these two attributes will do.
    """

    times: Float[Array, " time"]
    readings: Float[Array, "time channel"]
    inputs: Float[Array, "time input"] | None = None


def as_time_series(recording: Any) -> TimeSeries:
    """The times and readings of a recording as arrays, checked.

    **Raises:** `InputError` where shapes disagree, times do not increase or there are fewer than two rows.
    """
    times, readings = recording.times, recording.readings
    if isinstance(times, jax.core.Tracer):
        return TimeSeries(times, readings)
    times, readings = np.asarray(times, dtype=float), np.asarray(readings, dtype=float)
    if times.ndim != 1 or readings.ndim != 2 or len(times) != len(readings) or len(times) < 2:
        raise InputError(
            f"A recording needs times (n,) and readings (n, channels) with n of at least 2, but has shapes "
            f"{times.shape} and {readings.shape}."
        )
    if not np.all(np.isfinite(times)) or not np.all(np.diff(times) > 0):
        raise InputError("The times of a recording must be finite and strictly increasing; sort or clean them first.")
    if np.any(np.isinf(readings)):
        raise InputError("A recording has infinite readings; give NaN where a reading is missing.")
    return TimeSeries(jnp.asarray(times), jnp.asarray(readings))


class AbstractObjective(eqx.Module):
    """Scores a model against a recording, in nats; lower is better."""

    @abc.abstractmethod
    def __call__(self, model: StateSpaceModel, recording: Any) -> Float[Array, ""]:
        """Minus the log density of the recording under the model."""


class MarginalLikelihood(AbstractObjective):
    """Minus the log marginal likelihood (2.4) by the unscented Kalman filter; +inf where the filter fails.

    The propagator's intervals are those between the recording's times. Without an `initial` distribution the
    first reading of the full state is conditioned on, which is a flat prior on the state it reads.
    """

    transform: UnscentedTransform = STANDARD

    def __call__(self, model: StateSpaceModel, recording: Any) -> Float[Array, ""]:
        model, readings, intervals = prepare(model, as_time_series(recording))
        return -log_likelihood(model, readings, intervals, transform=self.transform)

    def filter(self, model: StateSpaceModel, recording: Any) -> Filtered:
        """The filter's history behind the score."""
        return _filter(model, as_time_series(recording), self.transform)


@eqx.filter_jit
def _filter(model: StateSpaceModel, series: TimeSeries, transform: UnscentedTransform) -> Filtered:
    model, readings, intervals = prepare(model, series)
    return unscented_filter(model, readings, intervals, transform=transform)


MARGINAL_LIKELIHOOD = MarginalLikelihood()


def prepare(model: StateSpaceModel, series: TimeSeries) -> tuple[StateSpaceModel, Array, PyTree]:
    """The model in plain arrays with an initial distribution, the readings still to be scored, the
    intervals."""
    model = resolve(model)
    noise = model.measurement_noise.covariance()
    if noise.shape[0] != series.readings.shape[1]:
        raise InputError(
            f"The recording has {series.readings.shape[1]} channels, but the measurement noise is for "
            f"{noise.shape[0]}; give one variance per channel."
        )
    readings = series.readings
    if model.initial is None:
        model = eqx.tree_at(lambda m: m.initial, model, _given_first(model, readings[0], noise), is_leaf=_is_none)
        readings = readings.at[0].set(jnp.nan)
    return model, readings, intervals_between(series.times)


def _is_none(node: Any) -> bool:
    return node is None


def _given_first(model: StateSpaceModel, reading: Array, noise: Array) -> Gaussian:
    """The state given its first reading alone, under a flat prior."""
    if not isinstance(model.observation, FullState):
        raise InputError(
            "The model has no initial distribution, and its observation is not `FullState`; give it "
            "`initial=Gaussian(mean, covariance)`."
        )
    if not isinstance(reading, jax.core.Tracer) and bool(jnp.any(jnp.isnan(reading))):
        raise InputError("The first row has missing readings; give the model `initial=Gaussian(mean, covariance)`.")
    return Gaussian(reading, noise)
