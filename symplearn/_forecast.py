"""What comes after a recording: one deterministic path, and a Gaussian by the filter's own moments."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._errors import InputError
from ._fit import Estimate
from ._forecast_grid import input_rows, times_until
from ._model import AbstractStateSpaceModel, Instant, intervals_between
from ._objectives import MarginalLikelihood
from ._parameters import resolve
from ._transforms import AbstractTransform
from ._triangular import semidefinite_cholesky, triangularise


class Forecast(eqx.Module):
    """Readings and states ahead of a recording, at `times`.

    `path` (time, channel) is the deterministic push-forward of the last filtered mean, process noise off.
    `means` and `sds` are those of the readings to come, process and measurement noise included; `state_*`
    those of the state. Parameters are at their MAP: their uncertainty is not in the `sds`.
    """

    times: Float[Array, " time"]
    path: Float[Array, "time channel"]
    means: Float[Array, "time channel"]
    sds: Float[Array, "time channel"]
    state_path: Float[Array, "time state"]
    state_means: Float[Array, "time state"]
    state_covariances: Float[Array, "time state state"]

    def __str__(self) -> str:
        first, last = float(self.times[0]), float(self.times[-1])
        ends = f"sd {np.asarray(self.sds[0])} at {first:g}, {np.asarray(self.sds[-1])} at {last:g}"
        return f"Forecast of {self.times.shape[0]} readings from {first:g} to {last:g}: {ends}"


def forecast(estimate: Estimate, *, until: float | None = None, times: Any = None, inputs: Any = None) -> Forecast:
    """Forecast an estimate beyond its recording.

    **Arguments:** give one of `until` - the last time, in steps of the recording's last interval; `times` -
    increasing times after the recording's last; and, of a driven model, `inputs` (time + 1, input), held from the
    recording's last time and from each of the times after it. Process noise of `AdditiveGaussian` is added once per
    forecast interval, so with it keep to the recording's spacing.

    **Raises:** `InputError` where not exactly one is given, times do not lie ahead, inputs do not fit, or the forecast
    is not finite.
    """
    objective = estimate.objective if isinstance(estimate.objective, MarginalLikelihood) else MarginalLikelihood()
    series = estimate.recording
    if isinstance(series, tuple):
        raise InputError(
            f"`forecast` continues one recording, but the estimate is of {len(series)}: fit that one alone, or filter "
            "it with the estimate's model."
        )
    ahead = _times_ahead(np.asarray(series.times), until, times)
    filtered = objective.filter(estimate.model, series)
    grid = jnp.concatenate([series.times[-1:], jnp.asarray(ahead)])
    start = filtered.filtered_means[-1], filtered.filtered_covariances[-1]
    rows = input_rows(series, inputs, len(grid))
    result = _push_forward(resolve(estimate.model), objective.transform, grid, rows, *start)
    if not all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in (*jax.tree.leaves(result), *start)):
        raise InputError(f"The forecast is not finite before t = {ahead[-1]:g}: the model escapes. Forecast less far.")
    return result


def _times_ahead(recorded: np.ndarray, until: float | None, times: Any) -> np.ndarray:
    if (until is None) == (times is None):
        raise InputError("`forecast` needs either `until` or `times`, and not both.")
    last, spacing = recorded[-1], recorded[-1] - recorded[-2]
    if times is None:
        times = times_until(float(until or 0.0), last, spacing)
    ahead = np.asarray(times, dtype=float)
    if (
        ahead.ndim != 1
        or len(ahead) == 0
        or not np.isfinite(ahead).all()
        or not np.all(np.diff(np.concatenate([[last], ahead])) > 0)
    ):
        raise InputError(
            f"A forecast needs finite, increasing times after the recording's last, {last:g}; "
            f"one interval is {spacing:g}."
        )
    return ahead


@eqx.filter_jit
def _push_forward(
    model: AbstractStateSpaceModel, transform: AbstractTransform, grid: Array, inputs: Any, m: Array, P: Array
):
    known, instants = jnp.zeros_like(P), Instant(grid[1:], None if inputs is None else inputs[1:])

    def step(carry, data):
        interval, instant = data
        x, m, root = carry
        moments = model.predict(transform, m, root, interval)
        m, root = moments.mean, triangularise(moments.factor)[0]
        # From a point, without a spread, the moments' mean is the deterministic path.
        x = model.predict(transform, x, known, interval).mean
        read = model.read(transform, m, root, instant)
        path = model.read(transform, x, known, instant).mean
        sd = jnp.sqrt(jnp.diagonal(read.covariance))
        return (x, m, root), (path, read.mean, sd, x, m, root @ root.T)

    start = m, m, semidefinite_cholesky(P)
    _, ahead = jax.lax.scan(step, start, (intervals_between(grid, inputs), instants))
    return Forecast(grid[1:], *ahead)
