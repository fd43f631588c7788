"""Explicit symplectic methods by splitting, and their symmetric compositions."""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from integrators._integrator import AbstractIntegrator
from integrators._system import AbstractHamiltonian, Time, as_parameter, split

# (q, p, x, y): the coordinates and momenta of both copies.
_Copies = tuple[Array, Array, Array, Array]


class AbstractVerlet(AbstractIntegrator):
    """Kick and drift in turns, for H = T(p) + U(q), symmetric about the middle of the step."""

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


class Leapfrog(AbstractVerlet):
    """Leapfrog, or Stormer-Verlet, for H = T(p) + U(q): kick, drift, kick. Dissertation (5.5)-(5.6).

    The first choice for a separable system. Order 2, symplectic, symmetric; two evaluations of dU/dq a
    step, and one where steps without forces follow each other.
    """

    def flow(
        self,
        hamiltonian: AbstractHamiltonian,
        state: Float[Array, "n ..."],
        t: Time,
        dt: Time,
    ) -> Float[Array, "n ..."]:
        q, p = split(state)
        p = p - 0.5 * dt * hamiltonian.at(t + 0.25 * dt).slope(q, p)
        q = q + dt * hamiltonian.at(t + 0.5 * dt).velocity(q, p)
        p = p - 0.5 * dt * hamiltonian.at(t + 0.75 * dt).slope(q, p)
        return jnp.concatenate([q, p])

    def joined(
        self, hamiltonian: AbstractHamiltonian, state: Float[Array, "n ..."], dt: Time, steps: int
    ) -> Float[Array, "n ..."] | None:
        q, p = split(state)
        begun = q, p - 0.5 * dt * hamiltonian.slope(q, p)

        # The half kick that ends a step and the one that begins the next are one.
        def one(state: tuple[Array, Array], kick: Any) -> tuple[tuple[Array, Array], None]:
            q, p = state
            q = q + dt * hamiltonian.velocity(q, p)
            return (q, p - kick * dt * hamiltonian.slope(q, p)), None

        kicks = np.where(np.arange(steps) < steps - 1, 1.0, 0.5)
        return jnp.concatenate(jax.lax.scan(one, begun, kicks)[0])


class PositionVerlet(AbstractVerlet):
    """Leapfrog with the drift outside, for H = T(p) + U(q): drift, kick, drift. Tuckerman, Berne & Martyna (1992).

    Order 2, symplectic, symmetric; one evaluation of dU/dq a step, where a single step of `Leapfrog` has two, and
    two of dT/dp.
    """

    def flow(
        self,
        hamiltonian: AbstractHamiltonian,
        state: Float[Array, "n ..."],
        t: Time,
        dt: Time,
    ) -> Float[Array, "n ..."]:
        q, p = split(state)
        q = q + 0.5 * dt * hamiltonian.at(t + 0.25 * dt).velocity(q, p)
        p = p - dt * hamiltonian.at(t + 0.5 * dt).slope(q, p)
        q = q + 0.5 * dt * hamiltonian.at(t + 0.75 * dt).velocity(q, p)
        return jnp.concatenate([q, p])


class AbstractProjection(eqx.Module):
    """How two copies of a phase point become one."""

    @abc.abstractmethod
    def __call__(self, copies: Float[Array, "2 two_d ..."]) -> Float[Array, "two_d ..."]:
        """The phase point of the two copies."""


class FirstCopy(AbstractProjection):
    """Drops the second copy, as dissertation (5.18) does."""

    def __call__(self, copies: Float[Array, "2 two_d ..."]) -> Float[Array, "two_d ..."]:
        return copies[0]


class MeanOfCopies(AbstractProjection):
    """The mean of both copies: far nearer to symplectic than dropping one (specification E40)."""

    def __call__(self, copies: Float[Array, "2 two_d ..."]) -> Float[Array, "two_d ..."]:
        return copies.mean(axis=0)


def _as_strength(omega: Any) -> Any:
    if omega is None:
        return None
    strength = as_parameter(omega)
    if (
        isinstance(strength, jax.Array)
        and not isinstance(strength, jax.core.Tracer)
        and not jnp.all(jnp.isfinite(strength))
    ):
        raise ValueError(f"`Tao` needs a finite `omega`, or None for no binding, but was given {strength}.")
    return strength


class Tao(AbstractIntegrator):
    """Tao's explicit symplectic method for any H(q, p). Dissertation (5.7)-(5.8); Tao (2016), PRE 94, 043303.

    Symplectic on the doubled phase space (q, p, x, y), not on (q, p) alone: lift once per trajectory.
    Projected at every step, as (5.18) has it, it is not symplectic (specification E40).

    A weak binding lets the copies part, and the energy shows it: look at `energy_drift`. At dt = 0.01 over
    1000 time units, omega = 5 loses Kepler's ellipse and 20 keeps it; the double pendulum wants 40.

    **Arguments:**

    - `omega`: strength of the binding between the copies, in 1/time. Larger binds tighter, needs smaller dt. None for
      no binding, which takes a quarter less work: for copies that are joined again after a step.
    - `projection`: how a doubled state is read; `MeanOfCopies()`, or `FirstCopy()` for (5.18) as printed.

    **Raises:** `ValueError` where `omega` is not finite.
    """

    omega: Float[Array, ""] | None = eqx.field(converter=_as_strength, default=20.0)
    projection: AbstractProjection = eqx.field(default_factory=MeanOfCopies)

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
    def copies(self) -> int:
        return 2

    def project(self, state: Float[Array, "n ..."]) -> Float[Array, "two_d ..."]:
        return self.projection(state.reshape(2, -1, *state.shape[1:]))

    def flow(
        self,
        hamiltonian: AbstractHamiltonian,
        state: Float[Array, "n ..."],
        t: Time,
        dt: Time,
    ) -> Float[Array, "n ..."]:
        q, p, x, y = jnp.split(state, 4)
        early, late = hamiltonian.at(t + 0.25 * dt), hamiltonian.at(t + 0.75 * dt)
        # H(q, y) moves p and x; H(x, p) moves q and y; the binding turns the differences of the copies.
        dx, dp = _push(early, q, y, 0.5 * dt)
        middle = (hamiltonian.at(t + 0.5 * dt),) * 2 if self.omega is None else (early, late)
        q, p, x, y = self._middle(*middle, (q, p + dp, x + dx, y), dt)
        dx, dp = _push(late, q, y, 0.5 * dt)
        return jnp.concatenate([q, p + dp, x + dx, y])

    def joined(
        self, hamiltonian: AbstractHamiltonian, state: Float[Array, "n ..."], dt: Time, steps: int
    ) -> Float[Array, "n ..."] | None:
        q, p, x, y = jnp.split(state, 4)
        dx, dp = _push(hamiltonian, q, y, 0.5 * dt)

        # What H(q, y) does at the end of a step and at the beginning of the next is one.
        def one(copies: _Copies, share: Any) -> tuple[_Copies, None]:
            q, p, x, y = self._middle(hamiltonian, hamiltonian, copies, dt)
            dx, dp = _push(hamiltonian, q, y, share * dt)
            return (q, p + dp, x + dx, y), None

        shares = np.where(np.arange(steps) < steps - 1, 1.0, 0.5)
        return jnp.concatenate(jax.lax.scan(one, (q, p + dp, x + dx, y), shares)[0])

    def _middle(self, early: AbstractHamiltonian, late: AbstractHamiltonian, copies: _Copies, dt: Time) -> _Copies:
        """The middle of a step: H(x, p) on both sides of the binding, or all at once where nothing binds."""
        q, p, x, y = copies
        if self.omega is None:
            dq, dy = _push(early, x, p, dt)
            return q + dq, p, x, y + dy
        dq, dy = _push(early, x, p, 0.5 * dt)
        q, p, x, y = _bind(q + dq, p, x, y + dy, 2.0 * self.omega * dt)
        dq, dy = _push(late, x, p, 0.5 * dt)
        return q + dq, p, x, y + dy


def _push(
    hamiltonian: AbstractHamiltonian, q: Float[Array, "d ..."], p: Float[Array, "d ..."], dt: Time
) -> tuple[Float[Array, "d ..."], Float[Array, "d ..."]]:
    """The way that H(q, p), both frozen, carries the other copy's coordinates and momenta in `dt`."""
    velocity, force = hamiltonian.velocity_and_force(q, p)
    return dt * velocity, dt * force


def _bind(
    q: Float[Array, "d ..."],
    p: Float[Array, "d ..."],
    x: Float[Array, "d ..."],
    y: Float[Array, "d ..."],
    angle: Float[Array, ""],
) -> tuple[Float[Array, "d ..."], Float[Array, "d ..."], Float[Array, "d ..."], Float[Array, "d ..."]]:
    """Exact flow of the binding: the copies' mean stays, their difference turns. Specification E39."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    dq, dp = q - x, p - y
    turned_q, turned_p = c * dq + s * dp, c * dp - s * dq
    return (
        0.5 * (q + x + turned_q),
        0.5 * (p + y + turned_p),
        0.5 * (q + x - turned_q),
        0.5 * (p + y - turned_p),
    )


class Composition(AbstractIntegrator):
    """A symmetric composition of steps of `base`. Hairer, Lubich & Wanner, II.4 and V.3.

    Only the Hamiltonian flow is composed. Forces of a `Forced` system stay outside, as half kicks of positive
    length: a negative substep would run friction backwards. With forces the order is therefore 2.

    Made by `yoshida4` and `suzuki4`. Raises `ValueError` where the base is not symmetric, or the weights are
    not a palindrome that sums to one.

    **Arguments:**

    - `base`: a symmetric method.
    - `weights`: the substeps' lengths as fractions of dt.
    - `composed_order`: the order the weights reach with this base.
    """

    base: AbstractIntegrator
    weights: tuple[float, ...] = eqx.field(static=True)
    composed_order: int = eqx.field(static=True)

    def __check_init__(self) -> None:
        if not self.base.is_symmetric:
            raise ValueError(
                "A composition raises the order of a symmetric method, but was given "
                f"`{type(self.base).__name__}`. Use `Leapfrog`, `Tao` or `ImplicitMidpoint`."
            )
        # Both conditions hold to round-off of a few additions.
        if abs(sum(self.weights) - 1.0) > 1e-12 or self.weights != self.weights[::-1]:
            raise ValueError(f"A composition needs palindromic weights that sum to one, not {self.weights}.")

    @property
    def order(self) -> int:
        return self.composed_order

    @property
    def is_symplectic(self) -> bool:
        return self.base.is_symplectic

    @property
    def is_symmetric(self) -> bool:
        return True

    @property
    def needs_separable(self) -> bool:
        return self.base.needs_separable

    @property
    def copies(self) -> int:
        return self.base.copies

    def lift(self, x: Float[Array, "two_d ..."]) -> Float[Array, "n ..."]:
        return self.base.lift(x)

    def project(self, state: Float[Array, "n ..."]) -> Float[Array, "two_d ..."]:
        return self.base.project(state)

    def flow(
        self,
        hamiltonian: AbstractHamiltonian,
        state: Float[Array, "n ..."],
        t: Time,
        dt: Time,
    ) -> Float[Array, "n ..."]:
        weights = jnp.asarray(self.weights, dtype=state.dtype)
        starts = jnp.cumsum(weights) - weights

        def stage(state: Array, part: tuple[Array, Array]) -> tuple[Array, None]:
            start, weight = part
            return self.base.flow(hamiltonian, state, t + start * dt, weight * dt), None

        return jax.lax.scan(stage, state, (starts, weights))[0]


def yoshida4(base: AbstractIntegrator) -> Composition:
    """The triple jump: order 4 from a symmetric method of order 2. Yoshida (1990), Phys. Lett. A 150, 262."""
    outer = 1.0 / (2.0 - 2.0 ** (1.0 / 3.0))
    return Composition(base, (outer, 1.0 - 2.0 * outer, outer), 4)


def suzuki4(base: AbstractIntegrator) -> Composition:
    """Suzuki's fractal: order 4 from a symmetric method of order 2. Suzuki (1990), Phys. Lett. A 146, 319.

    Five stages, and an error far smaller than that of Yoshida's three.
    """
    outer = 1.0 / (4.0 - 4.0 ** (1.0 / 3.0))
    return Composition(base, (outer, outer, 1.0 - 4.0 * outer, outer, outer), 4)
