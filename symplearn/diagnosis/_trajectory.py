"""Trajectories of many combinations at once, with their sensitivities: one compiled function serves them all."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float, Int

from ._batched_steps import LANES as LANES
from ._batched_steps import BatchedSteps
from ._course import Course, costly, courses
from ._lanes import AbstractSteps, Found, Lanes, Threads
from ._native_rows import WIDTH, native_rows
from ._native_steps import NativeSteps
from ._problem import Combination, Problem

DIRECTIONS = WIDTH  # slopes are taken along so many directions at a time

A = TypeVar("A")
B = TypeVar("B")


@dataclass(frozen=True)
class Predictions:
    """Readings of every lane over the first rows of one recording, and their slopes in its own unknowns."""

    readings: Float[np.ndarray, "lane time channel"]
    slopes: Float[np.ndarray, "lane local time channel"]


def _steps(problem: Problem, threads: Threads) -> AbstractSteps:
    """How a problem is stepped: by machine code, where there is one for it and the work is a processor's."""
    along = courses(problem)
    native = native_rows(problem.equations, problem.integrator, along[0].inputs.shape[1])
    return BatchedSteps(along, threads) if native is None else NativeSteps(native, along, threads)


class Stepper:
    """Steps any number of combinations through all recordings on `jobs` threads."""

    def __init__(self, problem: Problem, jobs: int = 1, steps: AbstractSteps | None = None):
        self.problem, self.threads = problem, Threads(jobs)
        self.steps = _steps(problem, self.threads) if steps is None else steps

    @property
    def courses(self) -> Sequence[Course]:
        """What every recording gives to its trajectories."""
        return self.steps.courses

    def on(self, problem: Problem) -> "Stepper":
        """The same for a problem over the same courses, which differs in which readings count or what bounds values."""
        other = Stepper.__new__(Stepper)
        other.problem, other.threads, other.steps = problem, self.threads, self.steps
        return other

    def predict(
        self, zs: Float[np.ndarray, "lane z"], combinations: Sequence[Combination], rows: Sequence[int]
    ) -> list[Predictions]:
        """Predictions by recording, over its first `rows[r]` rows."""
        p, alike = self.problem, self._alike(combinations)
        some, kinds, runs = [combinations[k] for k in alike], set(combinations), []
        for r in range(len(self.courses)):
            local = p.local(r)
            free = {c: np.nonzero(p.active(c)[local])[0] for c in kinds}
            hots = {c: p.onehot(c, r) for c in kinds}
            by_lane = np.stack([hots[c] for c in some])
            runs.append(Lanes(r, zs[alike][:, local], by_lane, [free[c] for c in some], rows[r]))
        return [self._spread(run, found, alike) for run, found in zip(runs, self.steps(p, runs), strict=True)]

    def _alike(self, combinations: Sequence[Combination]) -> Int[np.ndarray, " lane"]:
        """Lanes in an order in which those of the same cost come together, by what acts and by how many directions."""
        p = self.problem
        cost = {c: (-(-int(p.active(c).sum()) // DIRECTIONS), costly(p, c)) for c in set(combinations)}
        return np.lexsort(np.array([cost[c] for c in combinations]).T)

    def _spread(self, run: Lanes, found: Found, order: Int[np.ndarray, " lane"]) -> Predictions:
        """Predictions of lanes that were stepped in an order, as they were given."""
        p = self.problem
        shown = np.empty((len(run.z), run.rows, p.channels))
        shown[order] = found.shown[..., : p.channels]
        slopes = np.zeros((len(run.z), run.z.shape[1], run.rows, p.channels))
        for lane, places, along in zip(order, run.along, found.slopes, strict=True):
            slopes[lane, places] = along[..., : p.channels]
        return Predictions(shown, slopes)

    def ahead(self, work: Callable[[A], B], items: Sequence[A]) -> Iterator[B]:
        """The work on every item in order, on all threads while what comes before is being used; where stepping is
        quick, when its turn comes."""
        return map(work, items) if self.steps.is_quick else self.threads.ahead(work, items)

    def responses(
        self, z: Float[np.ndarray, " z"], combination: Combination, laid: Sequence[Any], rows: int, r: int
    ) -> list[np.ndarray]:
        """Slopes (local, time, channel) of one recording's readings along the amplitudes of further effects.

        `laid` are lanes of further effects as `_scan.layout` has them, at most `LANES`; `combination` moves at `z`.
        """
        p, local = self.problem, self.problem.local(r)
        some, hots = self._beside([(z, combination, one) for one in laid], r)
        along = []
        for _, matrix, amplitudes in laid:
            unseen = [p.equations.width - 1, 2 * p.equations.width - 1] if matrix[-1].any() else []
            along.append(np.concatenate([unseen, self._further + np.concatenate(amplitudes)]).astype(int))
        (found,) = self.steps(p, [Lanes(r, some, hots, along, rows)])
        out = []
        for places, slopes in zip(along, found.slopes, strict=True):
            full = np.zeros((len(local), rows, p.channels))
            full[places] = slopes[..., : p.channels]
            out.append(full)
        return out

    def carried(
        self, z: Float[np.ndarray, " z"], combination: Combination, laid: Sequence[Any], rows: int, r: int
    ) -> list[Float[np.ndarray, "direction time _"]]:
        """Slopes of one recording's readings and phase points, by lane: along the amplitudes of each of `laid`, as in
        `responses`, and along the start where there are none."""
        return [slopes for _, slopes in self.carried_each([(z, combination, one) for one in laid], rows, r)]

    def carried_each(
        self, lanes: Sequence[tuple[np.ndarray, Combination, Any]], rows: int, r: int
    ) -> list[tuple[Float[np.ndarray, "time _"], Float[np.ndarray, "direction time _"]]]:
        """The same of several motions: by lane its unknowns, its combination and one of `laid`; readings and phase
        points, and their slopes."""
        some, hots = self._beside(lanes, r)
        start = np.arange(self.problem.state)
        along = [self._further + np.concatenate(one[2]) if one[2] else start for _, _, one in lanes]
        (found,) = self.steps(self.problem, [Lanes(r, some, hots, along, rows)])
        return list(zip(found.shown, found.slopes, strict=True))

    def about_paths(
        self, paths: Float[np.ndarray, "lane time state"], values: Float[np.ndarray, "lane theta"], hots: np.ndarray,
        slots: Sequence[Int[np.ndarray, " _"]], r: int,
    ) -> tuple[Float[np.ndarray, "lane time _"], Float[np.ndarray, "lane local time _"]]:  # fmt: skip
        """Readings on paths of at most `LANES` lanes and the phase points that every row arrives at from the one before
        it, and the slopes of both in each row's own phase point, the calibrated values and the `slots` named.

        `values` are the calibrated ones and those of the slots, `hots` what coefficients these are (`Problem.onehot`).
        """
        p, (lanes, rows, state) = self.problem, paths.shape
        local_z = np.concatenate([np.zeros((lanes, state)), values], axis=1)
        along = [np.concatenate([p.moving(hot[-1]), self._further + own]) for hot, own in zip(hots, slots, strict=True)]
        (found,) = self.steps(p, [Lanes(r, local_z, hots, along, rows, paths)])
        slopes = np.zeros((lanes, local_z.shape[1], rows, found.shown.shape[-1]))
        for lane, places in enumerate(along):
            slopes[lane, places] = found.slopes[lane]
        return found.shown, slopes

    @property
    def _further(self) -> int:
        """Where the values of further effects stand in what one recording depends on."""
        return self.problem.state + self.problem.calibrated.size

    def _beside(self, lanes: Sequence[tuple[np.ndarray, Combination, Any]], r: int) -> tuple[np.ndarray, np.ndarray]:
        """Unknowns and coefficients of lanes that move as a combination does and have further effects."""
        p = self.problem
        some, hots, motions = [], [], dict[tuple[int, Combination], np.ndarray]()
        for z, combination, (values, matrix, _) in lanes:
            fixed = motions.get((id(z), combination))
            if fixed is None:  # most lanes share a motion
                fixed = p.coefficients(r, z, combination) - p.coefficients(r, z, ())
                motions[id(z), combination] = fixed
            own = z[p.local(r)].copy()
            own[self._further :] = values
            hot = matrix.copy()
            hot[-1] += fixed
            some.append(own)
            hots.append(hot)
        return np.stack(some), np.stack(hots)
