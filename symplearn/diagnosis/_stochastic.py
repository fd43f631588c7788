"""The augmented simulation as a state-space model with a white missing force, and its unscented filter."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import integrators as ig

from .._augmented_flow import Span
from .._filter import Filtered, unscented_filter
from .._lane_loops import with_lane_loops
from .._model import Gaussian, StateSpaceModel
from ._calibrate import THINNED
from ._course import Course, model_at
from ._native_rows import native_rows
from ._native_steps import run_natively
from ._problem import Combination, Problem
from ._trajectory import Stepper


class MissingForce(eqx.Module):
    """Process noise of a white force on the momenta: exact for free flight with the given softness d2H/dp2."""

    intensity: Float[Array, " d"]  # squared force times time
    softness: Float[Array, " d"]
    unseen: int = eqx.field(static=True, default=0)

    def covariance(self, context: tuple[Span, Array]) -> Float[Array, "state state"]:
        span, exposure = context
        t = span.length
        q, w = self.intensity * exposure, self.softness
        cross = self._filled(0.5 * w * q * t**2)
        return jnp.block([[self._filled(w**2 * q * t**3 / 3), cross], [cross, self._filled(q * t)]])

    def _filled(self, values: Array) -> Array:
        """A diagonal, with nothing for an unseen oscillator."""
        return jnp.diag(jnp.pad(values, (0, self.unseen)))


class _Carried(eqx.Module):
    """A flow over spans that also say in which share of them the missing force acts."""

    inner: Any

    def __call__(self, x: Array, context: tuple[Span, Array]) -> Array:
        return self.inner(x, context[0])


class RowNoise(eqx.Module):
    """Reading noise; rows that average many readings are scaled to it beforehand."""

    variance: Float[Array, " channel"]

    def covariance(self, context: Any) -> Float[Array, "channel channel"]:
        return jnp.diag(self.variance)


class _Scaled(eqx.Module):
    """An observation scaled by the root of each row's information, so that every row has the same noise."""

    inner: Any

    def __call__(self, x: Array, context: Any) -> Array:
        row, root = context
        return self.inner(x, row) * root


def filter_lane(
    equations, integrator, course, calibrated, coefficients, noise, intensity, exposure, soft, x, spread, readings,
    roots,
) -> tuple[StateSpaceModel, Any, Any, Filtered]:  # fmt: skip
    """Filter the leading rows that `readings` covers from N(x, spread); also the model and what it was given.

    `noise` is that of one original reading; `roots` (time, channel) the root of each row's information in its units;
    `exposure` (time,) the share of each span in which the missing force acts.
    """
    flow, read = model_at(equations, integrator, course, calibrated, coefficients)
    force, initial = MissingForce(intensity, soft, int(equations.hidden)), Gaussian(x, spread)
    model = StateSpaceModel(_Carried(flow), _Scaled(read), force, RowNoise(noise**2), initial)
    n = readings.shape[0]
    spans = jax.tree.map(lambda leaf: leaf[: n - 1], (course.spans, exposure))
    contexts = ((course.times[:n], course.inputs[:n]), roots)
    filtered = with_lane_loops(lambda scaled: unscented_filter(model, scaled, spans, contexts))(readings * roots)
    return model, spans, contexts, filtered


_filter = eqx.filter_jit(filter_lane)


def row_roots(problem: Problem, recording: int, length: int, ratio: Float[np.ndarray, " channel"]) -> np.ndarray:
    """Square root of each row's information in units of one reading's (time, channel); 1 where there is none.

    `ratio` is the variance of a coloured error over the white one: averaging rows does not make it smaller. Rows up
    to `length` are filled in.
    """
    counts = padded(problem.rows[recording].counts, length, 0.0)
    white = np.where(counts > 1, THINNED / np.where(counts > 1, counts, 1.0), 1.0)
    return np.sqrt((1.0 + ratio) / (white + ratio))


def padded(values: Float[np.ndarray, "time ..."], length: int, fill: float) -> Float[np.ndarray, "length ..."]:
    """Rows up to `length`, so that recordings of every length share one compiled function."""
    out = np.full((length, *values.shape[1:]), fill)
    out[: len(values)] = values[:length]
    return out


def exposure(exposures: Sequence[np.ndarray] | None, r: int, length: int) -> Float[np.ndarray, " length"]:
    """Share of each span of a recording in which the missing force acts, up to `length`: none after those given."""
    return np.ones(length) if exposures is None else padded(exposures[r], length, 0.0)


def softness(problem: Problem, course: Course, z: np.ndarray, recording: int) -> np.ndarray:
    """d2H/dp_i2 at the initial phase point, by which a missing impulse becomes a missing velocity."""
    eq = problem.equations
    x = z[recording * problem.state : (recording + 1) * problem.state].reshape(2, -1)[:, : eq.dim].ravel()
    inputs = np.asarray(course.inputs)[0, : len(eq.inputs)]
    rest = [problem.parameter_values(recording, z), inputs, np.asarray(course.times)[:1]]
    return np.asarray(eq.softness(jax.device_put(np.concatenate([x, *rest, np.zeros(eq.size)]))))


def run_filter(
    problem: Problem,
    course: Course,
    recording: int,
    z: Float[np.ndarray, " z"],
    combination: Combination,
    noise: Float[np.ndarray, " channel"],
    ratio: Float[np.ndarray, " channel"],
    intensity: Float[np.ndarray, " d"],
    spread: Float[np.ndarray, "state state"],
    readings: Float[np.ndarray, "row channel"],
    exposures: Sequence[np.ndarray] | None = None,
) -> tuple[Any, Filtered]:
    """Filter a recording from the phase point in `z` with covariance `spread`; also returns what the filter was given.

    `exposures` holds the share of each span in which the missing force acts, by recording; None where it always does.
    Readings after those of the leading rows that are given are hidden; rows beyond the recording's own are padding.
    """
    length = course.times.shape[0]
    head, f = problem.head, problem.calibrated.size
    found = problem.coefficients(recording, z, combination) - problem.coefficients(recording, z, ())
    model, spans, contexts, filtered = _filter(
        problem.equations,
        problem.integrator,
        course,
        jax.device_put(z[head : head + f]),
        jax.device_put(found),
        jax.device_put(noise),
        jax.device_put(intensity),
        jax.device_put(exposure(exposures, recording, length)),
        jax.device_put(softness(problem, course, z, recording)),
        jax.device_put(z[recording * problem.state : (recording + 1) * problem.state]),
        jax.device_put(spread),
        jax.device_put(padded(readings, length, np.nan)),
        jax.device_put(row_roots(problem, recording, length, ratio)),
    )
    return (model, spans, contexts), filtered


def free_run(
    problem: Problem, course: Course, z: np.ndarray, combination: Combination, recording: int, x: Any, start: int
) -> tuple[Float[np.ndarray, "time channel"], Float[np.ndarray, "time state"]]:
    """Readings and phase points from row `start` on of a run that begins at `x` there and looks at no reading."""
    coefficients = problem.coefficients(recording, z, combination) - problem.coefficients(recording, z, ())
    head, f = problem.head, problem.calibrated.size
    native = native_rows(problem.equations, problem.integrator, course.inputs.shape[1])
    if native is not None:
        shown = run_natively(native, problem, course, recording, np.append(x, z[head : head + f]), coefficients, start)
        return shown[:, : problem.channels], shown[:, problem.channels :]
    readings, states = run_lane(
        problem.equations,
        problem.integrator,
        course,
        jax.device_put(z[head : head + f]),
        jax.device_put(coefficients),
        jax.device_put(x),
        jnp.asarray(start),
    )
    rows = slice(start, len(problem.rows[recording].times))
    return np.asarray(readings)[rows], np.asarray(states)[rows]


def trajectories(
    stepper: Stepper, z: Float[np.ndarray, " z"], combination: Combination, rows: Sequence[int]
) -> list[Float[np.ndarray, "row state"]]:
    """Phase points of free runs of a combination at the leading rows of every recording, from z's initial states."""
    p, courses = stepper.problem, stepper.courses
    begins = [z[r * p.state : (r + 1) * p.state] for r in range(len(rows))]
    return [free_run(p, courses[r], z, combination, r, x, 0)[1][: rows[r]] for r, x in enumerate(begins)]


@eqx.filter_jit
def run_lane(equations: Any, integrator: ig.AbstractIntegrator, course: Course, calibrated, coefficients, x, start):
    """Readings and phase points of all rows, of a run that begins at `x` in row `start`."""
    flow, read = model_at(equations, integrator, course, calibrated, coefficients)

    def step(x, row):
        k, span, t, inputs = row
        return jnp.where(k >= start, flow(x, span), x), (read(x, (t, inputs)), x)

    places = jnp.arange(course.times.shape[0])
    return jax.lax.scan(step, x, (places, course.spans, course.times, course.inputs))[1]
