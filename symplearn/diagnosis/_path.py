"""A remainder in the dynamics: a white missing force, and the most probable path that it takes.

The path of every phase point is fitted with the unknowns by Gauss-Newton (the iterated Kalman smoother of Bell 1994;
weak-constraint variational assimilation). Linearised about that path, a Kalman filter gives the Gram matrix of the
innovations as functions of the unknowns, from which step, evidence and scores of effects follow. As the force's
intensity goes to zero this is the trajectory fit; a force holds it to the readings where that diverges, though from a
start far off it may diverge too.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._lane_loops import with_lane_loops
from ._trajectory import Stepper


class Linear(NamedTuple):
    """The model linearised about a path: x' = defect + A dx + T dtheta, y = residual - H dx - G dtheta."""

    defect: Float[Array | np.ndarray, "time state"]
    A: Float[Array | np.ndarray, "time state state"]
    T: Float[Array | np.ndarray, "time state theta"]
    residual: Float[Array | np.ndarray, "time channel"]
    H: Float[Array | np.ndarray, "time channel state"]
    G: Float[Array | np.ndarray, "time channel theta"]


class Pass(NamedTuple):
    """A forward pass: the Gram matrix of the innovations by column [1, x_0, theta], and what a backward pass needs."""

    gram: Float[Array, "column column"]
    logs: Float[Array, ""]  # sum of log innovation variances
    means: Float[Array, "time state column"]
    covariances: Float[Array, "time state state"]
    gains: Float[Array, "time channel state"]
    innovations: Float[Array, "time channel column"]
    variances: Float[Array, "time channel"]


def linearise(
    stepper: Stepper, r: int, paths: Float[np.ndarray, "lane time state"], values: Float[np.ndarray, "lane theta"],
    hots: Float[np.ndarray, "lane row coefficient"], slots: Sequence[Int[np.ndarray, " _"]], readings: np.ndarray,
) -> Linear:  # fmt: skip
    """Linearise flow and observation of one recording about the paths of at most `LANES` lanes, over the rows that
    `readings` covers; after them nothing moves and nothing is read.

    theta are the calibrated values and the slots, whose `values` are given; slopes in slots that are not named are 0.
    """
    n, state = len(readings), stepper.problem.state
    length, channels = paths.shape[1], stepper.problem.channels
    out, slopes = stepper.about_paths(paths[:, :n], values, hots, slots, r)
    seen = ~np.isnan(readings)
    residual = np.where(seen, np.where(seen, readings, 0.0) - out[..., :channels], 0.0)
    shown = np.where(seen[..., None], np.moveaxis(slopes[..., :channels], 1, -1), 0.0)
    arrived = np.moveaxis(slopes[:, :, 1:, channels:], 1, -1)
    defect = out[:, 1:, channels:] - paths[:, 1:n]
    parts = [defect, arrived[..., :state], arrived[..., state:], residual, shown[..., :state], shown[..., state:]]
    return Linear(*(_lengthened(part, length) for part in parts))


def _lengthened(values: np.ndarray, length: int) -> np.ndarray:
    """Rows of every lane with zeros after them."""
    out = np.zeros((len(values), length, *values.shape[2:]))
    out[:, : values.shape[1]] = values
    return out


def _pushed(intensity: Array, state: int) -> Array:
    """A square root of what a white force adds to a phase point per unit of time. An unseen oscillator's momentum
    gets none: it follows."""
    d = intensity.shape[0]
    return jnp.zeros((state, d)).at[state // 2 + np.arange(d), np.arange(d)].set(jnp.sqrt(intensity))


def _diffusion(A: Array, start: Array, length: Array) -> Array:
    """Covariance a white force adds over one span, by Simpson's rule over the time it acts. Of the phase point."""
    end, middle = A @ start, 0.5 * (start + A @ start)
    return length / 6 * (end @ end.T + 4 * middle @ middle.T + start @ start.T)


def forward(linear: Linear, variances: Array, intensity: Array, lengths: Array) -> Pass:
    """Filter the columns [1, x_0, theta]; `variances` (time, channel) of the readings, 0 where there is none."""
    state, theta = linear.A.shape[-1], linear.T.shape[-1]
    size = 1 + state + theta
    means, pushed = jnp.zeros((state, size)).at[:, 1 : 1 + state].set(jnp.eye(state)), _pushed(intensity, state)
    zeros = jnp.zeros((linear.H.shape[1], state))

    def step(carry, data):
        M, P, logs = carry
        lin, r, length = data
        M0, P0 = M, P
        own = jnp.concatenate([lin.residual[:, None], jnp.zeros_like(zeros), -lin.G], axis=1)
        gains: list[Array] = []
        innovations: list[Array] = []
        spread: list[Array] = []
        for j in range(lin.H.shape[0]):  # channels are few, and independent given the state
            h, seen = lin.H[j], r[j] > 0
            S = jnp.where(seen, h @ P @ h + r[j], 1.0)
            K = jnp.where(seen, P @ h / S, 0.0)
            e = jnp.where(seen, own[j] - h @ M, 0.0)
            logs = logs + jnp.where(seen, jnp.log(S), 0.0)
            M, P = M + jnp.outer(K, e), P - jnp.outer(K, K) * S
            gains, innovations, spread = [*gains, K], [*innovations, e], [*spread, S]
        kept = (M0, P0, jnp.stack(gains), jnp.stack(innovations), jnp.stack(spread))
        drift = jnp.concatenate([lin.defect[:, None], jnp.zeros((state, state)), lin.T], axis=1)
        P = lin.A @ P @ lin.A.T + _diffusion(lin.A, pushed, length)
        return (lin.A @ M + drift, 0.5 * (P + P.T), logs), kept

    start = (means, jnp.zeros((state, state)), jnp.zeros(()))
    (_, _, logs), kept = jax.lax.scan(step, start, (linear, variances, lengths))
    innovations, spread = kept[3], kept[4]
    gram = jnp.einsum("tjc,tjd->cd", innovations / spread[..., None], innovations)
    return Pass(gram, logs, *kept)


class Smooth(NamedTuple):
    """A backward pass: the path's correction, and what the readings say of noises."""

    shift: Float[Array, "time state"]
    noise: Float[Array, "time channel"]  # expected squared reading error, in the reading's own variance


def backward(linear: Linear, done: Pass, variances: Array, delta: Array) -> Smooth:
    """Smooth at a step `delta` of [x_0, theta] by Bryson and Frazier's recursion, which inverts nothing."""
    column = jnp.concatenate([jnp.ones(1), delta])

    def step(carry, data):
        adjoint, information = carry
        H, x, P, K, e, S, r = data
        own: list[Array] = []
        for j in reversed(range(H.shape[0])):
            h, seen = H[j], r[j] > 0
            u = jnp.where(seen, e[j] / S[j] + K[j] @ adjoint, 0.0)
            D = jnp.where(seen, 1 / S[j] + K[j] @ information @ K[j], 0.0)
            own = [r[j] ** 2 * u**2 + r[j] - r[j] ** 2 * D, *own]
            keep = jnp.eye(h.shape[0]) - jnp.outer(K[j], h)
            adjoint = jnp.where(seen, keep.T @ adjoint - h * e[j] / S[j], adjoint)
            information = jnp.where(seen, keep.T @ information @ keep + jnp.outer(h, h) / S[j], information)
        shift = x - P @ adjoint
        return (adjoint, information), (shift, jnp.stack(own), adjoint)

    def through(carry, data):
        (adjoint, information), A, rest = carry, data[0], data[1:]
        carry, (shift, own, _) = step((A.T @ adjoint, A.T @ information @ A), rest)
        return carry, (shift, own)

    d = linear.A.shape[-1]
    # The span after a row carries its adjoint back; nothing follows the last row.
    spans = jnp.asarray(linear.A).at[-1].set(0.0)
    moved, innovations = done.means @ column, done.innovations @ column
    data = (spans, linear.H, moved, done.covariances, done.gains, innovations, done.variances, variances)
    _, (shift, own) = jax.lax.scan(through, (jnp.zeros(d), jnp.zeros((d, d))), data, reverse=True)
    return Smooth(shift, own)


# Not Equinox's: all they are given is arrays, NumPy's among them, which JAX hands over by itself. Put on the device one
# by one they, and those of `_along`, took two of the demo's sixteen seconds.
forward_lanes = jax.jit(jax.vmap(with_lane_loops(forward)))
backward_lanes = jax.jit(jax.vmap(with_lane_loops(backward)))
