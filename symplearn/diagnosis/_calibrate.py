"""Trajectory fits of many combinations at once: Levenberg-Marquardt on readings and priors, in a growing window."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from ._problem import Combination, Problem
from ._trajectory import Predictions, Stepper

# Variance of a thinned reading against that of a plain mean: the curvature correction's share, (26/24)^2 + 2/24^2.
THINNED = 1.177
# An estimated noise never falls below this share of the readings' spread: readings repeat themselves exactly.
_FLOOR = 1e-9
# Directions flatter than this share of the steepest are taken as flat.
_FLAT = 1e-13
# After this many steps a lane that lies this many nats behind the best is no longer improved.
_PATIENCE, _HOPELESS = 6, 500.0


@dataclass(frozen=True)
class Priors:
    """Gaussian priors of z under every combination: calibrated values and initial states; effects by `scales`."""

    mean: Float[np.ndarray, " z"]
    precision: Float[np.ndarray, " z"]
    scales: Float[np.ndarray, " candidate"]

    def precision_of(self, problem: Problem, combination: Combination) -> Float[np.ndarray, " z"]:
        """Prior precisions with the slots' entries filled in."""
        values = self.precision.copy()
        first = problem.head + problem.calibrated.size
        for slot, candidate in enumerate(combination):
            values[first + slot] = self.scales[candidate] ** -2.0
        return values


@dataclass(frozen=True)
class Fits:
    """Fitted lanes: unknowns, noise of one thinned row with a count of one, predictions, residual sums, success."""

    combinations: list[Combination]
    z: Float[np.ndarray, "lane z"]
    noise: Float[np.ndarray, "lane channel"]
    predictions: list[Predictions]
    cost: Float[np.ndarray, " lane"]  # minus twice the log posterior, up to a constant
    converged: Bool[np.ndarray, " lane"]


def weights(problem: Problem, rows: Sequence[int]) -> list[Float[np.ndarray, "time channel"]]:
    """Readings averaged in every row, in units of one reading's information; 0 where there is none."""
    out = []
    for r, n in zip(problem.rows, rows, strict=True):
        counts = r.counts[:n]
        out.append(np.where(counts > 1, counts / THINNED, counts))
    return out


def residuals(problem: Problem, predictions: list[Predictions], weight: list[np.ndarray]) -> list[np.ndarray]:
    """Readings minus predictions (lane, time, channel), 0 where nothing was read."""
    out = []
    for rows, p, w in zip(problem.rows, predictions, weight, strict=True):
        seen = w > 0
        out.append(np.where(seen, np.where(seen, rows.readings[: len(w)], 0.0) - p.readings, 0.0))
    return out


def estimate_noise(problem: Problem, r: list[np.ndarray], weight: list[np.ndarray]) -> np.ndarray:
    """Noise sd of one reading by lane and channel: known where the file knows it, else the residuals' rms."""
    with np.errstate(over="ignore", invalid="ignore"):  # a lane that diverged is told by its cost
        square = sum((w * x**2).sum(1) for w, x in zip(weight, r, strict=True))
    number = sum((w > 0).sum(0) for w in weight)
    spread = np.concatenate([np.where(w > 0, rows.readings[: len(w)], np.nan)
                             for w, rows in zip(weight, problem.rows, strict=True)])  # fmt: skip
    floor = _FLOOR * np.maximum(np.nanmax(np.abs(spread), axis=0), 1e-300)
    estimated = np.maximum(np.sqrt(square / np.maximum(number, 1)), floor)
    return np.where(np.isnan(problem.noise), estimated, problem.noise)


def grow(
    stepper: Stepper,
    start: Float[np.ndarray, "lane z"],
    combinations: Sequence[Combination],
    priors: Priors,
    windows: Sequence[Sequence[int]],
    final: int = 40,
) -> Fits:
    """Fit in one window after the other, each from the one before, the last to convergence."""
    z = start
    for number, rows in enumerate(windows):
        last = number == len(windows) - 1
        fits = calibrate(stepper, z, combinations, priors, rows, final if last else 12)
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
) -> Fits:
    """Levenberg-Marquardt over the first `rows` rows of every recording.

    A lane has converged when an undamped step promises less than `tolerance` of minus twice the log posterior.
    """
    problem, lanes = stepper.problem, len(start)
    weight = weights(problem, rows)
    precision = np.stack([priors.precision_of(problem, c) for c in combinations])
    active = np.stack([problem.active(c) for c in combinations])
    fits = _evaluated(stepper, np.array(start, float), list(combinations), rows, weight)
    damping, done, stuck = np.full(lanes, 1e-3), np.zeros(lanes, bool), np.zeros(lanes, bool)
    fits = _costed(problem, fits, weight, precision, priors.mean)
    for count in range(iterations):
        step, promised = _steps(problem, fits, weight, precision, priors.mean, active, damping)
        done |= promised < tolerance
        if done.all():
            break
        trial_z = _bounded(problem, fits.z + np.where(done[:, None], 0.0, step))
        trial = _evaluated(stepper, trial_z, fits.combinations, rows, weight)
        trial = _costed(problem, replace(trial, noise=fits.noise), weight, precision, priors.mean)
        better = trial.cost <= fits.cost
        merged = _merged(fits, trial, better)
        merged = replace(merged, noise=estimate_noise(problem, residuals(problem, merged.predictions, weight), weight))
        fits = _costed(problem, merged, weight, precision, priors.mean)
        damping = np.clip(np.where(better, damping / 10, damping * 5), 1e-9, 1e12)
        stuck |= damping > 1e8
        done |= stuck
        if count >= _PATIENCE:
            value = fits.cost + 2 * _log_noise(problem, fits.noise, weight)
            best = np.min(np.where(np.isnan(value), np.inf, value))
            stuck |= ~done & (value > best + 2 * _HOPELESS)
            done |= stuck
    return replace(fits, converged=done & ~stuck & np.isfinite(fits.cost))


def _log_noise(problem: Problem, noise: np.ndarray, weight: list[np.ndarray]) -> np.ndarray:
    """Sum over readings of the log noise, by lane."""
    number = sum((w > 0).sum(0) for w in weight)
    return (number * np.log(noise)).sum(1)


def _evaluated(stepper, z, combinations, rows, weight) -> Fits:
    predictions = stepper.predict(z, combinations, rows)
    noise = estimate_noise(stepper.problem, residuals(stepper.problem, predictions, weight), weight)
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


def _steps(problem, fits: Fits, weight, precision, mean, active, damping) -> tuple[np.ndarray, np.ndarray]:
    """Damped Gauss-Newton steps, and what an undamped one promises to take off the cost."""
    with np.errstate(over="ignore", invalid="ignore"):
        matrix, vector = normal_equations(problem, fits, weight)
    vector = vector - precision * (fits.z - mean)
    steps, promised = np.zeros_like(fits.z), np.full(len(fits.z), np.inf)
    for b in range(len(steps)):
        a = np.nonzero(active[b])[0]
        square = matrix[b][np.ix_(a, a)] + np.diag(precision[b][a])
        if not (np.isfinite(square).all() and np.isfinite(vector[b]).all()):
            continue
        scale = np.sqrt(np.maximum(np.diag(square), 1e-300))
        values, vectors = np.linalg.eigh(square / np.outer(scale, scale))
        values = np.maximum(values, _FLAT * values[-1])
        along = vectors.T @ (vector[b, a] / scale)
        steps[b, a] = vectors @ (along / (values + damping[b])) / scale
        promised[b] = float((along**2 / values).sum())
    return steps, promised


def _bounded(problem: Problem, z: np.ndarray) -> np.ndarray:
    part = slice(problem.head, problem.head + problem.calibrated.size)
    z[:, part] = np.clip(z[:, part], problem.calibrated.lower, problem.calibrated.upper)
    return z


def _merged(old: Fits, new: Fits, better: np.ndarray) -> Fits:
    def choose(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.where(better.reshape(-1, *[1] * (a.ndim - 1)), b, a)

    predictions = [
        Predictions(choose(o.readings, n.readings), choose(o.slopes, n.slopes))
        for o, n in zip(old.predictions, new.predictions, strict=True)
    ]
    return replace(old, z=choose(old.z, new.z), predictions=predictions, cost=choose(old.cost, new.cost))
