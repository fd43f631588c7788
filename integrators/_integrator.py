"""What a step is: lift the phase point, step the state, project it back."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from integrators._system import (
    AbstractHamiltonian,
    AbstractSeparableHamiltonian,
    Forced,
    System,
    Time,
    conservative,
    split,
)


class AbstractIntegrator(eqx.Module):
    """A one-step method for Hamiltonian systems.

    A state is one phase point, or several copies of it end to end. Lift once per trajectory, step the state,
    and project the states to be read: a method may be symplectic on the lifted space alone.

    `t` and `dt` are in the system's unit of time; `dt` may be negative.
    """

    @property
    @abc.abstractmethod
    def order(self) -> int:
        """Order of the global error on a Hamiltonian system; 2 at most with the forces of a `Forced` one."""

    @property
    @abc.abstractmethod
    def is_symplectic(self) -> bool:
        """Whether a step preserves the symplectic form on the lifted space."""

    @property
    @abc.abstractmethod
    def is_symmetric(self) -> bool:
        """Whether a step of -dt undoes a step of dt."""

    @property
    def needs_separable(self) -> bool:
        """Whether only H = T(p) + U(q) can be stepped."""
        return False

    @property
    def copies(self) -> int:
        """How many phase points a state holds."""
        return 1

    @abc.abstractmethod
    def flow(
        self,
        hamiltonian: AbstractHamiltonian,
        state: Float[Array, "n ..."],
        t: Time,
        dt: Time,
    ) -> Float[Array, "n ..."]:
        """The state after one step of the Hamiltonian part, from time `t` to `t + dt`."""

    def lift(self, x: Float[Array, "two_d ..."]) -> Float[Array, "n ..."]:
        """The state that starts at the phase point `x`."""
        return jnp.concatenate([x] * self.copies)

    def project(self, state: Float[Array, "n ..."]) -> Float[Array, "two_d ..."]:
        """The phase point of a state."""
        return state

    def step(self, system: System, state: Float[Array, "n ..."], t: Time, dt: Time) -> Float[Array, "n ..."]:
        """The state one step later: Strang splitting around `flow` where the system has forces.

        The half kicks take the time at their own middles, t + dt/4 and t + 3 dt/4, so that an input that
        jumps at the end of a step is read on the right side of the jump.
        """
        if not isinstance(system, Forced):
            return self.flow(system, state, t, dt)
        if not system.forces:
            return self.flow(system.hamiltonian, state, t, dt)
        kicked = self._kick(system, state, t + 0.25 * dt, 0.5 * dt)
        moved = self.flow(system.hamiltonian, kicked, t, dt)
        end = self._kick(system.reversed(), moved, t + 0.75 * dt, 0.5 * dt)
        if any(force.sticks for force in system.forces):
            return self._hold(system, kicked, end, t + 0.5 * dt)
        return end

    def march(
        self, system: System, state: Float[Array, "n ..."], t: Time, dt: Time, steps: int
    ) -> Float[Array, "n ..."]:
        """The state `steps` steps of `dt` later, to round-off, with what `joined` steps share done once."""
        hamiltonian = conservative(system)
        if hamiltonian is not None and hamiltonian.stands_still:
            shared = self.joined(hamiltonian, state, dt, steps)
            if shared is not None:
                return shared

        def one(state: Float[Array, "n ..."], count: Array) -> tuple[Float[Array, "n ..."], None]:
            return self.step(system, state, t + count * dt, dt), None

        return jax.lax.scan(one, state, jnp.arange(steps))[0]

    def joined(
        self, hamiltonian: AbstractHamiltonian, state: Float[Array, "n ..."], dt: Time, steps: int
    ) -> Float[Array, "n ..."] | None:
        """`march` for a Hamiltonian that does not change with time, where steps share work; None where they do not."""
        return None

    def accepts(self, system: System) -> None:
        """Raises `TypeError`, in the field's words, where this method cannot step `system`."""
        hamiltonian = system.hamiltonian if isinstance(system, Forced) else system
        name, given = type(self).__name__, type(hamiltonian).__name__
        if not isinstance(hamiltonian, AbstractHamiltonian):
            raise TypeError(
                f"`{name}` steps a Hamiltonian system, but was given `{given}`. "
                "Subclass `AbstractHamiltonian` with an `energy(q, p)`."
            )
        if self.needs_separable and not isinstance(hamiltonian, AbstractSeparableHamiltonian):
            raise TypeError(
                f"`{name}` steps a separable Hamiltonian, T(p) + U(q), but was given `{given}`. "
                "Use `Tao` for H(q, p), or `RK2` for any system."
            )

    def _kick(self, system: Forced, state: Float[Array, "n ..."], t: Time, dt: Time) -> Float[Array, "n ..."]:
        points = state.reshape(self.copies, -1)
        return jax.vmap(lambda x: system.kick(x, t, dt))(points).reshape(-1)

    def _hold(
        self, system: Forced, start: Float[Array, "n ..."], end: Float[Array, "n ..."], t: Time
    ) -> Float[Array, "n ..."]:
        """Keeps a coordinate that friction holds where it was.

        Splitting alone lets a stuck body creep, at a speed of order dt |dU/dq| / m: the flow moves it a
        little in each step before friction stops it.
        """

        def one(x: Float[Array, "two_d ..."], y: Float[Array, "two_d ..."]) -> Float[Array, "two_d ..."]:
            held = system.holds(x, t)
            q, p = split(y)
            return jnp.concatenate([jnp.where(held, split(x)[0], q), jnp.where(held, 0.0, p)])

        shape = (self.copies, -1)
        return jax.vmap(one)(start.reshape(shape), end.reshape(shape)).reshape(-1)
