"""What one effect more would gain at one place, and where its fit would begin: the score test of Rao (1948)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from .. import _effects as effects
from ._calibrate import Priors
from ._problem import Combination, Problem
from ._strength import mixture_gain


@dataclass(frozen=True)
class Unit:
    """An effect on a target at one place."""

    candidate: int
    place: float | None


@dataclass(frozen=True, eq=False)
class Start:
    """Where a fit of a combination begins, and the log evidence that it is expected to gain.

    `still` is the fit that a score was taken at, where the new effect has no amplitude yet.
    """

    combination: Combination
    z: Float[np.ndarray, " z"]
    gain: float
    still: Float[np.ndarray, " z"] | None = None


class Nuisance(NamedTuple):
    """Everything but an effect's amplitudes, at its best without them."""

    active: Bool[np.ndarray, " z"]
    inverse: Float[np.ndarray, "active active"]
    vector: Float[np.ndarray, " active"]
    step: Float[np.ndarray, " active"]  # to that best
    bounds: tuple[np.ndarray, np.ndarray]  # of every entry of z
    gain: float = 0.0  # of an unseen start, under the widest prior

    @property
    def earned(self) -> float:
        """Log evidence of these unknowns, but for the density of their priors."""
        return float(0.5 * self.vector @ self.step + 0.5 * np.linalg.slogdet(self.inverse)[1])


def nuisance(
    problem: Problem, by_recording: Sequence[np.ndarray], z, combination: Combination, priors: Priors, member: int,
    kept: dict[int, Nuisance],
) -> Nuisance:  # fmt: skip
    """The same for every effect, but for an unseen oscillator, whose start is unknown too."""
    if not kept:
        kept[0] = _remaining(problem, by_recording, z, combination, priors)
    if problem.candidate(member).effect is not effects.HIDDEN:
        return kept[0]
    found = _remaining(problem, by_recording, z, combination, priors, member)
    width = priors.precision_of(problem, (member,))[_starts(problem, member)]
    return found._replace(gain=found.earned - kept[0].earned + float(0.5 * np.log(width).sum()))


def _starts(problem: Problem, member: int) -> np.ndarray:
    """Where in z an unseen oscillator begins."""
    return np.concatenate([problem.unseen(r) for r in problem.members[member].recordings])


def _remaining(
    problem: Problem, by_recording: Sequence[np.ndarray], z, combination: Combination, priors: Priors,
    unseen: int | None = None,
) -> Nuisance:  # fmt: skip
    """All unknowns of a combination, and the start of what one further member adds `unseen`."""
    size = problem.size
    active, precision = problem.active(combination), priors.precision_of(problem, combination)
    if unseen is not None:
        starts = _starts(problem, unseen)
        active[starts] = True
        precision[starts] = priors.precision_of(problem, (unseen,))[starts]
    gram = np.zeros((1 + size, 1 + size))
    for r, own in enumerate(by_recording):
        place = np.concatenate([[0], 1 + problem.local(r)])
        gram[np.ix_(place, place)] += own[: len(place), : len(place)]
    vector = gram[0, 1:] - precision * (z - priors.mean_of(problem, combination))
    found = inverse(gram[1:, 1:][np.ix_(active, active)] + np.diag(precision[active]))
    return Nuisance(active, found, vector[active], found @ vector[active], priors.bounds_of(problem, combination))


def inverse(matrix: np.ndarray) -> np.ndarray:
    """The inverse; NaN where there is none. A direction that nothing holds keeps a wide, finite spread."""
    with np.errstate(all="ignore"):  # a trajectory that ran away is told by NaN
        scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        scaled = matrix / np.outer(scale, scale)
        if not np.isfinite(scaled).all():
            return np.full_like(matrix, np.nan)
        values, vectors = np.linalg.eigh(scaled)
        return (vectors / np.maximum(values, 1e-13)) @ vectors.T / np.outer(scale, scale)


def score(
    problem: Problem, by_recording: Sequence[np.ndarray], z, combination: Combination, priors: Priors, unit: Unit,
    member: int, others: Nuisance,
) -> Start | None:  # fmt: skip
    """The step that a unit's amplitudes and everything else would take, and what it gains."""
    one = problem.candidate(member)
    number = one.effect.amplitudes
    cross, square, vector = np.zeros((problem.size, number)), np.zeros((number, number)), np.zeros(number)
    for r in problem.members[member].recordings:
        own, gram = problem.local(r), by_recording[r]
        k = 1 + len(own)
        cross[own] += gram[1:k, k:]
        square, vector = square + gram[k:, k:], vector + gram[0, k:]
    cross = cross[others.active]
    scales = priors.scales[one.first : one.first + number]
    after = others.inverse @ cross  # how the others follow a unit of each amplitude
    # What the others can take over wholly leaves a difference of round-off, not less than nothing.
    left = square - cross.T @ after + np.diag(scales**-2.0 + 1e-12 * np.diag(square))
    spread = inverse(left)
    push = vector - after.T @ others.vector
    amplitudes = spread @ push
    if not np.isfinite(amplitudes).all() or (one.effect.positive and amplitudes[0] < 0):
        return None
    lowest = np.full(number, 0.0 if one.effect.positive else -np.inf)
    if one.effect.positive:
        amplitudes = np.maximum(amplitudes, 0.0)
    gain = others.gain + 0.5 * push @ amplitudes + 0.5 * np.linalg.slogdet(spread)[1] - np.log(scales).sum()
    if one.effect is effects.HIDDEN:
        gain += _unseen_strength(problem, member, priors, others, after, amplitudes, spread)
    else:
        shape = np.outer(scales, scales)
        gain += mixture_gain(amplitudes / scales, spread / shape, np.zeros(number, int), lowest / scales)
    larger = tuple(sorted((*combination, member)))
    moved = z.copy()
    moved[others.active] += others.step - after @ amplitudes
    moved = np.clip(moved, *others.bounds)
    ends = [
        placed(problem, at, combination, larger, member, size, unit)
        for at, size in ((moved, amplitudes), (z, np.zeros(number)))
    ]
    return Start(larger, ends[0], float(gain), ends[1])


def _unseen_strength(problem, member: int, priors: Priors, others: Nuisance, after, amplitudes, spread) -> float:
    """What an unseen oscillator gains for being of any strength: its amplitude and its start together."""
    some = np.isin(np.nonzero(others.active)[0], _starts(problem, member))
    scales = np.append(
        priors.scales[problem.candidate(member).first],
        priors.precision_of(problem, (member,))[_starts(problem, member)] ** -0.5,
    )
    begin = others.step - after @ amplitudes
    cross = -after[some] @ spread
    corner = others.inverse[np.ix_(some, some)] + after[some] @ spread @ after[some].T
    joint = np.block([[spread, cross.T], [cross, corner]])
    centre, lowest = np.append(amplitudes, begin[some]), np.append(0.0, np.full(some.sum(), -np.inf))
    shape = np.outer(scales, scales)
    return mixture_gain(centre / scales, joint / shape, np.zeros(len(centre), int), lowest)


def placed(problem, z, combination, larger, member, amplitudes, unit: Unit) -> np.ndarray:
    """Unknowns and old effects as they are in z, and the new effect of given amplitudes at the unit's place."""
    old, out = dict(problem.placed(combination)), z.copy()
    out[problem.slots :] = 0.0
    for m, place in problem.placed(larger):
        if m == member:
            out[place] = np.append(amplitudes, [] if unit.place is None else [unit.place])
        else:
            out[place] = z[old[m]]
    return out
