"""A remainder in the times: a clock that runs ahead and behind, beside an error of the sensor with a memory.

Such an error goes with the rate of change of what is read, and vanishes where that turns. There the amplitudes stand as
they are, so that laws which differ in how a motion decays are told apart however far its phase wanders.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ._calibrate import Fits, Priors, residuals, weights
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
from ._evidence import variance_inflation
from ._problem import Problem
from ._scatter import law_gain, tail_gain
from ._weighed import REMAINDER, Estimate, correlated, trusting

# How often sensor and clock are fitted, in turn, each with the other as it is; and how often all of that, about the
# path that follows.
_TURNS, _PASSES = 3, 2
# Dampings of the clock's error, and how many memory lengths are tried.
_DAMPINGS, _TIMES = (30.0, 1.001), 5
# Steps of the logarithms of (ratio, frequency, damping) of both about the best, as many as the grid has points; and how
# large they are, in turn.
_NEARBY = np.random.default_rng(0).normal(size=(len(_DAMPINGS) * _TIMES * len(RATIOS), 2, 3)) * [1.0, 1.0, 0.0]
_FINER = (1.0, 0.5, 0.25)

_whitened = jax.jit(whitened)
_on_grid = jax.jit(jax.vmap(whitened, (None, None, None, None, 0)))


@dataclass(frozen=True, eq=False)
class _Piece:
    """One channel in one recording: columns [error, slopes], and the factors of both errors, all by row."""

    columns: Float[np.ndarray, "column row"]
    rates: Float[np.ndarray, " row"]
    weight: Float[np.ndarray, " row"]
    times: Float[np.ndarray, " row"]

    def middle(self, column: Float[np.ndarray, " column"]) -> "_Piece":
        """The rows that shapes are searched with, and their errors, a sum of the columns."""
        begin = max(0, (len(self.times) - MOST_ROWS) // 2)
        some = slice(begin, begin + MOST_ROWS)
        return _Piece((column @ self.columns)[None, some], self.rates[some], self.weight[some], self.times[some])

    @cached_property
    def rows(self) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Factors, variances and gaps, as the filter takes them."""
        loadings = np.stack([np.ones_like(self.rates), self.rates])
        return filled(loadings), row_variances(self.weight), row_gaps(self.times)


@np.errstate(all="ignore")  # a lane that diverged is told by its evidence
def weigh_clock(
    problem: Problem, fits: Fits, priors: Priors, rows: Sequence[int], colours: Sequence[Sequence[Colour]]
) -> list[Estimate]:
    """Estimates where every channel's error has a memory and its clock runs ahead and behind, about the trajectory fit.

    `colours` are those of the sensors alone, by lane and channel. None for a combination with a wrongly given noise.
    """
    weight = weights(problem, rows)
    errors = residuals(problem, fits.predictions, weight)
    number = sum((w > 0).sum(0) for w in weight)
    out: list[Estimate] = []
    for b in trusting(problem, fits):
        pieces = [_pieces(problem, fits, [x[b, :, j] for x in errors], weight, b, j) for j in range(problem.channels)]
        both, z = [(colour, replace(colour, ratio=0.0)) for colour in colours[b]], fits.z[b]
        begins = [both]
        if out:  # the errors beside another law, too: each search may be caught in an optimum of its own
            best = max(out, key=lambda one: one.log_evidence)
            begins.append(list(zip(best.colours, best.clocks, strict=True)))
        for _ in range(_PASSES):  # what is off the path changes what the path is
            off = fits.z[b] - z
            both = [_fitted(problem, pieces[j], j, [one[j] for one in begins], off) for j in range(problem.channels)]
            begins = [both]
            grams, logs = zip(*(_gram_of(problem, *one) for one in zip(pieces, both, strict=True)), strict=True)
            occam = sum(colour.occam + clock.occam for colour, clock in both)
            one = correlated(problem, fits, b, np.stack(grams), np.array(logs), number, occam, priors)
            z = one.z
        out.append(_told(problem, one, fits.z[b], pieces, both))
    return out


def _pieces(
    problem: Problem, fits: Fits, errors: Sequence[np.ndarray], weight: Sequence[np.ndarray], b: int, j: int
) -> list[_Piece]:
    times = [r.times[: len(w)] for r, w in zip(problem.rows, weight, strict=True)]
    speeds = rates([p.readings[b, :, j] for p in fits.predictions], times)
    out = []
    for k, x in enumerate(errors):
        w = weight[k][:, j]
        slopes = np.where(w > 0, fits.predictions[k].slopes[b, :, :, j], 0.0)
        columns = np.concatenate([x[None], slopes])
        out.append(_Piece(columns, speeds[k], w, times[k]))
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
    pieces = [_Piece(x, rate, w, t) for x, rate, w, t in zip(columns, rates(shown, times), weight, times, strict=True)]
    return [_cleared(one, both)[0].T for one in pieces]


def _fitted(
    problem: Problem, pieces: Sequence[_Piece], j: int, begins: Sequence[tuple[Colour, Colour]],
    off: Float[np.ndarray, " z"],
) -> tuple[Colour, Colour]:  # fmt: skip
    """The likeliest error of the sensor and of its clock, each found in turn from the better one of some beginnings,
    then together; sizes are against the white noise, and all unknowns `off` what the columns were taken at."""
    known = problem.noise[j]
    some = [one.middle(np.append(1.0, off[problem.local(k)])) for k, one in enumerate(pieces)]
    grid = grid_of([one.times for one in pieces], _DAMPINGS, _TIMES)
    largest = REMAINDER * float(np.nanstd(np.concatenate([r.readings[:, j] for r in problem.rows])))
    both = list(begins[0])
    if len(begins) > 1:  # filled up to the grid's number of points, whose program is compiled already
        shapes = np.resize([[_shape(one) for one in pair] for pair in begins], (len(grid) + 1, 2, 3))
        both = list(begins[int(np.argmax(_values(some, shapes, known, largest)[: len(begins)]))])
    for turn in range(_TURNS):
        searched = 1 - turn % 2
        tried = np.append(grid, [_shape(both[searched])], axis=0)
        shapes = np.repeat([[_shape(one) for one in both]], len(tried), axis=0)
        shapes[:, searched] = tried
        both[searched] = chosen(tried, _values(some, shapes, known, largest))
    best = np.array([_shape(one) for one in both])
    for steps in _NEARBY * np.array(_FINER)[:, None, None, None]:
        shapes = np.append(best[None], best * np.exp(steps), axis=0)
        best = shapes[int(np.argmax(_values(some, shapes, known, largest)))]
    names = ("ratio", "frequency", "damping")
    sensor, clock = (replace(one, **dict(zip(names, map(float, shape), strict=True)))
                     for one, shape in zip(both, best, strict=True))  # fmt: skip
    return sensor, clock


def _values(pieces: Sequence[_Piece], shapes: Float[np.ndarray, "point both shape"], known: float, largest: float):
    """Log likelihoods of several shapes of both errors, whose innovations may have heavy tails: clocks leap."""
    places, logs, parts = tuple(jnp.asarray(part) for part in np.moveaxis(shapes, 2, 0)), np.zeros(len(shapes)), []
    for one in pieces:
        found, log = _on_grid(filled(one.columns), *one.rows, places)
        parts.append(np.asarray(found)[:, : len(one.times), 0][:, one.weight > 0])
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


def _gram_of(problem: Problem, pieces: Sequence[_Piece], both: Sequence[Colour]) -> tuple[np.ndarray, float]:
    """Gram matrix of one channel's whitened columns, all recordings together, and the log determinants."""
    full, total = np.zeros((1 + problem.size, 1 + problem.size)), 0.0
    for k, one in enumerate(pieces):
        place = np.concatenate([[0], 1 + problem.local(k)])
        series, log = _cleared(one, both)
        full[np.ix_(place, place)] += series.T @ series
        total += log
    return full, total


def _told(
    problem: Problem, one: Estimate, begin: np.ndarray, pieces: Sequence[Sequence[_Piece]],
    both: Sequence[tuple[Colour, Colour]],
) -> Estimate:  # fmt: skip
    """With what heavier tails gain, and how far from white the scores are that are left."""
    errors, scores = [], []
    for k in range(len(problem.rows)):
        column = np.concatenate([[1.0], (begin - one.z)[problem.local(k)]])
        series = [_cleared(piece[k], shape)[0] / noise
                  for piece, shape, noise in zip(pieces, both, one.noise, strict=True)]  # fmt: skip
        left = [np.where(piece[k].weight > 0, x @ column, np.nan) for piece, x in zip(pieces, series, strict=True)]
        errors.append(np.stack(left, axis=1))
        scores.append(sum((x @ column)[:, None] * x[:, 1 + problem.state :] for x in series))
    value = one.log_evidence + law_gain(problem, one.combination, np.concatenate(errors))
    colours, clocks = zip(*both, strict=True)
    inflation = variance_inflation(np.concatenate(scores))
    return replace(one, kind="clock", log_evidence=value, colours=colours, clocks=clocks, inflation=inflation)


def _cleared(one: _Piece, both: Sequence[Colour]) -> tuple[Float[np.ndarray, "row column"], float]:
    """Whitened columns in units of the white sd, and the log determinant that the whitening leaves."""
    series, log = _whitened(filled(one.columns), *one.rows, _shapes(both))
    return np.asarray(series)[: len(one.times)], float(log)
