"""Where the fits begin: initial states found in a short window, from many starts."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from ._along import along, along_all, force, readings, velocity
from ._calibrate import Fits, Priors, calibrate, residuals, weights
from ._drawn import around, scattered, within_the_motion
from ._missed import share_missed
from ._motion import rms
from ._problem import Problem
from ._trajectory import Predictions, Stepper

# Starts tried over a few rows, and those of them that are followed on.
_TRIED, _STARTS = 64, 16
# Rows of the first windows, at least so many.
_SHORT = (8, 14)
# Shares of the rows in the windows after them.
_FIRST = (0.02, 0.04, 0.08)
# Where nothing is known: this many times the size of what was found.
_WIDE = 10.0
# Starts that differ by less than this share of their size are one; a size that few of them exceed.
_ALIKE, _LARGE = 0.05, 0.9
# Starts are tried for lying apart that are behind the best by so many nats at most.
_HOPELESS = 15.0
# The share of what readings vary by that first fits miss a few rows by where they have gone astray.
_ASTRAY = 0.3
# Relative round-off of forces a whole turn on.
_ROUND_OFF = 1e-9


def priors_without_effects(problem: Problem) -> Priors:
    """Priors of calibrated values and initial states; the effects have no scale yet."""
    c, size = problem.calibrated, problem.size
    mean, precision = np.zeros(size), np.zeros(size)
    mean[: problem.head] = np.tile(problem.initial.mean, len(problem.rows))
    with np.errstate(divide="ignore"):
        inverse = np.where(problem.initial.sd > 0, problem.initial.sd, np.inf) ** -2.0
        precision[: problem.head] = np.tile(inverse, len(problem.rows))
        part = slice(problem.head, problem.head + c.size)
        # A flat prior is a very wide one, so that no combination gains by losing sight of a parameter.
        wide = np.where(c.mean != 0, _WIDE * np.abs(c.mean), np.inf)
        mean[part], precision[part] = c.mean, np.where(np.isinf(c.sd), wide, c.sd) ** -2.0
    size = problem.equations.size
    wide = np.full(size, np.inf)
    return Priors(mean, precision, np.zeros(size), wide, -wide, wide, np.full((problem.equations.declared, 2), np.inf))


def with_states(problem: Problem, priors: Priors, paths: Sequence[Float[np.ndarray, "_ state"]]) -> Priors:
    """Very wide priors of unknown initial states, as large as the motion along given paths asks for."""
    precision = priors.precision.copy()
    size = np.array([rms(column) for column in np.concatenate(paths).T])
    unknown = np.tile(np.isinf(problem.initial.sd), len(problem.rows))
    precision[: problem.head][unknown] = (_WIDE * np.tile(size, len(problem.rows))[unknown]) ** -2.0
    return replace(priors, precision=precision, sizes=np.where(np.isinf(problem.initial.sd), size, np.inf))


def windows(rows: Sequence[int], fractions: Sequence[float], least: int) -> list[list[int]]:
    """Numbers of rows of every recording for growing windows."""
    return [[max(min(least, n), round(n * fraction)) for n in rows] for fraction in fractions]


def beginning(problem: Problem, rows: Sequence[int]) -> list[int]:
    """Of so many rows of every recording those that the first fits follow in the end."""
    return windows(rows, _FIRST[-1:], _least(problem))[0]


def _least(problem: Problem) -> int:
    return max(_SHORT[-1], 4 * problem.state)


@np.errstate(all="ignore")  # a lane that ran away is told by its cost
def first_fits(stepper: Stepper, priors: Priors, rows: Sequence[int]) -> Fits:
    """Calibrate initial states, then everything, in short windows from many starts; the best lane comes first.

    A few rows first: where not everything is read, or the forces are singular, a trajectory from a start that is far
    off soon has nothing to do with the recording.
    """
    problem = stepper.problem
    short = [[min(n, least) for n in rows] for least in _SHORT]
    short += windows(rows, _FIRST, _least(problem))
    drawn, nearby = scattered(problem, priors), within_the_motion(problem, priors)
    fits = _begun(stepper, drawn, priors, short, False)
    if nearby is not priors:
        # The motion's size is an order of magnitude, and may be wrong: only what had gone astray is begun within it.
        fits = _better(problem, fits, _begun(stepper, drawn, nearby, short, True), short[-1])
    if share_missed(problem, fits.predictions, short[-1]).min() > _ASTRAY:
        moved = on_first_readings(stepper, drawn, priors)
        fits = _better(problem, fits, _begun(stepper, moved, priors, short, False), short[-1])
    value = likelihood(problem, fits, short[-1])
    ranked = np.argsort(value)
    near = int((value[ranked] <= value[ranked[0]] + 2 * _HOPELESS * len(rows)).sum())
    apart, alike = apart_first(fits.z[ranked, : problem.head], near)
    order = ranked[[*apart, *alike]]
    z = np.stack([without_turns(problem, z) for z in fits.z[order]])
    return Fits([()] * _STARTS, z, fits.noise[order], [], fits.cost[order], fits.converged[order])


@np.errstate(all="ignore")  # a lane that ran away
def on_first_readings(
    stepper: Stepper, drawn: Float[np.ndarray, "lane z"], priors: Priors
) -> Float[np.ndarray, "lane z"]:
    """The same with what is unknown of initial states moved to where it reads what was read first. Starts are drawn
    about zero; a motion far from there, as of a population that is simulated by its logarithm, is reached by none where
    what is far off runs away within a few rows."""
    problem = stepper.problem
    first = [int((r.counts > 0).any(1).argmax()) + 1 for r in problem.rows]
    fits = calibrate(stepper, drawn, [()] * len(drawn), _tightened(problem, priors), first)
    unknown = np.flatnonzero(np.tile(np.isinf(problem.initial.sd), len(problem.rows)))
    moved = drawn.copy()
    moved[:, unknown] = fits.z[:, unknown]
    return moved


def _better(problem: Problem, fits: Fits, other: Fits, rows: Sequence[int]) -> Fits:
    """The others where they are clearly likelier."""
    value, its = (likelihood(problem, some, rows).min() for some in (fits, other))
    return other if its < value - 2 * _HOPELESS else fits


def _begun(
    stepper: Stepper, drawn: np.ndarray, priors: Priors, short: Sequence[Sequence[int]], is_careful: bool
) -> Fits:
    """Fits from many starts in one window after the other; with care from elsewhere, too, in the valley of the one
    before."""
    problem, tight = stepper.problem, _tightened(stepper.problem, priors)
    fits = calibrate(stepper, _tried(stepper, drawn, short[0]), [()] * _TRIED, tight, short[0], 40)
    for number, window in enumerate(short[1:], 1):
        before, held = short[number - 1], tight if number < len(_SHORT) + 1 else priors
        starts = [_recombined(problem, fits.z, fits.predictions, before)[:_STARTS]]
        if is_careful and window != before:
            starts.append(_ahead_of(stepper, fits, held, before, window))
        ways = [calibrate(stepper, z, [()] * _STARTS, held, window, 40) for z in starts]
        best = [likelihood(problem, way, window).min() for way in ways]
        fits = ways[-1] if best[-1] < best[0] - 2 * _HOPELESS else ways[0]
    return fits


def _tried(stepper: Stepper, drawn: Float[np.ndarray, "draw z"], rows: Sequence[int]) -> Float[np.ndarray, "lane z"]:
    """Where the first fits begin: half as drawn, half those of many draws that follow a few rows best as they are."""
    predictions = stepper.predict(drawn, [()] * len(drawn), rows)
    half = _TRIED // 2
    side_by_side = [(k,) * len(rows) for k in range(half)]
    orders = [order for order, _ in ranked(stepper.problem, predictions, rows)]
    best = _joined(stepper.problem, drawn, orders, side_by_side)
    return np.concatenate([best, drawn[:half]])


def _ahead_of(
    stepper: Stepper, fits: Fits, priors: Priors, rows: Sequence[int], more: Sequence[int]
) -> Float[np.ndarray, "lane z"]:
    """Of many draws about the fits those that follow more rows best as they are.

    What a few rows leave open is a valley, and fits slide along it to one place. Where a body comes close to a centre,
    how it goes on from there is no longer open, and no fit finds the way back.
    """
    value = likelihood(stepper.problem, fits, rows)
    likely = np.flatnonzero(value <= value.min() + 2 * _HOPELESS * len(rows))
    drawn = around(stepper.problem, fits, likely, priors, rows)
    predictions = stepper.predict(drawn, [()] * len(drawn), more)
    return _recombined(stepper.problem, drawn, predictions, more)[:_STARTS]


def without_turns(problem: Problem, z: Float[np.ndarray, " z"]) -> Float[np.ndarray, " z"]:
    """The same motion with every angle of unknown start that nothing reads begun within half a turn of its prior mean.

    A whole turn changes nothing there, but a spring that is looked for would start wound up.
    """
    z = z.copy()
    for r in range(len(problem.rows)):
        begin = slice(r * problem.state, (r + 1) * problem.state)
        for i in range(problem.equations.dim):
            x = z[begin]
            if not np.isinf(problem.initial.sd[i]) or not np.isfinite(x).all():
                continue
            turns = 2 * np.pi * np.round((x[i] - problem.initial.mean[i]) / (2 * np.pi))
            if turns and _is_unread_angle(problem, r, z, x, i, turns):
                z[begin.start + i] -= turns
    return z


def _is_unread_angle(problem: Problem, r: int, z: np.ndarray, x: np.ndarray, i: int, turns: float) -> bool:
    """Whether whole turns of a coordinate change neither what moves it nor what is read, at a point and off it.

    All at once: of a length of 1e11 m a single turn would be lost in rounding.
    """
    points = np.stack([x, x + 0.3, x - 0.7])
    turned = points - turns * (np.arange(len(x)) == i)
    for what in (force, velocity, readings):
        here, there = (along(problem, what, r, z, (), some) for some in (points, turned))
        if not np.allclose(here, there, rtol=_ROUND_OFF, atol=_ROUND_OFF * np.abs(here).max()):
            return False
    return True


def _recombined(
    problem: Problem, lanes: Float[np.ndarray, "lane z"], predictions: list[Predictions], rows: Sequence[int]
) -> Float[np.ndarray, "lane z"]:
    """Lanes of which the first begins every recording where that one is followed best, the next ones where it is
    followed next best from elsewhere, in one recording or several.

    Of two starts that mirror each other a few rows of one recording tell little; all rows of all of them tell which
    belong together.
    """
    orders, apart = [], []
    for r, (order, misfit) in enumerate(ranked(problem, predictions, rows)):
        near = int((misfit[order] <= misfit[order[0]] + 2 * _HOPELESS).sum())
        first, others = apart_first(lanes[order, r * problem.state : (r + 1) * problem.state], near)
        orders.append(order[[*first, *others]])
        apart.append(len(first))
    return _joined(problem, lanes, orders, _ranks(apart, len(lanes)))


def ranked(
    problem: Problem, predictions: list[Predictions], rows: Sequence[int]
) -> list[tuple[Int[np.ndarray, " lane"], Float[np.ndarray, " lane"]]]:
    """Lanes of every recording, those that follow it best first, and minus twice the profile likelihood of each."""
    weight, out = weights(problem, rows), []
    for x, w in zip(residuals(problem, predictions, weight), weight, strict=True):
        number = (w > 0).sum(0)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            told = number * np.log((w * x**2).sum(1) / np.maximum(number, 1))
        misfit = np.where(number > 0, told, 0.0).sum(1)  # a column that nothing was read of tells nothing
        misfit = np.where(np.isnan(misfit), np.inf, misfit)
        out.append((np.argsort(misfit), misfit))
    return out


def _joined(
    problem: Problem, lanes: np.ndarray, orders: Sequence[np.ndarray], ranks: Sequence[Sequence[int]]
) -> Float[np.ndarray, "lane z"]:
    """Lanes that begin each recording as the one of some rank does. The calibrated values, which were hardly free yet,
    come with the first recording."""
    z = lanes[: len(ranks)].copy()
    for r, order in enumerate(orders):
        own = slice(r * problem.state, (r + 1) * problem.state if r else problem.size)
        z[:, own] = lanes[order[[one[r] for one in ranks]], own]
    return z


def apart_first(x: Float[np.ndarray, "lane state"], near: int) -> tuple[list[int], list[int]]:
    """Which of so many leading states lie apart from all before them, and the others."""
    finite = x[np.isfinite(x).all(1)]
    alike = _ALIKE * np.quantile(np.abs(finite), _LARGE, axis=0) if len(finite) else np.zeros(x.shape[1])
    apart: list[int] = []
    for k, one in enumerate(x[:near]):
        with np.errstate(invalid="ignore"):
            if not (np.abs(one - x[apart]) <= alike).all(1).any():
                apart.append(k)
    return apart, [k for k in range(len(x)) if k not in apart]


def _ranks(numbers: Sequence[int], lanes: int) -> list[tuple[int, ...]]:
    """Which of its starts every recording takes, for so many lanes: those of the smallest sums of ranks; then, where
    all have been taken together, rank by rank."""
    sums = itertools.count()
    out: list[tuple[int, ...]] = []
    while len(out) < min(lanes, math.prod(numbers)):
        out += _summing(numbers, next(sums))
    return [*out, *((k,) * len(numbers) for k in range(len(out), lanes))][:lanes]


def _summing(numbers: Sequence[int], total: int) -> list[tuple[int, ...]]:
    """Ranks, each below its number, of one sum."""
    if len(numbers) == 1:
        return [(total,)] if total < numbers[0] else []
    return [(k, *rest) for k in range(min(total + 1, numbers[0])) for rest in _summing(numbers[1:], total - k)]


def _tightened(problem: Problem, priors: Priors) -> Priors:
    """Calibrated values held near their starting values while the initial states are found."""
    precision = priors.precision.copy()
    part = slice(problem.head, problem.head + problem.calibrated.size)
    mean = np.abs(problem.calibrated.mean)
    scale = 1e-3 * np.where(mean > 0, mean, 1e-6)
    precision[part] = np.maximum(precision[part], scale**-2.0)
    return replace(priors, precision=precision)


def likelihood(problem: Problem, fits: Fits, rows: Sequence[int]) -> np.ndarray:
    """Minus twice the profile likelihood, infinite for a lane that ran away: with an estimated noise the cost alone
    tells nothing."""
    number = sum((r.counts[:n] > 0).sum(0) for r, n in zip(problem.rows, rows, strict=True))
    return np.where(np.isfinite(fits.cost), fits.cost + 2 * (number * np.log(fits.noise)).sum(1), np.inf)


def typical_forces(problem: Problem, z: np.ndarray, paths: Sequence[np.ndarray]) -> np.ndarray:
    """Root mean square of dp/dt along given paths, by momentum."""
    push = along_all(problem, force, z, paths)
    return np.array([rms(column) for column in push[:, : problem.equations.dim].T])
