"""Augmented simulations compiled once, moved over a span of any length; and SciPy's solution of the same by hand."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import sympy
from engine_cases import solved

import integrators as ig
from symplearn._augmented import equations
from symplearn._augmented_flow import SimulatedFlow, Span
from symplearn._expression import symbol
from symplearn._terms import Mechanics

# The two methods a diagnosis steps by.
LEAPFROG, TAO = ig.PositionVerlet(), ig.Tao(None)
MASS, A = 2.0, 0.7
START, PAIR_START = np.array([0.9, 0.8]), np.array([0.9, -0.6, 0.4, 0.8])
LENGTH = 3.0
ORIGIN = 0.35  # phases inside count from here, which is not where drifts count from
Q, P, M, K, U, T = (symbol(name) for name in ("q", "p", "m", "a", "u", "t"))
Q2, P2 = symbol("q2"), symbol("p2")


def compiled(hamiltonian, force=0, inputs=(), coordinates=(Q,), momenta=(P,)):
    """An augmented simulation with parameters m and a, which shows its coordinates."""
    forces = [sympy.sympify(force), *[sympy.Integer(0)] * (len(coordinates) - 1)]
    readings = {f"y{i}": q for i, q in enumerate(coordinates)}
    known = Mechanics(list(coordinates), list(momenta), hamiltonian, forces, readings, start=0.0)
    return equations(known, (M, K), inputs, origin=ORIGIN)


SOFT = compiled(P**2 / (2 * M) + K * sympy.cosh(Q))  # v = p / m, force -a sinh(q)
CURVED = compiled((Q**2 + 1) * (P**2 + 1) / (2 * M) * K)  # not separable: softness a (q^2 + 1) / m
FLAT_PAIR = compiled((P**2 + P2**2) / (2 * M) + K * (Q * Q2) ** 2 + sympy.cosh(Q + Q2), 0, (), (Q, Q2), (P, P2))
CURVED_PAIR = compiled(P**2 * (1 + Q2**2) / (2 * M) + P2**2 / (2 * M) + K * (Q**2 + Q2**2) / 2, 0, (), (Q, Q2), (P, P2))


def candidate(built, effect, target=None, side=None):
    """An effect on a target, the first one by default."""
    return next(
        c for c in built.candidates if c.effect.name == effect and target in (None, c.target) and side in (None, c.side)
    )


def vector(built, effect, values, target=None, side=None):
    """The coefficient vector that holds one effect, given by the contract's coefficients."""
    one = candidate(built, effect, target, side)
    out = np.zeros(built.size)
    out[one.values] = one.effect.inner(values, built.origin)
    if one.effect.switched:
        out[one.values.stop] = 1.0
    return out


@eqx.filter_jit
def _moved(built, method, values, x, start, step, inputs, count):
    flow = SimulatedFlow(built, method, jnp.array([MASS, A]), values)

    def body(k, x):
        return flow(x, Span(start + k * step, step, inputs[jnp.minimum(k, len(inputs) - 1)][None], jnp.asarray(1)))

    return jax.lax.fori_loop(0, count, body, x)


def flow(built, method, values, x, start, step, count, inputs=None):
    """Phase point, unseen oscillator and all, after `count` substeps; may be differentiated forwards."""
    inputs = jnp.zeros((1, 0)) if inputs is None else jnp.asarray(inputs)
    numbers = (jnp.asarray(start, float), jnp.asarray(step, float), inputs, jnp.asarray(count))
    return _moved(built, method, jnp.asarray(values), jnp.asarray(x), *numbers)


def widened(x, unseen=(0.0, 0.0)):
    """A phase point with the unseen oscillator behind its coordinates and behind its momenta."""
    q, p = np.split(np.asarray(x, float), 2)
    return np.array([*q, unseen[0], *p, unseen[1]])


def moved(built, method, values, x=START, length=LENGTH, pieces=300, inputs=None, start=0.0):
    """The phase point that is seen, after a time, the unseen oscillator at rest to begin with."""
    found = np.asarray(flow(built, method, values, widened(x), start, length / pieces, pieces, inputs))
    q, p = np.split(found, 2)
    return np.concatenate([q[:-1], p[:-1]])


def by_hand(rates, x=START, length=LENGTH, start=0.0):
    """SciPy's DOP853."""
    return solved(rates, x, np.array([start, start + length]), 1e-12)[-1]


def soft(force=lambda t, q, v: 0.0, m=lambda t: MASS, a=lambda t: A):
    """SOFT by hand."""
    return lambda t, x: [x[1] / m(t), -a(t) * np.sinh(x[0]) + force(t, x[0], x[1] / m(t))]


def curved(force=lambda t, q, v: 0.0, m=lambda t: MASS, a=lambda t: A):
    """CURVED by hand."""

    def rates(t, x):
        q, p, scale = *x, a(t) / m(t)
        velocity = scale * p * (q**2 + 1)
        return [velocity, -scale * q * (p**2 + 1) + force(t, q, velocity)]

    return rates


def flat_pair(force):
    """FLAT_PAIR by hand, `force` of (q, v)."""

    def rates(t, x):
        q, v = x[:2], x[2:] / MASS
        slope = 2 * A * q[0] * q[1] * q[::-1] + np.sinh(q.sum())
        return [*v, *(np.asarray(force(q, v)) - slope)]

    return rates


def curved_pair(force):
    """CURVED_PAIR by hand."""

    def rates(t, x):
        q, v = x[:2], np.array([x[2] * (1 + x[1] ** 2), x[3]]) / MASS
        slope = A * q + np.array([0.0, x[2] ** 2 * q[1] / MASS])
        return [*v, *(np.asarray(force(q, v)) - slope)]

    return rates
