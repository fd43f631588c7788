"""How readings scatter: noise that is heavier-tailed than a Gaussian, noise that is wrongly given, and outliers."""

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import gammaln

from .._effects import NOISE, OUTLIERS
from .._normal import log_density
from ._problem import Combination, Problem

# Degrees of freedom of the heavy-tailed noise that is weighed beside the Gaussian.
_FREEDOM = 5.0
# Beyond this mean square of standardised errors a fit has gone astray: its likelihood is next to nothing by any law.
_ASTRAY = 1e6
# Prior of a wrongly given noise: standard deviation of the logarithm of its factor.
_FACTOR = 1.0
# Priors of outliers: their share is below this one, and the logarithm of their size has this standard deviation.
_SHARE, _SIZE = 0.2, 1.5
# A reading is suspected where it lies this many robust standard deviations off; Student's t of 5 degrees of freedom
# sends one in a thousand there.
_SUSPECT = 6.0
# Where a noise of two scales may begin, in robust standard deviations, and by how many nats it has to be likelier than
# the likeliest of one, Gaussian or Student's; how probable it is then that a reading is of the wider one.
_EDGE, _APART, _CLEARLY = 2.5, 3.0, 0.9
_ROUNDS = 50
# Standard deviations by which neighbours may lie off together more often than chance has it.
_CHANCE = 3.0


def law_gain(problem: Problem, combination: Combination, errors: Float[np.ndarray, "row channel"]) -> float:
    """Log evidence gained by leaving open whether the noise is Gaussian or Student's, each half likely beforehand.

    `errors` are innovations by their own standard deviations, NaN where there is none: under a remainder, too, what is
    predicted of a reading has the two moments it has, and either law's tails. A heavy tail is the sensor's own, no
    mismatch. A column with outliers has a law of its own (`outlier_evidence`): what lies far off is excused once.
    """
    known, total = problem.noise_of(combination), 0.0
    ones = [problem.candidate(m) for m in combination]
    own = {one.place for one in ones if one.effect is OUTLIERS}
    for j in range(errors.shape[1]):
        e = errors[~np.isnan(errors[:, j]), j]
        if j not in own and len(e) and np.mean(e**2) < _ASTRAY:
            total += float(tail_gain(e, bool(np.isnan(known[j]))))
    return total


def tail_gain(e: Float[np.ndarray, "*lane row"], free: bool) -> Float[np.ndarray, "*lane"]:
    """The same of one channel, for several series of innovations; the noise's size is `free`, or one."""
    return np.asarray(np.logaddexp(0.0, _student(e, free) - _gaussian(e, free)) - np.log(2.0))


def _gaussian(e: np.ndarray, free: bool) -> np.ndarray:
    """Log likelihood of the Gaussian, its scale the best one where it is free, else one."""
    square = np.maximum(np.mean(e**2, axis=-1, keepdims=True), 1e-300) if free else np.ones(1)
    return np.asarray(-0.5 * (np.log(2 * np.pi * square) + e**2 / square).sum(-1))


def _student(e: np.ndarray, free: bool) -> np.ndarray:
    """Log likelihood of Student's t, its scale the best one where it is free, else that of unit variance."""
    f, squares = _FREEDOM, e**2
    square = np.full((*e.shape[:-1], 1), (f - 2) / f)
    for _ in range(30 if free else 0):
        share = (squares / (f * square + squares)).sum(-1, keepdims=True) / e.shape[-1]
        square = np.maximum((f + 1) * square * share, 1e-300)
    constant = gammaln((f + 1) / 2) - gammaln(f / 2) - 0.5 * np.log(f * np.pi * square)
    return np.asarray((constant - 0.5 * (f + 1) * np.log1p(squares / (f * square))).sum(-1))


def factor_evidence(
    problem: Problem, combination: Combination, noise: Float[np.ndarray, " channel"], number: np.ndarray
) -> float:
    """What a wrongly given noise owes for the choice of its factor: prior times the width of the likelihood."""
    total = 0.0
    for member in combination:
        one = problem.candidate(member)
        if one.effect is NOISE:
            factor = np.log(noise[one.place] / problem.noise[one.place])
            total += log_density(factor, _FACTOR) + 0.5 * np.log(np.pi / max(number[one.place], 1.0))
    return float(total)


def suspects(
    errors: Sequence[Float[np.ndarray, "_ channel"]],
) -> list[Bool[np.ndarray, "_ channel"]]:
    """Readings that lie far off, by recording; at most the share that the prior of outliers allows."""
    joined = np.concatenate(errors)
    with np.errstate(invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a column in which nothing was read has no median
        middle = np.nanmedian(joined, axis=0)
        spread = 1.4826 * np.nanmedian(np.abs(joined - middle), axis=0)
        e = (joined - middle) / np.maximum(spread, 1e-300)
        far = np.abs(e) > _SUSPECT
    for j, column in enumerate(e.T):
        far[:, j] = _stand_apart(column, far[:, j])
    far &= far.mean(0) < _SHARE
    parts = np.split(far, np.cumsum([len(one) for one in errors])[:-1])
    clumps = [_clumped(part) for part in parts]
    # By chance, neighbours both lie off as often as the share squared; a motion that is missed goes on for a while.
    expected, pairs = len(far) * far.mean(0) ** 2, sum((part[1:] & part[:-1]).sum(0) for part in parts)
    chance = pairs <= 1 + expected + _CHANCE * np.sqrt(expected)
    some = chance | (sum(clump.sum(0) for clump in clumps) < far.sum(0) / 2)
    return [part & some & (chance | ~clump) for part, clump in zip(parts, clumps, strict=True)]


def _clumped(far: Bool[np.ndarray, "_ channel"]) -> Bool[np.ndarray, "_ channel"]:
    """Which of them have a neighbour in time."""
    pairs, out = far[1:] & far[:-1], np.zeros_like(far)
    out[1:] |= pairs
    out[:-1] |= pairs
    return out


def _stand_apart(e: Float[np.ndarray, " row"], far: Bool[np.ndarray, " row"]) -> Bool[np.ndarray, " row"]:
    """Those that lie far off, and errors of the wider of two scales where these are much likelier than one; none where
    so many are of the wider that it is the sensor's own way."""
    seen = np.isfinite(e)
    x, out = e[seen], far.copy()
    wide = np.abs(x) > _EDGE
    if not 0 < wide.mean() < _SHARE:
        return np.zeros_like(far)
    scales = Scales(float(wide.mean()), float(np.sqrt(np.mean(x[wide] ** 2))), float(np.sqrt(np.mean(x[~wide] ** 2))))
    for _ in range(_ROUNDS):
        scales = scales.refined(x, scales.belongs(x))
    if scales.share > _SHARE:
        return np.zeros_like(far)
    one = max(float(_gaussian(x, True)), float(_student(x, True)))
    if scales.log_likelihood(x) > one + _APART:
        out[seen] |= scales.belongs(x) > _CLEARLY
    return out


class Scales(NamedTuple):
    """A noise of two scales: a share of the errors has a Gaussian one of sd `size` on top of that of sd `core`."""

    share: float
    size: float
    core: float = 1.0

    def _logs(self, e: np.ndarray) -> np.ndarray:
        wide = log_density(e, np.hypot(self.size, self.core))
        with np.errstate(divide="ignore"):
            return np.stack([np.log(self.share) + wide, np.log1p(-self.share) + log_density(e, self.core)])

    def belongs(self, e: Float[np.ndarray, " row"]) -> Float[np.ndarray, " row"]:
        """Probability that each error has the wider noise."""
        logs = self._logs(e)
        return np.asarray(np.exp(logs[0] - np.logaddexp(*logs)))

    def log_likelihood(self, e: Float[np.ndarray, " row"]) -> float:
        return float(np.logaddexp(*self._logs(e)).sum())

    def refined(self, e: Float[np.ndarray, " row"], belongs: Float[np.ndarray, " row"]) -> "Scales":
        """The next step of expectation and maximisation, the core free."""
        core = float(np.sqrt(((1 - belongs) * e**2).sum() / max((1 - belongs).sum(), 1e-300)))
        square = float((belongs * e**2).sum() / max(belongs.sum(), 1e-300))
        return Scales(float(belongs.mean()), float(np.sqrt(max(square - core**2, core**2))), max(core, 1e-300))


def outlier_evidence(
    combination: Combination,
    problem: Problem,
    errors: Float[np.ndarray, "row channel"],
    flagged: Bool[np.ndarray, "row channel"],
) -> float:
    """Log evidence of a noise of two scales, over that of a Gaussian for the readings that are not suspected.

    Share and size of the wider scale are integrated over their priors. Which reading is of which is left open: whoever
    counts every suspect as wide pays for those that are none.
    """
    total, free = 0.0, np.isnan(problem.noise_of(combination))
    for member in combination:
        one = problem.candidate(member)
        if one.effect is OUTLIERS:
            seen = ~np.isnan(errors[:, one.place])
            e, off = errors[seen, one.place], flagged[seen, one.place]
            if not off.any():
                return -np.inf
            total += _two_scales(e, off, bool(free[one.place])) - log_density(e[~off]).sum()
    return float(total)


def _two_scales(e: Float[np.ndarray, " row"], off: Bool[np.ndarray, " row"], free: bool) -> float:
    """Log evidence of a noise of two scales by Laplace's method about its best share and size; its core is `free`, or
    one."""
    scales = Scales(float(off.mean()), float(np.sqrt(np.mean(e[off] ** 2))))
    for _ in range(_ROUNDS):
        scales = scales.refined(e, scales.belongs(e))
        scales = scales if free else scales._replace(core=1.0)
    share, n = min(scales.share, _SHARE), len(e)
    value = scales._replace(share=share).log_likelihood(e)
    value += 0.5 * np.log(2 * np.pi * share * (1 - share) / n) - np.log(_SHARE)
    return float(value + 0.5 * np.log(np.pi / max(n * share, 1.0)) + log_density(0.0, _SIZE))


def outliers(errors: Float[np.ndarray, " row"], flagged: Bool[np.ndarray, " row"]) -> tuple[float, float]:
    """Share of the readings that are outliers, and their standard deviation in that of the noise.

    By expectation and maximisation from the flagged ones, since the smallest outliers hide among the noise.
    """
    seen = ~np.isnan(errors)
    e, off = errors[seen], flagged[seen]
    if not off.any():
        return 0.0, 0.0
    scales = Scales(float(off.mean()), float(np.sqrt(np.mean(e[off] ** 2))))
    for _ in range(_ROUNDS):
        belongs = scales.belongs(e)
        belongs[off] = 1.0
        size = float(np.sqrt(max((belongs * e**2).sum() / belongs.sum() - 1.0, 1.0)))
        scales = Scales(float(belongs.mean()), size)
    return scales.share, scales.size
