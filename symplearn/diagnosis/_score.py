"""What one effect more would gain at one place, and where its fit would begin: the score test of Rao (1948)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ._arrow import LEAST, MANY, Arrow
from ._calibrate import Priors
from ._problem import Combination, Problem
from ._strength import mixture_gains


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
    """Everything but an effect's amplitudes, at its best without them: one for many effects, or one for each."""

    active: Bool[np.ndarray, " z"]
    inverse: Float[np.ndarray, "lane active active"]
    vector: Float[np.ndarray, "lane active"]
    step: Float[np.ndarray, "lane active"]  # to that best
    bounds: tuple[np.ndarray, np.ndarray]  # of every entry of z
    spread: Float[np.ndarray, " lane"]  # the logarithm of the inverse's determinant
    gain: Float[np.ndarray, " lane"]  # of an unseen start, under the widest prior

    @property
    def earned(self) -> Float[np.ndarray, " lane"]:
        """Log evidence of these unknowns, but for the density of their priors."""
        return 0.5 * (self.vector * self.step).sum(1) + 0.5 * self.spread


def nuisance(
    problem: Problem, by_recording: Sequence[np.ndarray], z, combination: Combination, priors: Priors
) -> Nuisance:
    """The same for every effect but an unseen oscillator."""
    return _remaining(problem, [by_recording], z, combination, priors)


def unseen_nuisance(
    problem: Problem, lanes: Sequence[Sequence[np.ndarray]], z, combination: Combination, priors: Priors, member: int,
    others: Nuisance,
) -> Nuisance:  # fmt: skip
    """That of an unseen oscillator's units, whose start is unknown too, beside that of every other effect."""
    found = _remaining(problem, lanes, z, combination, priors, member)
    width = priors.precision_of(problem, (member,))[problem.starts(member).ravel()]
    return found._replace(gain=found.earned - others.earned + float(0.5 * np.log(width).sum()))


def _remaining(
    problem: Problem, lanes: Sequence[Sequence[np.ndarray]], z, combination: Combination, priors: Priors,
    unseen: int | None = None,
) -> Nuisance:  # fmt: skip
    """All unknowns of a combination, and the start of what one further member adds `unseen`."""
    active, precision = problem.active(combination), priors.precision_of(problem, combination)
    if unseen is not None:
        starts = problem.starts(unseen).ravel()
        active[starts] = True
        precision[starts] = priors.precision_of(problem, (unseen,))[starts]
    found, spread, push = _inverted(problem, lanes, precision, active)
    vector = (push - precision * (z - priors.mean_of(problem, combination)))[:, active]
    step = np.einsum("lab,lb->la", found, vector)
    return Nuisance(active, found, vector, step, priors.bounds_of(problem, combination), spread, np.zeros(len(lanes)))


def _inverted(
    problem: Problem,
    lanes: Sequence[Sequence[np.ndarray]],
    precision: Float[np.ndarray, " z"],
    active: Bool[np.ndarray, " z"],
) -> tuple[Float[np.ndarray, "lane active active"], Float[np.ndarray, " lane"], Float[np.ndarray, "lane z"]]:
    """The inverse of all information on what is active, the logarithm of its determinant, and what the error pushes."""
    size, state, local = problem.size, problem.state, 1 + problem.state + problem.size - problem.head
    by_recording = [np.stack([own[:local, :local] for own in each]) for each in zip(*lanes, strict=True)]
    if len(by_recording) >= MANY:
        grams = np.stack(by_recording, axis=1)
        starts = grams[:, :, 0, 1 : 1 + state].reshape(len(lanes), -1)
        push = np.concatenate([starts, grams[:, :, 0, 1 + state :].sum(1)], axis=1)
        both = [Arrow.of(lane[:, 1:, 1:], state).held(precision, active).inverse() for lane in grams]
        return np.stack([one[np.ix_(active, active)] for one, _ in both]), np.array([log for _, log in both]), push
    gram = np.zeros((len(lanes), 1 + size, 1 + size))
    for r, own in enumerate(by_recording):
        place = np.concatenate([[0], 1 + problem.local(r)])
        gram[:, place[:, None], place] += own
    found = inverse(gram[:, 1:, 1:][:, active][:, :, active] + np.diag(precision[active]))
    return found, np.linalg.slogdet(found)[1], gram[:, 0, 1:]


def inverse(matrix: Float[np.ndarray, "*lane n n"]) -> Float[np.ndarray, "*lane n n"]:
    """The inverse; NaN where there is none. A direction that nothing holds keeps a wide, finite spread."""
    with np.errstate(all="ignore"):  # a trajectory that ran away is told by NaN
        scale = np.sqrt(np.maximum(np.diagonal(matrix, axis1=-2, axis2=-1), 1e-300))
        shape = scale[..., :, None] * scale[..., None, :]
        scaled = matrix / shape
        sound = np.isfinite(scaled).all((-2, -1))[..., None, None]
        values, vectors = np.linalg.eigh(np.where(sound, scaled, np.eye(matrix.shape[-1])))
        found = (vectors / np.maximum(values, LEAST)[..., None, :]) @ vectors.mT / shape
        return np.where(sound, found, np.nan)


class Response(NamedTuple):
    """What the readings say of a unit's amplitudes, where it is one member: Gram sums over that member's recordings."""

    unit: Unit
    member: int
    cross: Float[np.ndarray, "z amplitude"]  # with every other unknown
    square: Float[np.ndarray, "amplitude amplitude"]
    vector: Float[np.ndarray, " amplitude"]  # with the error


def response(problem: Problem, by_recording: Sequence[np.ndarray], unit: Unit, member: int) -> Response:
    """From the Gram matrices of a unit's columns."""
    number, some = problem.candidate(member).effect.amplitudes, list(problem.members[member].recordings)
    state, local = problem.state, 1 + problem.state + problem.size - problem.head
    grams = np.stack([by_recording[r] for r in some])
    cross = np.zeros((problem.size, number))
    cross[: problem.head].reshape(-1, state, number)[some] = grams[:, 1 : 1 + state, local:]
    cross[problem.head :] = grams[:, 1 + state : local, local:].sum(0)
    return Response(unit, member, cross, grams[:, local:, local:].sum(0), grams[:, 0, local:].sum(0))


class Score(NamedTuple):
    """Where a unit's amplitudes and everything else would step, and what that gains."""

    unit: Unit
    member: int
    gain: float
    amplitudes: Float[np.ndarray, " amplitude"]
    moved: Float[np.ndarray, " z"]  # everything else

    def start(self, problem: Problem, z: Float[np.ndarray, " z"], combination: Combination) -> Start:
        """Where a fit of the combination and this member begins."""
        larger = tuple(sorted((*combination, self.member)))
        begin, still = (placed(problem, at, combination, larger, self.member, size, self.unit)
                        for at, size in ((self.moved, self.amplitudes), (z, 0.0 * self.amplitudes)))  # fmt: skip
        return Start(larger, begin, self.gain, still)


@np.errstate(all="ignore")  # what is not finite is told by None
def scores(
    problem: Problem, responses: Sequence[Response], z: Float[np.ndarray, " z"], priors: Priors, others: Nuisance
) -> list[Score | None]:
    """The score of every response, of effects that have as many amplitudes and are bounded alike in units of their
    scales, or of one unseen oscillator; None where there is no step."""
    ones = [problem.candidate(one.member) for one in responses]
    effect, number = ones[0].effect, ones[0].effect.amplitudes
    scales = np.stack([priors.scales[one.first : one.first + number] for one in ones])
    cross = np.stack([one.cross for one in responses])[:, others.active]
    square, vector = np.stack([one.square for one in responses]), np.stack([one.vector for one in responses])
    after = others.inverse @ cross  # how the others follow a unit of each amplitude
    # What the others can take over wholly leaves a difference of round-off, not less than nothing.
    held = scales**-2.0 + 1e-12 * np.diagonal(square, axis1=1, axis2=2)
    spread = inverse(square - cross.mT @ after + held[:, :, None] * np.eye(number))
    push = vector - (after * others.vector[:, :, None]).sum(1)
    amplitudes = np.einsum("lab,lb->la", spread, push)
    lowest = problem.lowest(responses[0].member)
    sound = np.isfinite(amplitudes).all(1) & (amplitudes[:, 0] >= lowest[0])
    amplitudes = np.maximum(amplitudes, lowest)
    gains = others.gain + 0.5 * (push * amplitudes).sum(1) + 0.5 * np.linalg.slogdet(spread)[1] - np.log(scales).sum(1)
    steps = others.step - np.einsum("lza,la->lz", after, amplitudes)
    if effect.switched:
        (member,) = {one.member for one in responses}
        gains += _unseen_strengths(problem, member, priors, others, after, amplitudes, spread, steps)
    else:
        shape = scales[:, :, None] * scales[:, None, :]
        gains += mixture_gains(amplitudes / scales, spread / shape, np.zeros(number, int), lowest / scales[0])
    moved = np.repeat(z[None], len(ones), axis=0)
    moved[:, others.active] += steps
    moved = np.clip(moved, *others.bounds)
    return [Score(one.unit, one.member, float(gains[k]), amplitudes[k], moved[k]) if sound[k] else None
            for k, one in enumerate(responses)]  # fmt: skip


def _unseen_strengths(
    problem: Problem, member: int, priors: Priors, others: Nuisance, after: Float[np.ndarray, "lane active amplitude"],
    amplitudes: Float[np.ndarray, "lane amplitude"], spread: Float[np.ndarray, "lane amplitude amplitude"],
    steps: Float[np.ndarray, "lane active"],
) -> Float[np.ndarray, " lane"]:  # fmt: skip
    """What unseen oscillators gain for being of any strength: their amplitude and their start together."""
    starts = problem.starts(member).ravel()
    some = np.isin(np.nonzero(others.active)[0], starts)
    scales = np.append(
        priors.scales[problem.candidate(member).first],
        priors.precision_of(problem, (member,))[starts] ** -0.5,
    )
    follow = after[:, some]
    cross = -follow @ spread
    corner = others.inverse[:, some][:, :, some] + follow @ spread @ follow.mT
    joint = np.concatenate(
        [np.concatenate([spread, cross.mT], axis=2), np.concatenate([cross, corner], axis=2)], axis=1
    )
    centre, lowest = np.concatenate([amplitudes, steps[:, some]], axis=1), np.append(0.0, np.full(some.sum(), -np.inf))
    return mixture_gains(centre / scales, joint / np.outer(scales, scales), np.zeros(len(scales), int), lowest)


def placed(problem, z, combination, larger, member, amplitudes, unit: Unit) -> np.ndarray:
    """Unknowns and old effects as they are in z, and the new effect of given amplitudes at the unit's place."""
    out, number = problem.carried(z, combination, larger), problem.candidate(member).effect.amplitudes
    amplitudes = np.append(problem.turned(member, unit.place, amplitudes[:number]), amplitudes[number:])
    out[dict(problem.placed(larger))[member]] = np.append(amplitudes, [] if unit.place is None else [unit.place])
    return np.asarray(out)
