"""The unscented Kalman filter for additive noise. Dissertation (2.5)-(2.8), Algorithms 2 and 5 corrected.

Slips of the printed algorithms that are right here: the measurement at k = 0 is used first; sigma points go
along the columns of a lower Cholesky factor and are drawn again before the measurement; the exponent is a
squared norm.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from ._model import StateSpaceModel, slice_at

# A pivot below this share of its diagonal entry is round-off of a singular covariance: its column is dropped.
_SINGULAR = 1e-14
# Loops over the columns of a small matrix are laid out flat up to this size, which XLA fuses better.
_FLAT = 16


class UnscentedTransform(eqx.Module):
    """The scaled unscented transform with 2d + 1 sigma points. Wan and van der Merwe (2000); Algorithm 5.

    The default is well conditioned. The dissertation uses (1e-3, 2, 0), whose weights of about 1e6 cost some
    six digits. The moments are summed over differences from the centre point, and beta >= alpha**2 keeps
    every covariance positive semi-definite.

    **Raises:** `ValueError` where alpha <= 0 or beta < alpha**2.
    """

    alpha: float = eqx.field(static=True, default=1.0)
    beta: float = eqx.field(static=True, default=2.0)
    kappa: float = eqx.field(static=True, default=0.0)

    def __check_init__(self):
        if self.alpha <= 0 or self.beta < self.alpha**2:
            raise ValueError(
                f"`UnscentedTransform` needs alpha > 0 and beta >= alpha**2, but was given "
                f"alpha={self.alpha}, beta={self.beta}. Use the default (1, 2, 0) or (1e-3, 2, 0)."
            )

    def spread(self, dim: int) -> float:
        """d + lambda = alpha^2 (d + kappa), the squared stretch of the sigma points."""
        if dim + self.kappa <= 0:
            raise ValueError(f"`UnscentedTransform` needs dim + kappa > 0, but dim={dim}, kappa={self.kappa}.")
        return self.alpha**2 * (dim + self.kappa)

    def offsets(self, covariance: Float[Array, "state state"]) -> Float[Array, "point state"]:
        """The sigma points other than the centre, minus it: +-sqrt(d + lambda) times the columns of L."""
        half = math.sqrt(self.spread(covariance.shape[0])) * semidefinite_cholesky(covariance).T
        return jnp.concatenate([half, -half])

    def moments(self, function: Callable[[Any], Any], mean: Any, offsets: Any) -> "TransformedMoments":
        """Moments of `function(x)` for the sigma points `mean` and `mean + offsets`."""
        outputs = jax.vmap(function)(jnp.concatenate([mean[None], mean + offsets]))
        deviations = outputs[1:] - outputs[0]
        weight = 0.5 / self.spread(mean.shape[0])
        shift = weight * jnp.sum(deviations, axis=0)
        # sum_i w_i (D_i - shift)(D_i - shift)' with sum_i w_i = 2 + beta - alpha^2 and a zero centre
        # difference.
        remainder = (self.beta - self.alpha**2) * jnp.outer(shift, shift)
        return TransformedMoments(outputs[0] + shift, deviations, remainder, weight)


STANDARD = UnscentedTransform()


class TransformedMoments(NamedTuple):
    """What a transform knows of f(x): its mean, deviations from the centre (point, output), and the rest."""

    mean: Array
    deviations: Array
    remainder: Array
    weight: float

    @property
    def covariance(self) -> Array:
        """Var[f(x)]."""
        return self.weight * self.deviations.T @ self.deviations + self.remainder


class Filtered(eqx.Module):
    """What the filter says of the state at each of n readings.

    `predicted_*` are given the readings before, `filtered_*` given the reading too; the first prediction is
    the initial distribution. `increments` (time,) add up to `log_likelihood`, in nats, constants included.
    `innovations` are y - E[y | past] and `standardised_innovations` the same divided by the lower Cholesky
    factor of `innovation_covariances`; both are 0 where `observed` is False. `ok` is False where a step was
    not finite or an innovation covariance not positive; `log_likelihood` is then -inf and the later moments
    mean nothing.
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
    ok: Bool[Array, ""]


class _Carry(NamedTuple):
    mean: Array
    covariance: Array
    log_likelihood: Array
    ok: Array


class _Record(NamedTuple):
    increment: Array
    predicted_mean: Array
    predicted_covariance: Array
    filtered_mean: Array
    filtered_covariance: Array
    innovation: Array
    innovation_covariance: Array
    standardised_innovation: Array
    observed: Array


def unscented_filter(
    model: StateSpaceModel,
    readings: Float[Array, "time channel"],
    intervals: PyTree,
    contexts: PyTree = None,
    transform: UnscentedTransform = STANDARD,
) -> Filtered:
    """Filter a recording and keep everything the smoother and a diagnosis need. Algorithm 2, corrected.

    **Arguments:** `model` - with plain arrays (see `resolve`) and an `initial` Gaussian; `readings` - NaN
    where missing, in whole rows or in part; `intervals` - a pytree with leading axis time - 1, one slice per
    data interval; `contexts` - a pytree with leading axis time for the observation, or None; `transform` -
    sigma points.

    Works under `jit`, `vmap`, `jacfwd` and `grad`. After a failure forward gradients are 0; reverse
    gradients are 0 too, unless the dynamics itself overflowed, where they may be NaN: look at `ok`.
    """
    carry, first, later = _run(model, readings, intervals, contexts, transform, keep=True)
    history = [jnp.concatenate([one[None], rest]) for one, rest in zip(first, later, strict=True)]
    # The fields of `_Record` are those of `Filtered` between the first and the last.
    return Filtered(*(_guarded(carry), *history, carry.ok))


def log_likelihood(
    model: StateSpaceModel,
    readings: Float[Array, "time channel"],
    intervals: PyTree,
    contexts: PyTree = None,
    transform: UnscentedTransform = STANDARD,
) -> Float[Array, ""]:
    """The log marginal likelihood (2.4) in nats, without a history; -inf where the filter failed.

    Arguments as for `unscented_filter`.
    """
    return _guarded(_run(model, readings, intervals, contexts, transform, keep=False)[0])


def _guarded(carry: _Carry) -> Array:
    return jnp.where(carry.ok, carry.log_likelihood, -jnp.inf)


def _run(model, readings, intervals, contexts, transform, keep):
    """Measure at k = 0, then predict and measure through every data interval."""
    start = jnp.asarray(model.initial.mean)
    zero = jnp.zeros((), start.dtype)
    carry = _Carry(start, jnp.asarray(model.initial.covariance), zero, jnp.asarray(True))
    carry, first = _measure(model, transform, carry, readings[0], slice_at(contexts, 0))

    def step(carry, data):
        reading, interval, context = data
        carry = _predict(model, transform, carry, interval)
        carry, record = _measure(model, transform, carry, reading, context)
        return carry, (record if keep else None)

    later_contexts = jax.tree.map(lambda leaf: leaf[1:], contexts)
    # Checkpointing the step makes the gradient faster as well as 16 times smaller (performance.md, A7).
    step = jax.checkpoint(step, prevent_cse=False)
    carry, later = jax.lax.scan(step, carry, (readings[1:], intervals, later_contexts))
    return carry, first, later


def _predict(model, transform, carry, interval):
    """Moments of the next state (2.6), sigma points drawn afresh from the filtered moments."""
    offsets = transform.offsets(carry.covariance)
    moments = transform.moments(lambda x: model.dynamics(x, interval), carry.mean, offsets)
    covariance = moments.covariance + model.process_noise.covariance(interval)
    # The transform's part is a sum of squares, so only a negative process noise can fail here.
    positive = jnp.all(jnp.diagonal(covariance) >= 0.0)
    return _accept(model, carry, moments.mean, covariance, positive, 0.0)


def _measure(model, transform, carry, reading, context):
    """Condition on one reading, (2.7)-(2.8), with the covariance in Joseph's form, a sum of squares.

    Missing channels get a unit innovation variance, no correlation and a zero innovation: exactly as if
    absent.
    """
    m, P = carry.mean, carry.covariance
    offsets = transform.offsets(P)
    moments = transform.moments(lambda x: model.observation(x, context), m, offsets)
    noise = moments.remainder + model.measurement_noise.covariance()
    seen = ~jnp.isnan(reading)
    deviations = jnp.where(seen, moments.deviations, 0.0)
    r = jnp.where(seen, jnp.where(seen, reading, 0.0) - moments.mean, 0.0)
    S = moments.weight * moments.deviations.T @ moments.deviations + noise
    masked = jnp.where(seen[:, None] & seen[None, :], S, 0.0) + jnp.diag(jnp.where(seen, 0.0, 1.0))
    U = moments.weight * offsets.T @ deviations
    whitened, roots, positive = _whiten(masked, jnp.concatenate([U, r[None], jnp.eye(r.shape[0])]))
    UL, e, L_inverse = whitened[: m.shape[0]], whitened[m.shape[0]], whitened[m.shape[0] + 1 :].T
    K = UL @ L_inverse
    left = offsets - deviations @ K.T
    mean = m + UL @ e
    covariance = moments.weight * left.T @ left + K @ noise @ K.T
    constant = 0.5 * math.log(2 * math.pi) * jnp.sum(seen)
    increment = -0.5 * e @ e - jnp.sum(jnp.log(roots)) - constant
    after = _accept(model, carry, mean, covariance, positive, increment)
    safe_increment = after.log_likelihood - carry.log_likelihood
    record = _Record(safe_increment, m, P, after.mean, after.covariance, r, S, e, seen)
    return after, record


def _accept(model, carry, mean, covariance, positive, increment):
    """The next carry, or a harmless fixed one from the first failure on: no NaN is computed with."""
    finite = jnp.all(jnp.isfinite(mean)) & jnp.all(jnp.isfinite(covariance)) & jnp.isfinite(increment)
    ok = carry.ok & positive & finite
    refuge = jax.lax.stop_gradient(jnp.asarray(model.initial.mean))
    covariance = 0.5 * (covariance + covariance.T)
    total = carry.log_likelihood + jnp.where(ok, increment, 0.0)
    return _Carry(jnp.where(ok, mean, refuge), jnp.where(ok, covariance, 0.0), total, ok)


def semidefinite_cholesky(covariance: Float[Array, "state state"]) -> Float[Array, "state state"]:
    """Lower Cholesky factor of a covariance that may be singular, or zero; differentiable.

    A column whose pivot is below 1e-14 of its diagonal entry is set to zero, together with its derivative.
    """
    return _eliminate(covariance, _SINGULAR)[0]


def _whiten(covariance, rows):
    """`rows` times the inverse transpose of the Cholesky factor L, the diagonal of L, and whether L
    exists."""
    columns, roots, positive = _eliminate(jnp.concatenate([covariance, rows]), 0.0)
    return columns[covariance.shape[0] :], roots, jnp.all(positive)


def _eliminate(stack, tolerance):
    """Right-looking Cholesky of A on the stack [A; B]: gives [L; B L^-T], the diagonal of L, the good
    pivots."""
    height, size = stack.shape
    rows = jnp.arange(height)

    def column(rest, data):
        j, scale = data
        pivot = rest[j, j]
        good = pivot > tolerance * jnp.abs(scale)
        root = jnp.sqrt(jnp.where(good, pivot, 1.0))
        entries = jnp.where(good & (rows >= j), rest[:, j] / root, 0.0)
        return rest - jnp.outer(entries, entries[:size]), (entries, root, good)

    data = (jnp.arange(size), jnp.diagonal(stack))
    _, (columns, roots, good) = jax.lax.scan(column, stack, data, unroll=min(size, _FLAT))
    return columns.T, roots, good
