"""Kalman and unscented filters in square-root form. Dissertation (2.5)-(2.8), Algorithms 2, 4 and 5 corrected.

Slips of the printed algorithms that are right here: the measurement at k = 0 is used first; sigma points go
along the columns of a lower Cholesky factor and are drawn again before the measurement; the exponent is a
squared norm. The filter carries a square root of the state's covariance, which no round-off can make indefinite.
"""

import functools
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from ._errors import InputError
from ._faults import SENTENCES, Fault, is_fatal
from ._filter_step import AbstractPassage, begin, measure, unscored
from ._guard import guard
from ._model import AbstractAffine, AbstractStateSpaceModel, StateSpaceModel, slice_at
from ._swift_slopes import with_swift_slopes
from ._transforms import STANDARD, AbstractTransform, Moments, Taylor

# Bytes of the states of all readings beyond which a gradient does not keep all of them, but takes a third longer.
_KEPT = 2_000_000


class Filtered(eqx.Module):
    """What the filter says of the state at each of n readings.

    `predicted_*` are given the readings before, `filtered_*` given the reading too; the first prediction is
    the initial distribution. `increments` (time,) add up to `log_likelihood`, in nats, constants included.
    `innovations` are y - E[y | past] and `standardised_innovations` the same divided by the lower Cholesky
    factor of `innovation_covariances`; both are 0 where `observed` is False. `fault` and `fault_step` are the first
    `Fault` met and the reading it was met at (-1 for none); `str(filtered)` says it in words. After a fatal one
    `log_likelihood` is -1e15 and the later moments mean nothing.
    """

    log_likelihood: Float[Array, ""]
    increments: Float[Array, " time"]
    predicted_means: Float[Array, "time state"]
    predicted_covariances: Float[Array, "time state state"]
    filtered_means: Float[Array, "time state"]
    filtered_covariances: Float[Array, "time state state"]
    innovations: Float[Array, "time channel"]
    innovation_covariances: Float[Array, "time channel channel"]
    standardised_innovations: Float[Array, "time channel"]
    observed: Bool[Array, "time channel"]
    fault: Int[Array, ""]
    fault_step: Int[Array, ""]

    @property
    def ok(self) -> Bool[ArrayLike, ""]:
        """Whether the filter came through: no fault, or only a remote reading."""
        return ~is_fatal(self.fault)

    def __str__(self) -> str:
        count = f"Filtered {self.increments.shape[0]} readings: log likelihood {float(self.log_likelihood):.6g} nats"
        if int(self.fault) == Fault.NONE:
            return count
        verdict = "FAILED" if not bool(self.ok) else "note"
        return f"{count}. {verdict} at reading {int(self.fault_step)}: {SENTENCES[Fault(int(self.fault))]}"


class Sequential(AbstractPassage):
    """One reading after the other. The default: any model, and the least work."""

    def run(self, model, readings, intervals, contexts, transform, keep):
        model, readings, intervals, contexts = guard((model, readings, intervals, contexts))
        if len(readings) == 1:
            carry, record = begin(model, transform, readings[0], slice_at(contexts, 0))
            return carry, jax.tree.map(lambda leaf: leaf[None], record)

        def step(carry, data):
            reading, interval, context, k = data
            inside, carry = guard((model, carry))
            later = inside.predict(transform, *guard((carry.mean, carry.root)), interval)
            # The first reading goes through the loop as well: with it outside, kernel by kernel, the likelihood of 20
            # readings of 20 substeps took half as long again. What is predicted before it is dropped: with a branch,
            # which spares it, the gradient of a network of 1000 readings took 1.6 times as long.
            predicted = jax.tree.map(functools.partial(jnp.where, k == 0), _as_it_is(carry, later), later)
            carry, record = measure(inside, transform, carry, predicted, reading, context, k)
            return carry, (record if keep else None)

        # Checkpointing the step makes the gradient faster as well as 16 times smaller (performance.md, A7).
        step = jax.checkpoint(step, prevent_cse=False)
        carry, records = unscored(jnp.asarray(model.initial.mean), model.initial.root), None
        if keep or len(readings) * sum(leaf.nbytes for leaf in carry) <= _KEPT:
            # The first interval stands for the one before the first reading, of which nothing is used.
            before = jax.tree.map(lambda leaf: jnp.concatenate([leaf[:1], leaf]), intervals)
            carry, records = jax.lax.scan(step, carry, (readings, before, contexts, np.arange(len(readings))))
        else:
            carry = _in_stretches(step, carry, (readings, contexts), intervals)
        # What a last step leaves in the tangents is past every guard inside.
        return carry._replace(log_likelihood=guard(carry.log_likelihood)), records


SEQUENTIAL = Sequential()


def unscented_filter(
    model: AbstractStateSpaceModel,
    readings: Float[Array, "time channel"],
    intervals: PyTree,
    contexts: PyTree = None,
    transform: AbstractTransform = STANDARD,
    passage: AbstractPassage = SEQUENTIAL,
) -> Filtered:
    """Filter a recording and keep everything the smoother and a diagnosis need. Algorithm 2, corrected.

    **Arguments:** `model` - with plain arrays (see `resolve`) and an `initial` Gaussian; `readings` - NaN
    where missing, in whole rows or in part; `intervals` - a pytree with leading axis time - 1, one slice per
    data interval; `contexts` - a pytree with leading axis time for the observation, or None; `transform` -
    the rule for the moments of what is not affine: `UnscentedTransform`, `Cubature`, `GaussHermite` or `Taylor`;
    `passage` - one reading after the other, `Sequential`, or all side by side, `ParallelInTime`, for affine models.

    Works under `jit`, `vmap`, `jacfwd` and `grad`. A failure is a value: see `Filtered.fault`; derivatives are then 0.

    **Raises:** `InputError` where the readings have other channels than the model's observation.
    """
    carry, records = passage.run(model, readings, intervals, contexts, transform, keep=True)
    # The fields of `Record` are those of `Filtered` between the first and the faults.
    return Filtered(*(carry.log_likelihood, *records, carry.fault, carry.fault_step))


def log_likelihood(
    model: AbstractStateSpaceModel,
    readings: Float[Array, "time channel"],
    intervals: PyTree,
    contexts: PyTree = None,
    transform: AbstractTransform = STANDARD,
    passage: AbstractPassage = SEQUENTIAL,
) -> Float[Array, ""]:
    """The log marginal likelihood (2.4) in nats, without a history; -1e15 where the filter failed.

    Arguments as for `unscented_filter`. On a processor its loop over the readings is machine code where that can be
    written, of one model or of many under `vmap`; first derivatives, in either mode, come from its reverse.
    """
    arrays, rest = eqx.partition((model, readings, intervals, contexts, transform, passage), eqx.is_array)
    leaves, structure = jax.tree.flatten(arrays)

    def of(*leaves: Any) -> Array:
        *given, transform, passage = eqx.combine(jax.tree.unflatten(structure, leaves), rest)
        return passage.run(*given, transform, keep=False)[0].log_likelihood

    return with_swift_slopes(of)(*leaves)


def kalman_filter(
    model: StateSpaceModel,
    readings: Float[Array, "time channel"],
    intervals: PyTree,
    contexts: PyTree = None,
    passage: AbstractPassage = SEQUENTIAL,
) -> Filtered:
    """The Kalman filter, exact for a model whose dynamics and observation are affine (3.1). Algorithm 4, corrected.

    Arguments as for `unscented_filter`, which gives the same for such a model.

    **Raises:** `InputError` where the dynamics or the observation is not an `AbstractAffine`, or the readings have
    other channels than the observation.
    """
    for name, part in (("dynamics", model.dynamics), ("observation", model.observation)):
        if not isinstance(part, AbstractAffine):
            raise InputError(
                f"`kalman_filter` is for affine models, but the {name} is `{type(part).__name__}`; use "
                "`unscented_filter`, or make it a subclass of `AbstractAffine`."
            )
    return unscented_filter(model, readings, intervals, contexts, Taylor(), passage)


def _as_it_is(carry, like):
    """The state as moments of the shape of a prediction: more columns, of zeros."""
    wide = jnp.pad(carry.root, ((0, 0), (0, like.factor.shape[1] - carry.root.shape[1])))
    return Moments(carry.mean, wide, jnp.zeros_like(like.source))


def _in_stretches(step, carry, of_readings, intervals):
    """The carry after all readings; derivatives keep only that at the start of every stretch of sqrt(n) readings.

    Each stretch is taken out of the recording when its turn comes: a copy of all of it would be larger than what is
    saved. The last one may be longer than what is left, and does nothing there.
    """
    count = len(of_readings[0])
    length = math.isqrt(count) + 1

    @functools.partial(jax.checkpoint, prevent_cse=False)
    def stretch(carry, at):
        places = at + np.arange(length)
        readings, contexts = jax.tree.map(lambda leaf: jnp.take(leaf, places, axis=0, mode="clip"), of_readings)
        inside = jax.tree.map(lambda leaf: jnp.take(leaf, places - 1, axis=0, mode="clip"), intervals)
        return jax.lax.scan(within, carry, (readings, inside, contexts, places))[0], None

    def within(carry, data):
        after, _ = step(carry, data)
        return jax.tree.map(lambda new, old: jnp.where(data[-1] < count, new, old), after, carry), None

    return jax.lax.scan(stretch, carry, np.arange(0, count, length))[0]
