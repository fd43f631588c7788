"""Errors of a sensor with a memory and of its clock, which enters by the rate of change of what is read: how large they
are and how long they last, and columns of the readings whitened beside them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._lane_loops import with_lane_loops
from ._calibrate import Fits
from ._clock_points import whitened_column
from ._coloured import (
    MOST_ROWS,
    RATIOS,
    Colour,
    chosen,
    filled,
    grid_of,
    row_gaps,
    row_variances,
    whitened,
)
from ._problem import Problem
from ._scatter import tail_gain
from ._weighed import largest

# How often sensor and clock are fitted, in turn, each with the other as it is.
_TURNS = 3
# Dampings of the clock's error, and how many memory lengths are tried.
_DAMPINGS, _TIMES = (30.0, 1.001), 5
# Steps of the logarithms of (ratio, frequency, damping) of both about the best, as many as the grid has points; and how
# large they are, in turn.
_NEARBY = np.random.default_rng(0).normal(size=(len(_DAMPINGS) * _TIMES * len(RATIOS), 2, 3)) * [1.0, 1.0, 0.0]
_FINER = (1.0, 0.5, 0.25)

_whitened = jax.jit(with_lane_loops(whitened))
_on_grid = jax.jit(jax.vmap(whitened_column, (None, None, None, None, 0)))


@dataclass(frozen=True, eq=False)
class Piece:
    """One channel in one recording: columns [error, slopes], maybe shapes of a further error behind them, and the
    factors of both errors, all by row."""

    columns: Float[np.ndarray, "column row"]
    rates: Float[np.ndarray, " row"]
    weight: Float[np.ndarray, " row"]
    times: Float[np.ndarray, " row"]

    def middle(self, column: Float[np.ndarray, " column"]) -> "Piece":
        """The rows that shapes are searched with, and their errors, a sum of the columns."""
        begin = max(0, (len(self.times) - MOST_ROWS) // 2)
        some = slice(begin, begin + MOST_ROWS)
        return Piece((column @ self.columns)[None, some], self.rates[some], self.weight[some], self.times[some])

    @cached_property
    def rows(self) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Factors, variances and gaps, as the filter takes them."""
        loadings = np.stack([np.ones_like(self.rates), self.rates])
        return filled(loadings), row_variances(self.weight), row_gaps(self.times)


def pieces_of(
    problem: Problem, fits: Fits, errors: Sequence[np.ndarray], weight: Sequence[np.ndarray], b: int, j: int
) -> list[Piece]:
    times = [r.times[: len(w)] for r, w in zip(problem.rows, weight, strict=True)]
    speeds = rates([p.readings[b, :, j] for p in fits.predictions], times)
    out = []
    for k, x in enumerate(errors):
        w = weight[k][:, j]
        slopes = np.where(w > 0, fits.predictions[k].slopes[b, :, :, j], 0.0)
        columns = np.concatenate([x[None], slopes])
        out.append(Piece(columns, speeds[k], w, times[k]))
    return out


def rates(shown: Sequence[np.ndarray], times: Sequence[np.ndarray]) -> list[Float[np.ndarray, " _"]]:
    """How fast expected readings change, by recording, of a root mean square of one."""
    found = [np.gradient(y, t) if len(t) > 1 else np.ones(len(t)) for y, t in zip(shown, times, strict=True)]
    size = float(np.sqrt(np.mean(np.concatenate(found) ** 2)))
    return [np.nan_to_num(rate / (size or 1.0)) for rate in found]


def whitened_beside(
    columns: Sequence[Float[np.ndarray, "column _"]], shown: Sequence[Float[np.ndarray, " _"]],
    weight: Sequence[Float[np.ndarray, " _"]], times: Sequence[Float[np.ndarray, " _"]],
    both: tuple[Colour, Colour],
) -> list[Float[np.ndarray, "column _"]]:  # fmt: skip
    """One channel's columns, by recording, whitened beside errors of its sensor and of its clock; `shown` are the
    expected readings."""
    pieces = [Piece(x, rate, w, t) for x, rate, w, t in zip(columns, rates(shown, times), weight, times, strict=True)]
    return [cleared(one, both)[0].T for one in pieces]


def fitted(
    problem: Problem, pieces: Sequence[Piece], j: int, begins: Sequence[tuple[Colour, Colour]],
    left: Sequence[Float[np.ndarray, " column"]],
) -> tuple[Colour, Colour]:  # fmt: skip
    """The likeliest error of the sensor and of its clock, each found in turn from the better one of some beginnings,
    then together; sizes are against the white noise, and `left`, by recording, tells what is left of the errors as sums
    of the columns."""
    known = problem.noise[j]
    some = [one.middle(column) for one, column in zip(pieces, left, strict=True)]
    grid = grid_of([one.times for one in pieces], not np.isnan(known), _DAMPINGS, _TIMES)
    most = largest(problem, j)
    both = list(begins[0])
    if len(begins) > 1:  # filled up to the grid's number of points, whose program is compiled already
        shapes = np.resize([[_shape(one) for one in pair] for pair in begins], (len(grid) + 1, 2, 3))
        both = list(begins[int(np.argmax(_values(some, shapes, known, most)[: len(begins)]))])
    for turn in range(_TURNS):
        searched = 1 - turn % 2
        tried = np.append(grid, [_shape(both[searched])], axis=0)
        shapes = np.repeat([[_shape(one) for one in both]], len(tried), axis=0)
        shapes[:, searched] = tried
        both[searched] = chosen(tried, _values(some, shapes, known, most))
    best = np.array([_shape(one) for one in both])
    for steps in _NEARBY * np.array(_FINER)[:, None, None, None]:
        shapes = np.append(best[None], best * np.exp(steps), axis=0)
        best = shapes[int(np.argmax(_values(some, shapes, known, most)))]
    names = ("ratio", "frequency", "damping")
    sensor, clock = (replace(one, **dict(zip(names, map(float, shape), strict=True)))
                     for one, shape in zip(both, best, strict=True))  # fmt: skip
    return sensor, clock


def _values(pieces: Sequence[Piece], shapes: Float[np.ndarray, "point both shape"], known: float, largest: float):
    """Log likelihoods of several shapes of both errors, whose innovations may have heavy tails: clocks leap."""
    places, logs, parts = tuple(jnp.asarray(part) for part in np.moveaxis(shapes, 2, 0)), np.zeros(len(shapes)), []
    for one in pieces:
        found, log = _on_grid(filled(one.columns)[0], *one.rows, places)
        parts.append(np.asarray(found)[:, : len(one.times)][:, one.weight > 0])
        logs += np.asarray(log)
    e = np.concatenate(parts, axis=1)
    white = np.maximum(np.mean(e**2, axis=1), 1e-300) if np.isnan(known) else np.full(len(shapes), known**2)
    e = e / np.sqrt(white)[:, None]
    value = -0.5 * (e.shape[1] * np.log(white) + (e**2).sum(1) + logs) + tail_gain(e, bool(np.isnan(known)))
    return np.where(np.isfinite(value) & (shapes[:, :, 0].max(1) * white <= largest**2), value, -np.inf)


def _shape(one: Colour) -> tuple[float, float, float]:
    return one.ratio, one.frequency, one.damping


def _shapes(both: Sequence[Colour]) -> Any:
    """Ratios, frequencies and dampings of sensor and clock."""
    return tuple(jnp.asarray(part) for part in zip(*map(_shape, both), strict=True))


def cleared(one: Piece, both: Sequence[Colour]) -> tuple[Float[np.ndarray, "row column"], float]:
    """Whitened columns in units of the white sd, and the log determinant that the whitening leaves."""
    series, log = _whitened(filled(one.columns), *one.rows, _shapes(both))
    return np.asarray(series)[: len(one.times)], float(log)
