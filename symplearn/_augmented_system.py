"""The augmented simulation as a Hamiltonian system: its energy with every effect, and forces that a velocity enters."""

import math
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

import integrators as ig

from ._augmented import Equations
from ._effects import (
    COULOMB,
    DRIFTING,
    ERROR,
    EXCITATION,
    FORCING,
    GYROSCOPIC,
    HIDDEN,
    MEMORIES,
    MODULATION,
    ON_PARAMETERS,
    QUADRATIC,
    REGIME,
    RELATIVE,
    SIDES,
    STOP,
    VISCOUS,
    Effect,
)

# Logarithm of the ratio of two speeds between which a stop is stepped alike.
_OCTAVE = math.log(2.0)
# The values of an effect by target, by its name and side; a tuple over its values.
Values = Mapping[tuple[str, str | None], tuple[Float[Array, " target"], ...]]


def taken_apart(equations: Equations, coefficients: Float[Array, " coefficient"]) -> Values:
    """The coefficient vector by effect; once before a trajectory, since picking entries costs as much as a force."""
    found = {}
    for one in {(c.effect, c.side): c for c in equations.candidates}.values():
        firsts = equations.firsts(one.effect, one.side)
        found[one.effect.kept_as, one.side] = tuple(coefficients[firsts + k] for k in range(one.effect.entries))
    for effect in ON_PARAMETERS:  # of which a simulation may have none
        found.setdefault((effect.name, None), (coefficients[:0],) * effect.entries)
    return found


class Switches(eqx.Module):
    """What may be left out of the work because no trajectory that is stepped together with this one has it."""

    friction: Bool[Array, ""] | bool = True
    impulses: Bool[Array, ""] | bool = True
    delays: Bool[Array, ""] | bool = True
    forcing: Bool[Array, ""] | bool = True
    changes: Bool[Array, ""] | bool = True  # of parameters, periodic or sudden
    stops: Bool[Array, ""] | bool = True


EVERYTHING = Switches()


class Moment(eqx.Module):
    """What depends on time alone: parameters as they stand, and periodic forces; and the time that it stands for."""

    time: Float[Array, "..."]
    width: Float[Array, "..."]
    parameters: Float[Array, "... parameter"]
    push: Float[Array, "... declared"]


class SimulatedHamiltonian(ig.AbstractHamiltonian):
    """The Hamiltonian of a simulation file with its effects, for any H(q, p), frozen at one moment.

    Frozen in the middle of a step it is right to order two in time, and the step stays symmetric.
    """

    equations: Equations = eqx.field(static=True)
    coefficients: Float[Array, " coefficient"]
    values: Values
    inputs: Float[Array, " input"]
    moment: Moment
    switches: Switches = EVERYTHING

    def of(self, effect: Effect, value: int = 0, side: str | None = None) -> Float[Array, " target"]:
        """One value of an effect, by target."""
        return self.values[effect.kept_as, side][value]

    @eqx.filter_jit
    def arguments(self, q: Float[Array, " width"], p: Float[Array, " width"]) -> Float[Array, " argument"]:
        """The vector that the compiled equations take."""
        d, now = self.equations.dim, self.moment
        return jnp.concatenate([q[:d], p[:d], now.parameters, self.inputs, now.time[None], self.coefficients])

    def energy(self, q: Float[Array, " width"], p: Float[Array, " width"]) -> Float[Array, ""]:
        return self.equations.energy(self.arguments(q, p))[0]

    @eqx.filter_jit
    def velocity(self, q: Float[Array, " width"], p: Float[Array, " width"]) -> Float[Array, " width"]:
        return jnp.concatenate([self.equations.velocity(self.arguments(q, p)), p[self.equations.dim :]])

    @eqx.filter_jit
    def slope(self, q: Float[Array, " width"], p: Float[Array, " width"]) -> Float[Array, " width"]:
        """Minus every force that no velocity enters."""
        d, n = self.equations.dim, self.equations.declared
        push = self.moment.push
        push = jax.lax.cond(self.switches.stops, lambda push: push + self._stopped(q, p), lambda push: push, push)
        slope = self.equations.slope(self.arguments(q, p))
        if not self.equations.hidden:
            return slope - jnp.pad(push, (0, d - n))
        present, omega = self.of(HIDDEN, 2), self.of(HIDDEN, 1)
        unseen = (present * omega**2).sum() * q[d] - (self.of(HIDDEN) * q[:n]).sum()
        return jnp.concatenate([slope - jnp.pad(push + present * q[d], (0, d - n)), unseen[None]])

    def _stopped(self, q: Float[Array, " width"], p: Float[Array, " width"]) -> Float[Array, " declared"]:
        """Forces of the stops, each by its mean over the time that the moment stands for.

        Those of one instant would make the slopes of a trajectory jump where a substep comes to lie inside or outside,
        each time by the impulse of a whole substep: how hard a stop is would look far better known than it is.
        """
        n = self.equations.declared
        half = 0.5 * self.moment.width * _octave(self.velocity(q, p)[:n])
        (k, a), (low_k, low_a) = ([self.of(STOP, value, side) for value in range(2)] for side in SIDES)
        return low_k * _mean_excess(low_a - q[:n], half) - k * _mean_excess(q[:n] - a, half)

    @eqx.filter_jit
    def smooth_force(self, q: Float[Array, " width"], p: Float[Array, " width"]) -> Float[Array, " width"]:
        """Forces that a velocity enters, or that fade; dry friction left out."""
        eq, n = self.equations, self.equations.declared
        arguments = self.arguments(q, p)
        v = eq.velocity(arguments)[:n]
        drag = self.of(VISCOUS) + self.of(QUADRATIC) * jnp.abs(v) - self.of(EXCITATION)
        force = -(drag + self.of(EXCITATION, 1) * q[:n] ** 2) * v
        force = jnp.pad(force + self._between(v), (0, eq.dim - n))
        force = force if eq.kick is None else force + eq.kick(arguments)
        return self._fading(force, v, p[eq.dim]) if eq.fades else jnp.pad(force, (0, eq.width - eq.dim))

    def _fading(
        self, force: Float[Array, " d"], v: Float[Array, " declared"], w: Float[Array, ""]
    ) -> Float[Array, " width"]:
        """Forces with one that fades, w, and what w changes by."""
        present, gained, lost = jnp.zeros_like(v), jnp.zeros_like(w), jnp.zeros_like(w)
        for effect in MEMORIES:
            kappa, fading, here = (self.of(effect, k) for k in range(3))
            present = present + here
            gained = gained + (kappa * v).sum()
            lost = lost + (here * fading * effect.lost(v, jnp.abs(v), w, jnp.abs(w))).sum()
        pushed = force - w * jnp.pad(present, (0, len(force) - len(v)))
        return jnp.concatenate([pushed, (gained - lost)[None]])

    def _between(self, v: Float[Array, " declared"]) -> Float[Array, " declared"]:
        """Forces between pairs of coordinates that a velocity enters."""
        total = [jnp.zeros((), v.dtype)] * len(v)
        for k, (i, j) in enumerate(zip(*self.equations.pairs(), strict=True)):
            relative, turning = self.of(RELATIVE)[k] * (v[i] - v[j]), self.of(GYROSCOPIC)[k]
            total[i] = total[i] + turning * v[j] - relative
            total[j] = total[j] + relative - turning * v[i]
        return jnp.stack(total)

    def rates(self, x: Float[Array, " state"]) -> Float[Array, " state"]:
        """The right-hand side with every force but impulses."""
        q, p = ig.split(x)
        eq = self.equations
        dry = self.of(COULOMB) * jnp.sign(self.velocity(q, p)[: eq.declared])
        force = self.smooth_force(q, p) - jnp.pad(dry, (0, eq.width - eq.declared))
        before = jnp.zeros(eq.momentum.start, x.dtype)
        return self.vector_field(x) + jnp.concatenate([before, force])


def _octave(v: Float[Array, " d"]) -> Float[Array, " d"]:
    """Speeds rounded up to a power of two. A force that goes with the speed itself has no potential, and pumps a motion
    that bounces; between two such steps this one has, and its flow is symplectic there."""
    return jnp.exp(_OCTAVE * (jnp.floor(jnp.log(jax.lax.stop_gradient(jnp.abs(v))) / _OCTAVE) + 1.0))


def _mean_excess(x: Float[Array, " d"], half: Float[Array, " d"]) -> Float[Array, " d"]:
    """Mean of what is above zero of what goes evenly from x - half to x + half."""
    crosses = jnp.abs(x) < half
    return jnp.where(crosses, (x + half) ** 2 / (4 * jnp.where(crosses, half, 1.0)), jnp.maximum(x, 0.0))


class Simulated(eqx.Module):
    """An augmented simulation with its numbers: what gives its Hamiltonian at any time."""

    equations: Equations = eqx.field(static=True)
    parameters: Float[Array, " parameter"]
    coefficients: Float[Array, " coefficient"]
    values: Values
    switches: Switches

    def __init__(self, equations: Equations, parameters: Any, coefficients: Any, switches: Switches = EVERYTHING):
        self.equations, self.switches = equations, switches
        self.parameters, self.coefficients = jnp.asarray(parameters), jnp.asarray(coefficients)
        self.values = taken_apart(equations, self.coefficients)

    def at(
        self, t: Float[Array, ""] | float, inputs: Float[Array, " known"], width: Float[Array, ""] | float = 0.0
    ) -> SimulatedHamiltonian:
        """The system with all that depends on time as it stands at one time; `width` as in `moment`. What is known of
        the time before the inputs is of no account."""
        inputs = inputs[: len(self.equations.inputs)]
        moment = self.moment(jnp.asarray(t, self.coefficients.dtype), width)
        return SimulatedHamiltonian(self.equations, self.coefficients, self.values, inputs, moment, self.switches)

    def moment(self, t: Float[Array, ""], width: Float[Array, ""] | float) -> Moment:
        """What depends on time alone.

        `width` is the time over which a sudden change of a parameter is spread, so that its time has a derivative. At
        an instant, of which a reading is, it has come or not: spread over however little, a fit would find the time at
        which a single reading has just the share of the change that it asks for.
        """
        of = lambda effect, k=0: self.values[effect.name, None][k]  # noqa: E731

        def changed(factor: Array) -> Array:
            lasts, since = jnp.asarray(width) > 0, t - of(REGIME, 1)
            after = jnp.where(lasts, jnp.clip(since / jnp.where(lasts, width, 1.0) + 0.5, 0.0, 1.0), since >= 0)
            return factor * (1 + self._oscillation(MODULATION, t)) * (1 + of(REGIME) * after)

        factor = (1 + of(ERROR)) * (1 + of(DRIFTING) * (t - self.equations.start - of(DRIFTING, 1)))
        factor = jax.lax.cond(self.switches.changes, changed, lambda factor: factor, factor)
        n = factor.shape[0]
        parameters = jnp.concatenate([self.parameters[:n] * factor, self.parameters[n:]])
        none = jnp.zeros_like(of(FORCING))
        push = jax.lax.cond(self.switches.forcing, lambda _: self._oscillation(FORCING, t), lambda _: none, t)
        return Moment(t, jnp.asarray(width, t.dtype), parameters, push)

    def _oscillation(self, effect: Effect, t: Array) -> Float[Array, " target"]:
        cosine, sine, omega, later = self.values[effect.name, None]
        angle = omega * (t - self.equations.origin - later)
        return cosine * jnp.cos(angle) + sine * jnp.sin(angle)
