"""Filtering and smoothing linearised about a path that is known, as the one that a missing force most probably takes.

Sigma points lie as far apart as the state is uncertain; where little is read of an eccentric orbit, or of a chaotic
motion, they may lose it, though a fit of the whole path has found it. About that path everything is linear (the last
pass of an iterated extended smoother, Bell 1994).
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._faults import Fault
from .._filter import Filtered
from .._smoother import Smoothed, smooth_along
from ._path import linearise
from ._problem import SLOTS, Combination
from ._stochastic import MissingForce, exposure, free_run, padded, row_roots, softness
from ._trajectory import Stepper


def prolonged(
    stepper: Stepper, recording: int, z: Float[np.ndarray, " z"], combination: Combination, path: np.ndarray
) -> Float[np.ndarray, "time state"]:
    """A path of the leading rows that runs on freely over the others; where it diverges there, it stays."""
    last = len(path) - 1
    _, later = free_run(stepper.problem, stepper.courses[recording], z, combination, recording, path[last], last)
    bad = ~np.isfinite(later).all(1)
    later[bad] = path[last]
    return np.concatenate([path[:last], later])


def filter_along(
    stepper: Stepper, recording: int, z: Float[np.ndarray, " z"], combination: Combination,
    path: Float[np.ndarray, "time state"], noise: Float[np.ndarray, " channel"], ratio: Float[np.ndarray, " channel"],
    intensity: Float[np.ndarray, " d"], spread: Float[np.ndarray, "state state"],
    readings: Float[np.ndarray, "row channel"], exposures: Sequence[np.ndarray] | None = None,
) -> tuple[Filtered, Smoothed]:  # fmt: skip
    """Filter and smooth a recording about a path of all its rows, from the phase point in `z` with covariance `spread`;
    the rest as for `run_filter`. Of the likelihood nothing is told.
    """
    problem, course = stepper.problem, stepper.courses[recording]
    length = course.times.shape[0]
    hot = np.zeros((1, SLOTS + 1, problem.equations.size))
    hot[0, -1] = problem.coefficients(recording, z, combination) - problem.coefficients(recording, z, ())
    values = np.concatenate([z[problem.head : problem.slots], np.zeros(SLOTS)])[None]
    whole = np.concatenate([path, np.repeat(path[-1:], length - len(path), axis=0)])
    known = padded(readings, length, np.nan)
    linear = linearise(stepper, recording, whole[None], values, hot, [np.zeros(0, int)], np.nan_to_num(known))
    scale = row_roots(problem, recording, length, ratio)
    soft = softness(problem, course, z, recording)
    force = MissingForce(jnp.asarray(intensity), jnp.asarray(soft), int(problem.equations.hidden))
    spans = jax.tree.map(lambda leaf: leaf[: length - 1], (course.spans, exposure(exposures, recording, length)))
    flow = linear.defect[0, :-1], linear.A[0, :-1]
    read = linear.residual[0] * scale, linear.H[0] * scale[..., None], ~np.isnan(known)
    first = z[recording * problem.state : (recording + 1) * problem.state] - path[0]
    found, *slopes = _pass(force, noise**2, spans, flow, read, first, spread)
    found = jax.tree.map(np.asarray, found)
    moved = found.predicted_means + whole, found.filtered_means + whole
    found = eqx.tree_at(lambda one: (one.predicted_means, one.filtered_means), found, moved)
    return found, jax.tree.map(np.asarray, _smooth(found, *slopes))


@eqx.filter_jit
def _pass(force, variance, spans, flow, read, first, spread):
    """A Kalman filter of the deviations from the path; and its slopes and noises."""
    (defect, A), (residual, H, observed) = flow, read
    Q, R = jax.vmap(force.covariance)(spans), jnp.diag(variance)
    seen = jnp.where(observed[..., None], H, 0.0)

    def step(carry, row):
        m, P = carry
        r, h, h_seen, is_seen, d, a, q = row
        innovation = jnp.where(is_seen, r - h @ m, 0.0)
        told, S = h_seen @ P @ h_seen.T + R, h @ P @ h.T + R
        K = jnp.linalg.solve(told, h_seen @ P).T
        m1, P1 = m + K @ innovation, P - K @ told @ K.T
        standard = jax.scipy.linalg.solve_triangular(jnp.linalg.cholesky(told), innovation, lower=True)
        P1 = 0.5 * (P1 + P1.T)
        return (d + a @ m1, a @ P1 @ a.T + q), (m, P, m1, P1, innovation, S, standard)

    def lengthened(values):
        return jnp.concatenate([values, jnp.zeros_like(values[:1])])

    rows = (residual, H, seen, observed, *map(lengthened, (defect, A, Q)))
    _, (before, prior, after, posterior, innovations, spreads, standard) = jax.lax.scan(step, (first, spread), rows)
    nothing, fault = jnp.zeros(len(residual)), jnp.where(jnp.isfinite(after).all(), Fault.NONE, Fault.STATE)
    found = Filtered(nothing.sum(), nothing, before, prior, after, posterior, innovations, spreads, standard, observed,
                     fault, jnp.asarray(-1))  # fmt: skip
    return found, A, Q, seen, jnp.broadcast_to(R, (len(residual), *R.shape))


_smooth = eqx.filter_jit(smooth_along)
