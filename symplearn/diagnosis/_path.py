"""A remainder in the dynamics: a white missing force, and the most probable path that it takes.

The path of every phase point is fitted with the unknowns by Gauss-Newton (the iterated Kalman smoother of Bell 1994;
weak-constraint variational assimilation). Linearised about that path, a Kalman filter gives the Gram matrix of the
innovations as functions of the unknowns, from which step, evidence and scores of effects follow. As the force's
intensity goes to zero this is the trajectory fit; a force holds it to the readings where that diverges, though from a
start far off it may diverge too.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._augmented_flow import Span
from .._augmented_system import EVERYTHING, Switches
from ._trajectory import Course, effect_coefficients, model_at


class Linear(NamedTuple):
    """The model linearised about a path: x' = defect + A dx + T dtheta, y = residual - H dx - G dtheta."""

    defect: Float[Array, "time state"]
    A: Float[Array, "time state state"]
    T: Float[Array, "time state theta"]
    residual: Float[Array, "time channel"]
    H: Float[Array, "time channel state"]
    G: Float[Array, "time channel theta"]


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
    equations, integrator, course: Course, path, calibrated, slots, onehot, readings, switches: Switches = EVERYTHING
) -> Linear:
    """Linearise flow and observation about a path (time, state) at theta = [calibrated, slots]."""
    state, f = path.shape[1], calibrated.shape[0]
    theta = jnp.concatenate([calibrated, slots])
    directions = jnp.eye(state + theta.shape[0])

    def row(x, k):
        def flow_and_read(joint):
            x, theta = joint[:state], joint[state:]
            found = effect_coefficients(theta[f:], onehot)
            flow, read = model_at(equations, integrator, course, theta[:f], found, switches)
            start, step, inputs = (leaf[k] for leaf in (course.spans.start, course.spans.step, course.spans.inputs))
            # One number of substeps for all rows, which are stepped together.
            span = Span(start, step, inputs, course.spans.pieces[0])
            return flow(x, span), read(x, (course.times[k], course.inputs[k]))

        slope = lambda along: jax.jvp(flow_and_read, (jnp.concatenate([x, theta]),), (along,))  # noqa: E731
        return jax.vmap(slope, out_axes=(None, -1))(directions)

    n = path.shape[0]
    (moved, h), (flown, shown) = jax.vmap(row)(path, jnp.arange(n))
    after = jnp.concatenate([path[1:], moved[-1:]])
    seen = ~jnp.isnan(readings)
    residual = jnp.where(seen, jnp.where(seen, readings, 0.0) - h, 0.0)
    A, T, H, G = flown[..., :state], flown[..., state:], shown[..., :state], shown[..., state:]
    return Linear(moved - after, A, T, residual, H, G)


def _diffusion(A: Array, intensity: Array, length: Array) -> Array:
    """Covariance a white force adds over one span, by Simpson's rule over the time it acts. Of the phase point."""
    d, state = intensity.shape[0], A.shape[0]
    momentum = state // 2 + jnp.arange(d)  # an unseen oscillator's, which follows, gets no force
    start = jnp.zeros((state, d)).at[momentum, jnp.arange(d)].set(jnp.sqrt(intensity))
    end, middle = A @ start, 0.5 * (start + A @ start)
    return length / 6 * (end @ end.T + 4 * middle @ middle.T + start @ start.T)


def forward(linear: Linear, variances: Array, intensity: Array, lengths: Array) -> Pass:
    """Filter the columns [1, x_0, theta]; `variances` (time, channel) of the readings, 0 where there is none."""
    state, theta = linear.A.shape[-1], linear.T.shape[-1]
    size = 1 + state + theta
    means = jnp.zeros((state, size)).at[:, 1 : 1 + state].set(jnp.eye(state))
    zeros = jnp.zeros((linear.H.shape[1], state))

    def step(carry, data):
        M, P, gram, logs = carry
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
            gram, logs = gram + jnp.outer(e, e) / S, logs + jnp.where(seen, jnp.log(S), 0.0)
            M, P = M + jnp.outer(K, e), P - jnp.outer(K, K) * S
            gains, innovations, spread = [*gains, K], [*innovations, e], [*spread, S]
        kept = (M0, P0, jnp.stack(gains), jnp.stack(innovations), jnp.stack(spread))
        drift = jnp.concatenate([lin.defect[:, None], jnp.zeros((state, state)), lin.T], axis=1)
        P = lin.A @ P @ lin.A.T + _diffusion(lin.A, intensity, length)
        return (lin.A @ M + drift, 0.5 * (P + P.T), gram, logs), kept

    start = (means, jnp.zeros((state, state)), jnp.zeros((size, size)), jnp.zeros(()))
    (_, _, gram, logs), kept = jax.lax.scan(step, start, (linear, variances, lengths))
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
        lin, M, P, K, e, S, r = data
        own: list[Array] = []
        for j in reversed(range(lin.H.shape[0])):
            h, seen = lin.H[j], r[j] > 0
            u = jnp.where(seen, e[j] @ column / S[j] + K[j] @ adjoint, 0.0)
            D = jnp.where(seen, 1 / S[j] + K[j] @ information @ K[j], 0.0)
            own = [r[j] ** 2 * u**2 + r[j] - r[j] ** 2 * D, *own]
            keep = jnp.eye(h.shape[0]) - jnp.outer(K[j], h)
            adjoint = jnp.where(seen, keep.T @ adjoint - h * (e[j] @ column) / S[j], adjoint)
            information = jnp.where(seen, keep.T @ information @ keep + jnp.outer(h, h) / S[j], information)
        shift = M @ column - P @ adjoint
        return (adjoint, information), (shift, jnp.stack(own), adjoint)

    def through(carry, data):
        (adjoint, information), A, rest = carry, data[0], data[1:]
        carry, (shift, own, _) = step((A.T @ adjoint, A.T @ information @ A), rest)
        return carry, (shift, own)

    d = linear.A.shape[-1]
    # The span after a row carries its adjoint back; nothing follows the last row.
    spans = linear.A.at[-1].set(0.0)
    data = (spans, linear, done.means, done.covariances, done.gains, done.innovations, done.variances, variances)
    _, (shift, own) = jax.lax.scan(through, (jnp.zeros(d), jnp.zeros((d, d))), data, reverse=True)
    return Smooth(shift, own)


@eqx.filter_jit
def forward_lanes(
    equations, integrator, course, paths, calibrated, slots, onehots, readings, variances, intensities, exposures,
    switches,
):  # fmt: skip
    """Linearise and filter every lane over the leading rows that `paths` (lane, time, state) covers.

    `exposures` (lane, time) is the share of each span in which the missing force acts.
    """
    lengths = course.spans.length
    n = paths.shape[1]

    def lane(path, c, s, onehot, r, q, exposure):
        linear = linearise(equations, integrator, course, path, c, s, onehot, readings, switches)
        return linear, forward(linear, r, q, lengths[:n] * exposure)

    return jax.vmap(lane)(paths, calibrated, slots, onehots, variances, intensities, exposures)


backward_lanes = eqx.filter_jit(jax.vmap(backward))
