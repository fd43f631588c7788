"""Trajectories with their sensitivities by machine code, lane by lane."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from ._course import Course, needed_each
from ._lanes import AbstractSteps, Found, Lanes, Threads
from ._native_rows import WIDTH, Blocks, NativeRows, Rail
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
        laid, number = [self._laid(problem, run) for run in runs], self._threads(runs)
        shares = [np.array_split(np.arange(len(run.z)), number) for run in runs]
        for _ in self.threads.each(lambda some: self._step(runs, laid, some), list(zip(*shares, strict=True))):
            pass  # it is written where it was laid out
        return [Found(blocks.out, _slopes(run, blocks)) for run, blocks in zip(runs, laid, strict=True)]

    def _threads(self, runs: Sequence[Lanes]) -> int:
        """On how many threads runs are worth their handing over."""
        substeps = [int(self.rails[run.recording].pieces[: run.rows].sum()) for run in runs]
        blocks = [sum(map(_blocks, run.along)) for run in runs]
        return self.threads.jobs if np.dot(substeps, blocks) > _WORTH else 1

    def _laid(self, problem: Problem, run: Lanes) -> Blocks:
        """What the machine takes for a run, and where it writes."""
        known, links = self.links[run.recording]
        number, first = len(links), known.size - run.hots.shape[2]
        values = known + run.z[:, :number] @ links
        values[:, first:] += (run.z[:, None, number:] @ run.hots[:, :-1])[:, 0] + run.hots[:, -1]
        counts = [len(places) for places in run.along]
        lanes, owners = (np.repeat(np.arange(len(run.z)), each) for each in (list(map(_blocks, run.along)), counts))
        places = np.concatenate(run.along)
        rows = np.arange(len(places)) + np.repeat(_begins(lanes, len(run.z)) - np.cumsum([0, *counts[:-1]]), counts)
        free, is_slot = np.zeros((len(lanes) * WIDTH, known.size)), places >= number
        free[rows[~is_slot]] = links[places[~is_slot]]
        free[rows[is_slot], first:] = run.hots[owners[is_slot], places[is_slot] - number]
        slopes = np.ascontiguousarray(free.reshape(len(lanes), WIDTH, -1).transpose(0, 2, 1))
        paths = None if run.paths is None else np.ascontiguousarray(run.paths, float)
        shape, switches = (run.rows, self.native.shown), needed_each(problem, run.recording, run.hots)
        return Blocks(lanes, values, switches, slopes, paths,
                      np.empty((len(run.z), *shape)), np.empty((len(lanes), WIDTH, *shape)))  # fmt: skip

    def _step(self, runs: Sequence[Lanes], laid: Sequence[Blocks], some: Sequence[Int[np.ndarray, " _"]]) -> None:
        """Step some lanes of every run."""
        for run, blocks, lanes in zip(runs, laid, some, strict=True):
            if lanes.size:
                own = np.arange(*np.searchsorted(blocks.lanes, [lanes[0], lanes[-1] + 1]))
                self.native(blocks, own, self.rails[run.recording])


def _blocks(places: Int[np.ndarray, " _"]) -> int:
    """How many blocks a lane with slopes in so many entries has: one at least, which tells its readings."""
    return -(-max(1, len(places)) // WIDTH)


def _begins(lanes: Int[np.ndarray, " block"], number: int) -> Int[np.ndarray, " lane"]:
    """Which of the directions of all blocks is the first of every lane."""
    return np.searchsorted(lanes, np.arange(number)) * WIDTH


def _slopes(run: Lanes, blocks: Blocks) -> list[Float[np.ndarray, "_ time shown"]]:
    """By lane the slopes in the entries that were named."""
    along, begins = blocks.along.reshape(-1, *blocks.along.shape[2:]), _begins(blocks.lanes, len(run.z))
    return [along[begin : begin + len(places)] for begin, places in zip(begins, run.along, strict=True)]


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
    switches, one = needed_each(problem, recording, coefficients[None, None]), np.zeros(1, int)
    out, along = np.empty((1, rows, native.shown)), np.empty((1, WIDTH, rows, native.shown))
    blocks = Blocks(one, values[None], switches, np.zeros((1, known.size, WIDTH)), None, out, along)
    native(blocks, one, Rail.of(course).since(start))
    return out[0]


def _link(course: Course, state: int) -> tuple[Float[np.ndarray, " taken"], Float[np.ndarray, "known taken"]]:
    """What the machine takes where all unknowns are zero, and what each unknown but the slots adds to it."""
    parameters, terms, to_parameters, to_coefficients = map(
        np.asarray, (course.parameters, course.terms, course.to_parameters, course.to_coefficients)
    )
    known = np.concatenate([np.zeros(state), parameters, terms])
    rows = np.concatenate([to_parameters, to_coefficients], axis=1)
    start = np.eye(state, known.size)
    return known, np.concatenate([start, np.pad(rows, [(0, 0), (state, 0)])])
