"""What a posterior predicts: its draws pushed forward, each from its own state. Dissertation (2.19), (2.20), (5.13)."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from ._errors import InputError
from ._filter import unscented_filter
from ._model import AbstractAffine, Instant, Interval, Propagator
from ._noise import WienerIncrement
from ._objectives import MarginalLikelihood, TimeSeries, as_recordings, one_of, prepare
from ._parameters import resolve
from ._posterior import Posterior
from ._simulate import draw_noise, draw_reading, own_parts
from ._smoother import smooth
from ._transforms import AbstractTransform
from ._triangular import semidefinite_cholesky

# A reading larger than this many times the recording's largest has left what the recording tells of.
_ESCAPED = 1e3


class PosteriorForecast(eqx.Module):
    """Readings and states that draws of a posterior predict at `times`.

    `readings` (draw, time, channel) and `states` (draw, time, state) are the draws' own paths; `alive` (draw, time) is
    False from where a path is no longer finite, or its readings are more than 1000 times as large as any recorded.
    Such a draw is left out from there on, and `diverged` (time,) counts them. `map_path` (time, channel) is that of the
    most probable model from its most probable state, without noise (2.20).
    """

    times: Float[Array, " time"]
    readings: Float[Array, "draw time channel"]
    states: Float[Array, "draw time state"]
    alive: Bool[Array, "draw time"]
    map_path: Float[Array, "time channel"]

    @property
    def diverged(self) -> np.ndarray:
        """How many draws have diverged, at each time."""
        return np.sum(~np.asarray(self.alive), axis=0)

    def mean(self) -> np.ndarray:
        """The mean reading (time, channel), over the draws that have not diverged: (2.19)."""
        return np.nanmean(self._kept(), axis=0)

    def sd(self) -> np.ndarray:
        """The standard deviation of the readings (time, channel)."""
        return np.nanstd(self._kept(), axis=0)

    def quantiles(self, probabilities: float | Sequence[float]) -> np.ndarray:
        """Quantiles of the readings, (time, channel); several probabilities make a leading axis."""
        return np.nanquantile(self._kept(), np.asarray(probabilities), axis=0)

    def _kept(self) -> np.ndarray:
        return np.where(np.asarray(self.alive)[:, :, None], np.asarray(self.readings), np.nan)

    def __str__(self) -> str:
        draws, count = self.alive.shape
        head = f"{draws} draws at {count} times from {float(self.times[0]):g} to {float(self.times[-1]):g}"
        gone = self.diverged
        if not gone.any():
            return f"Posterior forecast: {head}; none diverged."
        first = float(self.times[int(np.argmax(gone > 0))])
        return (
            f"Posterior forecast: {head}; {gone[-1]} of {draws} DIVERGED, the first by t = {first:g}: means and bands "
            "are over the others."
        )


def posterior_forecast(
    posterior: Posterior,
    *,
    times: Any = None,
    until: float | None = None,
    draws: int = 500,
    process_noise: bool = True,
    measurement_noise: bool = False,
    in_sample: bool = False,
    substeps: int | None = None,
    inputs: Any = None,
    recording: int = 0,
    key: PRNGKeyArray,
) -> PosteriorForecast:
    """Push draws of a posterior forward, each from a state of its own.

    A draw's state is drawn from what its own filter says of the last reading; with `in_sample`, from what its own
    smoother says of the first. It then runs freely, with the estimated process noise (5.13) or without it (2.19).
    Noise that belongs to a data interval, as `AdditiveGaussian`, enters at the recording's times and, after them, at
    multiples of its last interval, whatever `times` are; a `WienerIncrement` enters everywhere.

    **Arguments:** one of `times`, which increase from where the paths start, and `until`, in steps of the recording's
    last interval; `draws` - evenly spaced ones of the posterior; `measurement_noise` - whether readings have it;
    `substeps` - integrator steps per interval between `times`, by default so many that none is longer than in training;
    `inputs` - (time + 1, input), held from the start of the paths and from each of `times` on; the recording's own, in
    sample, if left out; `recording` - which one of several.

    **Raises:** `InputError` where times or inputs do not fit, dynamics that are one step per data interval are asked
    for other times, or all draws diverge.
    """
    estimate = posterior.estimate
    if estimate is None:
        raise InputError("This posterior is of a density without a model: there is nothing to push forward.")
    series = as_recordings(estimate.recording)
    if not 0 <= recording < len(series):
        raise InputError(f"There are {len(series)} recordings, but number {recording} was asked for, counted from 0.")
    choice = _Choice(process_noise, measurement_noise, in_sample, recording, len(series))
    grid = _grid(series[recording], _wanted(series[recording], times, until, in_sample), estimate.model, in_sample)
    grid = grid._replace(inputs=_held(grid, series[recording], inputs))
    objective = estimate.objective if isinstance(estimate.objective, MarginalLikelihood) else MarginalLikelihood()
    steps = _substeps(estimate.model, grid, substeps)
    models, keys = posterior.models(draws), jax.random.split(key, draws)
    states, readings = _paths(choice, objective.transform, models, series[recording], grid, steps, keys)
    still = dataclasses.replace(choice, process_noise=False, measurement_noise=False, spread=False)
    most_probable = jax.tree.map(lambda leaf: leaf[None] if eqx.is_array(leaf) else leaf, resolve(estimate.model))
    _, path = _paths(still, objective.transform, most_probable, series[recording], grid, steps, keys[:1])
    return _checked(grid, states, readings, path[0], series[recording])


@dataclasses.dataclass(frozen=True)
class _Choice:
    """What is drawn, and from where."""

    process_noise: bool
    measurement_noise: bool
    in_sample: bool
    recording: int
    count: int
    spread: bool = True


class _Grid(NamedTuple):
    """Instants of the paths, the start first: where process noise enters, and which of them were asked for."""

    times: Any
    noisy: Any
    wanted: Any
    spacing: float
    inputs: Any = None


def _wanted(series: TimeSeries, times: Any, until: float | None, in_sample: bool) -> np.ndarray:
    recorded = np.asarray(series.times)
    if (until is None) == (times is None):
        raise InputError("`posterior_forecast` needs either `until` or `times`, and not both.")
    start, spacing = recorded[0] if in_sample else recorded[-1], recorded[-1] - recorded[-2]
    if times is None:
        count = math.floor((float(until or 0.0) - start) / spacing + 1e-6)
        times = start + spacing * np.arange(1, count + 1)
    wanted = np.asarray(times, dtype=float)
    lowest = wanted.ndim == 1 and len(wanted) > 0 and (wanted[0] >= start if in_sample else wanted[0] > start)
    if not lowest or not np.all(np.isfinite(wanted)) or not np.all(np.diff(wanted) > 0):
        where = f"from the first reading, t = {start:g}, on" if in_sample else f"after the last reading, t = {start:g}"
        raise InputError(f"`posterior_forecast` needs finite, increasing times {where}.")
    return wanted


def _grid(series: TimeSeries, wanted: np.ndarray, model: Any, in_sample: bool) -> _Grid:
    """The times asked for and, between them, those at which process noise enters."""
    recorded = np.asarray(series.times)
    spacing, slack = float(recorded[-1] - recorded[-2]), 1e-9 * float(recorded[-1] - recorded[-2])
    start = recorded[0] if in_sample else recorded[-1]
    later = recorded[-1] + spacing * np.arange(1, max(0, math.floor((wanted[-1] - recorded[-1]) / spacing + 1e-6)) + 1)
    instants = np.concatenate([recorded[1:], later]) if in_sample else later
    instants = instants[(instants > start) & (instants <= wanted[-1] + slack)]
    every = np.concatenate([[start], np.sort(np.concatenate([wanted[wanted > start + slack], instants]))])
    # One of two that are the same but for round-off.
    every = every[np.concatenate([[True], np.diff(every) > slack])]
    noisy = np.array([bool(np.any(np.abs(instants - t) <= slack)) for t in every[1:]])
    noisy = noisy | isinstance(getattr(model, "process_noise", None), WienerIncrement)
    return _Grid(every, noisy, np.array([int(np.argmin(np.abs(every - t))) for t in wanted]), spacing)


def _held(grid: _Grid, series: TimeSeries, inputs: Any) -> Any:
    """The input at each instant of the grid: the latest row given."""
    if inputs is None and series.inputs is None:
        return None
    if inputs is None:
        times, rows = np.asarray(series.times), np.asarray(series.inputs)
        if grid.times[-1] > times[-1]:
            raise InputError("The model is driven, and the recording's inputs end with it; give `inputs`.")
    else:
        times = np.unique(np.concatenate([grid.times[:1], grid.times[grid.wanted]]))
        rows = np.asarray(inputs, dtype=float)
    if rows.ndim != 2 or len(rows) != len(times) or not np.all(np.isfinite(rows)):
        raise InputError(
            f"`inputs` must be finite and of shape ({len(times)}, input): a row for the start of the paths and one for "
            f"each time after it, but have the shape {rows.shape}."
        )
    return rows[np.maximum(np.searchsorted(times, grid.times + 1e-9 * grid.spacing, side="right") - 1, 0)]


def _substeps(model: Any, grid: _Grid, substeps: int | None) -> int | None:
    """Integrator steps per interval of the grid; None where the dynamics are no `Propagator`."""
    lengths = np.diff(grid.times)
    dynamics = getattr(model, "dynamics", None)
    if isinstance(dynamics, Propagator):
        finest = dynamics.substeps * float(np.max(lengths, initial=0.0)) / grid.spacing
        return max(1, math.ceil(finest - 1e-6)) if substeps is None else substeps
    if substeps is not None:
        raise InputError("`substeps` are of a `Propagator`, which the model's dynamics are not; leave them out.")
    if isinstance(dynamics, AbstractAffine) and np.any(np.abs(lengths - grid.spacing) > 1e-6 * grid.spacing):
        raise InputError(
            f"`{type(dynamics).__name__}` is one step per data interval of {grid.spacing:g}: ask for times that many "
            "apart, or give the model dynamics in continuous time."
        )
    return None


@eqx.filter_jit
def _paths(choice, transform, models, series, grid, substeps, keys):
    """States and readings at the times asked for, (draw, time, ...)."""
    return eqx.filter_vmap(lambda model, key: _path(choice, transform, model, series, grid, substeps, key))(
        models, keys
    )


def _path(choice, transform, model, series, grid, substeps, key):
    start_key, step_key, reading_key = jax.random.split(key, 3)
    model = one_of(model, choice.recording, choice.count)
    mean, covariance = _state(transform, model, series, choice.in_sample)
    x0 = mean
    if choice.spread:
        x0 = mean + semidefinite_cholesky(covariance) @ jax.random.normal(start_key, mean.shape)
    model = own_parts(model)
    if substeps is not None:
        model = eqx.tree_at(lambda m: m.dynamics, model, dataclasses.replace(model.dynamics, substeps=substeps))

    def step(x, data):
        interval, noisy, key = data
        x = model.dynamics(x, interval)
        if choice.process_noise:
            x = jnp.where(noisy, draw_noise(model.process_noise, x, interval, key), x)
        return x, x

    inputs = grid.inputs
    intervals = Interval(grid.times[:-1], grid.times[1:], None if inputs is None else inputs[:-1])
    keys = jax.random.split(step_key, grid.noisy.shape[0])
    _, later = jax.lax.scan(step, x0, (intervals, grid.noisy, keys))
    states = jnp.concatenate([x0[None], later])[grid.wanted]
    instants = Instant(grid.times[grid.wanted], None if inputs is None else inputs[grid.wanted])

    def read(x, instant, key):
        return draw_reading(model, x, instant, key) if choice.measurement_noise else model.observation(x, instant)

    return states, jax.vmap(read)(states, instants, jax.random.split(reading_key, len(states)))


def _state(transform: AbstractTransform, model: Any, series: TimeSeries, first: bool) -> tuple[Array, Array]:
    """Mean and covariance of the state at the last reading given all, or at the first."""
    prepared, readings, intervals, instants = prepare(model, series)
    filtered = unscented_filter(prepared, readings, intervals, instants, transform)
    if not first:
        return filtered.filtered_means[-1], filtered.filtered_covariances[-1]
    smoothed = smooth(prepared, filtered, intervals, instants, transform)
    return smoothed.means[0], smoothed.covariances[0]


def _checked(grid: _Grid, states: Array, readings: Array, path: Array, series: TimeSeries) -> PosteriorForecast:
    limit = _ESCAPED * float(jnp.nanmax(jnp.abs(series.readings)))
    sound = np.all(np.isfinite(states), axis=2) & np.all(np.abs(np.asarray(readings)) <= limit, axis=2)
    alive = np.logical_and.accumulate(sound, axis=1)
    times = np.asarray(grid.times)[grid.wanted]
    if not np.all(alive.any(axis=0)):
        end = float(times[np.argmin(alive.any(axis=0))])
        raise InputError(f"All {len(alive)} draws have diverged by t = {end:g}: forecast less far.")
    path = jnp.where(jnp.isfinite(path), path, jnp.inf)
    return PosteriorForecast(jnp.asarray(times), readings, states, jnp.asarray(alive), path)
