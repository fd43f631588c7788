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
from jaxtyping import Array, Float

from ._calibrate import Fits, Priors, residuals, weights
from ._coloured import MOST_ROWS, Colour, chosen, filled, gram, grid_of, row_gaps, row_variances, series, squares
from ._evidence import variance_inflation
from ._problem import Problem
from ._scatter import law_gain
from ._weighed import REMAINDER, Estimate, correlated, trusting

# How often sensor and clock are fitted, in turn, each with the other as it is.
_TURNS = 3
# Dampings of the clock's error, and how many memory lengths are tried.
_DAMPINGS, _TIMES = (30.0, 1.001), 5

_squares, _gram, _series = (jax.jit(what) for what in (squares, gram, series))
_on_grid = jax.jit(jax.vmap(squares, (None, None, None, None, 0)))


@dataclass(frozen=True, eq=False)
class _Piece:
    """One channel in one recording: columns [error, slopes], and the factors of both errors, all by row."""

    columns: Float[np.ndarray, "column row"]
    rates: Float[np.ndarray, " row"]
    weight: Float[np.ndarray, " row"]
    times: Float[np.ndarray, " row"]

    def middle(self) -> "_Piece":
        """The rows that the grid is searched with."""
        begin = max(0, (len(self.times) - MOST_ROWS) // 2)
        some = slice(begin, begin + MOST_ROWS)
        return _Piece(self.columns[:1, some], self.rates[some], self.weight[some], self.times[some])

    @cached_property
    def rows(self) -> tuple[Array, Array, Array]:
        """Factors, variances and gaps, as the filter takes them."""
        loadings = np.stack([np.ones_like(self.rates), self.rates])
        return filled(loadings), row_variances(self.weight), row_gaps(self.times)


def weigh_clock(
    problem: Problem, fits: Fits, priors: Priors, rows: Sequence[int], colours: Sequence[Sequence[Colour]]
) -> list[Estimate]:
    """Estimates where every channel's error has a memory and its clock runs ahead and behind, about the trajectory fit.

    `colours` are those of the sensors alone, by lane and channel. None for a combination with a wrongly given noise.
    """
    weight = weights(problem, rows)
    number = sum((w > 0).sum(0) for w in weight)
    out = []
    for b in trusting(problem, fits):
        pieces = [_pieces(problem, fits, b, rows, j) for j in range(problem.channels)]
        both = [_fitted(problem, pieces[j], j, colours[b][j]) for j in range(problem.channels)]
        grams, logs = zip(*(_gram_of(problem, *one) for one in zip(pieces, both, strict=True)), strict=True)
        occam = sum(colour.occam + clock.occam for colour, clock in both)
        one = correlated(problem, fits, b, np.stack(grams), np.array(logs), number, occam, priors)
        out.append(_told(problem, one, fits.z[b], pieces, both))
    return out


@np.errstate(all="ignore")  # a lane that diverged is told by its evidence
def _pieces(problem: Problem, fits: Fits, b: int, rows: Sequence[int], j: int) -> list[_Piece]:
    weight = weights(problem, rows)
    times = [r.times[:n] for r, n in zip(problem.rows, rows, strict=True)]
    rates = [np.gradient(p.readings[b, :, j], t) if len(t) > 1 else np.ones(len(t))
             for p, t in zip(fits.predictions, times, strict=True)]  # fmt: skip
    size = np.sqrt(np.mean(np.concatenate(rates) ** 2))
    out = []
    for k, x in enumerate(residuals(problem, fits.predictions, weight)):
        w = weight[k][:, j]
        slopes = np.where(w > 0, fits.predictions[k].slopes[b, :, :, j], 0.0)
        columns = np.concatenate([x[b, None, :, j], slopes])
        out.append(_Piece(columns, np.nan_to_num(rates[k] / (size or 1.0)), w, times[k]))
    return out


def _fitted(problem: Problem, pieces: Sequence[_Piece], j: int, colour: Colour) -> tuple[Colour, Colour]:
    """The likeliest error of the sensor and of its clock, each found in turn; sizes are against the white noise."""
    known, some = problem.noise[j], [one.middle() for one in pieces]
    grid = grid_of([one.times for one in pieces], _DAMPINGS, _TIMES)
    largest = REMAINDER * float(np.nanstd(np.concatenate([r.readings[:, j] for r in problem.rows])))
    both = [colour, replace(colour, ratio=0.0)]
    for turn in range(_TURNS):
        searched = 1 - turn % 2
        tried = np.append(grid, [_shape(both[searched])], axis=0)
        both[searched] = chosen(tried, _values(some, both, searched, tried, known, largest))
    return both[0], both[1]


def _values(pieces: Sequence[_Piece], both: Sequence[Colour], searched: int, grid, known: float, largest: float):
    """Log likelihoods of the errors with one of the two colours anywhere on the grid."""
    shapes = [np.repeat([_shape(one)], len(grid), axis=0) for one in both]
    shapes[searched] = grid
    places = tuple(jnp.asarray(part) for part in np.moveaxis(np.stack(shapes, axis=1), 2, 0))
    square, logs = np.zeros(len(grid)), np.zeros(len(grid))
    number = sum(int((one.weight > 0).sum()) for one in pieces)
    for one in pieces:
        parts = _on_grid(filled(one.columns), *one.rows, places)
        square, logs = square + np.asarray(parts[0]), logs + np.asarray(parts[1])
    white = np.maximum(square, 1e-300) / number if np.isnan(known) else np.full(len(grid), known**2)
    value = -0.5 * (number * np.log(white) + square / white + logs)
    return np.where(np.isfinite(value) & (grid[:, 0] * white <= largest**2), value, -np.inf)


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
        mine, log = _gram(filled(one.columns), *one.rows, _shapes(both))
        full[np.ix_(place, place)] += np.asarray(mine)
        total += float(log)
    return full, total


def _told(
    problem: Problem, one: Estimate, begin: np.ndarray, pieces: Sequence[Sequence[_Piece]],
    both: Sequence[tuple[Colour, Colour]],
) -> Estimate:  # fmt: skip
    """With what heavier tails gain, and how far from white the scores are that are left."""
    errors, scores = [], []
    for k in range(len(problem.rows)):
        column = np.concatenate([[1.0], (begin - one.z)[problem.local(k)]])
        whitened = [_whitened(piece[k], shape, noise)
                    for piece, shape, noise in zip(pieces, both, one.noise, strict=True)]  # fmt: skip
        left = [np.where(piece[k].weight > 0, x @ column, np.nan) for piece, x in zip(pieces, whitened, strict=True)]
        errors.append(np.stack(left, axis=1))
        scores.append(sum((x @ column)[:, None] * x[:, 1 + problem.state :] for x in whitened))
    value = one.log_evidence + law_gain(problem, one.combination, np.concatenate(errors))
    colours, clocks = zip(*both, strict=True)
    inflation = variance_inflation(np.concatenate(scores))
    return replace(one, kind="clock", log_evidence=value, colours=colours, clocks=clocks, inflation=inflation)


def _whitened(one: _Piece, both: Sequence[Colour], noise: float) -> Float[np.ndarray, "row column"]:
    return np.asarray(_series(filled(one.columns), *one.rows, _shapes(both)))[: len(one.times)] / noise
