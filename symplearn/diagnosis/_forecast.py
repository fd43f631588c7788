"""Readings to come, before and after: draws from the posterior, each filtered through all rows and run on."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._augmented_flow import Span
from .._errors import InputError
from .._importance import softened
from .._recording import Recording
from .._rows import known_inputs, past_of, spans_between
from .._triangular import semidefinite_cholesky
from ._bend import bent
from ._course import effect_coefficients, model_at
from ._lanes import Lanes
from ._lasting import colour_ratio, total_noise
from ._outlook import intensity_of
from ._problem import Problem
from ._reach import covariance_within_reach
from ._record import Forecast
from ._stochastic import exposure, filter_lane, padded, row_roots, softness
from ._taught import root_of, taught
from ._trajectory import Stepper
from ._weighed import Estimate

_DRAWS = 128
# Draws that count at least: where fewer would, the Gaussian is no good guess, and they are weighed less strictly.
_LEAST = 16.0
_LONGEST = 1_000_000
# Substeps of draws under a force are shortened so many times to see whether they were short enough, beside the width of
# the middle two thirds of all draws.
_FINER, _WITHIN = 4, (0.16, 0.84)


def forecast_times(recording: Recording, until: float, step: float | None) -> Float[np.ndarray, " time"]:
    """From the last observed time + step to `until`. `InputError` where that is empty or endless."""
    last = float(recording.times[-1])
    step = float(np.median(np.diff(recording.times))) if step is None else step
    if not (math.isfinite(step) and step > 0):
        raise InputError(f"--forecast-step: is {step}; give a positive number in the recording's unit of time")
    if not math.isfinite(until) or until < last + step * (1 - 1e-9):
        raise InputError(
            f"--forecast-until: is {until:.10g}, and the last observed time is {last:.10g}; give a time at least "
            f"{step:.6g} later"
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
        mean, sd = _expected(stepper, recording, estimate, times, inflation, jax.random.key(seed))
        for j, name in enumerate(columns):
            columns[name][label], columns[name][f"{label}_sd"] = mean[..., j], sd[..., j]
    return Forecast(times, columns)


def _expected(
    stepper: Stepper, recording: Recording, e: Estimate, times: np.ndarray, inflation: float, key: Array
) -> tuple[Float[np.ndarray, "time channel"], Float[np.ndarray, "time channel"]]:
    """Expected readings and their sd: run on from the phase point at the last of all rows, by draws of the posterior.

    Where no force is missing they are those of the most probable trajectory, since a Gaussian's draws of a time or of a
    frequency leave it farther than the readings would let them; for the same reason the draws are weighed there.
    """
    unit_key, state_key, push_key = jax.random.split(key, 3)
    root = root_of(stepper, e, inflation)
    units = np.asarray(jax.random.normal(unit_key, (_DRAWS // 2, len(root))))
    units = np.concatenate([0 * units[:1], units, -units])
    if e.intensity is None:
        zs, ends, log_weights = _by_all_rows(stepper, e, root, units)
    else:
        zs = jnp.asarray(_within(stepper.problem, e.z[stepper.problem.local(0)] + units @ root.T, root))
        ends, log_weights = _filtered(stepper, e, zs, state_key), np.zeros(len(units))
    # A force that has acted for a while is over.
    pushed = jnp.asarray(intensity_of(stepper, e) * (e.exposures is None))
    onehot, keys = jnp.asarray(stepper.problem.onehot(e.combination, 0)), jax.random.split(push_key, len(units))

    def run_on(finer: int) -> np.ndarray:
        ahead = _ahead(stepper.problem, recording, times, finer)
        return np.asarray(_run_on(*_model(stepper), zs, ends, onehot, pushed, ahead, keys))

    drawn = run_on(1)
    if e.intensity is not None:
        fine = run_on(_FINER)
        drawn = np.where(_resolved(drawn, fine, total_noise(e))[..., None], fine, np.nan)
    return _summary(bent(drawn, times, e.bends), log_weights, about_first=e.intensity is None)


def _model(stepper: Stepper) -> tuple[Any, Any, Any]:
    """What moves the first recording."""
    return stepper.problem.equations, stepper.problem.integrator, stepper.courses[0]


def _by_all_rows(
    stepper: Stepper, e: Estimate, root: np.ndarray, units: Float[np.ndarray, "draw local"]
) -> tuple[Array, Array, Float[np.ndarray, " draw"]]:
    """Draws given all rows, their phase points at the last one, and log weights; the first is the most probable one."""
    problem, rows = stepper.problem, stepper.problem.rows[0]
    known = taught(stepper, e, root)
    zs = _within(problem, known.mean + units @ known.root.T, known.root)
    hots, nowhere = np.stack([problem.onehot(e.combination, 0)] * len(zs)), [np.zeros(0, int)] * len(zs)
    (found,) = stepper.steps(problem, [Lanes(0, zs, hots, nowhere, len(rows.times))])
    seen, states = np.split(found.shown, [problem.channels], axis=2)
    log_weights = known.log_weights(units, bent(seen, rows.times, e.bends), rows.readings)
    return jnp.asarray(zs), jnp.asarray(states[:, -1]), log_weights


def _filtered(stepper: Stepper, e: Estimate, zs: Array, key: Array) -> Array:
    """Draws of the phase point at the last row under a missing force, each filtered through all rows."""
    problem, course = stepper.problem, stepper.courses[0]
    length, state = course.times.shape[0], problem.state
    fixed = (total_noise(e), intensity_of(stepper, e), exposure(e.exposures, 0, length),
             softness(problem, course, e.z, 0), covariance_within_reach(stepper, e, 0)[:state, :state],
             padded(problem.rows[0].readings, length, np.nan), row_roots(problem, 0, length, colour_ratio(e)),
             problem.onehot(e.combination, 0))  # fmt: skip
    keys = jax.random.split(key, len(zs))
    return _filter_through(*_model(stepper), zs, tuple(map(jnp.asarray, fixed)), keys)


@np.errstate(invalid="ignore", over="ignore")  # what diverged is not resolved
def _resolved(
    coarse: Float[np.ndarray, "draw time channel"], fine: Float[np.ndarray, "draw time channel"],
    noise: Float[np.ndarray, " channel"],
) -> Bool[np.ndarray, "draw time"]:  # fmt: skip
    """Up to when shorter substeps change a draw by less than draws differ, or readings err. One that passes closer to a
    centre than the motion that was fitted is thrown out far, by no force."""
    some = np.isfinite(fine).any(0)  # where none has stayed finite there are no quantiles, and none is kept
    low, high = np.nanquantile(np.where(np.isfinite(fine) | ~some, np.where(some, fine, 0.0), np.nan), _WITHIN, axis=0)
    return np.logical_and.accumulate((np.abs(fine - coarse) <= high - low + noise).all(2), axis=1)


def _ahead(problem: Problem, recording: Recording, times: np.ndarray, finer: int) -> tuple[Span, Array, Array]:
    """Spans, in as many times as many substeps as were fitted, times and inputs from the last row on."""
    spans = problem.rows[0].spans
    path = np.concatenate([problem.rows[0].times[-1:], times])
    pieces = finer * max(1, math.ceil(np.max(np.diff(path)) / float(np.max(spans.step)) - 1e-9))
    past = past_of(problem.rows[0].inputs, len(problem.equations.inputs))
    inputs = known_inputs(recording.inputs, times, past)
    return spans_between(path, pieces, recording.inputs), jnp.asarray(times), jnp.asarray(inputs)


@np.errstate(invalid="ignore", over="ignore")  # draws that diverged are not looked at
def _summary(
    drawn: Float[np.ndarray, "draw time channel"], log_weights: np.ndarray, about_first: bool
) -> tuple[Float[np.ndarray, "time channel"], Float[np.ndarray, "time channel"]]:
    """Mean and sd of the draws that have stayed finite up to each time, or the first and the deviations from it; NaN
    from where hardly any has."""
    usable = np.isfinite(log_weights)
    alive = usable[:, None] & np.logical_and.accumulate(np.isfinite(drawn).all(2), axis=1)
    weights = np.zeros(len(log_weights))
    if usable.any():
        weights[usable] = softened(log_weights[usable], least=min(_LEAST, float(usable.sum())))
    shares = weights[:, None] * alive
    shares = np.where(alive.sum(0) < _DRAWS // 4, np.nan, shares / shares.sum(0))
    values = np.where(alive[..., None], drawn, 0.0)
    centre = np.einsum("dt,dtc->tc", shares, values)
    if about_first:
        centre = np.where((alive[0] & np.isfinite(shares[0]))[:, None], drawn[0], centre)
    return centre, np.sqrt(np.einsum("dt,dtc->tc", shares, (values - centre) ** 2))


def _within(
    problem: Problem, zs: Float[np.ndarray, "draw local"], root: Float[np.ndarray, "local local"]
) -> Float[np.ndarray, "draw local"]:
    """Draws inside the bounds of the calibrated values; all else follows a value that is moved to its bound."""
    c, spread = problem.calibrated, root @ root.T
    for k, low, high in zip(range(problem.state, problem.state + c.size), c.lower, c.upper, strict=True):
        moved = np.clip(zs[:, k], low, high) - zs[:, k]
        if moved.any() and spread[k, k] > 0:
            zs = zs + moved[:, None] * (spread[k] / spread[k, k])
    part = slice(problem.state, problem.state + c.size)
    zs[:, part] = np.clip(zs[:, part], c.lower, c.upper)  # what follows one may leave its own
    return zs


@eqx.filter_jit
def _filter_through(equations: Any, integrator: Any, course: Any, zs: Array, fixed: Any, keys: Array) -> Array:
    """A draw of the phase point at the last row for every draw of the parameters, filtered through all rows."""
    noise, intensity, exposed, soft, spread, readings, roots, onehot = fixed
    state, f = 2 * equations.width, course.to_parameters.shape[0]

    def one(z: Array, key: Array) -> Array:
        calibrated, coefficients = z[state : state + f], effect_coefficients(z[state + f :], onehot)
        _, _, _, filtered = filter_lane(
            equations, integrator, course, calibrated, coefficients, noise, intensity, exposed, soft, z[:state],
            spread, readings, roots,
        )  # fmt: skip
        root = semidefinite_cholesky(filtered.filtered_covariances[-1])
        return filtered.filtered_means[-1] + root @ jax.random.normal(key, (state,))

    return jax.lax.map(lambda pair: one(*pair), (zs, keys), batch_size=16)


@eqx.filter_jit
def _run_on(
    equations: Any, integrator: Any, course: Any, zs: Array, ends: Array, onehot: Array, intensity: Array, ahead: Any,
    keys: Array,
) -> Array:  # fmt: skip
    """Readings (draw, time, channel) from given phase points on, under a white missing force."""
    spans, times, inputs = ahead
    state, f = 2 * equations.width, course.to_parameters.shape[0]

    def one(z: Array, x: Array, key: Array) -> Array:
        coefficients = effect_coefficients(z[state + f :], onehot)
        flow, read = model_at(equations, integrator, course, z[state : state + f], coefficients)
        pushes = jax.random.normal(key, (times.shape[0], equations.dim))

        def step(x: Array, row: tuple[Span, Array, Array, Array]) -> tuple[Array, Array]:
            span, t, u, push = row
            x = flow(x, span).at[equations.momentum].add(jnp.sqrt(intensity * span.length) * push)
            return x, read(x, (t, u))

        return jax.lax.scan(step, x, (spans, times, inputs, pushes))[1]

    return jax.lax.map(lambda three: one(*three), (zs, ends, keys), batch_size=16)
