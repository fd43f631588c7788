"""Filtering and smoothing linearised about a path that is known, as the one that a missing force most probably takes.

Sigma points lie as far apart as the state is uncertain; where little is read of an eccentric orbit, or of a chaotic
motion, they may lose it, though a fit of the whole path has found it. About that path everything is linear (the last
pass of an iterated extended smoother, Bell 1994).
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._filter import Filtered, unscented_filter
from .._lane_loops import with_lane_loops
from .._model import Gaussian, StateSpaceModel
from .._smoother import Smoothed, smooth_along
from ._path import linearise
from ._problem import SLOTS, Combination
from ._stochastic import MissingForce, RowNoise, exposure, free_run, padded, row_roots, softness
from ._trajectory import Stepper


class _Moved(eqx.Module):
    """Deviations from a path over one span."""

    def __call__(self, x: Array, span: tuple[Array, Array, Array]) -> Array:
        defect, A, _ = span
        return A @ x + defect


class _Shown(eqx.Module):
    """What deviations change of a row's readings."""

    def __call__(self, x: Array, H: Array) -> Array:
        return H @ x


class _Added(eqx.Module):
    """Process noise that is given for every span."""

    def covariance(self, span: tuple[Array, Array, Array]) -> Array:
        return span[2]


class Slopes(NamedTuple):
    """Slopes and noises along a path, which a smoother needs besides what the filter says."""

    A: Float[Array, "interval state state"]
    Q: Float[Array, "interval state state"]
    H: Float[Array, "time channel state"]
    R: Float[Array, "time channel channel"]


def prolonged(
    stepper: Stepper, recording: int, z: Float[np.ndarray, " z"], combination: Combination, path: np.ndarray
) -> Float[np.ndarray, "time state"]:
    """A path of the leading rows that runs on freely over the others; where it diverges there, it stays."""
    last = len(path) - 1
    _, later = free_run(stepper.problem, stepper.courses[recording], z, combination, recording, path[last], last)
    stays = np.where(np.isfinite(later).all(1, keepdims=True), later, path[last])
    return np.concatenate([path[:last], stays])


def filter_along(
    stepper: Stepper, recording: int, z: Float[np.ndarray, " z"], combination: Combination,
    path: Float[np.ndarray, "time state"], noise: Float[np.ndarray, " channel"], ratio: Float[np.ndarray, " channel"],
    intensity: Float[np.ndarray, " d"], spread: Float[np.ndarray, "state state"],
    readings: Float[np.ndarray, "row channel"], exposures: Sequence[np.ndarray] | None = None,
) -> tuple[Filtered, Slopes]:  # fmt: skip
    """Filter a recording about a path of all its rows, from the phase point in `z` with covariance `spread`.

    The rest as for `run_filter`.
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
    read = np.where(np.isnan(known), np.nan, linear.residual[0] * scale), linear.H[0] * scale[..., None]
    first = z[recording * problem.state : (recording + 1) * problem.state] - path[0]
    found, slopes = _filter(force, noise, spans, flow, read, first, spread)
    moved = np.asarray(found.predicted_means) + whole, np.asarray(found.filtered_means) + whole
    found = eqx.tree_at(lambda one: (one.predicted_means, one.filtered_means), found, moved)
    # As NumPy's: every part of JAX's that is looked at outside of compiled code is a program of its own.
    return jax.tree.map(np.asarray, found), slopes


@eqx.filter_jit
def _filter(force, noise, spans, flow, read, first, spread):
    (defect, A), (residual, H) = flow, read
    Q, rows = jax.vmap(force.covariance)(spans), RowNoise(noise**2)
    model = StateSpaceModel(_Moved(), _Shown(), _Added(), rows, Gaussian(first, spread))
    found = with_lane_loops(lambda y: unscented_filter(model, y, (defect, A, Q), H))(residual)
    return found, Slopes(A, Q, H, jnp.broadcast_to(rows.covariance(None), (len(H), *[H.shape[1]] * 2)))


def smooth(found: Filtered, slopes: Slopes) -> Smoothed:
    """Smooth what `filter_along` filtered."""
    return jax.tree.map(np.asarray, _smooth(found, *slopes))


_smooth = eqx.filter_jit(smooth_along)
