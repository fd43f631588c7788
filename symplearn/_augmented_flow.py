"""The augmented simulation in motion: its Hamiltonian with every effect, its flow, and what its sensors show."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import integrators as ig

from ._augmented import Equations
from ._effects import (
    BIAS,
    COULOMB,
    DELAY,
    DRIFT,
    DRIFTING,
    ERROR,
    EXCITATION,
    FORCING,
    GAIN,
    GYROSCOPIC,
    HIDDEN,
    IMPULSE,
    MODULATION,
    QUADRATIC,
    REGIME,
    RELATIVE,
    STOP,
    VISCOUS,
    Effect,
)

# Suzuki's weights: five stages of a symmetric method of order 2 make one of order 4. Suzuki (1990), Phys. Lett. A 146.
_OUTER = 1.0 / (4.0 - 4.0 ** (1.0 / 3.0))
_WEIGHTS = np.array([_OUTER, _OUTER, 1.0 - 4.0 * _OUTER, _OUTER, _OUTER])
# Carpenter and Kennedy's method of order 4 (1994, NASA TM 109112), by which a delayed reading goes back in time: a
# stage needs the rates at one place only, so that they are compiled once. Columns: A, B, C.
_STAGES = np.array([
    [0.0, 1432997174477 / 9575080441755, 0.0],
    [-567301805773 / 1357537059087, 5161836677717 / 13612068292357, 1432997174477 / 9575080441755],
    [-2404267990393 / 2016746695238, 1720146321549 / 2090206949498, 2526269341429 / 6820363962896],
    [-3550918686646 / 2091501179385, 3134564353537 / 4481467310338, 2006345519317 / 3224310063776],
    [-1275806237668 / 842570457699, 2277821191437 / 14882151754819, 2802321613138 / 2924317926251],
])  # fmt: skip
# Steps of it that a delay is made of.
_BACK = 2


class SimulatedHamiltonian(ig.AbstractHamiltonian):
    """The Hamiltonian of a simulation file with its effects, for any H(q, p).

    `width` is the substep, over which a sudden change of a parameter is spread, so that its time has a derivative.
    """

    equations: Equations = eqx.field(static=True)
    parameters: Float[Array, " parameter"]
    inputs: Float[Array, " input"]
    time: Float[Array, ""]
    coefficients: Float[Array, " coefficient"]
    width: Float[Array, ""]

    def of(self, effect: Effect, value: int = 0, side: str | None = None) -> Float[Array, " target"]:
        """One value of an effect, by target."""
        return self.coefficients[self.equations.firsts(effect, side) + value]

    @eqx.filter_jit
    def arguments(self, q: Float[Array, " width"], p: Float[Array, " width"]) -> Float[Array, " argument"]:
        """The vector that the compiled equations take."""
        d = self.equations.dim
        return jnp.concatenate([q[:d], p[:d], self.varied(), self.inputs, self.time[None], self.coefficients])

    def varied(self) -> Float[Array, " parameter"]:
        """The parameters as they stand at this time."""
        width = jnp.where(self.width > 0, self.width, 1.0)  # rows that only fill up have none
        after = jnp.clip((self.time - self.of(REGIME, 1)) / width + 0.5, 0.0, 1.0)
        factor = (1 + self.of(ERROR)) * (1 + self.of(DRIFTING) * (self.time - self.equations.start))
        factor = factor * (1 + self._oscillation(MODULATION)) * (1 + self.of(REGIME) * after)
        n = factor.shape[0]
        return jnp.concatenate([self.parameters[:n] * factor, self.parameters[n:]])

    def _oscillation(self, effect: Effect) -> Float[Array, " target"]:
        angle = self.of(effect, 2) * (self.time - self.equations.origin)
        return self.of(effect) * jnp.cos(angle) + self.of(effect, 1) * jnp.sin(angle)

    def energy(self, q: Float[Array, " width"], p: Float[Array, " width"]) -> Float[Array, ""]:
        return self.equations.energy(self.arguments(q, p))[0]

    @eqx.filter_jit
    def velocity(self, q: Float[Array, " width"], p: Float[Array, " width"]) -> Float[Array, " width"]:
        return jnp.concatenate([self.equations.velocity(self.arguments(q, p)), p[self.equations.dim :]])

    @eqx.filter_jit
    def slope(self, q: Float[Array, " width"], p: Float[Array, " width"]) -> Float[Array, " width"]:
        """Minus every force that no velocity enters."""
        d, n = self.equations.dim, self.equations.declared
        push = self._oscillation(FORCING)
        push = push - self.of(STOP, 0, "upper") * jnp.maximum(q[:n] - self.of(STOP, 1, "upper"), 0.0)
        push = push + self.of(STOP, 0, "lower") * jnp.maximum(self.of(STOP, 1, "lower") - q[:n], 0.0)
        slope = self.equations.slope(self.arguments(q, p))
        if not self.equations.hidden:
            return slope.at[:n].add(-push)
        present, omega = self.of(HIDDEN, 2), self.of(HIDDEN, 1)
        unseen = (present * omega**2).sum() * q[d] - (self.of(HIDDEN) * q[:n]).sum()
        return jnp.concatenate([slope.at[:n].add(-push - present * q[d]), unseen[None]])

    def at(self, t: Float[Array, ""] | float) -> "SimulatedHamiltonian":
        return SimulatedHamiltonian(
            self.equations, self.parameters, self.inputs, jnp.asarray(t), self.coefficients, self.width
        )

    @eqx.filter_jit
    def kick(
        self, q: Float[Array, " width"], p: Float[Array, " width"], dt: Float[Array, ""], ahead: float = 1.0
    ) -> tuple[Float[Array, " width"], Bool[Array, " width"]]:
        """The momentum after the forces that depend on velocity have acted for `dt` at frozen q, and what stuck.

        Smooth drag by the explicit midpoint rule. Dry friction by the mean sign of the velocity over the time that
        the kick stands for, which lies `ahead` (1) or behind (-1): a sign taken at one instant would make the
        trajectory jump with the starting values. Where friction can hold every other force, it stops the motion.
        Exact for a kinetic energy quadratic in each momentum.
        """
        d, n = self.equations.dim, self.equations.declared
        half = p.at[:d].add(0.5 * dt * self.smooth_force(q, p))
        p = p.at[:d].add(dt * self.smooth_force(q, half))
        friction = self.of(COULOMB)
        v, acceleration = jax.jvp(self.velocity, (q, p), (self.velocity(q, p), -self.slope(q, p)))
        v, acceleration = v[:n], acceleration[:n]
        softness = self.equations.softness(self.arguments(q, p))[:n]
        stop = v / softness
        held = (friction > 0) & (jnp.abs(stop) <= friction * dt) & (jnp.abs(acceleration) <= friction * softness)
        change = jnp.where(held, stop, friction * dt * _mean_sign(v, v + ahead * dt * acceleration))
        return p.at[:n].add(-change), jnp.pad(held, (0, self.equations.width - n))

    @eqx.filter_jit
    def smooth_force(self, q: Float[Array, " width"], p: Float[Array, " width"]) -> Float[Array, " d"]:
        """Forces that a velocity enters, dry friction left out."""
        eq, n = self.equations, self.equations.declared
        arguments = self.arguments(q, p)
        v = eq.velocity(arguments)[:n]
        drag = self.of(VISCOUS) + self.of(QUADRATIC) * jnp.abs(v) - self.of(EXCITATION)
        force = -(drag + self.of(EXCITATION, 1) * q[:n] ** 2) * v
        i, j = eq.pairs()
        if len(i):
            relative, turning = self.of(RELATIVE) * (v[i] - v[j]), self.of(GYROSCOPIC)
            force = force.at[i].add(turning * v[j] - relative).at[j].add(relative - turning * v[i])
        force = jnp.pad(force, (0, eq.dim - n))
        return force if eq.kick is None else force + eq.kick(arguments)

    def rates(self, x: Float[Array, " state"]) -> Float[Array, " state"]:
        """The right-hand side with every force but impulses."""
        q, p = ig.split(x)
        eq = self.equations
        dry = self.of(COULOMB) * jnp.sign(self.velocity(q, p)[: eq.declared])
        force = self.smooth_force(q, p).at[: eq.declared].add(-dry)
        return self.vector_field(x).at[eq.momentum].add(force)


def _mean_sign(begin: Float[Array, " d"], end: Float[Array, " d"]) -> Float[Array, " d"]:
    """Mean of the sign of what goes evenly from `begin` to `end`: (|end| - |begin|) / (end - begin)."""
    crosses = begin * end < 0
    change = jnp.where(crosses, end - begin, 1.0)
    return jnp.where(crosses, (jnp.abs(end) - jnp.abs(begin)) / change, jnp.sign(begin + end))


class Span(eqx.Module):
    """One interval between rows: where it starts, its substep, and the inputs' mean over each substep."""

    start: Float[Array, "..."]
    step: Float[Array, "..."]
    inputs: Float[Array, "... substep input"]


class SimulatedFlow(eqx.Module):
    """The flow of the augmented simulation over one `Span`: Hamiltonian part symplectic, dissipation by splitting.

    Strang splitting with kicks of positive length outside (order 2 in the small dissipative forces), Suzuki's
    composition of the integrator, of order 4, in everything conservative. The doubled state of Tao's method is
    projected by the mean of its copies at every substep. An impulse is shared by both ends of its substep so that
    its mean time is right.
    """

    equations: Equations = eqx.field(static=True)
    integrator: ig.AbstractIntegrator  # symmetric, of order 2
    parameters: Float[Array, " parameter"]
    coefficients: Float[Array, " coefficient"]

    def __call__(self, x: Float[Array, " state"], span: Span) -> Float[Array, " state"]:
        def substep(carry: tuple[Array, Array], inputs: Array) -> tuple[tuple[Array, Array], None]:
            x, t = carry
            return (self._substep(x, t, span.step, inputs), t + span.step), None

        return jax.lax.scan(substep, (x, span.start), span.inputs)[0][0]

    def _substep(self, x: Array, t: Array, dt: Array, inputs: Array) -> Array:
        system = SimulatedHamiltonian(self.equations, self.parameters, inputs, t + 0.5 * dt, self.coefficients, dt)
        q, p = ig.split(x)
        early, late = self._jumps(system, t, dt)
        p, held = system.at(t + 0.25 * dt).kick(q, p + early, 0.5 * dt)
        moved, p = ig.split(self._conservative(system, jnp.concatenate([q, p]), t, dt))
        p, stuck = system.at(t + 0.75 * dt).kick(moved, p, 0.5 * dt, ahead=-1.0)
        # Held at both ends: without this a body at rest would creep through the flow in between.
        return jnp.concatenate([jnp.where(held & stuck, q, moved), p + late])

    def _conservative(self, system: SimulatedHamiltonian, x: Array, t: Array, dt: Array) -> Array:
        """The Hamiltonian part, of order 4; the stages are a loop, since unrolled they take minutes to compile."""

        def stage(carry: tuple[Array, Array], weight: Array) -> tuple[tuple[Array, Array], None]:
            state, t = carry
            return (self.integrator.flow(system, state, t, weight * dt), t + weight * dt), None

        start = (self.integrator.lift(x), t)
        return self.integrator.project(jax.lax.scan(stage, start, jnp.asarray(_WEIGHTS))[0][0])

    def _jumps(self, system: SimulatedHamiltonian, t: Array, dt: Array) -> tuple[Array, Array]:
        """What impulses inside a substep add to the momenta at its start and at its end."""
        eq = self.equations
        known = eq.impulses(system.arguments(jnp.zeros(eq.width), jnp.zeros(eq.width))).reshape(-1, 2)
        size = jnp.concatenate([system.of(IMPULSE), known[:, 0]])
        when = jnp.concatenate([system.of(IMPULSE, 1), known[:, 1]])
        place = jnp.asarray([*range(eq.declared), *eq.jumping])
        share = (when - t) / jnp.where(dt > 0, dt, 1.0)
        size = jnp.where((share >= 0) & (share < 1) & (dt > 0), size, 0.0)
        empty = jnp.zeros(eq.width)
        return empty.at[place].add(size * (1 - share)), empty.at[place].add(size * share)


class SimulatedReading(eqx.Module):
    """What the sensors show at a phase point, (1 + g) h(x(t - tau)) + b + r (t - t_0); the context is `(t, inputs)`."""

    equations: Equations = eqx.field(static=True)
    parameters: Float[Array, " parameter"]
    coefficients: Float[Array, " coefficient"]

    def __call__(
        self, x: Float[Array, " state"], context: tuple[Float[Array, ""], Float[Array, " input"]]
    ) -> Float[Array, " channel"]:
        t, inputs = context
        eq = self.equations
        sudden = jnp.full((), 1e-9, x.dtype)  # a reading is taken at an instant
        system = SimulatedHamiltonian(eq, self.parameters, inputs, t, self.coefficients, sudden)
        off = system.of(BIAS) + system.of(DRIFT) * (t - eq.start)
        return (1 + system.of(GAIN)) * self._seen(system, x) + off

    def _seen(self, system: SimulatedHamiltonian, x: Array) -> Float[Array, " channel"]:
        """h, of the phase point as it was a delay ago."""
        eq = self.equations
        if not eq.delayed:
            return eq.readings(system.arguments(*ig.split(x)))
        earlier = jax.vmap(lambda delay: _back(system, x, delay))(system.of(DELAY))
        shown = jax.vmap(lambda x: eq.readings(system.arguments(*ig.split(x))))(earlier)
        return jnp.diagonal(shown)


def _back(system: SimulatedHamiltonian, x: Float[Array, " state"], delay: Float[Array, ""]) -> Float[Array, " state"]:
    """The phase point a little earlier."""
    dt = -delay / _BACK

    def stage(carry: tuple[Array, Array], row: Array) -> tuple[tuple[Array, Array], None]:
        x, change = carry
        a, b, when = row
        change = a * change + dt * system.at(system.time + when * dt).rates(x)
        return (x + b * change, change), None

    steps = np.concatenate([_STAGES + [0.0, 0.0, float(k)] for k in range(_BACK)])
    return jax.lax.scan(stage, (x, jnp.zeros_like(x)), jnp.asarray(steps))[0][0]


class Midway(ig.AbstractIntegrator):
    """Leapfrog that drifts, kicks and drifts: order 2 with one evaluation of dU/dq a step.

    Of a separable system, as `ig.Leapfrog`, which kicks first and needs two where steps are not joined.
    """

    @property
    def order(self) -> int:
        return 2

    @property
    def is_symplectic(self) -> bool:
        return True

    @property
    def is_symmetric(self) -> bool:
        return True

    @property
    def needs_separable(self) -> bool:
        return True

    def flow(
        self, hamiltonian: ig.AbstractHamiltonian, state: Float[Array, " n"], t: Array | float, dt: Array | float
    ) -> Float[Array, " n"]:
        q, p = ig.split(state)
        q = q + 0.5 * dt * hamiltonian.at(t + 0.25 * dt).velocity(q, p)
        p = p - dt * hamiltonian.at(t + 0.5 * dt).slope(q, p)
        q = q + 0.5 * dt * hamiltonian.at(t + 0.75 * dt).velocity(q, p)
        return jnp.concatenate([q, p])
