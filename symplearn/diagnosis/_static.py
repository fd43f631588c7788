"""A remainder in the dynamics that goes with place: a force that is small and static, as of a slightly wrong geometry.

Such a force repeats with the motion, and a part of it is like any stiffness of the vocabulary. It is a random function
of one coordinate: Legendre polynomials over the range of the motion with independent amplitudes of one size, which
enter to first order about the trajectory and are integrated out. Where one side is as the other it has the odd ones
alone, over a range that reaches as far on both. Or it is the fourth or the fifth power alone, with which an expansion
goes on whose first three have a name. It is small: what the other unknowns do not take over has a prior rms of half the
noise at most. A larger one is physics that was left out, and a stiffness has a name.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy.polynomial import Legendre, Polynomial
from scipy.special import logsumexp

from .._effects import POWERS, SHAPES
from ._calibrate import Fits, Priors, residuals, weights
from ._evidence import variance_inflation
from ._problem import Problem
from ._scan import layout
from ._scatter import factor_evidence, law_gain
from ._score import Unit, inverse
from ._trajectory import Stepper
from ._weighed import Estimate, amplitudes_out, correlated, of_any_strength, standardised

_FORCES = (*POWERS, *SHAPES)
# Sizes that are tried: root mean squares that the force leaves in the readings, against their noise.
LARGEST = 0.5
_SIZES = (LARGEST / 4, LARGEST / 2, LARGEST)
# Share of a response that the other unknowns leave, below which it is round-off.
_ROUND_OFF = 1e-9


@dataclass(frozen=True, eq=False)
class _Push:
    """A force of place on one coordinate: what a unit of each shape does to all readings, by recording; Gram matrices
    of [error, slopes, responses] by channel, the last in units of `scale`, the size of each shape's amplitude."""

    responses: Sequence[Float[np.ndarray, "amplitude _ channel"]]
    grams: Float[np.ndarray, "channel column column"]
    scale: float

    @property
    def is_finite(self) -> bool:
        return bool(np.isfinite(self.grams).all())


@np.errstate(all="ignore")  # a lane that diverged is told by its evidence
def weigh_static(stepper: Stepper, fits: Fits, priors: Priors, rows: Sequence[int]) -> list[Estimate]:
    """Estimates beside a small force that goes with one coordinate, about the trajectory fit.

    Which coordinate, how large, and of which shapes: on average over all of each; numbers are those of the likeliest.
    """
    problem, weight = stepper.problem, weights(stepper.problem, rows)
    r, out = residuals(problem, fits.predictions, weight), []
    for b, responses in enumerate(_responses(stepper, fits, rows)):
        pushes, errors = [], [x[b] for x in r]
        for one in responses:
            gram = _gram(problem, fits, b, errors, weight, one)
            unit = _noise_sized(problem, fits, b, gram, weight, priors)
            some = [_Push(one, _scaled(gram, problem, size * unit), size * unit) for size in _SIZES]
            pushes += [push for push in some if push.is_finite]
        tried = of_any_strength(problem, priors, [_weighed(problem, fits, b, one, weight, priors) for one in pushes])
        if tried:
            value = float(logsumexp([one.log_evidence for one in tried]) - np.log(len(responses) * len(_SIZES)))
            best, push = max(zip(tried, pushes, strict=True), key=lambda pair: pair[0].log_evidence)
            out.append(_told(problem, fits, b, replace(best, log_evidence=value), push, errors, weight))
    return out


def _responses(
    stepper: Stepper, fits: Fits, rows: Sequence[int]
) -> list[list[list[Float[np.ndarray, "amplitude _ channel"]]]]:
    """Of all readings to a force of every shape, by lane, coordinate (once for each family of shapes) and recording."""
    problem, number = stepper.problem, stepper.problem.equations.declared
    units = [[Unit(_candidate(problem, k, i), None) for k in range(len(_FORCES))] for i in range(number)]
    laid = [layout(problem, some) for some in units]
    lanes = [(z, c, one) for z, c in zip(fits.z, fits.combinations, strict=True) for one in laid]
    shown = [stepper.carried_each(lanes, n, r) for r, n in enumerate(rows)]
    found = []
    for k in range(len(lanes)):
        q = np.concatenate([by_lane[k][0][:, problem.channels + k % number] for by_lane in shown])
        powers = [by_lane[k][1][:, :, : problem.channels] for by_lane in shown]
        found += [[np.einsum("ak,ktm->atm", shapes, one) for one in powers] for shapes in _families(q)]
    each = len(found) // len(fits.z)
    return [found[a : a + each] for a in range(0, len(found), each)]


def _candidate(problem: Problem, power: int, place: int) -> int:
    """Number of the force that is a power of a coordinate."""
    return next(n for n, one in enumerate(problem.equations.candidates)
                if one.effect is _FORCES[power] and one.place == place)  # fmt: skip


def _families(q: Float[np.ndarray, " row"]) -> list[Float[np.ndarray, "amplitude power"]]:
    """Shapes of a force over the range of a motion: all, those of a force that is odd in the coordinate, and single
    powers that have no name.

    A wrong geometry may keep the symmetry that the right one has; even shapes, which it then lacks, would cost as much
    as the data are sure of that. Of all shapes together those have the most room that a parameter would take over if it
    were a little less known.
    """
    reach, number = float(np.abs(q).max()), np.arange(len(_FORCES))
    odd = np.where(number[:, None] % 2 == 1, _polynomials(-reach, reach), 0.0)
    powers = [np.outer(number == k, (number == k) / (reach or 1.0) ** k) for k in range(len(POWERS), len(_FORCES))]
    return [_polynomials(float(q.min()), float(q.max())), odd, *powers]


def _polynomials(low: float, high: float) -> Float[np.ndarray, "amplitude power"]:
    """Legendre's, orthonormal over a range, as sums of the forces that are powers of the coordinate."""
    signs = np.array([one.sign for one in _FORCES])
    out = np.zeros((len(_FORCES), len(_FORCES)))
    if not low < high < np.inf:
        return out
    for n in range(len(_FORCES)):
        series = Legendre.basis(n, domain=[low, high]).convert(kind=Polynomial, domain=[-1, 1]).coef
        out[n, : len(series)] = np.sqrt(2 * n + 1) * series
    return out * signs


def _gram(
    problem: Problem, fits: Fits, b: int, errors: Sequence[np.ndarray], weight: Sequence[np.ndarray],
    responses: Sequence[np.ndarray],
) -> Float[np.ndarray, "channel column column"]:  # fmt: skip
    """Gram matrices of [error, slopes, responses], by channel."""
    size = 1 + problem.size + len(_FORCES)
    full = np.zeros((problem.channels, size, size))
    for k, (x, w) in enumerate(zip(errors, weight, strict=True)):
        place = np.concatenate([[0], 1 + problem.local(k), 1 + problem.size + np.arange(len(_FORCES))])
        columns = np.concatenate([x[None], fits.predictions[k].slopes[b], responses[k]])
        columns = np.where(w > 0, columns * np.sqrt(w), 0.0)
        full[:, place[:, None], place[None, :]] += np.einsum("atj,btj->jab", columns, columns)
    return full


def _noise_sized(
    problem: Problem, fits: Fits, b: int, gram: np.ndarray, weight: Sequence[np.ndarray], priors: Priors
) -> float:
    """Amplitude of every shape at which they leave as much in the readings as their noise is; infinite where the other
    unknowns take over all of it."""
    total = (gram / (fits.noise[b] ** 2)[:, None, None]).sum(0)
    combination, rest = fits.combinations[b], np.arange(1 + problem.size, len(total))
    free = np.nonzero(problem.active(combination))[0]
    held = total[np.ix_(1 + free, 1 + free)] + np.diag(priors.precision_of(problem, combination)[free])
    cross = total[np.ix_(1 + free, rest)]
    whole = float(np.trace(total[np.ix_(rest, rest)]))
    left = whole - float(np.trace(cross.T @ inverse(held) @ cross))
    return float(np.sqrt(sum((w > 0).sum() for w in weight) / left)) if left > _ROUND_OFF * whole else np.inf


def _scaled(gram: Float[np.ndarray, "channel column column"], problem: Problem, size: float) -> np.ndarray:
    """The same with responses in units of a size."""
    unit = np.where(np.arange(gram.shape[1]) > problem.size, size, 1.0)
    return np.asarray(gram * np.outer(unit, unit))


def _weighed(
    problem: Problem, fits: Fits, b: int, push: _Push, weight: Sequence[np.ndarray], priors: Priors
) -> Estimate:
    every = np.concatenate(weight)
    seen = every > 0
    logs = -np.log(np.where(seen, every, 1.0)).sum(0)
    return correlated(problem, fits, b, push.grams, logs, seen.sum(0), 0.0, priors)


def _told(
    problem: Problem, fits: Fits, b: int, one: Estimate, push: _Push, errors: Sequence[np.ndarray],
    weight: Sequence[np.ndarray],
) -> Estimate:  # fmt: skip
    """With what heavier tails gain and a wrongly given noise owes, and how far from white the scores are that it
    leaves."""
    column = np.concatenate([[1.0], fits.z[b] - one.z])
    follow = amplitudes_out((push.grams / (one.noise**2)[:, None, None]).sum(0), 1 + problem.size)[1]
    amplitudes, left, scores = push.scale * (follow @ column), [], []
    for k, (x, w) in enumerate(zip(errors, weight, strict=True)):
        slopes = fits.predictions[k].slopes[b]
        rest = x + np.einsum("z,ztj->tj", column[1 + problem.local(k)], slopes)
        left.append(rest - np.einsum("a,atj->tj", amplitudes, push.responses[k]))
        by_noise = np.where(w > 0, w * left[k], 0.0) / one.noise**2
        scores.append(np.einsum("ztj,tj->tz", slopes[problem.state :], by_noise))
    value = one.log_evidence + law_gain(problem, one.combination, standardised(left, list(weight), one.noise))
    value += factor_evidence(problem, one.combination, one.noise, (np.concatenate(weight) > 0).sum(0))
    inflation = variance_inflation(np.concatenate(scores))
    return replace(one, kind="static", log_evidence=value, inflation=inflation)
