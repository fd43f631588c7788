"""Recordings drawn from a model: the states and readings of a hidden Markov model, by its own noises."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ._doubled import DoubledNoise
from ._errors import InputError
from ._hidden_markov import HiddenMarkovModel
from ._keys import refuse_key
from ._model import AbstractStateSpaceModel, Instant, Interval, StateSpaceModel, intervals_between, slice_at
from ._noise import Additive, Multiplicative
from ._objectives import TimeSeries
from ._parameters import resolve
from ._transforms import Moments
from ._triangular import semidefinite_cholesky


def simulate(
    model: AbstractStateSpaceModel, times: Any, key: PRNGKeyArray, inputs: Any = None
) -> tuple[TimeSeries, Float[Array, "time state"]]:
    """Draw a recording from a model: its readings at `times`, and the states (time, state) behind them.

    **Arguments:** `model` - a `StateSpaceModel` or a `HiddenMarkovModel` with an `initial` Gaussian, from which the
    state at the first reading is drawn; `times` - increasing, (time,); `key` - of `jax.random.key`; `inputs` -
    (time, input), held over the interval that follows, or None. Many recordings: `jax.vmap` over keys.

    **Raises:** `InputError` where the model has no single initial distribution, a noise cannot be drawn, sizes do not
    fit, times do not increase, or the state leaves the reals.
    """
    refuse_key(key)
    times = jnp.asarray(times, dtype=float)
    inputs = None if inputs is None else jnp.asarray(inputs, dtype=float)
    _refuse_times(times, inputs)
    series, states = _simulate(resolve(model), times, key, inputs)
    _refuse_escape(series, states)
    return series, states


def _refuse_times(times: Array, inputs: Array | None) -> None:
    if (
        times.ndim != 1
        or times.shape[0] < 2
        or (inputs is not None and (inputs.ndim != 2 or len(inputs) != len(times)))
    ):
        raise InputError(
            f"`simulate` needs at least two times (n,), and inputs (n, input) or None, but was given shapes "
            f"{times.shape} and {None if inputs is None else inputs.shape}."
        )
    if not isinstance(times, jax.core.Tracer) and not (np.all(np.isfinite(times)) and np.all(np.diff(times) > 0)):
        raise InputError("`simulate` needs finite times that strictly increase; sort them first.")


def _refuse_escape(series: TimeSeries, states: Array) -> None:
    if isinstance(states, jax.core.Tracer):
        return
    finite = np.all(np.isfinite(states), axis=1) & np.all(np.isfinite(series.readings), axis=1)
    if not np.all(finite):
        raise InputError(
            f"The simulated state or reading is not finite from t = {float(series.times[np.argmin(finite)]):g} on: the "
            "model escapes, or a covariance is not positive semi-definite. Simulate less far, or change the model."
        )


@eqx.filter_jit
def _simulate(model, times, key, inputs):
    start_key, reading_key, later_key = jax.random.split(key, 3)
    intervals, instants = intervals_between(times, inputs), Instant(times, inputs)
    x0 = draw_initial(model, start_key)
    y0 = draw_reading(model, x0, slice_at(instants, 0), reading_key)

    def step(x, data):
        interval, instant, key = data
        state_key, reading_key = jax.random.split(key)
        x = draw_state(model, x, interval, state_key)
        return x, (x, draw_reading(model, x, instant, reading_key))

    later = intervals, jax.tree.map(lambda leaf: leaf[1:], instants), jax.random.split(later_key, len(times) - 1)
    _, (xs, ys) = jax.lax.scan(step, x0, later)
    readings = jnp.concatenate([y0[None], ys])
    return TimeSeries(times, readings, inputs), jnp.concatenate([x0[None], xs])


def draw_initial(model: AbstractStateSpaceModel, key: PRNGKeyArray) -> Float[Array, " state"]:
    """One draw of the state at the first reading.

    **Raises:** `InputError` where the model has no single initial Gaussian.
    """
    if model.initial is None or isinstance(model.initial, tuple):
        given = "none" if model.initial is None else f"{len(model.initial)}, one for each of several recordings"
        raise InputError(
            f"To draw states, a model needs one initial distribution, but has {given}; give it "
            "`initial=Gaussian(mean, covariance)`."
        )
    mean = jnp.asarray(model.initial.mean, dtype=float)
    return mean + model.initial.root @ jax.random.normal(key, mean.shape)


def draw_state(
    model: AbstractStateSpaceModel, x: Float[Array, " state"], interval: Interval | Any, key: PRNGKeyArray
) -> Float[Array, " state"]:
    """One draw of the state after a data interval, given the state before it."""
    if isinstance(model, HiddenMarkovModel):
        return model.transition(x, sampled(model.process_noise, key), interval)
    model = own_parts(model)
    image = model.dynamics(x, interval)
    return same_size(draw_noise(model.process_noise, image, interval, key), x, "state")


def draw_reading(
    model: AbstractStateSpaceModel, x: Float[Array, " state"], context: Any, key: PRNGKeyArray
) -> Float[Array, " channel"]:
    """One draw of a reading, given the state."""
    if isinstance(model, HiddenMarkovModel):
        return model.observation(x, sampled(model.measurement_noise, key), context)
    model = own_parts(model)
    return draw_noise(model.measurement_noise, model.observation(x, context), context, key)


def draw_noise(noise: Any, value: Float[Array, " entry"], record: Any, key: PRNGKeyArray) -> Float[Array, " entry"]:
    """A noiseless value with one draw of a noise in it: added, or multiplied and then added.

    **Raises:** `InputError` where the noise is known by its moments only, or is of another size.
    """
    if isinstance(noise, Multiplicative):
        factor_key, key = jax.random.split(key)
        product = value * same_size(sampled(noise.factor, factor_key), value, "factor")
        return product if noise.additive is None else draw_noise(noise.additive, product, record, key)
    if isinstance(noise, Additive):
        return value + same_size(sampled(noise.distribution, key), value, "additive noise")
    if isinstance(noise, DoubledNoise) and not hasattr(noise.noise, "covariance"):
        return value + _drawn_twice(noise, value, record, key)
    if not hasattr(noise, "covariance"):
        raise InputError(
            f"`{type(noise).__name__}` cannot be drawn: it has neither a distribution nor a `covariance(record)`; use "
            "`Additive` or `Multiplicative` with a distribution."
        )
    root = semidefinite_cholesky(noise.covariance(record))
    return value + same_size(root @ jax.random.normal(key, root.shape[:1]), value, "additive noise")


def _drawn_twice(noise: DoubledNoise, value: Array, record: Any, key: PRNGKeyArray) -> Array:
    """A draw of a noise of the phase point for each column that `draws` makes of one: one for both copies, or two."""
    nothing, no_columns = jnp.zeros(value.shape), jnp.zeros((value.shape[0], 0))
    means = noise.enter(Moments(nothing, no_columns, no_columns), record).mean
    of_one = value.shape[0] // 2

    def part(column: int, key: PRNGKeyArray) -> Array:
        draw = draw_noise(noise.noise, nothing[:of_one], record, key) - means[:of_one]
        return noise.draws(draw[:, None])[:, column]

    keys = jax.random.split(key, noise.draws(nothing[:of_one, None]).shape[1])
    return means + sum((part(k, one) for k, one in enumerate(keys)), nothing)


def own_parts(model: Any) -> StateSpaceModel:
    """The model, which must have dynamics, an observation and noises of its own."""
    if not isinstance(model, StateSpaceModel):
        raise InputError(
            f"`{type(model).__name__}` says nothing of how it is drawn; write it as a `StateSpaceModel` or a "
            "`HiddenMarkovModel`."
        )
    return model


def sampled(distribution: Any, key: PRNGKeyArray) -> Array:
    """One draw of a distribution, which must have `sample`."""
    if not hasattr(distribution, "sample"):
        raise InputError(
            f"`{type(distribution).__name__}` cannot be drawn: it has no `sample(key)`; use a distribution such as "
            "`Uniform` or `MultivariateNormal`."
        )
    return distribution.sample(key)


def same_size(draw: Array, value: Array, what: str) -> Array:
    """The draw, which must not be stretched over a longer vector: its entries would be one and the same number."""
    if draw.shape != value.shape:
        raise InputError(
            f"The {what} has the shape {draw.shape}, but {value.shape} is needed: give the distribution `dim="
            f"{value.shape[0]}`, or a number for each entry."
        )
    return draw
