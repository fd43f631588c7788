"""Where a further effect would help: scores on a grid of places, without a refit.

An effect's amplitudes enter in proportion, so their response at zero tells how much they would gain once the other
unknowns follow (the score test of Rao 1948, nuisance projected out). A frequency, a time or a threshold has no slope at
amplitude zero, so it is tried on a grid; the best places are where fits begin.
"""

from collections.abc import Callable, Container, Iterator, Sequence
from itertools import chain, zip_longest

import numpy as np
from jaxtyping import Float

from .. import _effects as effects
from .._effects import Candidate, Memory
from ._arrow import MANY
from ._calibrate import Fits, Priors, residuals, weights
from ._noisy import PathFit, lane_grams
from ._problem import SLOTS, Combination, Problem
from ._score import Nuisance, Response, Score, Start, Unit, nuisance, placed, response, scores, unseen_nuisance
from ._trajectory import DIRECTIONS, LANES, Stepper

# Places tried for times, and the most frequencies; frequencies this many times pi over the span apart.
_TIMES, _FREQUENCIES, _SPACING = 60, 160, 0.8
# How fast a force fades, evenly spread in the logarithm.
_FADINGS = 12
# How far inside the motion a stop is tried, as shares of the way from its edge to its middle.
_DEPTHS = np.geomspace(0.01, 0.9, 12)
# Unseen oscillators that are scored at once.
_TOGETHER = 64
# Starts kept for each effect and target, and for each choice of recordings.
BEST = 3


def grid(problem: Problem, priors: Priors, candidate: int) -> list[Unit]:
    """The places that are tried for an effect on a target."""
    one = problem.equations.candidates[candidate]
    if not one.effect.places:
        return [Unit(candidate, None)] if one.effect.amplitudes else []
    return [Unit(candidate, float(place)) for place in _tried(problem, priors, one)]


def _tried(problem: Problem, priors: Priors, one: Candidate) -> np.ndarray:
    low, high = ends(priors, one)
    if priors.windows is None or one.effect not in effects.AT_ONCE:
        return _places(one, low, high, max(float(np.ptp(r.times)) for r in problem.rows))
    # Where clocks lie apart, time between them is none.
    begins, read = _joined(priors.windows)
    past = np.cumsum([0.0, *read])
    at = _places(one, 0.0, float(past[-1]))
    k = np.searchsorted(past, at, side="right") - 1
    return begins[k] + at - past[k]


def ends(priors: Priors, one: Candidate) -> tuple[float, float]:
    """Between which values the place of an effect lies: of what comes at once, from zero to how long is read in all."""
    if priors.windows is not None and one.effect in effects.AT_ONCE:
        return 0.0, float(_joined(priors.windows)[1].sum())
    return float(priors.lower[one.values.stop - 1]), float(priors.upper[one.values.stop - 1])


def _joined(windows: Float[np.ndarray, "recording 2"]) -> tuple[Float[np.ndarray, " part"], Float[np.ndarray, " part"]]:
    """When the parts of time begin in which anything is read, and how long each is."""
    parts: list[list[float]] = []
    for low, high in sorted(map(tuple, windows)):
        if parts and low <= parts[-1][1]:
            parts[-1][1] = max(parts[-1][1], high)
        else:
            parts.append([low, high])
    return np.array([low for low, _ in parts]), np.array([high - low for low, high in parts])


def _places(one: Candidate, low: float, high: float, longest: float = np.inf) -> np.ndarray:
    if one.effect.swings:
        step = spacing(one, low, high)
        number = int(min(_FREQUENCIES, np.ceil((high - low) / step)))
        # Evenly spaced as far as they go, which is what the span resolves; then ever wider.
        even = np.linspace(low, high, number)
        return even if high - low <= max(step, resolved(longest)) * _FREQUENCIES else np.geomspace(low, high, number)
    if isinstance(one.effect, Memory):
        return np.geomspace(low, high, _FADINGS + 2)[1:-1]
    if one.effect is effects.STOP:
        return high - (high - low) * _DEPTHS if one.side == "upper" else low + (high - low) * _DEPTHS
    return low + (high - low) * (np.arange(_TIMES) + 0.5) / _TIMES


def spacing(one: Candidate, low: float, high: float) -> float:
    """About how far apart neighbouring frequencies or times are."""
    if one.effect.swings:
        return _SPACING * low * (2 if one.effect is effects.HIDDEN else 1)
    return (high - low) / _TIMES


def resolved(longest: float) -> float:
    """About how far apart neighbouring frequencies are where recordings, of which the longest is so long, are read by
    clocks that lie far apart: what each resolves."""
    return 2 * _SPACING * np.pi / longest


def packed(problem: Problem, units: Sequence[Unit]) -> Iterator[list[Unit]]:
    """Units that can be looked at together: each target once, one unseen oscillator, no more values than slots."""
    by_candidate: dict[int, list[Unit]] = {}
    for unit in units:
        by_candidate.setdefault(unit.candidate, []).append(unit)
    for group in zip_longest(*by_candidate.values()):
        lane: list[Unit] = []
        for unit in (unit for unit in group if unit is not None):
            if not _fits(problem, lane, unit):
                yield lane
                lane = []
            lane.append(unit)
        yield lane


def _fits(problem: Problem, lane: list[Unit], unit: Unit) -> bool:
    ones = [problem.equations.candidates[u.candidate] for u in (*lane, unit)]
    unseen = sum(one.effect.switched for one in ones)
    directions = sum(one.effect.amplitudes for one in ones) + 2 * unseen
    size = sum(one.effect.size for one in ones)
    once = unit.candidate not in {u.candidate for u in lane}
    return once and size <= SLOTS and directions <= DIRECTIONS and unseen <= 1


def layout(problem: Problem, lane: Sequence[Unit]) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Values of the slots, their coefficients (as `Problem.onehot`), and the slots of each unit's amplitudes."""
    values, matrix, amplitudes = np.zeros(SLOTS), np.zeros((SLOTS + 1, problem.equations.size)), []
    first = 0
    for unit in lane:
        one = problem.equations.candidates[unit.candidate]
        rows = np.arange(first, first + one.effect.size)
        matrix[rows, np.arange(one.values.start, one.values.stop)] = 1.0
        if one.effect.switched:
            matrix[-1, one.values.stop] = 1.0
        if unit.place is not None:
            values[rows[-1]] = unit.place
        amplitudes.append(rows[: one.effect.amplitudes])
        first += one.effect.size
    return values, matrix, amplitudes


# Gram matrices by recording of the columns [1, x_0, calibrated, slots, amplitudes] of every unit of some lanes: what a
# recording depends on (`Problem.local`) under the combination that was fitted, and the amplitudes that it lacks.
Grams = Callable[[Sequence[Sequence[Unit]]], Iterator[list[list[np.ndarray]]]]


def on_trajectory(stepper: Stepper, fits: Fits, lane: int, rows: Sequence[int]) -> Grams:
    """Grams about a fitted trajectory: the response of every reading to an amplitude."""
    problem, combination = stepper.problem, fits.combinations[lane]
    weight = weights(problem, rows)
    r = residuals(problem, fits.predictions, weight)
    unknown = problem.state + problem.calibrated.size  # the slots of `responses` are those of the units

    def of(lanes: Sequence[Sequence[Unit]]) -> list[list[list[np.ndarray]]]:
        laid = [layout(problem, units) for units in lanes]
        found: list[list[list[np.ndarray]]] = [[[] for _ in units] for units in lanes]
        for k, w in enumerate(weight):
            root = np.where(w > 0, np.sqrt(w), 0.0) / fits.noise[lane]
            known = fits.predictions[k].slopes[lane]
            slopes = stepper.responses(fits.z[lane], combination, laid, rows[k], k)
            for b, (units, (_, _, amplitudes)) in enumerate(zip(lanes, laid, strict=True)):
                for u, unit in enumerate(units):
                    own = known
                    if problem.equations.candidates[unit.candidate].effect.switched:
                        own = known.copy()
                        own[_unseen(problem)] = slopes[b][_unseen(problem)]
                    further = slopes[b][unknown + amplitudes[u]]
                    columns = np.concatenate([r[k][lane][None], own, further]) * root
                    flat = np.nan_to_num(columns.reshape(len(columns), -1))
                    found[b][u].append(flat @ flat.T)
        return found

    return lambda lanes: _in_groups(stepper, of, lanes)


def on_path(stepper: Stepper, fit: PathFit, rows: Sequence[int]) -> Grams:
    """Grams about a path without effects but a missing force: innovations, which follow the recording however far it
    has gone."""
    problem = stepper.problem
    unknown = 1 + problem.state + problem.calibrated.size

    def of(lanes: Sequence[Sequence[Unit]]) -> list[list[list[np.ndarray]]]:
        laid = [layout(problem, units) for units in lanes]
        found: list[list[list[np.ndarray]]] = [[[] for _ in units] for units in lanes]
        for k in range(len(rows)):
            grams = lane_grams(stepper, fit, laid, rows, k)
            for b, (units, (_, _, amplitudes)) in enumerate(zip(lanes, laid, strict=True)):
                for u in range(len(units)):
                    some = np.concatenate([np.arange(unknown), unknown + amplitudes[u]])
                    place = np.where(some < unknown, some, unknown + SLOTS + np.arange(len(some)) - unknown)
                    full = np.zeros((unknown + SLOTS + len(amplitudes[u]),) * 2)
                    full[np.ix_(place, place)] = grams[b][np.ix_(some, some)]
                    found[b][u].append(full)
        return found

    return lambda lanes: _in_groups(stepper, of, lanes)


def _in_groups(
    stepper: Stepper, of: Callable[[Sequence[Sequence[Unit]]], list[list[list[np.ndarray]]]],
    lanes: Sequence[Sequence[Unit]],
) -> Iterator[list[list[np.ndarray]]]:  # fmt: skip
    """Grams of every lane, those of `LANES` at a time."""
    groups = [lanes[a : a + LANES] for a in range(0, len(lanes), LANES)]
    return chain.from_iterable(stepper.ahead(of, groups))


def _unseen(problem: Problem) -> np.ndarray:
    width = problem.equations.width
    return np.array([width - 1, 2 * width - 1])


def scan(
    problem: Problem, grams: Grams, z: Float[np.ndarray, " z"], combination: Combination, priors: Priors,
    units: Sequence[Unit], chosen: Container[int] = (),
) -> list[Start]:  # fmt: skip
    """Starts of `combination` with one further effect each, the best places of every effect and target.

    Places of the candidates that are `chosen` are the best already, and no neighbours of each other.
    """
    lanes, tried, others = list(packed(problem, units)), list[Response](), None
    # Scores with unknowns of their own are taken a few at a time, by their place among all: of many recordings those
    # unknowns are matrices of megabytes.
    own, waiting = dict[int, Score | None](), dict[int, dict[int, Sequence[np.ndarray]]]()
    together = 1 if len(problem.rows) >= MANY else _TOGETHER
    for group, by_unit in zip(lanes, grams(lanes), strict=True):
        for unit, by_recording in zip(group, by_unit, strict=True):
            others = nuisance(problem, by_recording, z, combination, priors) if others is None else others
            for member in _members(problem, unit, combination):
                tried.append(response(problem, by_recording, unit, member))
                if problem.candidate(member).effect.switched:
                    some = waiting.setdefault(member, {})
                    some[len(tried) - 1] = by_recording
                    if len(some) == together:
                        own |= _unseen_scores(problem, tried, waiting.pop(member), z, combination, priors, others)
    if others is None:  # there is nothing to try
        return []
    for some in waiting.values():
        own |= _unseen_scores(problem, tried, some, z, combination, priors, others)
    found: dict[int, list[Score]] = {}
    for scored in _scored(problem, tried, own, z, priors, others):
        found.setdefault(scored.member, []).append(scored)
    return [one.start(problem, z, combination)
            for member, listed in found.items() for one in _peaks(listed, problem.whole(member) in chosen)]  # fmt: skip


def _unseen_scores(
    problem: Problem, tried: Sequence[Response], some: dict[int, Sequence[np.ndarray]], z: Float[np.ndarray, " z"],
    combination: Combination, priors: Priors, others: Nuisance,
) -> dict[int, Score | None]:  # fmt: skip
    """Scores of an unseen oscillator's units, by their place among the responses, from their Gram matrices."""
    ones = [tried[k] for k in some]
    alone = unseen_nuisance(problem, [*some.values()], z, combination, priors, ones[0].member, others)
    return dict(zip(some, scores(problem, ones, z, priors, alone), strict=True))


def _scored(
    problem: Problem, tried: Sequence[Response], own: dict[int, Score | None], z: Float[np.ndarray, " z"],
    priors: Priors, others: Nuisance,
) -> list[Score]:  # fmt: skip
    """Scores in the order of the responses, like ones together; some are known."""
    alike: dict[tuple[int, bool, int | None], list[int]] = {}
    for k, told in enumerate(tried):
        if k not in own:
            candidate = problem.candidate(told.member)
            effect, first = candidate.effect, candidate.first
            # What is known may differ by recording, and so may how much of it can be taken back.
            known = told.member if problem.terms[:, first : first + effect.amplitudes].any() else None
            alike.setdefault((effect.amplitudes, effect.positive, known), []).append(k)
    found = dict(own)
    for some in alike.values():
        found |= zip(some, scores(problem, [tried[k] for k in some], z, priors, others), strict=True)
    return [one for k in range(len(tried)) if (one := found[k]) is not None]


def noise_starts(problem: Problem, fits: Fits, rows: Sequence[int]) -> list[Start]:
    """A fitted combination with one given noise that is wrong: by what the scatter of the readings would gain."""
    (combination,), (z,), weight = fits.combinations, fits.z, weights(problem, rows)
    r = residuals(problem, fits.predictions, weight)
    square = sum((w * (x[0] / fits.noise[0]) ** 2).sum(0) for w, x in zip(weight, r, strict=True))
    number = np.maximum(sum((w > 0).sum(0) for w in weight), 1)
    found = []
    for member in problem.searched:
        one = problem.candidate(member)
        if one.effect is effects.NOISE and problem.is_possible((*combination, member)):
            factor = max(float(square[one.place] / number[one.place]), 1e-300)
            gain = 0.5 * float(number[one.place]) * (factor - 1.0 - np.log(factor))
            larger, unit = tuple(sorted((*combination, member))), Unit(member, None)
            begin = placed(problem, z, combination, larger, member, np.zeros(one.effect.size), unit)
            found.append(Start(larger, begin, gain))
    return found


def _members(problem: Problem, unit: Unit, combination: Combination) -> list[int]:
    """The effect and target in all recordings, or in some; a jump at one time is in one recording."""
    single = problem.equations.candidates[unit.candidate].effect is effects.IMPULSE
    members = [unit.candidate, *problem.variants(unit.candidate)]
    if single and len(problem.rows) > 1:
        members = [m for m in members if len(problem.members[m].recordings) == 1]
    return [m for m in members if problem.is_possible((*combination, m))]


def _peaks(listed: list[Score], apart: bool) -> list[Score]:
    """The best places that are no neighbours of a better one; all places are `apart` where none is."""
    listed = sorted(listed, key=lambda one: 0.0 if one.unit.place is None else one.unit.place)
    gains = np.array([one.gain for one in listed])
    padded = np.concatenate([[-np.inf], gains, [-np.inf]])
    peak = (padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:]) | apart
    ranked = sorted(np.nonzero(peak)[0], key=lambda k: -gains[k])
    return [listed[k] for k in ranked[:BEST]]
