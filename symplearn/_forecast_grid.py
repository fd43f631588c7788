"""When paths are pushed forward: the times asked for and, between them, those at which noise enters or was read."""

import dataclasses
import math
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ._counts import refuse_count
from ._errors import InputError
from ._model import AbstractAffine, Propagator
from ._noise import WienerIncrement
from ._objectives import TimeSeries

# Times ahead that can be asked for: more are a slip, and would not fit into memory.
_MOST_TIMES = 10_000_000


class Grid(NamedTuple):
    """Instants of paths, the start first: where process noise enters, which of them were asked for, which reading of
    the recording is at each (-1 for none), and the inputs held from each on."""

    times: Any
    noisy: Any
    wanted: Any
    reading: Any
    spacing: float
    inputs: Any = None


def grid_of(
    model: Any, series: TimeSeries, times: Any, until: float | None, in_sample: bool, inputs: Any = None
) -> Grid:
    """The grid of paths from the first reading on, or from the last.

    **Raises:** `InputError` where not one of `times` and `until` is given, or times or inputs do not fit.
    """
    wanted = _wanted(series, times, until, in_sample)
    recorded = np.asarray(series.times)
    _refuse_far(float(wanted[-1]), float(recorded[-1]), float(recorded[-1] - recorded[-2]))
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
    at = np.array([int(np.argmin(np.abs(every - t))) for t in wanted])
    nearest = np.abs(every[:, None] - recorded).argmin(axis=1)
    reading = np.where(np.abs(every - recorded[nearest]) <= slack, nearest, -1)
    grid = Grid(every, noisy, at, reading, spacing)
    return grid._replace(inputs=_held(grid, series, inputs))


def _wanted(series: TimeSeries, times: Any, until: float | None, in_sample: bool) -> np.ndarray:
    recorded = np.asarray(series.times)
    if (until is None) == (times is None):
        raise InputError("A forecast needs either `until` or `times`, and not both.")
    start, spacing = recorded[0] if in_sample else recorded[-1], recorded[-1] - recorded[-2]
    if times is None:
        times = times_until(float(until or 0.0), start, spacing)
    wanted = np.asarray(times, dtype=float)
    lowest = wanted.ndim == 1 and len(wanted) > 0 and (wanted[0] >= start if in_sample else wanted[0] > start)
    if not lowest or not np.all(np.isfinite(wanted)) or not np.all(np.diff(wanted) > 0):
        where = f"from the first reading, t = {start:g}, on" if in_sample else f"after the last reading, t = {start:g}"
        raise InputError(f"A forecast needs finite, increasing times {where}.")
    return wanted


def times_until(until: float, start: float, spacing: float) -> Float[np.ndarray, " time"]:
    """Times after `start` in steps of `spacing`, up to `until`.

    **Raises:** `InputError` where `until` is not finite, or they are more than can be held.
    """
    _refuse_far(until, start, spacing)
    # The small share lets `until` itself be reached in spite of round-off.
    return start + spacing * np.arange(1, math.floor((until - start) / spacing + 1e-6) + 1)


def _refuse_far(last: float, start: float, spacing: float) -> None:
    if not math.isfinite(last) or (last - start) / spacing > _MOST_TIMES:
        raise InputError(
            f"The last time, {last:g}, is not within {_MOST_TIMES:,} intervals of {spacing:g} after t = {start:g}; "
            "forecast less far."
        )


def _held(grid: Grid, series: TimeSeries, inputs: Any) -> Any:
    """The input at each instant of the grid: the latest row given."""
    if inputs is None and series.inputs is not None and grid.times[-1] <= np.asarray(series.times)[-1]:
        times, rows = np.asarray(series.times), np.asarray(series.inputs)
    else:
        times = np.unique(np.concatenate([grid.times[:1], grid.times[grid.wanted]]))
        given = input_rows(series, inputs, len(times))
        if given is None:
            return None
        rows = given
    return rows[np.maximum(np.searchsorted(times, grid.times + 1e-9 * grid.spacing, side="right") - 1, 0)]


def input_rows(series: TimeSeries, inputs: Any, rows: int) -> Float[np.ndarray, "time input"] | None:
    """Inputs ahead of a recording, a row from its end on and one from each time after it; None where nothing drives.

    **Raises:** `InputError` where the recording has inputs and none are given, or theirs is another shape.
    """
    if inputs is None and series.inputs is None:
        return None
    if inputs is None:
        raise InputError("The model is driven, and the recording's inputs end with it; give `inputs`.")
    given = np.asarray(inputs, dtype=float)
    if given.ndim != 2 or len(given) != rows or not np.all(np.isfinite(given)):
        raise InputError(
            f"`inputs` must be finite and of shape ({rows}, input): a row for the start of the paths and one for "
            f"each time after it, but have the shape {given.shape}."
        )
    return given


def substeps_of(model: Any, grid: Grid, substeps: int | None) -> int | None:
    """Integrator steps per interval of the grid; None where the dynamics are no `Propagator`.

    **Raises:** `InputError` where `substeps` is no whole number of at least 1, or the dynamics are one step per data
    interval and the grid has others.
    """
    if substeps is not None:
        refuse_count("posterior_forecast", "substeps", substeps)
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


def stepped(model: Any, substeps: int | None) -> Any:
    """The model with as many substeps; None leaves it as it is."""
    if substeps is None:
        return model
    return eqx.tree_at(lambda m: m.dynamics, model, dataclasses.replace(model.dynamics, substeps=substeps))
