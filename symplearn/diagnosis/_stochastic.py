"""The augmented simulation as a state-space model with a white missing force, and its unscented filter."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import integrators as ig

from .._augmented import Span
from .._filter import Filtered, unscented_filter
from .._model import Gaussian, StateSpaceModel
from .._smoother import Smoothed, smooth
from ._calibrate import THINNED
from ._problem import Combination, Problem
from ._trajectory import Course, model_at


class MissingForce(eqx.Module):
    """Process noise of a white force on the momenta: exact for free flight with the given softness d2H/dp2."""

    intensity: Float[Array, " d"]  # squared force times time
    softness: Float[Array, " d"]

    def covariance(self, span: Span) -> Float[Array, "state state"]:
        t = span.step * span.inputs.shape[-2]
        q, w = self.intensity, self.softness
        cross = jnp.diag(0.5 * w * q * t**2)
        return jnp.block([[jnp.diag(w**2 * q * t**3 / 3), cross], [cross, jnp.diag(q * t)]])


class _RowNoise(eqx.Module):
    """Reading noise; rows that average many readings are scaled to it beforehand."""

    variance: Float[Array, " channel"]

    def covariance(self) -> Float[Array, "channel channel"]:
        return jnp.diag(self.variance)


class _Scaled(eqx.Module):
    """An observation scaled by the root of each row's information, so that every row has the same noise."""

    inner: Any

    def __call__(self, x: Array, context: Any) -> Array:
        row, root = context
        return self.inner(x, row) * root


def filter_lane(
    equations, integrator, course, calibrated, coefficients, noise, intensity, soft, x, spread, readings, roots
) -> tuple[StateSpaceModel, Any, Any, Filtered]:
    """Filter the leading rows that `readings` covers from N(x, spread); also the model and what it was given.

    `noise` is that of one original reading; `roots` (time, channel) the root of each row's information in its units.
    """
    flow, read = model_at(equations, integrator, course, calibrated, coefficients)
    force, initial = MissingForce(intensity, soft), Gaussian(x, spread)
    model = StateSpaceModel(flow, _Scaled(read), force, _RowNoise(noise**2), initial)
    n = readings.shape[0]
    spans = jax.tree.map(lambda leaf: leaf[: n - 1], course.spans)
    contexts = ((course.times[:n], course.inputs[:n]), roots)
    return model, spans, contexts, unscented_filter(model, readings * roots, spans, contexts)


_filter = eqx.filter_jit(filter_lane)


@eqx.filter_jit
def _smooth(model, filtered, spans, contexts):
    return smooth(model, filtered, spans, contexts)


def row_roots(problem: Problem, recording: int, rows: int, ratio: Float[np.ndarray, " channel"]) -> np.ndarray:
    """Square root of each row's information in units of one reading's (time, channel); 1 where there is none.

    `ratio` is the variance of a coloured error over the white one: averaging rows does not make it smaller.
    """
    counts = problem.rows[recording].counts[:rows]
    white = np.where(counts > 1, THINNED / np.where(counts > 1, counts, 1.0), 1.0)
    return np.sqrt((1.0 + ratio) / (white + ratio))


def softness(problem: Problem, course: Course, z: np.ndarray, recording: int) -> np.ndarray:
    """d2H/dp_i2 at the initial phase point, by which a missing impulse becomes a missing velocity."""
    eq = problem.equations
    x = z[recording * problem.state : (recording + 1) * problem.state]
    rest = [problem.parameter_values(z), course.inputs[0], course.times[:1], np.zeros(len(eq.candidates))]
    return np.asarray(eq.softness(jnp.concatenate([jnp.asarray(part, float) for part in (x, *rest)])))


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
    rows: int,
    seen: int | None = None,
) -> tuple[Any, Filtered]:
    """Filter the first `rows` rows from the phase point in `z` with covariance `spread`; also returns its inputs.

    Readings from row `seen` on are hidden from the filter.
    """
    onehot, head, f = problem.onehot(combination), problem.head, problem.calibrated.size
    readings = problem.rows[recording].readings[:rows].copy()
    readings[seen if seen is not None else rows :] = np.nan
    model, spans, contexts, filtered = _filter(
        problem.equations,
        problem.integrator,
        course,
        jnp.asarray(z[head : head + f]),
        jnp.asarray(z[head + f :] @ onehot),
        jnp.asarray(noise),
        jnp.asarray(intensity),
        jnp.asarray(softness(problem, course, z, recording)),
        jnp.asarray(z[recording * problem.state : (recording + 1) * problem.state]),
        jnp.asarray(spread),
        jnp.asarray(readings),
        jnp.asarray(row_roots(problem, recording, rows, ratio)),
    )
    return (model, spans, contexts), filtered


def run_smoother(parts: Any, filtered: Filtered) -> Smoothed:
    """Smooth what `run_filter` filtered."""
    model, spans, contexts = parts
    return _smooth(model, filtered, spans, contexts)


def free_run(
    problem: Problem, course: Course, z: np.ndarray, combination: Combination, recording: int, x: Any, rows: slice
) -> tuple[Float[Array, "time channel"], Float[Array, "time state"]]:
    """Readings and phase points over `rows` of a run that starts from `x` at the first of them and looks at nothing."""
    coefficients = problem.coefficients(recording, z, combination) - problem.coefficients(recording, z, ())
    head, f = problem.head, problem.calibrated.size
    part = jax.tree.map(lambda leaf: leaf[rows], (course.spans, course.times, course.inputs))
    return _run(
        problem.equations,
        problem.integrator,
        eqx.tree_at(lambda c: (c.spans, c.times, c.inputs), course, part),
        jnp.asarray(z[head : head + f]),
        jnp.asarray(coefficients),
        jnp.asarray(x),
    )


@eqx.filter_jit
def _run(equations: Any, integrator: ig.AbstractIntegrator, course: Course, calibrated, coefficients, x):
    flow, read = model_at(equations, integrator, course, calibrated, coefficients)

    def step(x, row):
        span, t, inputs = row
        return flow(x, span), (read(x, (t, inputs)), x)

    return jax.lax.scan(step, x, (course.spans, course.times, course.inputs))[1]
