"""Trajectories of many combinations at once, with their sensitivities: one compiled function serves them all."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import integrators as ig

from .._augmented import Equations, SimulatedFlow, SimulatedReading, Span
from ._problem import SLOTS, Combination, Problem

LANES = 8  # combinations stepped together; a fixed number, so that the answer does not depend on the cores


class Course(eqx.Module):
    """What one recording gives to a trajectory: spans, rows, and the part of the model that is its own."""

    spans: Span
    times: Float[Array, " time"]
    inputs: Float[Array, "time input"]
    parameters: Float[Array, " parameter"]
    terms: Float[Array, " candidate"]
    # How calibrated values enter the parameters and the coefficients.
    to_parameters: Float[Array, "f parameter"]
    to_coefficients: Float[Array, "f candidate"]


def courses(problem: Problem) -> list[Course]:
    """The courses of a problem's recordings, padded to one length."""
    longest = max(len(rows.times) for rows in problem.rows)
    return [_course(problem, r, longest) for r in range(len(problem.rows))]


def _course(problem: Problem, r: int, length: int) -> Course:
    rows, c = problem.rows[r], problem.calibrated
    to_parameters = np.zeros((c.size, len(problem.parameters)))
    to_coefficients = np.zeros((c.size, len(problem.equations.candidates)))
    for j in range(c.size):
        table = to_parameters if j < c.parameters else to_coefficients
        table[j, c.place[j]] = c.recordings[r, j]
    known = problem.parameters.copy()
    known[c.place[: c.parameters]] = 0.0
    lack = length - len(rows.times)

    def padded(leaf: Array, more: int) -> Array:
        return jnp.pad(jnp.asarray(leaf), [(0, more)] + [(0, 0)] * (jnp.ndim(leaf) - 1))

    return Course(
        # One span more than there are gaps: the last leads nowhere, and padding has steps of length zero.
        jax.tree.map(partial(padded, more=lack + 1), rows.spans),
        padded(jnp.asarray(rows.times), lack),
        padded(jnp.asarray(rows.inputs), lack),
        *(jnp.asarray(a) for a in (known, problem.terms[r], to_parameters, to_coefficients)),
    )


def model_at(
    equations: Equations, integrator: ig.AbstractIntegrator, course: Course, calibrated: Array, coefficients: Array
) -> tuple[SimulatedFlow, SimulatedReading]:
    """Flow and observation at calibrated values, with `coefficients` added to the terms already there."""
    parameters = course.parameters + calibrated @ course.to_parameters
    total = course.terms + calibrated @ course.to_coefficients + coefficients
    return (
        SimulatedFlow(equations, integrator, parameters, total),
        SimulatedReading(equations, parameters, total),
    )


@eqx.filter_jit
def _sensitivities(equations, integrator, course, zs, onehots, rows):
    """Readings (lane, time, channel) and their slopes (lane, local, time, channel) over the first `rows` rows."""
    state, f = 2 * equations.dim, course.to_parameters.shape[0]

    def readings(z, onehot):
        flow, read = model_at(equations, integrator, course, z[state : state + f], z[state + f :] @ onehot)

        def body(k, carry):
            x, out = carry
            out = out.at[k].set(read(x, (course.times[k], course.inputs[k])))
            return flow(x, jax.tree.map(lambda leaf: leaf[k], course.spans)), out

        empty = jnp.zeros((course.times.shape[0], len(equations.columns)))
        return jax.lax.fori_loop(0, rows, body, (z[:state], empty))[1]

    def lane(z, onehot):
        # Forward mode: few unknowns, many readings, and a number of rows that is data.
        slope = lambda tangent: jax.jvp(lambda one: readings(one, onehot), (z,), (tangent,))  # noqa: E731
        return jax.vmap(slope, out_axes=(None, 0))(jnp.eye(z.shape[0]))

    return jax.vmap(lane)(zs, onehots)


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
        self.jobs = jobs

    def predict(
        self, zs: Float[np.ndarray, "lane z"], combinations: Sequence[Combination], rows: Sequence[int]
    ) -> list[Predictions]:
        """Predictions by recording, over its first `rows[r]` rows."""
        onehots = np.stack([self.problem.onehot(c) for c in combinations])
        chunks = [slice(a, a + LANES) for a in range(0, len(zs), LANES)]
        work = [(r, chunk) for r in range(len(self.courses)) for chunk in chunks]
        with ThreadPoolExecutor(max(1, self.jobs)) as pool:
            parts = list(pool.map(lambda w: self._chunk(zs, onehots, rows[w[0]], *w), work))
        return [_joined(parts[r * len(chunks) : (r + 1) * len(chunks)]) for r in range(len(self.courses))]

    def _chunk(self, zs: np.ndarray, onehots: np.ndarray, rows: int, r: int, chunk: slice) -> Predictions:
        p = self.problem
        count = len(zs[chunk])
        some = np.resize(zs[chunk][:, p.local(r)], (LANES, p.state + p.calibrated.size + SLOTS))
        hots = np.resize(onehots[chunk], (LANES, *onehots.shape[1:]))
        out, slopes = _sensitivities(
            p.equations, p.integrator, self.courses[r], jnp.asarray(some), jnp.asarray(hots), jnp.asarray(rows)
        )
        return Predictions(np.asarray(out)[:count, :rows], np.asarray(slopes)[:count, :, :rows])


def _joined(parts: list[Predictions]) -> Predictions:
    return Predictions(*(np.concatenate([getattr(p, f) for p in parts]) for f in ("readings", "slopes")))
