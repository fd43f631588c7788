"""The unscented Rauch-Tung-Striebel smoother and its auxiliary residuals: the trace of left-out physics.

Written with the adjoint of the state (Bryson and Frazier 1963; de Jong 1988), which needs no inverse of a
covariance, so that models without process noise have auxiliary residuals too.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from ._filter import Filtered
from ._model import AbstractStateSpaceModel
from ._transforms import STANDARD, AbstractTransform
from ._triangular import lower_inverse, semidefinite_cholesky

# Where the state is known exactly, slopes are central differences over this share of the state's size.
_NUDGE = 1e-5


class Smoothed(eqx.Module):
    """The state and the noises given the whole recording, at n readings and over n - 1 data intervals.

    `disturbances` are E[xi_k | Y] for x_{k+1} = E[x_{k+1} | x_k] + xi_k and `residuals` E[eta_k | Y] for
    y_k = E[y_k | x_k] + eta_k, so that noise of a mean of its own counts from there; their `*_covariances` are those of
    the noises given Y. The `standardised_*` are divided by the standard deviation of the estimate itself: each is
    N(0, 1) where the model is right, one series per state equation and one per channel. They exist without process
    noise too, as limits. Harvey and Koopman (1992). Of a missing reading, see `observed`, the standardised residual is
    0, and the residual what noise correlated with the other channels' says of it.
    """

    means: Float[Array, "time state"]
    covariances: Float[Array, "time state state"]
    disturbances: Float[Array, "interval state"]
    disturbance_covariances: Float[Array, "interval state state"]
    standardised_disturbances: Float[Array, "interval state"]
    residuals: Float[Array, "time channel"]
    residual_covariances: Float[Array, "time channel channel"]
    standardised_residuals: Float[Array, "time channel"]
    observed: Bool[Array, "time channel"]


class _Adjoint(NamedTuple):
    """r and N: the smoothed state is m + P r with covariance P - P N P; N is the variance of r."""

    r: Array
    N: Array


def smooth(
    model: AbstractStateSpaceModel,
    filtered: Filtered,
    intervals: PyTree,
    contexts: PyTree = None,
    transform: AbstractTransform = STANDARD,
) -> Smoothed:
    """Smooth what `unscented_filter` filtered; give the same model, intervals, contexts and transform.

    Sarkka (2008) for the unscented smoother. On a linear model everything is exact. Where noise is multiplied, its
    covariance is that at the filtered mean.
    """
    A, Q = jax.vmap(lambda m, P, interval: _slope_and_noise(model.predict, transform, m, P, interval))(
        filtered.filtered_means[:-1], filtered.filtered_covariances[:-1], intervals
    )
    H, R = jax.vmap(lambda m, P, context: _slope_and_noise(model.read, transform, m, P, context))(
        filtered.predicted_means, filtered.predicted_covariances, contexts
    )
    return smooth_along(filtered, A, Q, H, R)


def smooth_along(
    filtered: Filtered,
    A: Float[Array, "interval state state"],
    Q: Float[Array, "interval state state"],
    H: Float[Array, "time channel state"],
    R: Float[Array, "time channel channel"],
) -> Smoothed:
    """The same with slopes and noises that are known: of the dynamics, A and Q, and of the readings, H and R."""
    H = jnp.where(filtered.observed[:, :, None], H, 0.0)
    S_inverse = jax.vmap(_masked_inverse)(filtered.innovation_covariances, filtered.observed)
    K = jnp.einsum("kij,kcj,kcd->kid", filtered.predicted_covariances, H, S_inverse)
    predicted, corrected = _sweep(A, H, K, S_inverse, filtered.innovations)
    means, covariances = jax.vmap(_state)(filtered.filtered_means, filtered.filtered_covariances, corrected)
    later = jax.tree.map(lambda leaf: leaf[1:], predicted)
    xi = jax.vmap(_noise_given_all)(Q, later.r, later.N)
    u = jnp.einsum("kcd,kd->kc", S_inverse, filtered.innovations) - jnp.einsum("kic,ki->kc", K, corrected.r)
    D = S_inverse + jnp.einsum("kic,kij,kjd->kcd", K, corrected.N, K)
    eta = jax.vmap(_noise_given_all)(R, u, D)
    standardised = jnp.where(filtered.observed, eta[2], 0.0)
    return Smoothed(*(means, covariances, *xi, *eta[:2], standardised, filtered.observed))


def _slope_and_noise(part, transform, m, P, record):
    """The statistical slope Cov[f(x), x] P^-1 of a part of the model, and the covariance of its noise given x = m.

    Where P is singular the missing columns of its root are filled with small steps along the axes.
    """
    L = semidefinite_cholesky(P)
    step = _NUDGE * jnp.maximum(1.0, jnp.abs(m))
    L = L + jnp.diag(jnp.where(jnp.diagonal(L) > 0.0, 0.0, step))
    # Both with and without spread in one: a part of the model is long to compile.
    both = jax.vmap(lambda root: part(transform, m, root, record))(jnp.stack([L, jnp.zeros_like(L)]))
    moments, known = (jax.tree.map(lambda leaf, k=k: leaf[k], both) for k in (0, 1))
    # Cov[f, x] P^-1 = factor source' L'^-1 L^-1, with L^-1 source close to [1, 0].
    inverse = lower_inverse(L)
    slope = moments.factor @ (inverse @ moments.source).T @ inverse
    return slope, known.covariance


def _masked_inverse(S, seen):
    """The inverse of the innovation covariance of the channels that were read, 0 elsewhere."""
    both = seen[:, None] & seen[None, :]
    inverse = lower_inverse(semidefinite_cholesky(jnp.where(both, S, jnp.diag(jnp.ones(S.shape[0])))))
    return jnp.where(both, inverse.T @ inverse, 0.0)


def _sweep(A, H, K, S_inverse, innovations):
    """Backward through time: the adjoints before and after each reading."""
    size = K.shape[1]
    end = _Adjoint(jnp.zeros(size), jnp.zeros((size, size)))
    A = jnp.concatenate([A, jnp.zeros((1, size, size))])

    def step(later, data):
        A, H, K, S_inverse, v = data
        corrected = _Adjoint(A.T @ later.r, A.T @ later.N @ A)
        keep = jnp.eye(size) - K @ H
        r = H.T @ S_inverse @ v + keep.T @ corrected.r
        N = H.T @ S_inverse @ H + keep.T @ corrected.N @ keep
        predicted = _Adjoint(r, 0.5 * (N + N.T))
        return predicted, (predicted, corrected)

    _, adjoints = jax.lax.scan(step, end, (A, H, K, S_inverse, innovations), reverse=True)
    return adjoints


def _state(m, P, adjoint):
    covariance = P - P @ adjoint.N @ P
    return m + P @ adjoint.r, 0.5 * (covariance + covariance.T)


def _noise_given_all(Q, r, N):
    """Mean and covariance of a noise given all readings, and its mean in units of its own standard deviation.

    With diagonal Q the last is r_i / sqrt(N_ii), which stays meaningful where Q_ii is 0.
    """
    mean, spread = Q @ r, Q @ N @ Q
    moves = jnp.diagonal(Q) > 0.0
    variance = jnp.where(moves, jnp.diagonal(spread), jnp.diagonal(N))
    known = variance > 0.0
    scores = jnp.where(moves, mean, r) / jnp.sqrt(jnp.where(known, variance, 1.0))
    return mean, Q - spread, jnp.where(known, scores, 0.0)
