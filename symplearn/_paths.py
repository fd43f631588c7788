"""Paths of models, each pushed forward from what its own filter or smoother says of the state."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ._errors import InputError
from ._filter import unscented_filter
from ._fit import Estimate
from ._forecast_grid import Grid, grid_of, stepped, substeps_of
from ._model import Instant, Interval, StateSpaceModel
from ._objectives import MarginalLikelihood, TimeSeries, as_recordings, one_of, prepare
from ._parameters import resolve
from ._simulate import draw_noise, draw_reading
from ._smoother import smooth
from ._transforms import AbstractTransform
from ._triangular import semidefinite_cholesky


@dataclasses.dataclass(frozen=True)
class Choice:
    """What is drawn, and from where: with `spread` states are drawn of their distribution, without they are its mean;
    with `filtered` a path starts anew at every reading."""

    process_noise: bool
    measurement_noise: bool
    in_sample: bool
    spread: bool = True
    filtered: bool = False


class Task(NamedTuple):
    """All that paths hang on but the model and the key."""

    choice: Choice
    transform: AbstractTransform
    series: TimeSeries
    grid: Grid
    substeps: int | None
    recording: int
    recordings: int

    def alone(self) -> "Task":
        """The same without anything drawn: the path from the mean, started once."""
        still = Choice(False, False, self.choice.in_sample, spread=False)
        return self._replace(choice=still)


def task_of(
    estimate: Estimate,
    choice: Choice,
    recording: int,
    times: Any,
    until: float | None,
    substeps: int | None,
    inputs: Any,
) -> Task:
    """The task of continuing one recording of an estimate.

    **Raises:** `InputError` where there is no such recording, the model is no `StateSpaceModel`, or times, inputs or
    substeps do not fit.
    """
    several = as_recordings(estimate.recording)
    if not 0 <= recording < len(several):
        raise InputError(f"There are {len(several)} recordings, but number {recording} was asked for, counted from 0.")
    if not isinstance(estimate.model, StateSpaceModel):
        raise InputError(
            f"Paths are drawn with noise and without it, so of a `StateSpaceModel`, but the model is "
            f"`{type(estimate.model).__name__}`; use `forecast`, which needs its moments only."
        )
    series = several[recording]
    grid = grid_of(estimate.model, series, times, until, choice.in_sample, inputs)
    objective = estimate.objective if isinstance(estimate.objective, MarginalLikelihood) else MarginalLikelihood()
    steps = substeps_of(estimate.model, grid, substeps)
    return Task(choice, objective.transform, series, grid, steps, recording, len(several))


@eqx.filter_jit
def paths_of_many(task, models, keys):
    """States and readings at the times asked for, (draw, time, ...), of models stacked along draws."""
    return eqx.filter_vmap(lambda model, key: _path(task, model, key))(models, keys)


@eqx.filter_jit
def paths_of_one(task, model, keys):
    """The same of one model, with as many draws as keys."""
    model = resolve(model)
    return jax.vmap(lambda key: _path(task, model, key))(keys)


def _path(task, model, key):
    choice, grid = task.choice, task.grid
    start_key, step_key, reading_key = jax.random.split(key, 3)
    model = one_of(model, task.recording, task.recordings)
    means, roots = _known(task, model)

    def drawn(k, key):
        return means[k] + roots[k] @ jax.random.normal(key, means[k].shape) if choice.spread else means[k]

    model = stepped(model, task.substeps)

    def step(x, data):
        interval, noisy, reading, key = data
        # Two keys of one split: a number folded in may be the key that a noise splits off its own.
        key, start_key = jax.random.split(key) if choice.filtered else (key, key)
        x = model.dynamics(x, interval)
        if choice.process_noise:
            x = jnp.where(noisy, draw_noise(model.process_noise, x, interval, key), x)
        if not choice.filtered:
            return x, x
        return jnp.where(reading >= 0, drawn(reading, start_key), x), x

    inputs = grid.inputs
    intervals = Interval(grid.times[:-1], grid.times[1:], None if inputs is None else inputs[:-1])
    keys = jax.random.split(step_key, grid.noisy.shape[0])
    x0 = drawn(0, start_key)
    _, later = jax.lax.scan(step, x0, (intervals, grid.noisy, grid.reading[1:], keys))
    states = jnp.concatenate([x0[None], later])[grid.wanted]
    instants = Instant(grid.times[grid.wanted], None if inputs is None else inputs[grid.wanted])

    def read(x, instant, key):
        return draw_reading(model, x, instant, key) if choice.measurement_noise else model.observation(x, instant)

    return states, jax.vmap(read)(states, instants, jax.random.split(reading_key, len(states)))


def _known(task: Task, model: Any) -> tuple[Array, Array]:
    """Means of the state and roots of its covariances where paths may start: at every reading, given those up to it,
    or at one alone: the first or last given all."""
    prepared, readings, intervals, instants = prepare(model, task.series)
    filtered = unscented_filter(prepared, readings, intervals, instants, task.transform)
    means, covariances = filtered.filtered_means, filtered.filtered_covariances
    if not task.choice.filtered:
        means, covariances = means[-1:], covariances[-1:]
        if task.choice.in_sample:
            smoothed = smooth(prepared, filtered, intervals, instants, task.transform)
            means, covariances = smoothed.means[:1], smoothed.covariances[:1]
    return means, jax.vmap(semidefinite_cholesky)(covariances)
