"""The forces of dissipation, each with its coefficient per coordinate or one for all."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from integrators._system import AbstractForce, AbstractHamiltonian, Time, as_parameter


class ViscousDamping(AbstractForce):
    """F = -c v: lubricated bearings, slow flow.

    **Arguments:** - `c`: force per velocity, shape `()` or `(d,)`.
    """

    c: Float[Array, "..."] = eqx.field(converter=as_parameter)

    def force(self, q: Float[Array, " d"], v: Float[Array, " d"], t: Time) -> Float[Array, " d"]:
        return -self.c * v


class QuadraticDrag(AbstractForce):
    """F = -c |v| v, coordinate by coordinate: a blunt body in fast flow.

    **Arguments:** - `c`: force per squared velocity, shape `()` or `(d,)`.
    """

    c: Float[Array, "..."] = eqx.field(converter=as_parameter)

    def force(self, q: Float[Array, " d"], v: Float[Array, " d"], t: Time) -> Float[Array, " d"]:
        return -self.c * jnp.abs(v) * v


class CoulombFriction(AbstractForce):
    """F = -f sign(v), and at rest whatever holds the body still, up to f: dry friction.

    The kick is the exact flow at frozen q, a soft threshold of the momentum, so a body comes to rest and
    stays. It supposes that v_i has the sign of p_i, and is 0 where p_i is: a diagonal mass matrix, with no
    moving frame. The double pendulum is outside it.

    **Arguments:** - `f`: force, shape `()` or `(d,)`; from 0 up for friction.
    """

    f: Float[Array, "..."] = eqx.field(converter=as_parameter)

    sticks: ClassVar[bool] = True

    def force(self, q: Float[Array, " d"], v: Float[Array, " d"], t: Time) -> Float[Array, " d"]:
        return -self.f * jnp.sign(v)

    def kick(
        self,
        hamiltonian: AbstractHamiltonian,
        q: Float[Array, " d"],
        p: Float[Array, " d"],
        t: Time,
        dt: Time,
    ) -> Float[Array, " d"]:
        """Exact: p -> sign(p) max(|p| - f dt, 0)."""
        impulse = self.f * dt
        # With `>=` the derivative in p is 1 at f = 0 even from rest; max(|p| - f dt, 0) would give 0 there.
        return jnp.where(jnp.abs(p) >= impulse, p - impulse * jnp.sign(p), 0.0)

    def breakaway(self) -> Float[Array, "..."]:
        return self.f
