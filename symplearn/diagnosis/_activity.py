"""What a self-excitation feeds in, against what is lost beside it.

Beside a friction, or far inside the motion, a self-excitation is one more law of damping: the two cancel but for what
the law of friction lacks. That something drives the motion is seen only where more is fed in than is lost by the
frictions that are found. One that takes back a part of what the simulation loses, without outdoing that, is less to be
expected.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.special import log_ndtr

from .._effects import EXCITATION, RELATIVE, Candidate, Drag
from ._motion import Motion
from ._problem import Combination, Problem

# Stretches of every recording, each of a swing at least.
_STRETCHES = 12
# Prior probability, a guess, that what drives only takes back a part of what the simulation loses.
_TAKEN_BACK = 0.1
# The log of a probability that is as good as none.
_NEVER = -1e4


@dataclass(frozen=True)
class Powers:
    """Mean powers along a motion by stretch of time: `fed`, what each unit amplitude of a friction or an activity feeds
    in, and `known`, what the simulation's own feed into each coordinate. `recordings` tells which recording
    each stretch is of."""

    fed: Float[np.ndarray, "stretch value"]
    known: Float[np.ndarray, "stretch d"]
    recordings: Int[np.ndarray, " stretch"]


def powers(problem: Problem, motion: Motion) -> Powers:
    """Of stretches of a swing each, or as many as are looked at."""
    slowest = min(motion.own_frequency(i) for i in range(motion.q.shape[1]))
    rows, which, first = [], [], 0
    for r, times in enumerate(motion.times):
        swings = int((times[-1] - times[0]) * slowest / (2 * np.pi))
        for part in np.array_split(np.arange(len(times)), min(max(swings, 1), _STRETCHES)):
            rows.append(first + part)
            which.append(r)
        first += len(times)
    fed, known = np.zeros((len(rows), problem.equations.size)), _means(motion.turning, rows)
    for one in problem.equations.candidates:
        for k, power in enumerate(_power(motion, one)):
            fed[:, one.first + k] = _means(power, rows)
    return Powers(fed, known, np.array(which))


def _means(values: np.ndarray, rows: Sequence[np.ndarray]) -> np.ndarray:
    return np.array([np.mean(values[part], axis=0) for part in rows])


def _power(motion: Motion, one: Candidate) -> tuple[Float[np.ndarray, " row"], ...]:
    """Force times velocity of every amplitude, by row; nothing for other effects."""
    if one.effect is RELATIVE:
        i, j = one.places
        return (-((motion.v[:, i] - motion.v[:, j]) ** 2),)
    if isinstance(one.effect, Drag):
        return (-(np.abs(motion.v[:, one.place]) ** (one.effect.power + 1)),)
    if one.effect is EXCITATION:
        q, v = motion.q[:, one.place], motion.v[:, one.place]
        return v**2, -(q**2) * v**2
    return ()


def log_fed(
    problem: Problem, combination: Combination, by: Powers | None, z: Float[np.ndarray, " z"],
    covariance: Float[np.ndarray, "z z"],
) -> float:  # fmt: skip
    """Log probability that every self-excitation of a combination feeds in more than it and the frictions found on its
    coordinate take out, somewhere in the recordings, and than the simulation loses there; that of `_TAKEN_BACK` where
    it does not outdo the latter. Zero without any."""
    ones = [m for m in combination if problem.candidate(m).effect is EXCITATION]
    return 0.0 if by is None else float(sum(_log_fed(problem, combination, m, by, z, covariance) for m in ones))


def _log_fed(problem: Problem, combination: Combination, member: int, by: Powers, z, covariance) -> float:
    own = problem.members[member]
    fed = np.zeros((len(by.fed), len(z)))
    for m, place in problem.placed(combination):
        one = problem.members[m]
        if _is_met(own.candidate, one.candidate):
            amplitudes = slice(one.candidate.first, one.candidate.first + one.candidate.effect.amplitudes)
            acts = np.isin(by.recordings, one.recordings)
            entries = slice(place.start, place.start + one.candidate.effect.amplitudes)
            fed[:, entries] = np.where(acts[:, None], by.fed[:, amplitudes], 0.0)
    some = np.isin(by.recordings, own.recordings)
    fed, known = fed[some], by.known[some, own.candidate.place]
    with np.errstate(all="ignore"):  # what ran away says nothing
        sd = np.maximum(np.sqrt(np.maximum(np.einsum("wi,ij,wj->w", fed, covariance, fed), 0.0)), 1e-300)
        surplus = (np.stack([fed @ z + known, fed @ z]) / sd).T
    surplus = surplus[np.isfinite(surplus).all(1)]
    if not len(surplus):
        return 0.0
    drives, takes_back = np.maximum(log_ndtr(surplus.max(0)), _NEVER)
    return float(max(drives, np.log(_TAKEN_BACK) + takes_back))


def _is_met(own: Candidate, other: Candidate) -> bool:
    """Whether an effect is a self-excitation itself, or a friction of its coordinate."""
    if other is own:
        return True
    if other.effect is RELATIVE:
        return own.place in other.places
    return isinstance(other.effect, Drag) and other.place == own.place
