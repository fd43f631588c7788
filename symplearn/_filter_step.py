"""One step of the filters, in square-root form: a prediction is conditioned on a reading. Dissertation (2.7)-(2.8).

The measurement at k = 0 is used first; sigma points go along the columns of a lower Cholesky factor and are drawn again
before the measurement: the printed algorithms slip there.
"""

import abc
import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from ._errors import InputError
from ._faults import IMPOSSIBLE, Fault, first_fault, is_fatal, is_remote
from ._model import AbstractStateSpaceModel
from ._small_products import product
from ._transforms import AbstractTransform, Moments
from ._triangular import forward_substitution, triangularise


class Carry(NamedTuple):
    mean: Array
    root: Array
    log_likelihood: Array
    fault: Array
    fault_step: Array


class Record(NamedTuple):
    increment: Array
    predicted_mean: Array
    predicted_covariance: Array
    filtered_mean: Array
    filtered_covariance: Array
    innovation: Array
    innovation_covariance: Array
    standardised_innovation: Array
    observed: Array


class AbstractPassage(eqx.Module):
    """How a filter goes through a recording: `Sequential` or `ParallelInTime`."""

    @abc.abstractmethod
    def run(
        self,
        model: AbstractStateSpaceModel,
        readings: Float[Array, "time channel"],
        intervals: PyTree,
        contexts: PyTree,
        transform: AbstractTransform,
        keep: bool,
    ) -> tuple[Carry, Any]:
        """The state and the score after all readings; their records along a leading axis, which may be None unless
        `keep`."""


def begin(model, transform, reading, context):
    """The carry and the record of the first reading, which is conditioned on before anything moves."""
    mean, root = jnp.asarray(model.initial.mean), model.initial.root
    predicted = Moments(mean, root, jnp.zeros((mean.shape[0], 0)))
    return measure(model, transform, unscored(mean, root), predicted, reading, context, 0)


def unscored(mean, root):
    """A carry that has met neither a reading nor a fault."""
    return Carry(mean, root, jnp.zeros((), mean.dtype), jnp.asarray(int(Fault.NONE)), jnp.asarray(-1))


def measure(model, transform, carry, predicted, reading, context, k):
    """Condition the prediction on one reading, (2.7)-(2.8), by one triangularisation of the joint square root.

    [F_y; F_x] -> [S^1/2, 0; G, P+^1/2] with m+ = m + G e and e = S^-1/2 r. A missing channel has a row of zeros, which
    leaves everything else as if it were absent.
    """
    m, factor, _ = predicted
    # An exact reading takes the prediction's wide factor as it is and spares a triangularisation.
    root = factor if model.reads_exactly else triangularise(factor)[0]
    mean, rows, source = model.read(transform, m, root, context)
    channels = reading.shape[0]
    _refuse_other_channels(channels, mean.shape[0])
    seen = ~jnp.isnan(reading)
    masked = jnp.where(seen[:, None], rows, 0.0)
    triangle, good = triangularise(jnp.concatenate([masked, source]))
    S_root, G = triangle[:channels, :channels], triangle[channels:, :channels]
    r = jnp.where(seen, jnp.where(seen, reading, 0.0) - mean, 0.0)
    e = forward_substitution(S_root, r)
    # Not `jnp.diagonal`, whose derivative is a scatter, with which no loop is compiled as one function.
    diagonal = jnp.sum(jnp.where(np.eye(channels, dtype=bool), S_root, 0.0), axis=1)
    pivots = jnp.where(seen & good[:channels], diagonal, 1.0)
    increment = -0.5 * product(e, e) - jnp.sum(jnp.log(pivots)) - 0.5 * math.log(2 * math.pi) * jnp.sum(seen)
    fault = first_fault(
        (jnp.all(jnp.isfinite(m)), Fault.STATE),
        (jnp.all(jnp.isfinite(factor)), Fault.COVARIANCE),
        (jnp.all(jnp.isfinite(jnp.where(seen, mean, 0.0))) & jnp.all(jnp.isfinite(masked)), Fault.READING),
        (jnp.all(good[:channels] | ~seen), Fault.SINGULAR),
        (carry.log_likelihood + increment > IMPOSSIBLE, Fault.UNREACHED),
        (~is_remote(e), Fault.REMOTE),
    )
    after = _accept(model, carry, m + product(G, e), triangle[channels:, channels:], increment, fault, k)
    if_ok = after.log_likelihood - carry.log_likelihood
    moments = after.mean, product(after.root, after.root.T)
    record = Record(if_ok, m, product(factor, factor.T), *moments, r, product(rows, rows.T), e, seen)
    return after, jax.tree.map(_tidy, record)


def _refuse_other_channels(read: int, predicted: int) -> None:
    # One number would be stretched over all channels without a word.
    if read != predicted:
        raise InputError(
            f"The readings have {read} channels, but the model's observation gives {predicted}; read the channels that "
            "were recorded."
        )


def _tidy(leaf: Array) -> Array:
    """Zero for what is not finite, which only a failed step leaves behind."""
    return jnp.where(jnp.isfinite(leaf), leaf, jnp.zeros_like(leaf))


def _accept(model, carry, mean, root, increment, fault, k):
    """The next carry, or a harmless fixed one from the first fatal fault on: no NaN is computed with."""
    failed = is_fatal(carry.fault) | is_fatal(fault)
    first = (carry.fault == Fault.NONE) | (~is_fatal(carry.fault) & is_fatal(fault))
    noted = (fault != Fault.NONE) & first
    refuge = jax.lax.stop_gradient(jnp.nan_to_num(jnp.asarray(model.initial.mean)))
    return Carry(
        jnp.where(failed, refuge, mean),
        jnp.where(failed, 0.0, root),
        jnp.where(failed, IMPOSSIBLE, carry.log_likelihood + increment),
        jnp.where(noted, fault, carry.fault),
        jnp.where(noted, k, carry.fault_step),
    )
