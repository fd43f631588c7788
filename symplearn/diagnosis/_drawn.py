"""Where motions may begin: starts drawn from what is known of them, and about those that follow the first rows."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from ._calibrate import Fits, Priors, normal_equations, weights
from ._problem import Problem
from ._sizes import is_read, sizes_of_motion

# How many are drawn, and how far they are spread: where nothing is known, and about what was fitted.
_DRAWN = 1024
_SPREADS, _ABOUT = (1e-3, 0.1, 1.0, 10.0), (0.5, 1.0, 2.0)
# Beyond these sizes of a component of the phase point spreads count in that size.
_SMALL, _BIG = 1e-3, 1e2
# What is not known is within this many times the motion's size.
_WIDE = 10.0
# Directions flatter than this share of the steepest are open for good, or round-off: nothing is drawn along them.
_FLAT = 1e-12


def scattered(problem: Problem, priors: Priors) -> Float[np.ndarray, "lane z"]:
    """Prior means with initial states drawn from their priors, or about them where nothing is known."""
    rng = np.random.default_rng(0)
    z = np.tile(priors.mean, (_DRAWN, 1))
    spread = np.resize(_SPREADS, _DRAWN)
    noise = rng.normal(size=(_DRAWN, problem.head))
    given = np.tile(np.where(np.isfinite(problem.initial.sd), problem.initial.sd, 0.0), len(problem.rows))
    own = _sizes(problem, priors)
    # Every other round of spreads counts in the motion's own sizes, which may differ by far; else in one, where spreads
    # of all sizes reach it.
    rounds = np.arange(_DRAWN) // len(_SPREADS) % 2 == 1
    size = np.where(rounds[:, None] & np.isfinite(own), own, _unit_sizes(own))
    z[:, : problem.head] += np.where(_unknown(problem), noise * size * spread[:, None], given * noise)
    return z


def within_the_motion(problem: Problem, priors: Priors) -> Priors:
    """The same with unknown initial states not far beyond the motion's own size: a few rows leave open what is not
    read, and somewhere far off there is always a place from which they come out as well.

    A coordinate that is read needs none, and one that is not may swing about a place away from zero. Where all are
    read, nothing is changed.
    """
    size = _sizes(problem, priors)
    read = np.concatenate([is_read(problem, priors.mean, r) for r in range(len(problem.rows))])
    is_place = np.arange(problem.head) % problem.state < problem.equations.width
    if not (_unknown(problem) & is_place & ~read).any():
        return priors
    size = np.where(is_place, np.maximum(size, _unit_sizes(size)), size)
    held = np.flatnonzero(_unknown(problem) & np.isfinite(size) & ~(is_place & read))
    precision = priors.precision.copy()
    precision[held] = (_WIDE * size[held]) ** -2.0
    return replace(priors, precision=precision)


def around(
    problem: Problem,
    fits: Fits,
    lanes: Int[np.ndarray, " some"],
    priors: Priors,
    rows: Sequence[int],
    number: int = _DRAWN,
) -> Float[np.ndarray, "lane z"]:
    """Draws about some fitted lanes of one combination, as far off as their rows and priors leave open: of Laplace's
    normal density, half as wide, as wide, and twice as wide."""
    rng, centres, combination = np.random.default_rng(1), np.resize(lanes, number), fits.combinations[lanes[0]]
    active = problem.active(combination)
    precision = priors.precision_of(problem, combination)
    open_ended = np.flatnonzero(_unknown(problem))
    # Where nothing is known, the motion's own size.
    precision[open_ended] += _unit_sizes(_sizes(problem, priors))[open_ended] ** -2.0
    with np.errstate(all="ignore"):  # a lane that ran away
        matrix = normal_equations(problem, fits, weights(problem, rows))[0]
    steps = np.zeros((number, problem.size))
    for lane in lanes:
        own, told = centres == lane, matrix[lane][np.ix_(active, active)]
        root = _root(np.diag(precision[active]) + (told if np.isfinite(told).all() else 0.0))
        steps[np.ix_(own, active)] = rng.normal(size=(own.sum(), len(root))) @ root.T
    lower, upper = priors.bounds_of(problem, combination)
    spread = rng.choice(_ABOUT, number)[:, None]
    return np.clip(fits.z[centres] + spread * steps, lower, upper)


def _root(precision: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """A root of the covariance that belongs to a precision matrix."""
    scale = np.sqrt(np.where(np.diagonal(precision) > 0, np.diagonal(precision), 1.0))
    values, vectors = np.linalg.eigh(precision / np.outer(scale, scale))
    steep = values > _FLAT * values[-1]
    return vectors * np.where(steep, 1 / np.sqrt(np.where(steep, values, 1.0)), 0.0) / scale[:, None]


def _unknown(problem: Problem) -> np.ndarray:
    """Which initial values nothing is known of, all recordings together."""
    return np.tile(np.isinf(problem.initial.sd), len(problem.rows))


def _sizes(problem: Problem, priors: Priors) -> Float[np.ndarray, " head"]:
    """The motion's own sizes, all recordings together; NaN where they do not tell."""
    return np.concatenate([sizes_of_motion(problem, priors.mean, r) for r in range(len(problem.rows))])


@np.errstate(invalid="ignore")
def _unit_sizes(own: Float[np.ndarray, " head"]) -> Float[np.ndarray, " head"]:
    """What a start is counted in: one, where spreads of all sizes reach it; else the size of the motion."""
    return np.where((own < _SMALL) | (own > _BIG), own, 1.0)
