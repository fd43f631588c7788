"""A remainder in the sensor: readings whose error is white noise plus a stationary process with a memory.

The process is the damped oscillator of second order driven by white noise: rough like Ornstein-Uhlenbeck's at strong
damping, smooth like Matern's of order 3/2 at critical damping, nearly periodic at weak damping. A Kalman filter
for it whitens residuals and sensitivities alike, so one pass gives the Gram matrix from which generalised least
squares and the evidence follow (Jones 1980; Harvey 1989, section 3.4; Sarkka and Solin 2019, section 12.3). Several
such processes may add up, each entering a row by a factor of its own.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag
from jaxtyping import Array, Float

from .._lane_loops import with_lane_loops

# Variance of the coloured error against the white one, its damping, and how many memory lengths are tried.
RATIOS = np.geomspace(0.03, 1e6, 12)
_DAMPINGS = (30.0, 1.001, 0.3, 0.1)
_TIMES = 10
# Gaps that an error lasts at least where the noise is given: a shorter memory would be a noise that is wrongly given.
_LASTING = 3.0
# Rows that the grid is searched with; more would not tell the colour better.
MOST_ROWS = 4000
# Lanes whitened together.
_LANES = 8
# Rows are filled up to a power of two, at least the first of these, or to a multiple of the second, so that recordings
# share compiled functions.
_LEAST, _ROUND = 64, 512
# Gaps that agree to so many digits are the same.
_DIGITS = 9


@dataclass(frozen=True)
class Colour:
    """The coloured error of one channel.

    `ratio` is its variance over the white one, `frequency` in rad/time, `damping` relative to critical. `occam` is
    the log of the grid's mean likelihood relative to its largest: what the choice on the grid costs.
    """

    ratio: float
    frequency: float
    damping: float
    occam: float


def transition(gap: Array, frequency: Array, damping: Array) -> Array:
    """exp of the damped oscillator's matrix over `gap`, without overflow at strong damping. Shape (2, 2)."""
    rate = damping * frequency
    split = frequency * jnp.sqrt(jnp.abs(damping**2 - 1))
    slow, fast = jnp.exp(-(rate - split) * gap), jnp.exp(-(rate + split) * gap)
    fade = jnp.exp(-rate * gap)
    over = damping > 1
    c = jnp.where(over, 0.5 * (slow + fast), fade * jnp.cos(split * gap))
    s = jnp.where(over, 0.5 * (slow - fast), fade * jnp.sin(split * gap)) / split
    return jnp.array([[c + rate * s, s], [-(frequency**2) * s, c - rate * s]])


def remembered(columns, loadings, variances, gaps, shapes, visit, start):
    """Filter the errors' state for every column; `visit(total, e, S)` gathers innovations, `start` its first value.

    `shapes` are ratio, frequency and damping of one process or several, and `loadings` (process, row) the factors by
    which they enter each row; `gaps` are what follows the rows, as `row_gaps` has it.
    """
    ratio, frequency, damping = shapes
    kinds, places = gaps
    number = len(ratio)
    stationary = jnp.diag((ratio[:, None] * jnp.stack([jnp.ones_like(frequency), frequency**2], axis=1)).ravel())

    def step(carry, data):
        M, P, total, logs = carry
        y, h, r, F = data
        H = (h[:, None] * jnp.array([1.0, 0.0])).ravel()
        seen = r > 0
        S = jnp.where(seen, H @ P @ H + r, 1.0)
        e = jnp.where(seen, y - H @ M, 0.0)
        K = jnp.where(seen, P @ H / S, 0.0)
        total, kept = visit(total, e, S)
        M, P = M + K[:, None] * e, P - jnp.outer(K, K) * S
        P = stationary + F @ (P - stationary) @ F.T
        return (F @ M, P, total, logs + jnp.where(seen, jnp.log(S), 0.0)), kept

    # Most gaps are alike, and what takes long are exponentials and cosines.
    each = [jax.vmap(transition, (0, None, None))(kinds, frequency[i], damping[i]) for i in range(number)]
    transitions = jax.vmap(block_diag)(*each)[places]
    begin = (jnp.zeros((2 * number, columns.shape[0])), stationary, start, jnp.zeros(()))
    (_, _, total, logs), kept = jax.lax.scan(step, begin, (columns.T, loadings.T, variances, transitions))
    return total, logs, kept


def squares(columns, loadings, variances, gaps, shapes):
    """Sums of every column's squared whitened innovations, and of the log innovation variances."""

    def visit(total, e, S):
        return total + e**2 / S, None

    return remembered(columns, loadings, variances, gaps, shapes, visit, jnp.zeros(columns.shape[0]))[:2]


def gram(columns, loadings, variances, gaps, shapes):
    """Gram matrix of the whitened columns, and the sum of the log innovation variances."""

    def visit(total, e, S):
        return total + jnp.outer(e, e) / S, None

    size = columns.shape[0]
    return remembered(columns, loadings, variances, gaps, shapes, visit, jnp.zeros((size, size)))[:2]


def whitened(columns, loadings, variances, gaps, shapes):
    """The whitened columns (row, column), and the sum of the log innovation variances."""

    def visit(total, e, S):
        return total, e / jnp.sqrt(S)

    _, logs, kept = remembered(columns, loadings, variances, gaps, shapes, visit, jnp.zeros(()))
    return kept, logs


def _alone(what):
    """One process, of the same size in every row."""

    def done(columns, variances, gaps, ratio, frequency, damping):
        shapes = (ratio[None], frequency[None], damping[None])
        return what(columns, jnp.ones((1, columns.shape[1])), variances, gaps, shapes)

    return done


_series = jax.jit(_alone(whitened))
_lanes = jax.jit(jax.vmap(_alone(whitened), (0, None, None, 0, 0, 0)))
# Lanes are columns here: what they have in common, the filter's gains, is worked out once.
_on_grid = jax.jit(jax.vmap(with_lane_loops(_alone(squares)), (None, None, None, 0, 0, 0)))
_grams = jax.jit(jax.vmap(_alone(gram), (0, None, None, 0, 0, 0)))


def _chunks(lanes: int) -> list[np.ndarray]:
    """Lanes in groups of a fixed size, the last filled up from the first, so that nothing is compiled anew."""
    places = np.arange(-(-lanes // _LANES) * _LANES) % lanes
    return list(places.reshape(-1, _LANES))


def row_variances(weight: np.ndarray) -> np.ndarray:
    """White variance of every row in units of one reading's; 0 marks a missing one."""
    return filled(np.where(weight > 0, 1.0 / np.where(weight > 0, weight, 1.0), 0.0))


def row_gaps(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The different gaps that follow the rows, the first of them none, and which one follows each row."""
    gaps = np.diff(times)
    unit = float(np.median(gaps)) if len(gaps) else 1.0
    shares, places = np.unique(np.append(np.round(gaps / unit, _DIGITS), 0.0), return_inverse=True)
    return _wide(shares * unit, 1 << (len(shares) - 1).bit_length()), filled(places)


def filled(values: np.ndarray) -> np.ndarray:
    """Rows filled up with zeros to a round number: missing ones without gaps, which change nothing."""
    rows = max(values.shape[-1], _LEAST)
    return _wide(values, min(1 << (rows - 1).bit_length(), rows + -rows % _ROUND))


def _wide(values: np.ndarray, width: int) -> np.ndarray:
    """So many entries along the last axis, zeros after those that there are."""
    out = np.zeros((*values.shape[:-1], width), values.dtype)
    out[..., : values.shape[-1]] = values
    return out


def grid_of(
    times: list[np.ndarray], is_given: bool, dampings: Sequence[float] = _DAMPINGS, number: int = _TIMES
) -> np.ndarray:
    """Every (ratio, frequency, damping) that is tried: so many memories from one gap to a quarter of the recording, or
    from a few gaps where the noise is given."""
    gap = min(float(np.median(np.diff(t))) for t in times)
    least = _LASTING * gap if is_given else gap
    memories = np.geomspace(least, max(least, *(t[-1] / 4 - t[0] / 4 for t in times)), number)
    return np.array([(r, max(2 * z, 1.0) / m, z) for z in dampings for m in memories for r in RATIOS])


def fit_colour(
    residuals: list[Float[np.ndarray, "lane _"]],
    weight: list[Float[np.ndarray, " _"]],
    times: list[Float[np.ndarray, " _"]],
    known: float | None,
    largest: float = np.inf,
) -> list[Colour]:
    """The best coloured error of one channel for every lane, all recordings together.

    **Arguments:** - `residuals`: by recording, in the reading's unit. - `known`: the white noise's sd where the file
    gives it; None where it is profiled out. - `largest`: the largest sd of the coloured error; one as large as the
    signal would explain everything and mean nothing.
    """
    grid = grid_of(times, known is not None)
    ratio, frequency, damping = grid.T
    square: Any = 0.0
    logs: Any = 0.0
    number = 0
    for x, w, t in zip(residuals, weight, times, strict=True):
        some = slice(max(0, (len(t) - MOST_ROWS) // 2), max(0, (len(t) - MOST_ROWS) // 2) + MOST_ROWS)
        rows = row_variances(w[some]), row_gaps(t[some])
        parts = [_on_grid(filled(x[c][:, some]), *rows, ratio, frequency, damping) for c in _chunks(len(x))]
        square = square + np.concatenate([np.asarray(a).T for a, _ in parts])[: len(x)]
        logs = logs + np.asarray(parts[0][1])
        number += int((w[some] > 0).sum())
    white = np.maximum(square, 1e-300) / number if known is None else np.full_like(square, known**2)
    value = -0.5 * (number * np.log(white) + square / white + logs)
    value = np.where(np.isfinite(value) & (grid[:, 0] * white <= largest**2), value, -np.inf)
    return [chosen(grid, v) for v in value]


def chosen(grid: np.ndarray, values: np.ndarray) -> Colour:
    best = int(values.argmax())
    if not np.isfinite(values[best]):
        best, occam = 0, -np.inf
    else:
        occam = float(np.log(np.mean(np.exp(values - values[best]))))
    ratio, frequency, damping = (float(x) for x in grid[best])
    return Colour(ratio, frequency, damping, occam)


def whitened_gram(
    columns: Float[np.ndarray, "lane column time"],
    weight: Float[np.ndarray, " time"],
    times: Float[np.ndarray, " time"],
    colours: list[Colour],
) -> tuple[Float[np.ndarray, "lane column column"], Float[np.ndarray, " lane"]]:
    """Gram matrix of the whitened columns in units of the white variance, and the sum of log innovation variances."""
    shape = [np.array([getattr(c, f) for c in colours]) for f in ("ratio", "frequency", "damping")]
    rows = row_variances(weight), row_gaps(times)
    parts = [_grams(filled(columns[c]), *rows, *(s[c] for s in shape)) for c in _chunks(len(columns))]
    total, logs = (np.concatenate([np.asarray(part[i]) for part in parts])[: len(columns)] for i in range(2))
    return total, logs


def whitened_residuals(
    residuals: Float[np.ndarray, "lane time"],
    weight: Float[np.ndarray, " time"],
    times: Float[np.ndarray, " time"],
    colours: list[Colour],
) -> Float[np.ndarray, "lane time"]:
    """Every lane's residuals whitened by its own colour, in units of its white sd."""
    shape = [np.array([getattr(c, f) for c in colours]) for f in ("ratio", "frequency", "damping")]
    rows = row_variances(weight), row_gaps(times)
    parts = [_lanes(filled(residuals[c][:, None]), *rows, *(s[c] for s in shape))[0]
             for c in _chunks(len(residuals))]  # fmt: skip
    return np.concatenate([np.asarray(part)[..., 0] for part in parts])[: len(residuals), : len(times)]


def whitened_series(
    columns: Float[np.ndarray, "column time"],
    weight: Float[np.ndarray, " time"],
    times: Float[np.ndarray, " time"],
    colour: Colour,
) -> Float[np.ndarray, "time column"]:
    """The whitened columns of one lane, row by row, in units of the white sd."""
    shape = colour.ratio, colour.frequency, colour.damping
    return np.asarray(_series(filled(columns), row_variances(weight), row_gaps(times), *shape)[0])[: len(times)]
