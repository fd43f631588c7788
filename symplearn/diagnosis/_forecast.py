"""Readings to come, before and after: draws from the posterior, each filtered through all rows and run on."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._augmented_flow import Span
from .._errors import InputError
from .._recording import Recording
from .._rows import spans_between
from .._triangular import semidefinite_cholesky
from ._outlook import colour_ratio, intensity_of, start_spread, total_noise
from ._problem import Problem
from ._record import Forecast
from ._stochastic import filter_lane, padded, row_roots, softness
from ._trajectory import Stepper, effect_coefficients, model_at
from ._weighed import Estimate

_DRAWS = 128
_LONGEST = 1_000_000


def forecast_times(recording: Recording, until: float, step: float | None) -> Float[np.ndarray, " time"]:
    """From the last observed time + step to `until`. `InputError` where that is empty or endless."""
    last = float(recording.times[-1])
    step = float(np.median(np.diff(recording.times))) if step is None else step
    if not (math.isfinite(step) and step > 0):
        raise InputError(f"--forecast-step: is {step}; give a positive number in the recording's unit of time")
    if not math.isfinite(until) or until < last + step * (1 - 1e-9):
        raise InputError(
            f"--forecast-until: is {until}, and the last observed time is {last}; give a time at least {step} later"
        )
    count = math.floor((until - last) / step + 1e-9)
    if count > _LONGEST:
        raise InputError(f"--forecast-until: asks for {count:,} rows; give a larger --forecast-step or an earlier time")
    return last + step * np.arange(1, count + 1)


def forecast(
    stepper: Stepper,
    recording: Recording,
    before: Estimate,
    after: Estimate,
    times: Float[np.ndarray, " time"],
    inflation: float,
    seed: int,
) -> Forecast:
    """Mean and sd of the expected readings of the first recording, without reading noise."""
    columns: dict[str, dict[str, np.ndarray]] = {name: {} for name in stepper.problem.equations.columns}
    for label, estimate in (("before", before), ("after", after)):
        drawn = _draws(stepper, recording, estimate, times, inflation, jax.random.key(seed))
        for j, name in enumerate(columns):
            columns[name][label] = drawn[..., j].mean(0)
            columns[name][f"{label}_sd"] = drawn[..., j].std(0)
    return Forecast(times, columns)


def _draws(
    stepper: Stepper, recording: Recording, e: Estimate, times: np.ndarray, inflation: float, key: Array
) -> np.ndarray:
    """Readings (draw, time, channel) of posterior draws, run on from the state filtered through all rows."""
    problem, course, rows = stepper.problem, stepper.courses[0], stepper.problem.rows[0]
    local = problem.local(0)
    root = np.asarray(semidefinite_cholesky(jnp.asarray(e.covariance[np.ix_(local, local)] * inflation)))
    state_key, unit_key = jax.random.split(key)
    units = np.asarray(jax.random.normal(unit_key, (_DRAWS // 2, len(local))))
    zs = e.z[local] + np.concatenate([units, -units]) @ root.T
    path = np.concatenate([rows.times[-1:], times])
    pieces = max(1, math.ceil(np.max(np.diff(path)) / float(np.max(rows.spans.step)) - 1e-9))
    inputs = np.zeros((len(times), 0)) if recording.inputs is None else recording.inputs.at(times)
    ahead = (spans_between(path, pieces, recording.inputs), jnp.asarray(times), jnp.asarray(inputs))
    onehot, noise, length = problem.onehot(e.combination, 0), total_noise(e), course.times.shape[0]
    fixed = (jnp.asarray(noise), jnp.asarray(intensity_of(stepper, e)), jnp.asarray(softness(problem, course, e.z, 0)),
             jnp.asarray(start_spread(stepper, e, 0)), jnp.asarray(padded(rows.readings, length, np.nan)),
             jnp.asarray(row_roots(problem, 0, length, colour_ratio(e))), jnp.asarray(onehot))  # fmt: skip
    drawn = _run_draws(problem.equations, problem.integrator, course, jnp.asarray(_within(problem, zs)), fixed, ahead,
                       jax.random.split(state_key, _DRAWS))  # fmt: skip
    return _finite(np.asarray(drawn))


def _within(problem: Problem, zs: np.ndarray) -> np.ndarray:
    """Draws inside the bounds of the calibrated values."""
    part = slice(problem.state, problem.state + problem.calibrated.size)
    zs[:, part] = np.clip(zs[:, part], problem.calibrated.lower, problem.calibrated.upper)
    return zs


def _finite(drawn: np.ndarray) -> np.ndarray:
    """Draws that stayed finite; `InputError` where hardly any did."""
    good = np.isfinite(drawn).all((1, 2))
    if good.sum() < _DRAWS // 4:
        raise InputError("--forecast-until: the trajectory diverges before that time; give an earlier one")
    return drawn[good]


@eqx.filter_jit
def _run_draws(equations: Any, integrator: Any, course: Any, zs: Array, fixed: Any, ahead: Any, keys: Array) -> Array:
    noise, intensity, soft, spread, readings, roots, onehot = fixed
    spans, times, inputs = ahead
    state, f = 2 * equations.width, course.to_parameters.shape[0]

    def one(z: Array, key: Array) -> Array:
        calibrated, coefficients = z[state : state + f], effect_coefficients(z[state + f :], onehot)
        model, _, _, filtered = filter_lane(
            equations, integrator, course, calibrated, coefficients, noise, intensity, soft, z[:state], spread,
            readings, roots,
        )  # fmt: skip
        first, later = jax.random.split(key)
        root = semidefinite_cholesky(filtered.filtered_covariances[-1])
        x = filtered.filtered_means[-1] + root @ jax.random.normal(first, (state,))
        flow, read = model_at(equations, integrator, course, calibrated, coefficients)
        pushes = jax.random.normal(later, (times.shape[0], equations.dim))

        def step(x: Array, row: tuple[Span, Array, Array, Array]) -> tuple[Array, Array]:
            span, t, u, push = row
            x = flow(x, span).at[equations.momentum].add(jnp.sqrt(intensity * span.length) * push)
            return x, read(x, (t, u))

        return jax.lax.scan(step, x, (spans, times, inputs, pushes))[1]

    return jax.lax.map(lambda pair: one(*pair), (zs, keys), batch_size=16)
