"""What a self-excitation feeds in, against what is lost beside it.

Beside a friction, or far inside the motion, a self-excitation is one more law of damping: the two cancel but for what
the law of friction lacks. That something drives the motion is seen only where more is fed in than is lost.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.special import log_ndtr

from .._effects import EXCITATION, RELATIVE, Candidate, Drag
from ._calibrate import Priors
from ._motion import Motion
from ._problem import Combination, Problem

# Stretches of every recording, each of a swing at least.
_STRETCHES = 12
# The log of a probability that is as good as none.
_NEVER = -1e4


def powers(problem: Problem, motion: Motion) -> tuple[Float[np.ndarray, "stretch value"], Int[np.ndarray, " stretch"]]:
    """Mean power that each unit amplitude of a friction or an activity feeds in, by stretch of time along a motion, and
    which recording each stretch is of."""
    slowest = min(motion.own_frequency(i) for i in range(motion.q.shape[1]))
    rows, which, first = [], [], 0
    for r, times in enumerate(motion.times):
        swings = int((times[-1] - times[0]) * slowest / (2 * np.pi))
        for part in np.array_split(np.arange(len(times)), min(max(swings, 1), _STRETCHES)):
            rows.append(first + part)
            which.append(r)
        first += len(times)
    out = np.zeros((len(rows), problem.equations.size))
    for one in problem.equations.candidates:
        for k, power in enumerate(_power(motion, one)):
            out[:, one.first + k] = [np.mean(power[part]) for part in rows]
    return out, np.array(which)


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
    problem: Problem, combination: Combination, priors: Priors, z: Float[np.ndarray, " z"],
    covariance: Float[np.ndarray, "z z"],
) -> float:  # fmt: skip
    """Log probability that every self-excitation of a combination feeds in more than it and the frictions of its
    coordinate take out, somewhere in the recordings; zero without any."""
    ones = [m for m in combination if problem.candidate(m).effect is EXCITATION]
    return float(sum(_log_fed(problem, combination, m, priors, z, covariance) for m in ones))


def _log_fed(problem: Problem, combination: Combination, member: int, priors: Priors, z, covariance) -> float:
    own, fed = problem.members[member], np.zeros((len(priors.powers), len(z)))
    for m, place in problem.placed(combination):
        one = problem.members[m]
        if _is_met(own.candidate, one.candidate):
            amplitudes = slice(one.candidate.first, one.candidate.first + one.candidate.effect.amplitudes)
            acts = np.isin(priors.stretches, one.recordings)
            entries = slice(place.start, place.start + one.candidate.effect.amplitudes)
            fed[:, entries] = np.where(acts[:, None], priors.powers[:, amplitudes], 0.0)
    fed = fed[np.isin(priors.stretches, own.recordings)]
    with np.errstate(all="ignore"):  # what ran away says nothing
        sd = np.sqrt(np.maximum(np.einsum("wi,ij,wj->w", fed, covariance, fed), 0.0))
        surplus = fed @ z / np.maximum(sd, 1e-300)
    surplus = surplus[np.isfinite(surplus)]
    return max(float(log_ndtr(surplus.max())), _NEVER) if len(surplus) else 0.0


def _is_met(own: Candidate, other: Candidate) -> bool:
    """Whether an effect is a self-excitation itself, or a friction of its coordinate."""
    if other is own:
        return True
    if other.effect is RELATIVE:
        return own.place in other.places
    return isinstance(other.effect, Drag) and other.place == own.place
