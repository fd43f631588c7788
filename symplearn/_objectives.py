"""What a model is scored by: minus a log density, in nats, so that priors add and objectives compare."""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._errors import InputError
from ._filter import SEQUENTIAL, Filtered, log_likelihood, unscented_filter
from ._filter_step import AbstractPassage
from ._model import (
    AbstractStateSpaceModel,
    FullState,
    Gaussian,
    Instant,
    Interval,
    intervals_between,
    slice_at,
)
from ._parameters import resolve
from ._suitability import refuse_unsuited, refuse_wrong_state
from ._transforms import STANDARD, AbstractTransform, Moments, Taylor


def _floats(rows: Any) -> Any:
    return None if rows is None else jnp.asarray(rows, dtype=float)


class TimeSeries(eqx.Module):
    """The least a recording is: increasing `times` (time,) and `readings` (time, channel), NaN if missing.

    `inputs` (time, input) are known: row k acts on reading k and, held, on the interval that starts there.

    Wherever a recording is asked for, anything with these two attributes will do.
    """

    times: Float[Array, " time"] = eqx.field(converter=_floats)
    readings: Float[Array, "time channel"] = eqx.field(converter=_floats)
    inputs: Float[Array, "time input"] | None = eqx.field(converter=_floats, default=None)


def as_time_series(recording: Any) -> TimeSeries:
    """The times, readings and inputs of a recording as arrays, checked.

    **Raises:** `InputError` where there are no times and readings, shapes disagree, times do not increase or there are
    fewer than two rows.
    """
    if not (hasattr(recording, "times") and hasattr(recording, "readings")):
        raise InputError(
            f"A recording needs `times` and `readings`, but a `{type(recording).__name__}` has none; give "
            "`TimeSeries(times, readings)`, or what `read_recordings` gives."
        )
    times, readings, inputs = recording.times, recording.readings, getattr(recording, "inputs", None)
    if isinstance(times, jax.core.Tracer):
        return TimeSeries(times, readings, inputs)
    times, is_known = np.asarray(times, dtype=float), not isinstance(readings, jax.core.Tracer)
    readings = np.asarray(readings, dtype=float) if is_known else readings
    if times.ndim != 1 or readings.ndim != 2 or len(times) != len(readings) or len(times) < 2:
        raise InputError(
            f"A recording needs times (n,) and readings (n, channels) with n of at least 2, but has shapes "
            f"{times.shape} and {readings.shape}."
        )
    if not np.all(np.isfinite(times)) or not np.all(np.diff(times) > 0):
        raise InputError("The times of a recording must be finite and strictly increasing; sort or clean them first.")
    if is_known and np.any(np.isinf(readings)):
        raise InputError("A recording has infinite readings; give NaN where a reading is missing.")
    return TimeSeries(jnp.asarray(times), jnp.asarray(readings), _input_rows(inputs, times))


def _input_rows(inputs: Any, times: np.ndarray) -> Array | None:
    """The inputs at the rows: given as an array, or as the `Inputs` of a recording that was read from a file."""
    if inputs is None or isinstance(inputs, jax.core.Tracer):
        return inputs
    rows = np.asarray(
        inputs.at(times) if hasattr(inputs, "at") and not hasattr(inputs, "shape") else inputs, dtype=float
    )
    if rows.ndim != 2 or len(rows) != len(times) or not np.all(np.isfinite(rows)):
        raise InputError(
            f"The inputs of a recording must be finite and of shape (n, inputs) with n = {len(times)} rows, but have "
            f"the shape {rows.shape}."
        )
    return jnp.asarray(rows)


def as_recordings(recording: Any) -> tuple[TimeSeries, ...]:
    """One recording, or a list or tuple of them, as time series.

    **Raises:** `InputError` as `as_time_series`, and for an empty list.
    """
    is_one = hasattr(recording, "times")  # a named tuple may be one, too
    several = recording if isinstance(recording, list | tuple) and not is_one else (recording,)
    if not several:
        raise InputError("No recording was given; give one, or a list of at least one.")
    return tuple(as_time_series(one) for one in several)


class AbstractObjective(eqx.Module):
    """Scores a model against one recording or several, in nats; lower is better."""

    @abc.abstractmethod
    def score(self, model: Any, series: TimeSeries) -> Float[Array, ""]:
        """Minus the log density of one recording under a model whose `initial` is for that recording."""

    def refuse(self, model: Any, recordings: tuple[TimeSeries, ...]) -> None:
        """Refuse, with `InputError`, what a value makes impossible to score and compiled code could not say."""
        refuse_unsuited(model, recordings)

    def __call__(self, model: Any, recording: Any) -> Float[Array, ""]:
        """Minus the log density of the recording, or of independent recordings in a list or tuple: their sum."""
        recordings = as_recordings(recording)
        return sum(
            (self.score(one_of(model, k, len(recordings)), series) for k, series in enumerate(recordings)),
            jnp.zeros(()),
        )


def one_of(model: Any, k: int, count: int) -> Any:
    """The model of recording k: with its own initial distribution where the model has one for each."""
    if not isinstance(model.initial, tuple):
        return model
    if len(model.initial) != count:
        raise InputError(
            f"The model has {len(model.initial)} initial distributions, but there are {count} recordings; give one for "
            "each, or one for all."
        )
    return eqx.tree_at(lambda m: m.initial, model, model.initial[k], is_leaf=_is_none)


class MarginalLikelihood(AbstractObjective):
    """Minus the log marginal likelihood (2.4) by the Gaussian filter; +1e15 where the filter fails.

    The propagator's intervals are those between the recording's times. Without an `initial` distribution the
    first reading of the full state is conditioned on, which is a flat prior on the state it reads. `transform` is the
    rule for the moments of what is not affine. `passage` is `Sequential()`, or `ParallelInTime()`, for linear models
    with long recordings on a GPU.
    """

    transform: AbstractTransform = STANDARD
    passage: AbstractPassage = SEQUENTIAL

    def score(self, model: AbstractStateSpaceModel, series: TimeSeries) -> Float[Array, ""]:
        return -log_likelihood(*prepare(model, series), transform=self.transform, passage=self.passage)

    def refuse(self, model: AbstractStateSpaceModel, recordings: tuple[TimeSeries, ...]) -> None:
        super().refuse(model, recordings)
        if model.initial is None:
            for series in recordings:
                _refuse_unread(series.readings[0])

    def filter(self, model: AbstractStateSpaceModel, recording: Any) -> Filtered:
        """The filter's history behind the score of one recording.

        **Raises:** `InputError` where the model has not one initial distribution, or the recording does not suit it.
        """
        model, series = one_of(model, 0, 1), as_time_series(recording)
        self.refuse(model, (series,))
        return _filter(model, series, self)


@eqx.filter_jit
def _filter(model: AbstractStateSpaceModel, series: TimeSeries, by: MarginalLikelihood) -> Filtered:
    return unscented_filter(*prepare(model, series), transform=by.transform, passage=by.passage)


MARGINAL_LIKELIHOOD = MarginalLikelihood()


def prepare(
    model: AbstractStateSpaceModel, series: TimeSeries
) -> tuple[AbstractStateSpaceModel, Array, Interval, Instant]:
    """The model in plain arrays with an initial distribution, the readings still to be scored, the intervals and the
    instants of the readings."""
    model, readings = resolve(model), series.readings
    intervals, instants = intervals_between(series.times, series.inputs), Instant(series.times, series.inputs)
    size = readings.shape[1] if model.initial is None else jnp.asarray(model.initial.mean).shape[0]
    refuse_wrong_state(model, size)
    _check_channels(model, size, readings.shape[1], slice_at(instants, 0))
    if model.initial is None:
        given = _given_first(model, readings[0], slice_at(instants, 0))
        model = eqx.tree_at(lambda m: m.initial, model, given, is_leaf=_is_none)
        readings = readings.at[0].set(jnp.nan)
    return model, readings, intervals, instants


def _is_none(node: Any) -> bool:
    return node is None


def _check_channels(model: Any, state: int, channels: int, instant: Instant) -> None:
    try:
        moments = jax.eval_shape(lambda: model.read(Taylor(), jnp.zeros(state), jnp.zeros((state, state)), instant))
    except (TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"The recording has {channels} channels, the state {state} numbers: with these the model's observation and "
            "measurement noise do not fit together; give one variance per channel."
        ) from error
    if moments.mean.shape[0] != channels:
        raise InputError(
            f"The recording has {channels} channels, but the model's observation gives {moments.mean.shape[0]}; give "
            "one variance per channel and read the channels that were recorded."
        )


def _given_first(model: Any, reading: Array, instant: Instant) -> Gaussian:
    """The state given its first reading alone, under a flat prior."""
    if not isinstance(getattr(model, "observation", None), FullState):
        raise InputError(
            "The model has no initial distribution, and its observation is not `FullState`; give it "
            "`initial=Gaussian(mean, covariance)`."
        )
    _refuse_unread(reading)
    nothing = jnp.zeros((reading.shape[0], reading.shape[0]))

    def read(state: Array) -> Moments:
        return model.read(Taylor(), state, nothing, instant)

    # What noise of a mean of its own adds to a reading, and multiplies it by: 0 and 1 for most.
    added = read(jnp.zeros_like(reading)).mean
    factor = read(jnp.ones_like(reading)).mean - added
    state = (reading - added) / factor
    return Gaussian(state, read(state).covariance / jnp.outer(factor, factor))


def _refuse_unread(reading: Array) -> None:
    if not isinstance(reading, jax.core.Tracer) and bool(jnp.any(jnp.isnan(reading))):
        raise InputError("The first row has missing readings; give the model `initial=Gaussian(mean, covariance)`.")
