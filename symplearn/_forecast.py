"""What comes after a recording: one deterministic path, and a Gaussian by the filter's own moments."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._errors import InputError
from ._fit import Estimate
from ._forecast_grid import Grid, grid_of, stepped, substeps_of
from ._model import AbstractStateSpaceModel, Instant, StateSpaceModel, intervals_between
from ._noise import AdditiveGaussian, ScaledIdentity
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

    The state is stepped through the data's times, multiples of the recording's last interval after its end, whatever
    `times` are. Noise that belongs to a data interval, as `AdditiveGaussian`, enters there; a `WienerIncrement` enters
    everywhere. Means and standard deviations are pushed forward, as the filter's are, and say nothing once they are as
    wide as the motion itself, as soon happens between two wells; `stochastic_forecast` draws motions instead.

    **Arguments:** give one of `until` - the last time, in steps of the recording's last interval; `times` -
    increasing times after the recording's last; and, of a driven model, `inputs` (time + 1, input), held from the
    recording's last time and from each of the times after it.

    **Raises:** `InputError` where not exactly one is given, times do not lie ahead, inputs do not fit, dynamics that
    are one step per data interval are asked for other times, or the forecast is not finite.
    """
    objective = estimate.objective if isinstance(estimate.objective, MarginalLikelihood) else MarginalLikelihood()
    series = estimate.recording
    if isinstance(series, tuple):
        raise InputError(
            f"`forecast` continues one recording, but the estimate is of {len(series)}: fit that one alone, or filter "
            "it with the estimate's model."
        )
    grid = grid_of(estimate.model, series, times, until, in_sample=False, inputs=inputs)
    model = stepped(resolve(estimate.model), substeps_of(estimate.model, grid, None))
    filtered = objective.filter(estimate.model, series)
    start = filtered.filtered_means[-1], filtered.filtered_covariances[-1]
    result = _push_forward(model, objective.transform, grid, *start)
    if not all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in (*jax.tree.leaves(result), *start)):
        raise InputError(
            f"The forecast is not finite before t = {grid.times[-1]:g}: the model escapes. Forecast less far."
        )
    return result


@eqx.filter_jit
def _push_forward(
    model: AbstractStateSpaceModel, transform: AbstractTransform, grid: Grid, m: Array, P: Array
) -> Forecast:
    known, quiet = jnp.zeros_like(P), _without_process_noise(model, len(m))

    def moved(model, interval, x, m, root):
        moments = model.predict(transform, m, root, interval)
        # From a point, without a spread, the moments' mean is the deterministic path.
        return model.predict(transform, x, known, interval).mean, moments.mean, triangularise(moments.factor)[0]

    def step(carry, data):
        interval, instant, noisy = data
        x, m, root = jax.lax.cond(noisy, lambda: moved(model, interval, *carry), lambda: moved(quiet, interval, *carry))
        read = model.read(transform, m, root, instant)
        path = model.read(transform, x, known, instant).mean
        sd = jnp.sqrt(jnp.diagonal(read.covariance))
        return (x, m, root), (path, read.mean, sd, x, m, root @ root.T)

    times, held = jnp.asarray(grid.times), None if grid.inputs is None else jnp.asarray(grid.inputs)
    instants = Instant(times[1:], None if held is None else held[1:])
    start = m, m, semidefinite_cholesky(P)
    _, ahead = jax.lax.scan(step, start, (intervals_between(times, held), instants, grid.noisy))
    return jax.tree.map(lambda leaf: leaf[grid.wanted - 1], Forecast(times[1:], *ahead))


def _without_process_noise(model: Any, size: int) -> Any:
    """The model between the times at which noise enters; one that does not say how its noise does keeps it."""
    if not isinstance(model, StateSpaceModel):
        return model
    silent = AdditiveGaussian(ScaledIdentity(0.0, dim=size))
    return eqx.tree_at(lambda m: m.process_noise, model, silent)
