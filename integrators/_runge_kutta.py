"""The yardsticks: explicit Runge-Kutta methods, and the implicit midpoint rule as a symplectic reference."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from integrators._integrator import AbstractIntegrator
from integrators._system import AbstractHamiltonian, Time


class RK2(AbstractIntegrator):
    """Runge-Kutta of order 2 for any system: the midpoint rule (node 1/2) or Heun's (node 1). Not symplectic.

    **Arguments:** - `node`: where in the step the second stage lies, as a fraction of dt.
    """

    node: float = eqx.field(static=True, default=0.5)

    def __check_init__(self) -> None:
        if not 0.0 < self.node <= 1.0:
            raise ValueError(f"`RK2` needs a node in (0, 1], but was given {self.node}. Midpoint is 0.5.")

    @classmethod
    def midpoint(cls) -> "RK2":
        """The explicit midpoint rule."""
        return cls(0.5)

    @classmethod
    def heun(cls) -> "RK2":
        """Heun's rule, the explicit trapezium."""
        return cls(1.0)

    @property
    def order(self) -> int:
        return 2

    @property
    def is_symplectic(self) -> bool:
        return False

    @property
    def is_symmetric(self) -> bool:
        return False

    def flow(
        self,
        hamiltonian: AbstractHamiltonian,
        state: Float[Array, "n ..."],
        t: Time,
        dt: Time,
    ) -> Float[Array, "n ..."]:
        k1 = hamiltonian.at(t).vector_field(state)
        k2 = hamiltonian.at(t + self.node * dt).vector_field(state + self.node * dt * k1)
        share = 0.5 / self.node
        return state + dt * ((1.0 - share) * k1 + share * k2)


class RK4(AbstractIntegrator):
    """The classical Runge-Kutta method of order 4 for any system. Not symplectic. Kutta (1901)."""

    @property
    def order(self) -> int:
        return 4

    @property
    def is_symplectic(self) -> bool:
        return False

    @property
    def is_symmetric(self) -> bool:
        return False

    def flow(
        self,
        hamiltonian: AbstractHamiltonian,
        state: Float[Array, "n ..."],
        t: Time,
        dt: Time,
    ) -> Float[Array, "n ..."]:
        middle = hamiltonian.at(t + 0.5 * dt)
        k1 = hamiltonian.at(t).vector_field(state)
        k2 = middle.vector_field(state + 0.5 * dt * k1)
        k3 = middle.vector_field(state + 0.5 * dt * k2)
        k4 = hamiltonian.at(t + dt).vector_field(state + dt * k3)
        return state + dt * (k1 + 2.0 * k2 + 2.0 * k3 + k4) / 6.0


class ImplicitMidpoint(AbstractIntegrator):
    """The implicit midpoint rule for any system, by Newton's method. Hairer, Lubich & Wanner, VI.4.

    Symplectic on (q, p) itself, at the price of a linear solve per iteration; a reference for `Tao`.
    Differentiable in both directions, through the solution and not through the iterations. The step is NaN
    where Newton did not converge, so that `Trajectory.finite` says so.

    **Arguments:** - `iterations`: most Newton iterations a step may take.
    """

    iterations: int = eqx.field(static=True, default=20)

    @property
    def order(self) -> int:
        return 2

    @property
    def is_symplectic(self) -> bool:
        return True

    @property
    def is_symmetric(self) -> bool:
        return True

    def flow(
        self,
        hamiltonian: AbstractHamiltonian,
        state: Float[Array, "n ..."],
        t: Time,
        dt: Time,
    ) -> Float[Array, "n ..."]:
        if state.ndim > 1:
            # Of points side by side each has its own equations: one system of all would grow with their square.
            return jax.vmap(lambda x: self.flow(hamiltonian, x, t, dt), in_axes=1, out_axes=1)(state)
        field = hamiltonian.at(t + 0.5 * dt).vector_field

        def residual(middle: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
            return middle - state - 0.5 * dt * field(middle)

        guess = state + 0.5 * dt * field(state)
        middle = jax.lax.custom_root(residual, guess, self._newton, _solve_dense)
        return 2.0 * middle - state

    def _newton(self, residual, guess: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
        # A few ulps of the phase point: Newton's last correction then is round-off.
        tolerance = 64.0 * jnp.finfo(guess.dtype).eps

        def settled(x: Float[Array, "n ..."], correction: Float[Array, "n ..."]) -> Bool[Array, ""]:
            return jnp.max(jnp.abs(correction)) <= tolerance * (1.0 + jnp.max(jnp.abs(x)))

        def unfinished(carry):
            x, correction, count = carry
            return (count < self.iterations) & ~settled(x, correction)

        def improve(carry):
            x, _, count = carry
            correction = -jnp.linalg.solve(jax.jacfwd(residual)(x), residual(x))
            return x + correction, correction, count + 1

        x, correction, _ = jax.lax.while_loop(unfinished, improve, (guess, jnp.full_like(guess, jnp.inf), 0))
        return jnp.where(settled(x, correction), x, jnp.nan)


def _solve_dense(linear, right: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    return jnp.linalg.solve(jax.jacfwd(linear)(right), right)
