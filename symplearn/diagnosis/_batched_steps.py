"""Trajectories with their sensitivities, many at once, by XLA: on graphics cards, and without machine code."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._augmented_system import Switches
from ._course import Course, effect_coefficients, model_at, needed
from ._lanes import AbstractSteps, Found, Lanes, Threads
from ._problem import Problem

DIRECTIONS = 8  # slopes are taken along so many directions at a time, so that one program is compiled
# Combinations stepped together: a fixed number, so that the answer does not depend on the cores, and a small one, since
# a lane costs as much among few as among many, and those that are lacking are stepped in vain.
LANES = 4


class BatchedSteps(AbstractSteps):
    """Steps `LANES` motions and `DIRECTIONS` directions at a time."""

    def __init__(self, courses: Sequence[Course], threads: Threads):
        self.courses, self.threads = courses, threads

    def __call__(self, problem: Problem, runs: Sequence[Lanes]) -> list[Found]:
        calls, owners = [], []
        for k, run in enumerate(runs):
            for a in range(0, len(run.z), LANES):
                for call in self._calls(problem, run, slice(a, a + LANES)):
                    calls.append(call)
                    owners.append((k, a))
        found: dict[tuple[int, int], list[tuple[np.ndarray, np.ndarray]]] = {}
        for owner, done in zip(owners, self.threads.each(_arrays, calls), strict=True):
            found.setdefault(owner, []).append(done)
        return [self._joined(run, [found[k, a] for a in range(0, len(run.z), LANES)]) for k, run in enumerate(runs)]

    def _calls(self, problem: Problem, run: Lanes, few: slice) -> list[tuple[Any, ...]]:
        """Arguments of `_sensitivities` for a few of a run's lanes, one call for every `DIRECTIONS` directions."""
        number = len(run.z[few])
        lanes, course = np.arange(LANES) % number, self.courses[run.recording]
        width = -(-max(1, *map(len, run.along[few])) // DIRECTIONS) * DIRECTIONS
        directions = np.zeros((number, width, run.z.shape[1]))
        for lane, places in enumerate(run.along[few]):
            directions[lane, np.arange(len(places)), places] = 1.0
        paths = np.zeros((LANES, len(course.times), problem.state))
        if run.paths is not None:
            paths[:, : run.rows] = run.paths[few][lanes]
        some = [jax.device_put(a) for a in (run.z[few][lanes], run.hots[few][lanes])]
        switches = Switches(*map(jnp.asarray, needed(problem, run.recording, run.hots[few])))
        rest = jnp.asarray(run.rows), switches, jax.device_put(paths), jnp.asarray(run.paths is not None)
        return [
            (problem.equations, problem.integrator, course, *some,
             jax.device_put(directions[lanes, k : k + DIRECTIONS]), *rest)
            for k in range(0, width, DIRECTIONS)
        ]  # fmt: skip

    def _joined(self, run: Lanes, parts: Sequence[Sequence[tuple[np.ndarray, np.ndarray]]]) -> Found:
        """What a run's calls have found, by lane."""
        shown = np.concatenate([calls[0][0] for calls in parts])[: len(run.z), : run.rows]
        slopes = [along for calls in parts for along in np.concatenate([one for _, one in calls], axis=1)]
        return Found(shown, [own[: len(places), : run.rows] for own, places in zip(slopes, run.along, strict=False)])


def _arrays(call: tuple[Any, ...]) -> tuple[np.ndarray, np.ndarray]:
    shown, slopes = _sensitivities(*call)
    return np.asarray(shown), np.asarray(slopes)


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
