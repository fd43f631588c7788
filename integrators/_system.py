"""What moves: a Hamiltonian system, and forces it leaves out."""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

# A time or a step, in the system's unit of time.
Time = Float[Array, ""] | float


def as_parameter(value: Any) -> Any:
    """A number as a strongly typed floating array; a module is passed through.

    Use it as the converter of a field: `mass: Float[Array, ""] = eqx.field(converter=as_parameter)`. A plain
    float in a field is part of the structure for JAX, so every new value would compile anew.
    """
    # A module is a parameter described on a floor above, such as a positive one; it becomes an array there.
    return value if isinstance(value, eqx.Module) else jnp.asarray(value, dtype=float)


def split(x: Float[Array, "two_d ..."]) -> tuple[Float[Array, "d ..."], Float[Array, "d ..."]]:
    """The coordinates q and momenta p of a phase point x = [q, p], or of many in columns."""
    d = x.shape[0] // 2
    return x[:d], x[d:]


class AbstractHamiltonian(eqx.Module):
    """A Hamiltonian system, dq/dt = dH/dp and dp/dt = -dH/dq. Dissertation (5.1)-(5.2).

    Subclass with `energy`. The derivatives come by automatic differentiation; override `velocity` and `slope`
    where analytic ones are cheaper. Parameters are array fields, see `as_parameter`.
    """

    # Whether `velocity`, `slope`, `vector_field` and `velocity_and_force` also take many points at once, side by side
    # in columns (d, point): faster than `vmap`, which puts the points first and leaves rows too short for a vector
    # register.
    side_by_side: ClassVar[bool] = False

    @abc.abstractmethod
    def energy(self, q: Float[Array, " d"], p: Float[Array, " d"]) -> Float[Array, ""]:
        """H(q, p)."""

    def velocity(self, q: Float[Array, " d"], p: Float[Array, " d"]) -> Float[Array, " d"]:
        """dH/dp, the velocity dq/dt."""
        return jax.grad(self.energy, argnums=1)(q, p)

    def slope(self, q: Float[Array, " d"], p: Float[Array, " d"]) -> Float[Array, " d"]:
        """dH/dq, minus the force of the Hamiltonian."""
        return jax.grad(self.energy, argnums=0)(q, p)

    def vector_field(self, x: Float[Array, "two_d ..."]) -> Float[Array, "two_d ..."]:
        """dx/dt at the phase point x."""
        q, p = split(x)
        return jnp.concatenate([self.velocity(q, p), -self.slope(q, p)])

    def velocity_and_force(
        self, q: Float[Array, "d ..."], p: Float[Array, "d ..."]
    ) -> tuple[Float[Array, "d ..."], Float[Array, "d ..."]]:
        """dq/dt and dp/dt at once, the two halves of `vector_field`."""
        return split(self.vector_field(jnp.concatenate([q, p])))

    def at(self, t: Time) -> "AbstractHamiltonian":
        """The system as it stands at time `t`. A time-dependent one returns a copy with its time replaced."""
        return self

    @property
    def stands_still(self) -> bool:
        """Whether the system is the same at all times."""
        return type(self).at is AbstractHamiltonian.at

    def prepared(self) -> "AbstractHamiltonian":
        """The same system with all worked out that its parameters alone determine; asked for once, before many steps.

        Override it where derivatives need more than the parameters as they are.
        """
        return self


class AbstractSeparableHamiltonian(AbstractHamiltonian):
    """H(q, p) = T(p) + U(q). Subclass with `kinetic` and `potential`. Dissertation (5.3)."""

    @abc.abstractmethod
    def kinetic(self, p: Float[Array, " d"]) -> Float[Array, ""]:
        """T(p)."""

    @abc.abstractmethod
    def potential(self, q: Float[Array, " d"]) -> Float[Array, ""]:
        """U(q)."""

    def energy(self, q: Float[Array, " d"], p: Float[Array, " d"]) -> Float[Array, ""]:
        return self.kinetic(p) + self.potential(q)

    def velocity(self, q: Float[Array, " d"], p: Float[Array, " d"]) -> Float[Array, " d"]:
        return jax.grad(self.kinetic)(p)

    def slope(self, q: Float[Array, " d"], p: Float[Array, " d"]) -> Float[Array, " d"]:
        return jax.grad(self.potential)(q)


class AbstractForce(eqx.Module):
    """A generalised force that the Hamiltonian leaves out; it adds to dp/dt."""

    # Whether it can hold a body at rest, as dry friction does.
    sticks: ClassVar[bool] = False

    @abc.abstractmethod
    def force(self, q: Float[Array, " d"], v: Float[Array, " d"], t: Time) -> Float[Array, " d"]:
        """F(q, v, t) with v = dH/dp, in the units of dp/dt."""

    def kick(
        self,
        hamiltonian: AbstractHamiltonian,
        q: Float[Array, " d"],
        p: Float[Array, " d"],
        t: Time,
        dt: Time,
    ) -> Float[Array, " d"]:
        """The momentum after dp/dt = F(q, v(q, p), t) has acted for `dt` at frozen q and t.

        By the explicit midpoint rule. Override it with the exact flow where there is one.
        """
        half = p + 0.5 * dt * self.force(q, hamiltonian.velocity(q, p), t)
        return p + dt * self.force(q, hamiltonian.velocity(q, half), t)

    def breakaway(self) -> Float[Array, "..."]:
        """The largest applied force that this one balances at rest, one per coordinate or one for all."""
        return jnp.zeros(())


class Forced(eqx.Module):
    """A Hamiltonian system with extra forces, dp/dt = -dH/dq + sum of F(q, v, t).

    Integrators step it by Strang splitting: half a kick, the Hamiltonian flow, half a kick. Any symplectic
    method serves unchanged at order 2, and without forces it is the symplectic method itself.

    **Arguments:**

    - `hamiltonian`: the conservative part.
    - `forces`: the forces, in any order.
    """

    hamiltonian: AbstractHamiltonian
    forces: tuple[AbstractForce, ...] = eqx.field(converter=tuple, default=())

    def energy(self, q: Float[Array, " d"], p: Float[Array, " d"]) -> Float[Array, ""]:
        """H(q, p) of the conservative part."""
        return self.hamiltonian.energy(q, p)

    def vector_field(self, x: Float[Array, " two_d"], t: Time) -> Float[Array, " two_d"]:
        """dx/dt at the phase point x and time t, forces included."""
        q, p = split(x)
        hamiltonian = self.hamiltonian.at(t)
        v = hamiltonian.velocity(q, p)
        applied = -hamiltonian.slope(q, p) + sum(force.force(q, v, t) for force in self.forces)
        return jnp.concatenate([v, applied])

    def at(self, t: Time) -> "Forced":
        """The system as it stands at time `t`."""
        return Forced(self.hamiltonian.at(t), self.forces)

    def prepared(self) -> "Forced":
        """The same system, its conservative part prepared for many steps."""
        return Forced(self.hamiltonian.prepared(), self.forces)

    def reversed(self) -> "Forced":
        """The same system with its forces in the opposite order, so that a step is symmetric in time."""
        return Forced(self.hamiltonian, self.forces[::-1])

    def kick(self, x: Float[Array, " two_d"], t: Time, dt: Time) -> Float[Array, " two_d"]:
        """The phase point after the forces, one by one, have acted for `dt` at frozen q and t."""
        q, p = split(x)
        hamiltonian = self.hamiltonian.at(t)
        for force in self.forces:
            p = force.kick(hamiltonian, q, p, t, dt)
        return jnp.concatenate([q, p])

    def holds(self, x: Float[Array, " two_d"], t: Time) -> Bool[Array, " d"]:
        """Which coordinates stand still because friction balances every other force on them."""
        q, p = split(x)
        _, applied = split(self.vector_field(x, t))
        limit = sum((force.breakaway() for force in self.forces), jnp.zeros_like(q))
        return (p == 0) & (jnp.abs(applied) < limit)


System = AbstractHamiltonian | Forced


def conservative(system: System) -> AbstractHamiltonian | None:
    """The Hamiltonian of a system without forces; None where there are some."""
    if not isinstance(system, Forced):
        return system
    return None if system.forces else system.hamiltonian
