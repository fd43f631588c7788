"""The simulation with every word of the vocabulary built in, each behind a coefficient that may be zero."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import equinox as eqx
import jax
import jax.numpy as jnp
import sympy
from jaxtyping import Array, Bool, Float

import integrators as ig

from ._effects import COULOMB, QUADRATIC, VISCOUS, Candidate, PowerForce, vocabulary
from ._separable import is_separable
from ._symbolic import derivative, jax_function


@dataclass(frozen=True, eq=False)
class Equations:
    """The compiled right-hand sides of an augmented simulation, all functions of one argument vector.

    The vector is `[q, p, parameters, inputs, t, coefficients]`; `candidates` name the coefficients in order.
    """

    coordinates: tuple[str, ...]
    momenta: tuple[str, ...]
    parameters: tuple[str, ...]
    inputs: tuple[str, ...]
    columns: tuple[str, ...]
    candidates: tuple[Candidate, ...]
    separable: bool
    energy: Callable[[Array], Array]
    slope: Callable[[Array], Array]  # dH/dq minus the known forces that no velocity enters
    velocity: Callable[[Array], Array]
    softness: Callable[[Array], Array]  # d2H/dp_i2, by which a momentum turns into a velocity
    kick: Callable[[Array], Array] | None  # known forces that a velocity or momentum enters
    readings: Callable[[Array], Array]
    drags: tuple[tuple[int, ...], ...]  # places of viscous, quadratic, Coulomb coefficients, by coordinate

    @property
    def dim(self) -> int:
        """Degrees of freedom."""
        return len(self.coordinates)


def equations(
    coordinates: Sequence[sympy.Symbol],
    momenta: Sequence[sympy.Symbol],
    hamiltonian: sympy.Expr,
    parameters: Sequence[sympy.Symbol],
    inputs: Sequence[sympy.Symbol],
    forces: Sequence[sympy.Expr],
    readings: dict[str, sympy.Expr],
    drifts: Mapping[str, sympy.Expr] = MappingProxyType({}),
) -> Equations:
    """Build the augmented simulation from parsed expressions.

    `forces` has one entry per momentum. `drifts` are known errors of the columns that no gain multiplies.
    """
    names = [str(q) for q in coordinates]
    candidates = vocabulary(names, list(readings))
    c = [sympy.Symbol(f"c{index}*", real=True) for index in range(len(candidates))]
    energy = hamiltonian + sum(
        ck * one.effect.potential(coordinates[one.place])
        for ck, one in zip(c, candidates, strict=True)
        if isinstance(one.effect, PowerForce)
    )
    drags = tuple(tuple(i for i, one in enumerate(candidates) if one.effect is kind)
                  for kind in (VISCOUS, QUADRATIC, COULOMB))  # fmt: skip
    shaped = [_read(h, j, candidates, c) + drifts.get(column, 0) for j, (column, h) in enumerate(readings.items())]
    moving = [bool(f.free_symbols & set(momenta)) for f in forces]
    still = [sympy.Integer(0) if m else f for f, m in zip(forces, moving, strict=True)]
    driven = [f if m else sympy.Integer(0) for f, m in zip(forces, moving, strict=True)]
    arguments = [*coordinates, *momenta, *parameters, *inputs, sympy.Symbol("t", real=True), *c]

    def compiled(expressions: Sequence[sympy.Expr]) -> Callable[[Array], Array]:
        return jax_function(expressions, arguments)

    return Equations(
        coordinates=tuple(names),
        momenta=tuple(str(p) for p in momenta),
        parameters=tuple(str(p) for p in parameters),
        inputs=tuple(str(u) for u in inputs),
        columns=tuple(readings),
        candidates=candidates,
        separable=is_separable(hamiltonian, coordinates, momenta),
        energy=compiled([energy]),
        slope=compiled([derivative(energy, q) - f for q, f in zip(coordinates, still, strict=True)]),
        velocity=compiled([derivative(hamiltonian, p) for p in momenta]),
        softness=compiled([derivative(derivative(hamiltonian, p), p) for p in momenta]),
        kick=compiled(driven) if any(moving) else None,
        readings=compiled(shaped),
        drags=drags,
    )


def _read(h: sympy.Expr, column: int, candidates: Sequence[Candidate], c: Sequence[sympy.Symbol]) -> sympy.Expr:
    """The reading (1 + g) h + b of one column."""
    mine = {one.effect.name: ck for ck, one in zip(c, candidates, strict=True)
            if one.effect.family == "sensor" and one.place == column}  # fmt: skip
    return (1 + mine["sensor_gain"]) * h + mine["sensor_bias"]


class SimulatedHamiltonian(ig.AbstractHamiltonian):
    """The Hamiltonian of a simulation file with its conservative effects, for any H(q, p)."""

    equations: Equations = eqx.field(static=True)
    parameters: Float[Array, " parameter"]
    inputs: Float[Array, " input"]
    time: Float[Array, ""]
    coefficients: Float[Array, " candidate"]

    def arguments(self, q: Float[Array, " d"], p: Float[Array, " d"]) -> Float[Array, " argument"]:
        """The vector that the compiled equations take."""
        return jnp.concatenate([q, p, self.parameters, self.inputs, self.time[None], self.coefficients])

    def energy(self, q: Float[Array, " d"], p: Float[Array, " d"]) -> Float[Array, ""]:
        return self.equations.energy(self.arguments(q, p))[0]

    def velocity(self, q: Float[Array, " d"], p: Float[Array, " d"]) -> Float[Array, " d"]:
        return self.equations.velocity(self.arguments(q, p))

    def slope(self, q: Float[Array, " d"], p: Float[Array, " d"]) -> Float[Array, " d"]:
        return self.equations.slope(self.arguments(q, p))

    def at(self, t: Float[Array, ""] | float) -> "SimulatedHamiltonian":
        return SimulatedHamiltonian(self.equations, self.parameters, self.inputs, jnp.asarray(t), self.coefficients)

    def kick(
        self, q: Float[Array, " d"], p: Float[Array, " d"], dt: Float[Array, ""], ahead: float = 1.0
    ) -> tuple[Float[Array, " d"], Bool[Array, " d"]]:
        """The momentum after the forces that depend on velocity have acted for `dt` at frozen q, and what stuck.

        Smooth drag by the explicit midpoint rule. Dry friction by the mean sign of the velocity over the time that
        the kick stands for, which lies `ahead` (1) or behind (-1): a sign taken at one instant would make the
        trajectory jump with the starting values. Where friction can hold every other force, it stops the motion.
        Exact for a kinetic energy quadratic in each momentum.
        """
        half = p + 0.5 * dt * self._smooth(q, p)
        p = p + dt * self._smooth(q, half)
        friction = self.coefficients[jnp.asarray(self.equations.drags[2])]
        v, acceleration = jax.jvp(self.velocity, (q, p), (self.velocity(q, p), -self.slope(q, p)))
        softness = self.equations.softness(self.arguments(q, p))
        stop = v / softness
        held = (friction > 0) & (jnp.abs(stop) <= friction * dt) & (jnp.abs(acceleration) <= friction * softness)
        return p - jnp.where(held, stop, friction * dt * _mean_sign(v, v + ahead * dt * acceleration)), held

    def _smooth(self, q: Float[Array, " d"], p: Float[Array, " d"]) -> Float[Array, " d"]:
        arguments = self.arguments(q, p)
        v = self.equations.velocity(arguments)
        viscous, quadratic = (self.coefficients[jnp.asarray(place)] for place in self.equations.drags[:2])
        force = -(viscous + quadratic * jnp.abs(v)) * v
        return force if self.equations.kick is None else force + self.equations.kick(arguments)


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

    Strang splitting with kicks of positive length outside (order 2 in the small dissipative forces), the
    integrator's own order in everything conservative. The doubled state of Tao's method is projected by the mean of
    its copies at every substep.
    """

    equations: Equations = eqx.field(static=True)
    integrator: ig.AbstractIntegrator
    parameters: Float[Array, " parameter"]
    coefficients: Float[Array, " candidate"]

    def __call__(self, x: Float[Array, " state"], span: Span) -> Float[Array, " state"]:
        def substep(carry: tuple[Array, Array], inputs: Array) -> tuple[tuple[Array, Array], None]:
            x, t = carry
            return (self._substep(x, t, span.step, inputs), t + span.step), None

        return jax.lax.scan(substep, (x, span.start), span.inputs)[0][0]

    def hamiltonian(self, t: Float[Array, ""], inputs: Float[Array, " input"]) -> SimulatedHamiltonian:
        """The conservative part as it stands at time `t`."""
        return SimulatedHamiltonian(self.equations, self.parameters, inputs, t, self.coefficients)

    def _substep(self, x: Array, t: Array, dt: Array, inputs: Array) -> Array:
        system = self.hamiltonian(t + 0.5 * dt, inputs)
        q, p = ig.split(x)
        p, held = system.at(t + 0.25 * dt).kick(q, p, 0.5 * dt)
        state = self.integrator.lift(jnp.concatenate([q, p]))
        moved, p = ig.split(self.integrator.project(self.integrator.flow(system, state, t, dt)))
        p, stuck = system.at(t + 0.75 * dt).kick(moved, p, 0.5 * dt, ahead=-1.0)
        # Held at both ends: without this a body at rest would creep through the flow in between.
        return jnp.concatenate([jnp.where(held & stuck, q, moved), p])


class SimulatedReading(eqx.Module):
    """What the sensors show at a phase point; the context is `(t, inputs)` of the row."""

    equations: Equations = eqx.field(static=True)
    parameters: Float[Array, " parameter"]
    coefficients: Float[Array, " candidate"]

    def __call__(
        self, x: Float[Array, " state"], context: tuple[Float[Array, ""], Float[Array, " input"]]
    ) -> Float[Array, " channel"]:
        t, inputs = context
        return self.equations.readings(jnp.concatenate([x, self.parameters, inputs, t[None], self.coefficients]))
