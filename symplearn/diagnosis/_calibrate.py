"""Trajectory fits of many combinations at once: Levenberg-Marquardt on readings and priors, in a growing window."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from .._effects import AT_ONCE, Candidate
from ._problem import Combination, Problem
from ._trajectory import Predictions, Stepper

# Variance of a thinned reading against that of a plain mean: the curvature correction's share, (26/24)^2 + 2/24^2.
THINNED = 1.177
# An estimated noise never falls below this share of the readings' spread: readings repeat themselves exactly.
_FLOOR = 1e-9
# Directions flatter than this share of the steepest are taken as flat.
_FLAT = 1e-13
# Of minus twice the log posterior: what a fit may still promise that is as good as done.
_SLIGHT = 1.0
# Starts that are smaller than this share of the motion, as of what rests at first, are as likely as one of that size.
_AT_REST = 0.03
# After this many steps a lane that lies this many nats behind the best is no longer improved, unless that has fallen to
# this share in so many of them.
_PATIENCE, _HOPELESS = 6, 500.0
_NEARER, _LATELY = 0.7, 3
# After this many steps a lane that promises less than this, yet more than a fit that is done may, is in a valley, which
# its steps are bent along: by what readings show at this share of a step, where that turns it by less than this share.
_SLOW, _VALLEY, _PROBE, _TURN = 12, 100.0, 0.1, 0.75


@dataclass(frozen=True)
class Priors:
    """Gaussian priors of z under every combination: initial states and calibrated values, and the values of effects.

    `centres` and `scales` are by entry of the coefficient vector; `unseen` is the prior sd of the start of an unseen
    oscillator, by the coordinate that it hangs on. `lower` and `upper` bound where an effect may be placed, by entry of
    the coefficient vector; `windows`, where given, from when to when every recording is read, in which alone something
    may happen at once; `sizes`, where given, how large the motion is in every direction that a start is unknown in, and
    `forces` those already there, by coordinate.
    """

    mean: Float[np.ndarray, " z"]
    precision: Float[np.ndarray, " z"]
    centres: Float[np.ndarray, " coefficient"]
    scales: Float[np.ndarray, " coefficient"]
    lower: Float[np.ndarray, " coefficient"]
    upper: Float[np.ndarray, " coefficient"]
    unseen: Float[np.ndarray, "coordinate 2"]
    powers: Any = None  # `Powers` of the frictions along the motion
    windows: Float[np.ndarray, "recording 2"] | None = None
    sizes: Float[np.ndarray, " state"] | None = None  # infinite where the start is known
    forces: Float[np.ndarray, " d"] | None = None

    def widths(self, problem: Problem) -> Float[np.ndarray, " parameter"]:
        """Standard deviations of the calibrated parameters; 0 where nothing gives a size."""
        precision = self.precision[problem.head : problem.head + problem.calibrated.parameters]
        return np.where(precision > 0, precision, np.inf) ** -0.5

    def log_size(self, problem: Problem, z: Float[np.ndarray, " z"]) -> float:
        """Log prior density, up to a constant, of how large unknown starts are: of any order of magnitude. A flat one
        would favour what makes a motion larger, as a gain that makes its readings smaller, by the volume that is left
        to its start."""
        if self.sizes is None or not np.isfinite(self.sizes).any():
            return 0.0
        some = np.isfinite(self.sizes)
        starts = z[: problem.head].reshape(len(problem.rows), problem.state)[:, some] / self.sizes[some]
        return float(-0.5 * some.sum() * np.log(_AT_REST**2 + (starts**2).mean(1)).sum())

    def precision_of(self, problem: Problem, combination: Combination) -> Float[np.ndarray, " z"]:
        """Prior precisions with the entries of a combination filled in."""
        values = self.precision.copy()
        for member, place in problem.placed(combination):
            one, starts = problem.candidate(member), problem.starts(member)
            values[place] = self.scales[one.values] ** -2.0
            if (when := self.when(problem, member)) is not None:
                values[place.stop - 1] = even(*when)[1] ** -2.0
            if one.effect.switched:
                values[starts] = self.starts_of(one)[: starts.shape[1]] ** -2.0
        return values

    def starts_of(self, one: Candidate) -> Float[np.ndarray, "2"]:
        """Scales of where what is unseen begins: an oscillator, or a force that fades, which has the first alone."""
        return self.unseen[one.place]

    def mean_of(self, problem: Problem, combination: Combination) -> Float[np.ndarray, " z"]:
        """Prior means with the entries of a combination filled in."""
        return self._filled(problem, combination, self.mean, self.centres, lambda low, high: even(low, high)[0])

    def bounds_of(self, problem: Problem, combination: Combination) -> tuple[np.ndarray, np.ndarray]:
        """Between which values each entry of z stays in a fit."""
        c, free = problem.calibrated, np.full(problem.size, np.inf)
        lower, upper = -free, free.copy()
        lower[problem.head : problem.slots], upper[problem.head : problem.slots] = c.lower, c.upper
        lower = self._filled(problem, combination, lower, self.lower, min)
        return lower, self._filled(problem, combination, upper, self.upper, max)

    def when(self, problem: Problem, member: int) -> tuple[float, float] | None:
        """From when to when the recordings are read that have a member which comes at once; `None` of any other."""
        if self.windows is None or problem.candidate(member).effect not in AT_ONCE:
            return None
        mine = self.windows[list(problem.members[member].recordings)]
        return float(mine[:, 0].min()), float(mine[:, 1].max())

    def _filled(
        self, problem: Problem, combination: Combination, z: np.ndarray, values: np.ndarray,
        at: Callable[[float, float], float],
    ) -> np.ndarray:  # fmt: skip
        z = z.copy()
        for member, place in problem.placed(combination):
            z[place] = values[problem.candidate(member).values]
            if (when := self.when(problem, member)) is not None:
                z[place.stop - 1] = at(*when)
        return z


def even(low: float, high: float) -> tuple[float, float]:
    """Mean and standard deviation of what may be anywhere between."""
    return (low + high) / 2, (high - low) / np.sqrt(12)


@dataclass(frozen=True)
class Fits:
    """Fitted lanes: unknowns, noise of one thinned row with a count of one, predictions, residual sums, success."""

    combinations: list[Combination]
    z: Float[np.ndarray, "lane z"]
    noise: Float[np.ndarray, "lane channel"]
    predictions: list[Predictions]
    cost: Float[np.ndarray, " lane"]  # minus twice the log posterior, up to a constant
    converged: Bool[np.ndarray, " lane"]
    # Nats that one more step promises though the fit has ended, in a kink, where no step could take them.
    unearned: Float[np.ndarray, " lane"] | None = None


def weights(problem: Problem, rows: Sequence[int]) -> list[Float[np.ndarray, "_ channel"]]:
    """Readings averaged in every row, in units of one reading's information; 0 where there is none."""
    out = []
    for r, n in zip(problem.rows, rows, strict=True):
        out.append(weight_of(r.counts[:n]))
    return out


def weight_of(counts: Float[np.ndarray, "_ channel"]) -> Float[np.ndarray, "_ channel"]:
    """The same of rows that average so many readings each."""
    return np.where(counts > 1, counts / THINNED, counts)


def residuals(problem: Problem, predictions: list[Predictions], weight: list[np.ndarray]) -> list[np.ndarray]:
    """Readings minus predictions (lane, time, channel), 0 where nothing was read."""
    out = []
    for rows, p, w in zip(problem.rows, predictions, weight, strict=True):
        seen = w > 0
        out.append(np.where(seen, np.where(seen, rows.readings[: len(w)], 0.0) - p.readings, 0.0))
    return out


def estimate_noise(
    problem: Problem, combinations: Sequence[Combination], r: list[np.ndarray], weight: list[np.ndarray]
) -> np.ndarray:
    """Noise sd of one reading by lane and channel: known where the combination trusts it, else the residuals' rms."""
    with np.errstate(over="ignore", invalid="ignore"):  # a lane that diverged is told by its cost
        square = sum((w * x**2).sum(1) for w, x in zip(weight, r, strict=True))
    number = sum((w > 0).sum(0) for w in weight)
    largest = [np.abs(np.nan_to_num(rows.readings[: rows.fitted])).max(0) for rows in problem.rows]
    # A column of which nothing is read in these rows has residuals of zero, and the least noise.
    floor = _FLOOR * np.maximum(np.max(largest, axis=0), 1e-300)
    estimated = np.maximum(np.sqrt(square / np.maximum(number, 1)), floor)
    known = np.stack([problem.noise_of(c) for c in combinations])
    return np.where(np.isnan(known), estimated, known)


def grow(
    stepper: Stepper,
    start: Float[np.ndarray, "lane z"],
    combinations: Sequence[Combination],
    priors: Priors,
    windows: Sequence[Sequence[int]],
    final: int = 40,
    held: Bool[np.ndarray, " lane"] | None = None,
) -> Fits:
    """Fit in one window after the other, each from the one before, the last to convergence.

    In lanes that are `held` the values of the effects stay as they start until a window holds all rows: an earlier one
    may say nothing of them.
    """
    z, whole = start, [r.fitted for r in stepper.problem.rows]
    for number, rows in enumerate(windows):
        last = number == len(windows) - 1
        free = None if list(rows) == whole else held
        fits = calibrate(stepper, z, combinations, priors, rows, final if last else 12, held=free)
        z = fits.z
    return fits


def calibrate(
    stepper: Stepper,
    start: Float[np.ndarray, "lane z"],
    combinations: Sequence[Combination],
    priors: Priors,
    rows: Sequence[int],
    iterations: int = 40,
    tolerance: float = 1e-3,
    held: Bool[np.ndarray, " lane"] | None = None,
) -> Fits:
    """Levenberg-Marquardt over the first `rows` rows of every recording.

    A lane has converged when an undamped step promises less than `tolerance` of minus twice the log posterior; where
    the steps end before, as they do where none keeps what it promises, about a threshold that passes a reading, less
    than `_SLIGHT` lately: either side of such a kink promises another step. The values of effects do not move in lanes
    that are `held`.
    """
    problem, lanes = stepper.problem, len(start)
    weight = weights(problem, rows)
    precision = np.stack([priors.precision_of(problem, c) for c in combinations])
    mean = np.stack([priors.mean_of(problem, c) for c in combinations])
    bounds = np.stack([priors.bounds_of(problem, c) for c in combinations])
    active = np.stack([problem.active(c) for c in combinations])
    if held is not None:
        active[held, problem.slots :] = False
    fits = _evaluated(stepper, np.array(start, float), list(combinations), rows, weight)
    damping, done, stuck = np.full(lanes, 1e-3), np.zeros(lanes, bool), np.zeros(lanes, bool)
    left = np.full(lanes, np.inf)
    behind, lately = list[Float[np.ndarray, " lane"]](), list[Float[np.ndarray, " lane"]]()
    fits = _costed(problem, fits, weight, precision, mean)
    for count in range(iterations):
        some = np.nonzero(~done)[0]  # lanes that have converged are not stepped again
        if not len(some):
            break
        mine = _chosen(fits, some)
        given = precision[some], mean[some], active[some], bounds[some], damping[some]
        step, promised, inverse = _steps(problem, mine, weight, *given)
        left[some], done[some] = promised, promised < tolerance
        lately = [*lately[1 - _LATELY :], left.copy()]
        if done.all():
            break
        left_over = ~done[some]
        some, mine, step, inverse = some[left_over], _chosen(mine, left_over), step[left_over], inverse[left_over]
        valley = (left[some] > _SLIGHT) & (left[some] < _VALLEY)
        if count >= _SLOW and valley.any():
            step[valley] += _turn(stepper, _chosen(mine, valley), rows, weight, step[valley], inverse[valley])
        moved = np.clip(mine.z + step, bounds[some, 0], bounds[some, 1])
        trial = replace(_evaluated(stepper, moved, mine.combinations, rows, weight), noise=mine.noise)
        trial = _costed(problem, trial, weight, precision[some], mean[some])
        better = trial.cost <= mine.cost
        good = some[better]
        if len(good):
            kept = _chosen(trial, better)
            r = residuals(problem, kept.predictions, weight)
            kept = replace(kept, noise=estimate_noise(problem, kept.combinations, r, weight))
            _put(fits, good, _costed(problem, kept, weight, precision[good], mean[good]))
        damping[some] = np.clip(np.where(better, damping[some] / 10, damping[some] * 5), 1e-9, 1e12)
        stuck |= damping > 1e8
        done |= stuck
        value = fits.cost + 2 * _log_noise(problem, fits.noise, weight)
        behind.append(value - np.min(np.where(np.isnan(value), np.inf, value)))
        if count >= _PATIENCE:
            stuck |= ~done & is_hopeless(behind)
            done |= stuck
    rests = np.min(lately, axis=0, initial=np.inf) < _SLIGHT
    moved = np.nonzero(~(left < tolerance))[0]  # the last step may have led on
    if len(moved):
        given = precision[moved], mean[moved], active[moved], bounds[moved], damping[moved]
        left[moved] = _steps(problem, _chosen(fits, moved), weight, *given)[1]
    unearned = 0.5 * np.maximum(0.0, left - _SLIGHT)
    return replace(fits, converged=(done & ~stuck | rests) & np.isfinite(fits.cost), unearned=unearned)


def is_hopeless(behind: Sequence[Float[np.ndarray, " lane"]]) -> Bool[np.ndarray, " lane"]:
    """Lanes that lie far behind the best and do not come nearer, by how much minus twice the log posterior was larger
    after every step."""
    nearer = behind[-1] < _NEARER * behind[-1 - _LATELY]
    return (behind[-1] > 2 * _HOPELESS) & ~nearer


def _chosen(fits: Fits, lanes: np.ndarray) -> Fits:
    """Some of the lanes."""
    places = np.arange(len(fits.z))[lanes]
    predictions = [Predictions(p.readings[lanes], p.slopes[lanes]) for p in fits.predictions]
    combinations = [fits.combinations[k] for k in places]
    return Fits(combinations, fits.z[lanes], fits.noise[lanes], predictions, fits.cost[lanes], fits.converged[lanes])


def _put(fits: Fits, lanes: np.ndarray, new: Fits) -> None:
    """Write lanes back."""
    fits.z[lanes], fits.noise[lanes], fits.cost[lanes] = new.z, new.noise, new.cost
    for old, one in zip(fits.predictions, new.predictions, strict=True):
        old.readings[lanes], old.slopes[lanes] = one.readings, one.slopes


def _log_noise(problem: Problem, noise: np.ndarray, weight: list[np.ndarray]) -> np.ndarray:
    """Sum over readings of the log noise, by lane."""
    number = sum((w > 0).sum(0) for w in weight)
    return (number * np.log(noise)).sum(1)


def _evaluated(stepper, z, combinations, rows, weight) -> Fits:
    predictions = stepper.predict(z, combinations, rows)
    r = residuals(stepper.problem, predictions, weight)
    noise = estimate_noise(stepper.problem, combinations, r, weight)
    lanes = len(z)
    return Fits(combinations, z, noise, predictions, np.full(lanes, np.inf), np.zeros(lanes, bool))


def _costed(problem, fits: Fits, weight, precision, mean) -> Fits:
    r = residuals(problem, fits.predictions, weight)
    with np.errstate(over="ignore", invalid="ignore"):
        square = sum((w * (x / fits.noise[:, None]) ** 2).sum((1, 2)) for w, x in zip(weight, r, strict=True))
        cost = square + (precision * (fits.z - mean) ** 2).sum(1)
    return replace(fits, cost=np.where(np.isfinite(cost), cost, np.inf))


def normal_equations(
    problem: Problem, fits: Fits, weight: list[np.ndarray]
) -> tuple[Float[np.ndarray, "lane z z"], Float[np.ndarray, "lane z"]]:
    """J'WJ and J'Wr of the readings, all recordings together."""
    lanes = len(fits.z)
    matrix, vector = np.zeros((lanes, problem.size, problem.size)), np.zeros((lanes, problem.size))
    for r, (p, x, w) in enumerate(
        zip(fits.predictions, residuals(problem, fits.predictions, weight), weight, strict=True)
    ):
        root = np.sqrt(w) / fits.noise[:, None]
        scaled = (np.where(w > 0, p.slopes, 0.0) * root[:, None]).reshape(lanes, p.slopes.shape[1], -1)
        place = problem.local(r)
        matrix[:, place[:, None], place[None, :]] += scaled @ scaled.swapaxes(1, 2)
        vector[:, place] += np.einsum("bin,bn->bi", scaled, (x * root).reshape(lanes, -1))
    return matrix, vector


def by_the_noise(
    problem: Problem, fits: Fits, rows: Sequence[int]
) -> tuple[Float[np.ndarray, " reading"], Float[np.ndarray, "z reading"]]:
    """Errors of all readings of a fit of one lane, and their slopes in every unknown, recordings end to end."""
    weight = weights(problem, rows)
    errors, slopes = [], []
    roots = noise_roots(weight, fits)
    for r, (x, root) in enumerate(zip(residuals(problem, fits.predictions, weight), roots, strict=True)):
        own = np.where(root > 0, fits.predictions[r].slopes[0], 0.0) * root
        every = np.zeros((problem.size, root.size))
        every[problem.local(r)] = own.reshape(len(own), -1)
        errors.append((x[0] * root).ravel())
        slopes.append(every)
    return np.concatenate(errors), np.concatenate(slopes, axis=1)


def noise_roots(weight: Sequence[np.ndarray], fits: Fits) -> list[Float[np.ndarray, "_ channel"]]:
    """What a reading is to be multiplied by to be in units of the noise of a fit of one lane; 0 where there is none."""
    return [np.where(w > 0, np.sqrt(w), 0.0) / fits.noise[0] for w in weight]


def _turn(
    stepper: Stepper, fits: Fits, rows: Sequence[int], weight: list[np.ndarray], step: np.ndarray, inverse: np.ndarray
) -> Float[np.ndarray, "lane z"]:
    """What a step has to turn to follow a curved valley: half its geodesic acceleration (Transtrum and Sethna 2012);
    nothing where that is large beside the step."""
    problem, push = stepper.problem, np.zeros_like(step)
    ahead = stepper.predict(fits.z + _PROBE * step, fits.combinations, rows)
    both = zip(residuals(problem, fits.predictions, weight), residuals(problem, ahead, weight), strict=True)
    with np.errstate(all="ignore"):  # a probe may run away
        for r, (here, there) in enumerate(both):
            place, slopes = problem.local(r), fits.predictions[r].slopes
            straight = np.einsum("bztj,bz->btj", slopes, step[:, place])
            bend = 2.0 / _PROBE**2 * (there - here + _PROBE * straight) * weight[r] / fits.noise[:, None] ** 2
            push[:, place] += np.einsum("bztj,btj->bz", slopes, bend)
        turn = np.einsum("bxz,bz->bx", inverse, push)
        unit = np.sqrt(np.maximum(np.diagonal(inverse, axis1=1, axis2=2), 1e-300))
        small = np.linalg.norm(turn / unit, axis=1) < _TURN * np.linalg.norm(step / unit, axis=1)
    return np.where(small[:, None], 0.5 * turn, 0.0)


def _steps(
    problem, fits: Fits, weight, precision, mean, active, bounds, damping
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Damped Gauss-Newton steps, what an undamped one promises to take off the cost, and the damped inverse."""
    with np.errstate(over="ignore", invalid="ignore"):
        matrix, vector = normal_equations(problem, fits, weight)
    vector = vector - precision * (fits.z - mean)
    # What stands at a bound and is pushed against it stays there.
    active = active & ~((fits.z <= bounds[:, 0]) & (vector < 0)) & ~((fits.z >= bounds[:, 1]) & (vector > 0))
    steps, promised = np.zeros_like(fits.z), np.full(len(fits.z), np.inf)
    inverse = np.zeros_like(matrix)
    for b in range(len(steps)):
        a = np.nonzero(active[b])[0]
        square = matrix[b][np.ix_(a, a)] + np.diag(precision[b][a])
        if not (np.isfinite(square).all() and np.isfinite(vector[b]).all()):
            continue
        scale = np.sqrt(np.maximum(np.diag(square), 1e-300))
        values, vectors = np.linalg.eigh(square / np.outer(scale, scale))
        values = np.maximum(values, _FLAT * values.max(initial=0.0))  # none where everything is known
        along = vectors.T @ (vector[b, a] / scale)
        inverse[b][np.ix_(a, a)] = (vectors / (values + damping[b])) @ vectors.T / np.outer(scale, scale)
        steps[b, a] = vectors @ (along / (values + damping[b])) / scale
        promised[b] = float((along**2 / values).sum())
    return steps, promised, inverse
