"""What combinations gain where each of their effects may be of any order of magnitude: from their entries of z to the
mixtures of `_strength.py`, many posteriors at once."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.special import log_ndtr, logsumexp

from .._effects import EXCITATION
from .._normal import log_density
from ._activity import log_fed
from ._calibrate import Priors
from ._problem import Combination, Problem
from ._strength import FAINT_WIDTHS, SEEN, faint_share, mixture_gains, widths_from

# Standard deviation of the logarithm of where a self-excitation turns into a damping, about the size of the motion.
_TURNING = np.log(2.0)
# Nor is it far below: what turns at less than this share of that size, a quarter of the amplitude of a swing, drives
# nothing that was recorded, and is a damping.
_WITHIN = 0.4
# The grid that integrates over it, in standard deviations of the estimate.
_REACH, _POINTS = 5.0, 121
# Posteriors of like effects that are weighed at once. Of two effects each takes 0.66 ms by itself, 0.08 so, and 0.05
# with 64; of three 1.5 ms, and from 4 on 0.7 to 1.1. Memory grows by a third of a megabyte with each.
_LANES = 16


def strength_gain(
    problem: Problem, combination: Combination, priors: Priors, z: Float[np.ndarray, " z"],
    covariance: Float[np.ndarray, "z z"],
) -> float:  # fmt: skip
    """Log evidence under unknown orders of magnitude, less that under the widest priors, whose posterior is given; and
    of a self-excitation what is fed in."""
    return float(strength_gains(problem, [combination], priors, [z], [covariance])[0])


def strength_gains(
    problem: Problem, combinations: Sequence[Combination], priors: Priors, z: Sequence[Float[np.ndarray, " z"]],
    covariances: Sequence[Float[np.ndarray, "z z"]],
) -> Float[np.ndarray, " lane"]:  # fmt: skip
    """The same of many posteriors: those whose effects are alike in number and bounds are weighed side by side."""
    laid = {c: _Strengths.of(problem, c, priors) for c in dict.fromkeys(combinations)}
    gains, alike = np.zeros(len(combinations)), dict[_Kind, list[int]]()
    for k, (combination, one, spread) in enumerate(zip(combinations, z, covariances, strict=True)):
        gains[k] = log_fed(problem, combination, priors.powers, one, spread) + laid[combination].apart(one, spread)
        if laid[combination].kind.own:
            alike.setdefault(laid[combination].kind, []).append(k)
    for kind, lanes in alike.items():
        for some in (lanes[a : a + _LANES] for a in range(0, len(lanes), _LANES)):
            both = zip(*(laid[combinations[k]].scaled(z[k], covariances[k]) for k in some), strict=True)
            centre, spread = map(np.stack, both)
            gains[some] += mixture_gains(centre, spread, np.array(kind.own), np.array(kind.lowest), kind.alone)
    return gains


@dataclass(frozen=True)
class _Kind:
    """What mixtures are alike in: the number of the effect that each entry belongs to, the entries' bounds in units of
    their widest priors, and whether there is one effect alone."""

    own: tuple[int, ...]
    lowest: tuple[float, ...]
    alone: bool


@dataclass(frozen=True, eq=False)
class _Strengths:
    """Where in z the strengths of a combination stand, by member that has any; widest priors, and those of a turning
    self-excitation; and what a mixture needs of the others."""

    members: list[Int[np.ndarray, " _"]]
    turning: list[tuple[Int[np.ndarray, "2"], Float[np.ndarray, "2"]]]
    precision: Float[np.ndarray, " z"]
    mean: Float[np.ndarray, " z"]
    entries: Int[np.ndarray, " a"]
    kind: _Kind

    @classmethod
    def of(cls, problem: Problem, combination: Combination, priors: Priors) -> "_Strengths":
        """As the priors have it."""
        alone = sum(problem.candidate(member).effect.amplitudes > 0 for member in combination) == 1
        precision, bounds = priors.precision_of(problem, combination), problem.lower_bounds(combination)
        members, turning, blocks = [], [], []
        for member in combination:
            entries, one = strength_entries(problem, combination, member), problem.candidate(member)
            if not len(entries):
                continue
            members.append(entries)
            if one.effect is EXCITATION:
                turning.append((entries, priors.scales[one.values]))
            else:
                blocks.append(entries)
        a = np.concatenate([np.zeros(0, int), *blocks])
        own = tuple(k for k, block in enumerate(blocks) for _ in block)
        lowest = tuple(float(bounds.get(int(k), -np.inf) * precision[k] ** 0.5) for k in a)
        mean = priors.mean_of(problem, combination)
        return cls(members, turning, precision, mean, a, _Kind(own, lowest, alone))

    def apart(self, z: Float[np.ndarray, " z"], covariance: Float[np.ndarray, "z z"]) -> float:
        """What is gained beside the mixture: by where a self-excitation turns, and by the share that is seen."""
        total = 0.0
        for entries, scales in self.turning:
            total += turning_gain(z[entries], covariance[np.ix_(entries, entries)], scales, self.kind.alone)
        seen = [] if self.kind.alone else [self._seen_share(covariance, entries) for entries in self.members]
        return total + (float(np.log(max(seen))) if seen else 0.0)

    def scaled(
        self, z: Float[np.ndarray, " z"], covariance: Float[np.ndarray, "z z"]
    ) -> tuple[Float[np.ndarray, " a"], Float[np.ndarray, "a a"]]:
        """A posterior of the others in units of their widest priors, about these."""
        a, unit = self.entries, self.precision[self.entries] ** -0.5
        return (z - self.mean)[a] / unit, covariance[np.ix_(a, a)] / np.outer(unit, unit)

    def _seen_share(self, covariance: Float[np.ndarray, "z z"], entries: Int[np.ndarray, " entry"]) -> float:
        """Share of the prior of an effect that the recording shows."""
        unit = self.precision[entries] ** -0.5
        spread = covariance[np.ix_(entries, entries)] / np.outer(unit, unit)
        if not np.isfinite(spread).all():
            return 1.0
        known = np.mean(np.maximum(1.0 / np.clip(np.linalg.eigvalsh(spread), 1e-300, None) - 1.0, 0.0))
        return max(1.0 - faint_share(float(known) ** -0.5 if known > 0 else np.inf), 1.0 / FAINT_WIDTHS)


def turning_gain(centre: np.ndarray, spread: np.ndarray, scales: np.ndarray, alone: bool = False) -> float:
    """What a self-excitation c (1 - q^2/a^2) v gains, inside c v - e q^2 v, where c is of any order of magnitude and a
    is about where the motion is.

    Of c and e each for itself, most would be dampings that grow with q^2 and drive nothing.
    """
    if not (np.isfinite(centre).all() and np.isfinite(spread).all()):
        return 0.0
    size = widths_from(np.asarray(SEEN * np.sqrt(spread[0, 0]) / scales[0]), alone)
    values, vectors = np.linalg.eigh(spread)
    root = vectors * np.sqrt(np.maximum(values, 0.0))  # round-off may leave one below zero
    grid = np.linspace(-_REACH, _REACH, _POINTS)
    normal = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    points = centre + normal @ root.T
    inside = (points > 0).all(1)
    if not inside.any():
        return 0.0
    c, e = points[inside].T
    mass = log_density(normal[inside]).sum(1)
    ratio = 0.5 * np.log(c / e * scales[1] / scales[0])
    # Density of e given c: that of ln a, by |d ln a / d e| = 1 / (2 e).
    turning = log_density(ratio, _TURNING) - log_ndtr(-np.log(_WITHIN) / _TURNING) - np.log(2 * e)
    turning = np.where(ratio > np.log(_WITHIN), turning, -np.inf)
    each = log_density(c[:, None], size * scales[0])
    if not alone:
        each = each + 2 * np.log(c[:, None] / (size * scales[0]))
    strength = logsumexp(each, axis=1) - np.log(len(size))
    wide = log_density(c, scales[0]) + log_density(e, scales[1]) + np.log(2.0)
    return float(logsumexp(mass + turning + strength - wide) - logsumexp(mass))


def strength_entries(problem: Problem, combination: Combination, member: int) -> Int[np.ndarray, " entry"]:
    """Where in z the amplitudes of one member stand, and the start of what it adds unseen."""
    place = dict(problem.placed(combination))[member]
    amplitudes = np.arange(place.start, place.start + problem.candidate(member).effect.amplitudes)
    return np.concatenate([amplitudes, problem.starts(member).ravel()])
