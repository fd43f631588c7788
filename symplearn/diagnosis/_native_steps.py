"""Trajectories with their sensitivities by machine code, lane by lane."""

from collections.abc import Sequence
from itertools import chain, islice

import numpy as np
from jaxtyping import Float

from ._course import Course, needed
from ._lanes import AbstractSteps, Found, Lanes, Threads
from ._native_rows import WIDTH, NativeRows, Rail
from ._problem import Problem

# Substeps, each with the slopes of one register, that take as long as some ten tasks of a thread: two milliseconds.
_WORTH = 4000
# Substeps of all recordings from which on stepping is worth a thread beside what is done with its results: the demo,
# of 1,500, took 0.4 of 15.8 s longer with two threads than with one.
_LONG = 10_000


class NativeSteps(AbstractSteps):
    """Steps every lane on its own, `WIDTH` directions at a time."""

    def __init__(self, native: NativeRows, courses: Sequence[Course], threads: Threads):
        self.native, self.courses, self.threads = native, courses, threads
        self.rails = [Rail.of(course) for course in courses]
        self.links = [_link(course, native.state) for course in courses]

    @property
    def is_quick(self) -> bool:
        return sum(int(rail.pieces.sum()) for rail in self.rails) < _LONG

    def __call__(self, problem: Problem, runs: Sequence[Lanes]) -> list[Found]:
        work = [(problem, run, lane) for run in runs for lane in range(len(run.z))]
        shares = np.array_split(np.arange(len(work)), self._threads(runs))
        parts = self.threads.each(lambda some: [self._lane(*work[k]) for k in some], shares)
        done, out = chain.from_iterable(parts), []
        for run in runs:
            shown, slopes = zip(*islice(done, len(run.z)), strict=True)
            out.append(Found(np.stack(shown), slopes))
        return out

    def _threads(self, runs: Sequence[Lanes]) -> int:
        """On how many threads runs are worth their handing over."""
        substeps = [int(self.rails[run.recording].pieces[: run.rows].sum()) for run in runs]
        blocks = [sum(-(-len(places) // WIDTH) for places in run.along) for run in runs]
        return self.threads.jobs if np.dot(substeps, blocks) > _WORTH else 1

    def _lane(self, problem: Problem, run: Lanes, lane: int) -> tuple[np.ndarray, np.ndarray]:
        """Readings and phase points of one lane, and their slopes."""
        r, z, hot, places = run.recording, run.z[lane], run.hots[lane], run.along[lane]
        known, links = self.links[r]
        number, first = len(links), known.size - hot.shape[1]
        values = known + z[:number] @ links
        values[first:] += z[number:] @ hot[:-1] + hot[-1]
        blocks, is_slot = -(-max(1, len(places)) // WIDTH), places >= number
        free = np.zeros((blocks * WIDTH, known.size))
        free[: len(places)][~is_slot] = links[places[~is_slot]]
        free[: len(places), first:][is_slot] = hot[places[is_slot] - number]
        slopes = np.ascontiguousarray(free.reshape(blocks, WIDTH, -1).transpose(0, 2, 1))
        path = None if run.paths is None else np.ascontiguousarray(run.paths[lane], float)
        out, along = np.empty((run.rows, self.native.shown)), np.empty((blocks * WIDTH, run.rows, self.native.shown))
        switches = needed(problem, r, hot[None])
        for k, block in enumerate(slopes):
            self.native(values, block, self.rails[r], switches, path, out, along[k * WIDTH : (k + 1) * WIDTH])
        return out, along[: len(places)]


def run_natively(
    native: NativeRows, problem: Problem, course: Course, recording: int, unknowns: Float[np.ndarray, " unknown"],
    coefficients: Float[np.ndarray, " coefficient"], start: int,
) -> Float[np.ndarray, "time shown"]:  # fmt: skip
    """Readings and phase points from row `start` on, where a run begins whose phase point and calibrated values are
    the `unknowns`; `coefficients` are added to those already there."""
    known, links = _link(course, native.state)
    values = known + unknowns @ links
    values[known.size - coefficients.size :] += coefficients
    rows = len(problem.rows[recording].times) - start
    out, along = np.empty((rows, native.shown)), np.empty((WIDTH, rows, native.shown))
    switches = needed(problem, recording, coefficients[None, None])
    native(values, np.zeros((known.size, WIDTH)), Rail.of(course).since(start), switches, None, out, along)
    return out


def _link(course: Course, state: int) -> tuple[Float[np.ndarray, " taken"], Float[np.ndarray, "known taken"]]:
    """What the machine takes where all unknowns are zero, and what each unknown but the slots adds to it."""
    parameters, terms, to_parameters, to_coefficients = map(
        np.asarray, (course.parameters, course.terms, course.to_parameters, course.to_coefficients)
    )
    known = np.concatenate([np.zeros(state), parameters, terms])
    rows = np.concatenate([to_parameters, to_coefficients], axis=1)
    start = np.eye(state, known.size)
    return known, np.concatenate([start, np.pad(rows, [(0, 0), (state, 0)])])
