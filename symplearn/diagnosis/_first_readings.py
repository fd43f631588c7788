"""Starts that read what was read first.

Starts are drawn about zero where nothing is known of them. A motion far from there, as that of a population which is
simulated by its logarithm, is reached by none where what is far off runs away within a few rows.
"""

import jax
import numpy as np
from jaxtyping import Array, Float

from .._augmented_system import Simulated
from ._along import at_row, readings
from ._problem import Problem
from ._sizes import variation

# Steps of Levenberg and Marquardt, and what their damping is divided and multiplied by.
_STEPS, _EASED, _TIGHTENED = 30, 5.0, 4.0


@np.errstate(all="ignore")  # what is not finite stays where it is
def on_first_readings(problem: Problem, lanes: Float[np.ndarray, "lane z"]) -> Float[np.ndarray, "lane z"]:
    """The same with what is unknown of initial states moved to where every column reads what was read of it first."""
    lanes = lanes.copy()
    for r in range(len(problem.rows)):
        begin = slice(r * problem.state, (r + 1) * problem.state)
        lanes[:, begin] = _solved(problem, r, lanes, lanes[:, begin])
    return lanes


def _solved(
    problem: Problem, r: int, lanes: Float[np.ndarray, "lane z"], x: Float[np.ndarray, "lane state"]
) -> Float[np.ndarray, "lane state"]:
    """States that read the first readings, by least squares of all lanes side by side."""
    first, vary = _first(problem, r), variation(problem, r)[0]
    some = np.flatnonzero(np.isfinite(first) & np.isfinite(vary))
    unknown = np.isinf(problem.initial.sd)

    def missed(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        error = ((first - at_row(problem, readings, r, 0, lanes[0], x)) / vary)[:, some]
        square = (error**2).sum(1)
        return np.where(np.isfinite(error), error, 0.0), np.where(np.isfinite(square), square, np.inf)

    damping, (error, square) = np.ones(len(x)), missed(x)
    for _ in range(_STEPS):
        slopes = unknown * (at_row(problem, _slopes, r, 0, lanes[0], x) / vary[:, None])[:, some]
        tried = x + _step(np.where(np.isfinite(slopes), slopes, 0.0), error, damping)
        its_error, its_square = missed(tried)
        better = its_square < square
        x, error = np.where(better[:, None], tried, x), np.where(better[:, None], its_error, error)
        square = np.where(better, its_square, square)
        damping = np.where(better, damping / _EASED, damping * _TIGHTENED)
    return x


def _step(
    slopes: Float[np.ndarray, "lane channel state"],
    error: Float[np.ndarray, "lane channel"],
    damping: Float[np.ndarray, " lane"],
) -> Float[np.ndarray, "lane state"]:
    """A damped step of least squares; none in what moves no reading."""
    matrix = np.einsum("lci,lcj->lij", slopes, slopes)
    own = np.einsum("lii->li", matrix)
    matrix[:, *np.diag_indices(matrix.shape[1])] += np.where(own > 0, damping[:, None] * own, 1.0)
    return np.linalg.solve(matrix, np.einsum("lci,lc->li", slopes, error)[..., None])[..., 0]


def _first(problem: Problem, r: int) -> Float[np.ndarray, " channel"]:
    """What was read first of every channel, NaN where nothing was."""
    read = problem.rows[r].readings[: problem.rows[r].fitted]
    return read[np.isfinite(read).argmax(0), np.arange(read.shape[1])]


def _slopes(system: Simulated, x: Array, u: Array, t: Array) -> Array:
    """What readings change by with every component of a phase point."""
    return jax.jacfwd(lambda x: readings(system, x, u, t))(x)
