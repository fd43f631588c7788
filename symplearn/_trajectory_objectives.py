"""Objectives that follow trajectories: simulation, one-step prediction, multiple shooting. Dissertation (1.4)-(4.9).

They are limits of the marginal likelihood: Theorem 1, Theorem 2 and Proposition 4.
"""

import abc
import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ._counts import is_count, refuse_count
from ._errors import InputError
from ._faults import IMPOSSIBLE
from ._guard import guard
from ._model import AbstractAffine, Gaussian, Instant, Interval, StateSpaceModel, intervals_between
from ._objectives import AbstractObjective, TimeSeries, as_recordings, as_time_series, one_of
from ._parameters import AbstractKnown, Learnt, require, resolve
from ._triangular import forward_substitution, semidefinite_cholesky


class AbstractSegmentation(eqx.Module):
    """Where the segments of multiple shooting start."""

    @abc.abstractmethod
    def starts(self, intervals: int) -> tuple[int, ...]:
        """The readings l_1 = 0 < l_2 < ... at which the segments of that many data intervals start."""


class EverySteps(AbstractSegmentation):
    """Segments of `length` data intervals, the T of (4.9); the last one may be shorter.

    **Raises:** `InputError` where `length` is no whole number of at least 1.
    """

    length: int = eqx.field(static=True)

    def __check_init__(self):
        refuse_count("EverySteps", "length", self.length)

    def starts(self, intervals: int) -> tuple[int, ...]:
        return tuple(range(0, intervals, self.length))


class StartingAt(AbstractSegmentation):
    """Segments that start at the readings `indices`: 0 first, then increasing.

    **Raises:** `ValueError` where they do not start at 0 and increase; `InputError`, in use, where a recording
    ends before the last of them.
    """

    indices: tuple[int, ...] = eqx.field(static=True, converter=tuple)

    def __check_init__(self):
        indices, whole = self.indices, all(is_count(index, 0) for index in self.indices)
        if not whole or indices != tuple(sorted({0, *indices})):
            raise ValueError(f"`StartingAt` needs whole, increasing indices from 0 on, but was given {indices}.")

    def starts(self, intervals: int) -> tuple[int, ...]:
        if self.indices[-1] >= intervals:
            raise InputError(
                f"The last segment starts at reading {self.indices[-1]}, but the recording has {intervals} intervals; "
                "start it earlier."
            )
        return self.indices


class SegmentStarts(AbstractKnown):
    """The states at which the segments start, the Z_L of (4.10): `means` (segment, state), as a model's `initial`.

    Bare numbers are given; `SegmentStarts(Learnt(means))` learns them together with the parameters.
    """

    means: Any


class AbstractContinuity(eqx.Module):
    """What is asked of the gaps between the end of one segment and the start of the next."""

    @abc.abstractmethod
    def log_density(self, gaps: Float[Array, "gap state"]) -> Float[Array, " gap"]:
        """The log prior density of each gap, in nats."""


class Unconstrained(AbstractContinuity):
    """Nothing is asked: unconstrained multiple shooting."""

    def log_density(self, gaps: Float[Array, "gap state"]) -> Float[Array, " gap"]:
        return jnp.zeros(gaps.shape[0])


class GaussianContinuity(AbstractContinuity):
    """Each gap is normal about 0 with this variance, one number or one per state: pi(x_{l+1} | x_l) of (4.10).

    As the variance vanishes it becomes the constraint of Proposition 4; `fit_constrained` holds that exactly.
    """

    variance: Any = eqx.field(converter=lambda variance: jnp.asarray(variance, dtype=float))

    def __check_init__(self):
        require(self.variance > 0, "`GaussianContinuity` needs positive variances; `fit_constrained` closes the gaps.")

    def log_density(self, gaps: Float[Array, "gap state"]) -> Float[Array, " gap"]:
        return -0.5 * jnp.sum(gaps**2 / self.variance + jnp.log(2 * math.pi * self.variance), axis=1)


class SimulationLeastSquares(AbstractObjective):
    """Minus sum_k log N(y_k; h(Psi^k(x_0), u_k), Gamma): the error of a free run, k = 0..n. Theorem 1.

    x_0 is the mean of the model's `initial`; without one it is the state that the first reading reads, which is
    then not scored. Gamma is the measurement noise; the process noise plays no part. Missing readings are left
    out. A trajectory that leaves the reals scores 1e15 nats.

    **Raises:** `InputError` where channels disagree, or `initial` is None and the reading cannot be inverted.
    """

    def score(self, model: StateSpaceModel, series: TimeSeries) -> Float[Array, ""]:
        return _free_run(prepared(model, series), series)


class PropagatorLeastSquares(AbstractObjective):
    """Minus sum_{k>=1} log N(y_k; h(Psi(x_{k-1}, u_{k-1})), H Sigma H'), x_{k-1} = h^-1(y_{k-1}). Theorem 2, Remark 1.

    The error of one-step predictions for a linear, invertible reading h(x, u) = H x + D u. This is the density of
    the states read, log N(x_k; Psi(x_{k-1}), Sigma), with the Jacobian log |det H^-1|, written so that a missing
    channel of y_k can be left out. Sigma is the process noise; the measurement noise plays no part. An interval
    that starts at an incomplete reading is left out. A prediction that leaves the reals, or a singular Sigma,
    scores 1e15 nats.

    **Raises:** `InputError` where the reading cannot be inverted.
    """

    def score(self, model: StateSpaceModel, series: TimeSeries) -> Float[Array, ""]:
        return _one_step(prepared(model, series), series)


class MultipleShooting(AbstractObjective):
    """Minus sum_i sum_k log N(y_k; h(Psi^{k-l_i}(x_{l_i}), u_k), Gamma), k = l_i + 1..l_{i+1}. (4.9), Proposition 4.

    Neighbouring segments overlap in one reading, that at which the second starts: only so does one step per
    segment give one-step prediction, and one segment the simulation (specification E27). The first reading of all
    belongs to no segment; `scores_first` adds its term, for a start that learns. Gamma is the measurement noise.

    The states x_{l_i} are the model's `initial`: a `SegmentStarts`, learnt or given; a `Gaussian`, for one segment;
    None, the states that the readings read. A segment that would start at an incomplete reading is then left out.

    **Arguments:** `segments` - where they start; `continuity` - a prior on the gaps, none by default (see
    `fit_constrained` for gaps of exactly 0); `scores_first`.

    **Raises:** `InputError` where `segments` are none, or the starts do not fit them, or cannot be read.
    """

    segments: AbstractSegmentation
    continuity: AbstractContinuity = Unconstrained()
    scores_first: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        if not isinstance(self.segments, AbstractSegmentation):
            raise InputError(
                "`MultipleShooting` needs to be told where its segments start, by `EverySteps(length)` or "
                f"`StartingAt(indices)`, but was given {self.segments!r}."
            )

    def score(self, model: StateSpaceModel, series: TimeSeries) -> Float[Array, ""]:
        model, shots = self._shots(model, series)
        prior = jnp.sum(jnp.where(shots.joined, self.continuity.log_density(shots.gaps), 0.0))
        return _scored(model, series, shots, self.scores_first, prior)

    def gaps(self, model: StateSpaceModel, recording: Any) -> Float[Array, "gap state"]:
        """x_{l_{i+1}} - Psi^{dl_i}(x_{l_i}) of all recordings, 0 beside a segment that is left out."""
        recordings = as_recordings(recording)
        models = (one_of(model, k, len(recordings)) for k in range(len(recordings)))
        return jnp.concatenate([self._shots(*pair)[1].gaps for pair in zip(models, recordings, strict=True)])

    def _shots(self, model: StateSpaceModel, series: TimeSeries) -> tuple[StateSpaceModel, "_Shots"]:
        model = prepared(model, series)
        return model, _shoot(model, series, self.segments.starts(len(series.times) - 1))


def segment_starts(model: StateSpaceModel, recording: Any, segments: AbstractSegmentation) -> Any:
    """First guesses of the segments' starts that learn: the states read there, missing channels interpolated.

    For several recordings a tuple of them. Put the result in as the model's `initial`.

    **Raises:** `InputError` where the reading cannot be inverted, or a channel was never read.
    """
    if isinstance(recording, list | tuple):
        return tuple(segment_starts(model, one, segments) for one in recording)
    series = as_time_series(recording)
    times, readings = np.asarray(series.times), np.asarray(series.readings)
    if np.isnan(readings).all(axis=0).any():
        raise InputError("A channel has no reading at all; give the starts as `SegmentStarts(Learnt(means))`.")
    seen = ~np.isnan(readings)
    filled = [np.interp(times, times[s], y[s]) for s, y in zip(seen.T, readings.T, strict=True)]
    whole = TimeSeries(series.times, jnp.asarray(np.stack(filled, axis=1)), series.inputs)
    states, _ = states_read(prepared(model, whole), whole)
    return SegmentStarts(Learnt(states[jnp.asarray(segments.starts(len(times) - 1))]))


def prepared(model: StateSpaceModel, series: TimeSeries) -> StateSpaceModel:
    """The model in plain arrays.

    **Raises:** `InputError` where a noise is not additive and Gaussian, or is for another number of channels.
    """
    # The guard stands outermost too, before a `Positive` that overflows.
    model, first = resolve(guard(model)), _instants(series, 0)
    for name in ("process_noise", "measurement_noise"):
        if not hasattr(getattr(model, name), "covariance"):
            given = type(getattr(model, name)).__name__
            raise InputError(
                f"This objective is for additive Gaussian noise, but the {name.replace('_', ' ')} is `{given}`; "
                "use `MarginalLikelihood`."
            )
    channels, rows = model.measurement_noise.covariance(first).shape[0], series.readings.shape[1]
    if channels != rows:
        raise InputError(f"The recording has {rows} channels, but the measurement noise is for {channels}.")
    return model


def _instants(series: TimeSeries, at: Any) -> Instant:
    return _rows(Instant(series.times, series.inputs), at)


def states_read(model: StateSpaceModel, series: TimeSeries) -> tuple[Float[Array, "time state"], Bool[Array, " time"]]:
    """The states h^-1(y_k, u_k) of a linear, invertible reading, and where the readings were complete.

    **Raises:** `InputError` where the reading is not of that kind.
    """
    intervals = intervals_between(series.times, series.inputs)
    # Only the process noise knows how large a state is.
    x = jnp.zeros(model.process_noise.covariance(_rows(intervals, 0)).shape[0])
    reading = model.observation
    if not isinstance(reading, AbstractAffine) or reading.slope(x).shape != (x.size, x.size):
        raise InputError(
            f"The states are to be read off the readings, but `{type(reading).__name__}` has no inverse for a state of "
            f"size {x.size}; read the `FullState`, or give the model an `initial`."
        )
    complete = ~jnp.any(jnp.isnan(series.readings), axis=1)
    offsets = jax.vmap(lambda instant: reading(x, instant))(_instants(series, slice(None)))
    known = jnp.where(complete[:, None], series.readings, 0.0) - offsets
    return jnp.linalg.solve(reading.slope(x), known.T).T, complete


def log_densities(
    readings: Float[Array, "row channel"],
    means: Float[Array, "row channel"],
    covariances: Float[Array, "row channel channel"],
) -> Float[Array, " row"]:
    """log N(reading; mean, covariance) of each row, in nats; channels that are NaN are left out."""

    def one(y, m, C):
        m, C = guard((m, C))
        seen = ~jnp.isnan(y)
        r = jnp.where(seen, y, m) - m
        # A missing channel is given an independent unit variance and no error: exactly as if absent.
        L = semidefinite_cholesky(jnp.where(seen[:, None] & seen, C, jnp.eye(y.size)))
        e = forward_substitution(L, r)
        pivots = jnp.where(jnp.diagonal(L) > 0.0, jnp.diagonal(L), jnp.nan)
        return -0.5 * e @ e - jnp.sum(jnp.log(pivots)) - 0.5 * math.log(2 * math.pi) * jnp.sum(seen)

    return jax.vmap(one)(readings, means, covariances)


def bounded(score: Float[Array, ""], real: Bool[Array, ""]) -> Float[Array, ""]:
    """The score, or 1e15 where it is more, NaN, or of a trajectory that left the reals."""
    return jnp.where(real & (score < -IMPOSSIBLE), guard(score), -IMPOSSIBLE)


class _Shots(NamedTuple):
    """Trajectories from each start: the readings' numbers `at` (segment, step) with the states there, which of them
    count, and the gaps between segments with those that count."""

    starts: Array
    at: np.ndarray
    states: Array
    counts: Array
    gaps: Array
    joined: Array
    real: Array


def _shoot(model: StateSpaceModel, series: TimeSeries, begins: tuple[int, ...]) -> _Shots:
    last = len(series.times) - 1
    lengths = np.diff((*begins, last))
    steps = np.arange(max(lengths))
    inside = steps < lengths[:, None]
    # Shorter segments run on past their ends, uncounted, so that all are one batch.
    k = np.minimum(np.array(begins)[:, None] + steps, last - 1)
    starts, known = _starts(model, series, begins)
    starts = guard(starts)
    intervals = _rows(intervals_between(series.times, series.inputs), k)
    states, real = jax.vmap(lambda x, spans: _simulated(model, x, spans))(starts, intervals)
    counts = jnp.asarray(inside) & known[:, None]
    joined = known[1:] & known[:-1]
    gaps = starts[1:] - states[np.arange(len(begins)), lengths - 1][:-1]
    return _Shots(starts, k + 1, states, counts, jnp.where(joined[:, None], gaps, 0.0), joined, jnp.all(real | ~counts))


def _starts(model: StateSpaceModel, series: TimeSeries, begins: tuple[int, ...]) -> tuple[Array, Array]:
    """The state at which each segment starts, and whether it is known."""
    initial, at = model.initial, jnp.asarray(begins)
    if initial is None:
        states, complete = states_read(model, series)
        return states[at], complete[at]
    starts = jnp.asarray(initial.mean)[None] if isinstance(initial, Gaussian) else jnp.asarray(initial.means)
    if starts.shape[0] != len(begins):
        raise InputError(
            f"The recording is cut into {len(begins)} segments, but the model's `initial` has {starts.shape[0]} start "
            "states; give it `segment_starts(model, recording, segments)`, or None."
        )
    return starts, jnp.ones(len(begins), bool)


def _simulated(model: StateSpaceModel, start: Array, intervals: Interval) -> tuple[Array, Array]:
    """The states at the intervals' ends, and whether the trajectory was still real there; from then on it is 0."""

    def step(carry, interval):
        inside, x = guard((model, carry[0]))
        after = inside.dynamics(x, interval)
        real = carry[1] & jnp.all(jnp.isfinite(after))
        after = jnp.where(real, after, 0.0)
        return (after, real), (after, real)

    real = jnp.all(jnp.isfinite(start))
    step = jax.checkpoint(step, prevent_cse=False)
    return jax.lax.scan(step, (jnp.where(real, start, 0.0), real), intervals)[1]


def _scored(model: StateSpaceModel, series: TimeSeries, shots: _Shots, first: bool, prior: Array) -> Array:
    """Minus the log density of the readings that count, minus the log prior of the gaps."""
    at, states = shots.at.reshape(-1), shots.states.reshape(shots.at.size, -1)
    readings = jnp.where(shots.counts.reshape(-1, 1), series.readings[at], jnp.nan)
    if first and model.initial is not None:
        at, states = np.append(0, at), jnp.concatenate([shots.starts[:1], states])
        readings = jnp.concatenate([series.readings[:1], readings])
    predicted, covariances = jax.vmap(lambda x, instant: _reading(model, x, instant))(states, _instants(series, at))
    return bounded(-jnp.sum(log_densities(readings, predicted, covariances)) - prior, shots.real)


def _reading(model: StateSpaceModel, x: Array, instant: Instant) -> tuple[Array, Array]:
    inside, x = guard((model, x))
    return inside.observation(x, instant), inside.measurement_noise.covariance(instant)


def _free_run(model: StateSpaceModel, series: TimeSeries) -> Array:
    return _scored(model, series, _shoot(model, series, (0,)), True, jnp.zeros(()))


def _one_step(model: StateSpaceModel, series: TimeSeries) -> Array:
    states, complete = states_read(model, series)
    intervals = intervals_between(series.times, series.inputs)

    def ahead(x, interval, instant):
        inside, x = guard((model, x))
        after, H = inside.dynamics(x, interval), inside.observation.slope(x)
        return inside.observation(after, instant), H @ inside.process_noise.covariance(interval) @ H.T

    predicted, covariances = jax.vmap(ahead)(states[:-1], intervals, _instants(series, slice(1, None)))
    readings = jnp.where(complete[:-1, None], series.readings[1:], jnp.nan)
    real = jnp.all(jnp.isfinite(predicted) | jnp.isnan(readings))
    return bounded(-jnp.sum(log_densities(readings, predicted, covariances)), real)


def _rows(records: Any, at: Any) -> Any:
    """Rows of a pytree along its leading axis."""
    return jax.tree.map(lambda leaf: leaf[at], records)
