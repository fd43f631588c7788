"""What a late sensor shows first is of the time before its recording: nobody knows what drove the motion then."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from .._effects import DELAY
from .._recording import Recording
from ._build import BROAD
from ._found import Found
from ._problem import Problem
from ._stochastic import free_run
from ._trajectory import Stepper
from ._weighed import Estimate

# How far off, in sd of the noise, what a late sensor shows first may be where no input drives the motion.
_OFF = 2.0


def without_the_time_before(stepper: Stepper, found: Found, recordings: Sequence[Recording]) -> list[Recording] | None:
    """The recordings without what sensors that are late, by the likeliest answer, showed of the time before them; None
    where there is no such reading, or that is how the motion would have been."""
    e = found.of(max(found.estimates, key=found.odds), "white")
    if e is None or not np.isfinite(e.log_evidence):
        return None
    late = [_latest(stepper.problem, e, r) for r in range(len(recordings))]
    hidden = [_before(one, delay) for one, delay in zip(recordings, late, strict=True)]
    if not any(one.any() for one in hidden) or not (stepper.problem.equations.inputs or _is_off(stepper, e, late)):
        return None
    return [replace(one, readings=np.where(some, np.nan, one.readings))
            for one, some in zip(recordings, hidden, strict=True)]  # fmt: skip


def left_out(
    problem: Problem, found: Found, given: Sequence[Recording], used: Sequence[Recording]
) -> list[str]:  # fmt: skip
    """What of the recordings given was left out for that, in sentences, and whether the answer has it so at last."""
    e = found.of(max(found.estimates, key=found.odds), "white")
    late = np.max([_latest(problem, e, r) for r in range(len(given))], axis=0) if e else np.zeros(problem.channels)
    numbers = sum(np.isnan(b.readings).sum(0) - np.isnan(a.readings).sum(0) for a, b in zip(given, used, strict=True))
    told = []
    for column, is_late, n in zip(given[0].columns, late > 0, np.asarray(numbers).tolist(), strict=True):
        how = "is late" if is_late else "seemed to be late"
        told += [f"the sensor of {column} {how}: its first readings, {n} in all, show the time before the recording "
                 "and were left out"] * (n > 0)  # fmt: skip
    return told


def _before(recording: Recording, late: Float[np.ndarray, " channel"]) -> Bool[np.ndarray, "time channel"]:
    """Readings of the time before the first row."""
    return (recording.times[:, None] < recording.times[0] + late) & ~np.isnan(recording.readings)


def _latest(problem: Problem, e: Estimate, recording: int) -> Float[np.ndarray, " channel"]:
    """How late each sensor may be in a recording, by what is known and what was found."""
    late = problem.coefficients(recording, e.z, e.combination)[problem.equations.firsts(DELAY)]
    for member, place in problem.placed(e.combination):
        own = problem.members[member]
        if own.candidate.effect is DELAY and recording in own.recordings:
            late[own.candidate.place] += BROAD * np.sqrt(e.covariance[place.start, place.start])
    return late


def _is_off(stepper: Stepper, e: Estimate, late: Sequence[Float[np.ndarray, " channel"]]) -> bool:
    """Whether what sensors show first is not how the motion would have been before, as of a body that was let go."""
    problem, square, number = stepper.problem, 0.0, 0
    for r, (rows, course, delay) in enumerate(zip(problem.rows, stepper.courses, late, strict=True)):
        shown, _ = free_run(problem, course, e.z, e.combination, r, e.z[r * problem.state :][: problem.state], 0)
        first = (rows.times[:, None] < rows.times[0] + delay) & ~np.isnan(rows.readings)
        errors = ((rows.readings - shown) / e.noise)[first]
        square, number = square + float((errors**2).sum()), number + len(errors)
    return square > _OFF**2 * number
