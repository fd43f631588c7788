"""What a posterior predicts: its draws pushed forward, each from its own state. (2.19), (2.20), Fig. 5.13."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from ._counts import refuse_count
from ._errors import InputError
from ._fit import Estimate
from ._keys import refuse_key
from ._modes import Mode
from ._paths import Choice, Task, paths_of_many, paths_of_one, task_of
from ._posterior import Posterior

# A reading larger than this many times the recording's largest has left what the recording tells of.
_ESCAPED = 1e3
_DRAWS = 500


class PosteriorForecast(eqx.Module):
    """Readings and states that draws of a posterior predict at `times`.

    `readings` (draw, time, channel) and `states` (draw, time, state) are the draws' own paths; `alive` (draw, time) is
    False from where a path is no longer finite, or its readings are more than 1000 times as large as any recorded.
    Such a draw is left out from there on, and `diverged` (time,) counts them. `map_path` (time, channel) and
    `map_states` (time, state) are those of the most probable model from its most probable state, without noise (2.20).
    """

    times: Float[Array, " time"]
    readings: Float[Array, "draw time channel"]
    states: Float[Array, "draw time state"]
    alive: Bool[Array, "draw time"]
    map_path: Float[Array, "time channel"]
    map_states: Float[Array, "time state"]

    @property
    def diverged(self) -> np.ndarray:
        """How many draws have diverged, at each time."""
        return np.sum(~np.asarray(self.alive), axis=0)

    def mean(self) -> np.ndarray:
        """The mean reading (time, channel), over the draws that have not diverged: (2.19)."""
        return np.nanmean(self._kept(), axis=0)

    def sd(self) -> np.ndarray:
        """The standard deviation of the readings (time, channel)."""
        return np.nanstd(self._kept(), axis=0)

    def quantiles(self, probabilities: float | Sequence[float]) -> np.ndarray:
        """Quantiles of the readings, (time, channel); several probabilities make a leading axis."""
        return np.nanquantile(self._kept(), np.asarray(probabilities), axis=0)

    def _kept(self) -> np.ndarray:
        return np.where(np.asarray(self.alive)[:, :, None], np.asarray(self.readings), np.nan)

    def __str__(self) -> str:
        draws, count = self.alive.shape
        head = f"{draws} draws at {count} times from {float(self.times[0]):g} to {float(self.times[-1]):g}"
        gone = self.diverged
        if not gone.any():
            return f"Posterior forecast: {head}; none diverged."
        first = float(self.times[int(np.argmax(gone > 0))])
        return (
            f"Posterior forecast: {head}; {gone[-1]} of {draws} DIVERGED, the first by t = {first:g}: means and bands "
            "are over the others."
        )


def posterior_forecast(
    posterior: Posterior | Mode,
    *,
    times: Any = None,
    until: float | None = None,
    draws: int | None = None,
    process_noise: bool = True,
    measurement_noise: bool = False,
    in_sample: bool = False,
    substeps: int | None = None,
    inputs: Any = None,
    recording: int = 0,
    key: PRNGKeyArray,
) -> PosteriorForecast:
    """Push draws of a posterior, or of one mode of it, forward, each from a state of its own.

    A draw's state is drawn from what its own filter says of the last reading; with `in_sample`, from what its own
    smoother says of the first. It then runs freely, with the estimated process noise or without it (2.19).
    Noise that belongs to a data interval, as `AdditiveGaussian`, enters at the recording's times and, after them, at
    multiples of its last interval, whatever `times` are; a `WienerIncrement` enters everywhere.

    **Arguments:** one of `times`, which increase from where the paths start, and `until`, in steps of the recording's
    last interval; `draws` - evenly spaced ones of the posterior, 500 or all of fewer if left out; `measurement_noise` -
    whether readings have it; `substeps` - integrator steps per interval between `times`, by default so many that none
    is longer than in training; `inputs` - (time + 1, input), held from the start of the paths and from each of `times`
    on; the recording's own, in sample, if left out; `recording` - which one of several.

    **Raises:** `InputError` where times or inputs do not fit, dynamics that are one step per data interval are asked
    for other times, or all draws diverge.
    """
    estimate = posterior.estimate
    if estimate is None:
        raise InputError(
            "This posterior has no model to push forward: it is of a density of your own, or was loaded without its "
            "estimate; give `load_posterior(path, estimate)`."
        )
    choice = Choice(process_noise, measurement_noise, in_sample)
    task = task_of(estimate, choice, recording, times, until, substeps, inputs)
    count = min(_DRAWS, len(posterior.draws())) if draws is None else draws
    refuse_key(key)
    keys = jax.random.split(key, count)
    return _checked(task, estimate, keys, *paths_of_many(task, posterior.models(count), keys))


def stochastic_forecast(
    estimate: Estimate,
    *,
    times: Any = None,
    until: float | None = None,
    draws: int = 500,
    filtered: bool = False,
    state_spread: bool = False,
    measurement_noise: bool = False,
    in_sample: bool = False,
    substeps: int | None = None,
    inputs: Any = None,
    recording: int = 0,
    key: PRNGKeyArray,
) -> PosteriorForecast:
    """Paths of the most probable model under its own process noise, which need no posterior. Fig. 5.13.

    They run freely from the mean of the state at the last reading, or with `in_sample` at the first. With `filtered`,
    in sample, a path starts anew at every reading, from the state given the readings up to it, and what is told at the
    next one is what was predicted of it; after the last reading it runs freely. The dissertation's own code filters.

    **Arguments:** `draws` - how many paths; `state_spread` - whether states are drawn of their distribution where a
    path starts, rather than taken at its mean; the others as for `posterior_forecast`.

    **Raises:** `InputError` as `posterior_forecast`, and for `filtered` out of sample.
    """
    refuse_count("stochastic_forecast", "draws", draws)
    if filtered and not in_sample:
        raise InputError("`filtered` paths start at the readings; ask for them with `in_sample=True`.")
    choice = Choice(True, measurement_noise, in_sample, state_spread, filtered)
    task = task_of(estimate, choice, recording, times, until, substeps, inputs)
    refuse_key(key)
    keys = jax.random.split(key, draws)
    return _checked(task, estimate, keys, *paths_of_one(task, estimate.model, keys))


def _checked(task: Task, estimate: Estimate, keys: Array, states: Array, readings: Array) -> PosteriorForecast:
    largest = float(jnp.nanmax(jnp.abs(task.series.readings)))
    # Where nothing but 0 was read there is no size to be far beyond.
    limit = _ESCAPED * largest if largest > 0.0 else np.inf
    sound = np.all(np.isfinite(states), axis=2) & np.all(np.abs(np.asarray(readings)) <= limit, axis=2)
    alive = np.logical_and.accumulate(sound, axis=1)
    times = np.asarray(task.grid.times)[task.grid.wanted]
    if not np.all(alive.any(axis=0)):
        end = float(times[np.argmin(alive.any(axis=0))])
        raise InputError(f"All {len(alive)} draws have diverged by t = {end:g}: forecast less far.")
    path_states, path = (one[0] for one in paths_of_one(task.alone(), estimate.model, keys[:1]))
    path, path_states = (jnp.where(jnp.isfinite(one), one, jnp.inf) for one in (path, path_states))
    return PosteriorForecast(jnp.asarray(times), readings, states, jnp.asarray(alive), path, path_states)
