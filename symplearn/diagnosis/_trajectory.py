"""Trajectories of many combinations at once, with their sensitivities: one compiled function serves them all."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import chain
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ._course import costly, courses, effect_coefficients, model_at, switches_of
from ._problem import Combination, Problem

DIRECTIONS = 8  # slopes are taken along so many directions at a time, so that one program is compiled
# Combinations stepped together: a fixed number, so that the answer does not depend on the cores, and a small one, since
# a lane costs as much among few as among many, and those that are lacking are stepped in vain.
LANES = 4

A = TypeVar("A")
B = TypeVar("B")


@eqx.filter_jit
def _sensitivities(equations, integrator, course, zs, onehots, directions, rows, switches, paths, anew):
    """Readings (lane, time, channel) and their slopes (lane, direction, time, channel) over the first `rows` rows.

    Along the last axis the phase points follow the readings, so that one program serves `carried` too, and, where
    every row begins `anew` at its point of a path (lane, time, state), the linearisation about that path: the phase
    points are then those that arrive from the row before.
    """
    state, f = 2 * equations.width, course.to_parameters.shape[0]

    def readings(z, onehot, path):
        coefficients = effect_coefficients(z[state + f :], onehot)
        flow, read = model_at(equations, integrator, course, z[state : state + f], coefficients, switches)
        moved = z[:state] - jax.lax.stop_gradient(z[:state])  # nothing, with the slope of the start

        def body(k, carry):
            x, out = carry
            begun = jnp.where(anew, path[k] + moved, x)
            seen = read(begun, (course.times[k], course.inputs[k]))
            out = out.at[k].set(jnp.concatenate([seen, x]))
            return flow(begun, jax.tree.map(lambda leaf: leaf[k], course.spans)), out

        empty = jnp.zeros((course.times.shape[0], len(equations.columns) + state))
        return jax.lax.fori_loop(0, rows, body, (z[:state], empty))[1]

    def lane(z, onehot, along, path):
        # Forward mode: few unknowns, many readings, and a number of rows that is data.
        slope = lambda tangent: jax.jvp(lambda one: readings(one, onehot, path), (z,), (tangent,))  # noqa: E731
        return jax.vmap(slope, out_axes=(None, 0))(along)

    return jax.vmap(lane)(zs, onehots, directions, paths)


# Arguments of `_sensitivities`, one call for every `DIRECTIONS` directions.
_Run = list[tuple[Any, ...]]


def _arrays(call: tuple[Any, ...]) -> tuple[np.ndarray, np.ndarray]:
    shown, slopes = _sensitivities(*call)
    return np.asarray(shown), np.asarray(slopes)


@dataclass(frozen=True)
class Predictions:
    """Readings of every lane over the first rows of one recording, and their slopes in its own unknowns."""

    readings: Float[np.ndarray, "lane time channel"]
    slopes: Float[np.ndarray, "lane local time channel"]


class Stepper:
    """Steps any number of combinations through all recordings, `LANES` at a time, on `jobs` threads."""

    def __init__(self, problem: Problem, jobs: int = 1):
        self.problem = problem
        self.courses = courses(problem)
        self.no_path = jax.device_put(np.zeros((LANES, len(self.courses[0].times), problem.state)))
        self.jobs = jobs
        self._pool, self._compiled = ThreadPoolExecutor(max(1, jobs)), False

    def on(self, problem: Problem) -> "Stepper":
        """The same for a problem over the same courses, which differs in which readings count or what bounds values."""
        other = Stepper.__new__(Stepper)
        other.problem, other.courses, other.no_path = problem, self.courses, self.no_path
        other.jobs, other._pool, other._compiled = self.jobs, self._pool, self._compiled
        return other

    def predict(
        self, zs: Float[np.ndarray, "lane z"], combinations: Sequence[Combination], rows: Sequence[int]
    ) -> list[Predictions]:
        """Predictions by recording, over its first `rows[r]` rows."""
        p, alike = self.problem, self._alike(combinations)
        chunks = [alike[a : a + LANES] for a in range(0, len(zs), LANES)]
        work, runs = [], []
        for r in range(len(self.courses)):
            for chunk in chunks:
                local, some = p.local(r), [combinations[k] for k in chunk]
                free = [np.nonzero(p.active(c)[local])[0] for c in some]
                hots = np.stack([p.onehot(c, r) for c in some])
                work.append((r, free))
                runs.append(self._run(r, zs[chunk][:, local], hots, free, rows[r]))
        parts = [self._spread(*one, *found, rows) for one, found in zip(work, self._stepped(runs), strict=True)]
        back = np.argsort(alike)
        return [_joined(parts[r * len(chunks) : (r + 1) * len(chunks)], back) for r in range(len(self.courses))]

    def _alike(self, combinations: Sequence[Combination]) -> Int[np.ndarray, " lane"]:
        """Lanes in an order in which those of the same cost come together, by what acts and by how many directions."""
        calls = [-(-int(self.problem.active(c).sum()) // DIRECTIONS) for c in combinations]
        return np.lexsort((calls, [costly(self.problem, c) for c in combinations]))

    def _spread(
        self, r: int, free: Sequence[np.ndarray], shown: np.ndarray, along: np.ndarray, rows: Sequence[int]
    ) -> Predictions:
        """Predictions of some lanes whose slopes are known along their `free` entries."""
        p, number = self.problem, len(free)
        slopes = np.zeros((number, len(p.local(r)), rows[r], p.channels))
        for lane, places in enumerate(free):
            slopes[lane, places] = along[lane, : len(places), : rows[r], : p.channels]
        return Predictions(shown[:number, : rows[r], : p.channels], slopes)

    def _run(
        self, r: int, local_z: np.ndarray, hots: np.ndarray, along: Sequence[np.ndarray], rows: int,
        paths: np.ndarray | None = None,
    ) -> _Run:  # fmt: skip
        """What yields readings and phase points of at most `LANES` lanes and their slopes along the entries that
        `along` names; with `paths` every row begins anew at its own."""
        number, p = len(local_z), self.problem
        lanes = np.arange(LANES) % number
        width = -(-max(1, *map(len, along)) // DIRECTIONS) * DIRECTIONS
        directions = np.zeros((number, width, local_z.shape[1]))
        for lane, places in enumerate(along):
            directions[lane, np.arange(len(places)), places] = 1.0
        some, matrices = (jax.device_put(a[lanes]) for a in (local_z, hots))
        last, switches, anew = jnp.asarray(rows), switches_of(p, r, hots), jnp.asarray(paths is not None)
        begun = self.no_path if paths is None else jax.device_put(paths[lanes])
        return [
            (
                p.equations, p.integrator, self.courses[r], some, matrices,
                jax.device_put(directions[lanes, k : k + DIRECTIONS]), last, switches, begun, anew,
            )
            for k in range(0, width, DIRECTIONS)
        ]  # fmt: skip

    def _stepped(self, runs: Sequence[_Run]) -> list[tuple[np.ndarray, np.ndarray]]:
        """What runs yield, of `LANES` lanes each: side by side on all threads, which wait for nothing but these.

        The very first goes before, or every thread would compile it.
        """
        calls = [call for run in runs for call in run]
        alone = [] if self._compiled else [_arrays(calls.pop(0))]
        self._compiled = True
        side_by_side = self.jobs > 1 and len(calls) > 1
        done = chain(alone, self._pool.map(_arrays, calls) if side_by_side else map(_arrays, calls))
        found = [[next(done) for _ in run] for run in runs]
        return [(parts[0][0], np.concatenate([slopes for _, slopes in parts], axis=1)) for parts in found]

    def ahead(self, work: Callable[[A], B], items: Sequence[A]) -> Iterator[B]:
        """The work on every item in order, on all threads while what comes before is being used."""
        if self.jobs < 2 or len(items) < 2:
            yield from map(work, items)
            return
        with ThreadPoolExecutor(self.jobs) as pool:
            yield from pool.map(work, items)

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
        ((_, slopes),) = self._stepped([self._run(r, some, hots, along, rows)])
        out = []
        for lane, places in enumerate(along):
            full = np.zeros((len(local), rows, p.channels))
            full[places] = slopes[lane, : len(places), :rows, : p.channels]
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
        parts = [slice(a, a + LANES) for a in range(0, len(along), LANES)]
        done = self._stepped([self._run(r, some[few], hots[few], along[few], rows) for few in parts])
        return [(x[:rows], own[: len(places), :rows]) for few, found in zip(parts, done, strict=True)
                for x, own, places in zip(*found, along[few], strict=False)]  # fmt: skip

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
        whole = np.zeros((lanes, len(self.courses[r].times), state))
        whole[:, :rows] = paths
        along = [np.concatenate([p.moving(hot[-1]), self._further + own]) for hot, own in zip(hots, slots, strict=True)]
        ((out, found),) = self._stepped([self._run(r, local_z, hots, along, rows, whole)])
        slopes = np.zeros((lanes, local_z.shape[1], rows, out.shape[-1]))
        for lane, places in enumerate(along):
            slopes[lane, places] = found[lane, : len(places), :rows]
        return out[:lanes, :rows], slopes

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


def _joined(parts: list[Predictions], order: np.ndarray) -> Predictions:
    return Predictions(*(np.concatenate([getattr(p, f) for p in parts])[order] for f in ("readings", "slopes")))
