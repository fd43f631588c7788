"""The zoo: systems with known behaviour, each with a standard initial phase point."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from integrators._system import AbstractHamiltonian, AbstractSeparableHamiltonian, as_parameter


class HarmonicOscillator(AbstractSeparableHamiltonian):
    """H = p^2 / 2m + k q^2 / 2. Closed form: a turn of angular frequency sqrt(k / m)."""

    mass: Float[Array, ""] = eqx.field(converter=as_parameter, default=1.0)
    stiffness: Float[Array, ""] = eqx.field(converter=as_parameter, default=1.0)

    @property
    def initial(self) -> Float[Array, "2"]:
        return jnp.array([1.0, 0.0])

    def kinetic(self, p: Float[Array, " d"]) -> Float[Array, ""]:
        return 0.5 * p @ p / self.mass

    def potential(self, q: Float[Array, " d"]) -> Float[Array, ""]:
        return 0.5 * self.stiffness * q @ q


class Pendulum(AbstractSeparableHamiltonian):
    """H = p^2 / 2 m l^2 - m g l cos q; q is the angle from hanging, in radians."""

    mass: Float[Array, ""] = eqx.field(converter=as_parameter, default=1.0)
    length: Float[Array, ""] = eqx.field(converter=as_parameter, default=1.0)
    gravity: Float[Array, ""] = eqx.field(converter=as_parameter, default=9.81)

    @property
    def initial(self) -> Float[Array, "2"]:
        return jnp.array([2.5, 0.0])

    def kinetic(self, p: Float[Array, " d"]) -> Float[Array, ""]:
        return 0.5 * p @ p / (self.mass * self.length**2)

    def potential(self, q: Float[Array, " d"]) -> Float[Array, ""]:
        return -self.mass * self.gravity * self.length * jnp.cos(q).sum()


class HenonHeiles(AbstractSeparableHamiltonian):
    """Star in a galactic potential. Henon & Heiles (1964); dissertation (5.19).

    Start of specification E41, where H = 0.122708.
    """

    coupling: Float[Array, ""] = eqx.field(converter=as_parameter, default=1.0)

    @property
    def initial(self) -> Float[Array, "4"]:
        return jnp.array([0.2, -0.25, 0.3, -0.25])

    def kinetic(self, p: Float[Array, " d"]) -> Float[Array, ""]:
        return 0.5 * p @ p

    def potential(self, q: Float[Array, " d"]) -> Float[Array, ""]:
        return 0.5 * q @ q + self.coupling * (q[0] ** 2 * q[1] - q[1] ** 3 / 3.0)


class Kepler(AbstractSeparableHamiltonian):
    """H = |p|^2 / 2 - mu / |q| in the plane: a planet about the sun.

    Start: perihelion of the ellipse of eccentricity 0.6 and semi-axis 1, of period 2 pi / sqrt(mu).
    """

    mu: Float[Array, ""] = eqx.field(converter=as_parameter, default=1.0)

    @property
    def initial(self) -> Float[Array, "4"]:
        return jnp.array([0.4, 0.0, 0.0, 0.0]).at[3].set(2.0 * jnp.sqrt(self.mu))

    def kinetic(self, p: Float[Array, " d"]) -> Float[Array, ""]:
        return 0.5 * p @ p

    def potential(self, q: Float[Array, " d"]) -> Float[Array, ""]:
        return -self.mu / jnp.sqrt(q @ q)


class Cherry(AbstractHamiltonian):
    """Two oscillators in resonance, one of negative energy. Cherry (1925); dissertation (5.23).

    Explosive however small the disturbance; from the start it blows up near t = 28.
    """

    coupling: Float[Array, ""] = eqx.field(converter=as_parameter, default=1.0)

    @property
    def initial(self) -> Float[Array, "4"]:
        return jnp.array([0.15, 0.1, -0.05, 0.1])

    def energy(self, q: Float[Array, " d"], p: Float[Array, " d"]) -> Float[Array, ""]:
        oscillators = 0.5 * (q[0] ** 2 + p[0] ** 2) - (q[1] ** 2 + p[1] ** 2)
        return oscillators + self.coupling * (0.5 * p[1] * (p[0] ** 2 - q[0] ** 2) - q[0] * q[1] * p[0])


class TaoExample(AbstractHamiltonian):
    """H = (q^2 + 1)(p^2 + 1) / 2. Tao (2016); dissertation 5.4.3.

    From the start H = 5 and the period is 3.26106.
    """

    @property
    def initial(self) -> Float[Array, "2"]:
        return jnp.array([0.0, -3.0])

    def energy(self, q: Float[Array, " d"], p: Float[Array, " d"]) -> Float[Array, ""]:
        return 0.5 * (q @ q + 1.0) * (p @ p + 1.0)


class DoublePendulum(AbstractHamiltonian):
    """Two point masses on rods; q are the angles from hanging. Dissertation (5.28).

    As printed the denominator of (5.28) lacks a factor l1 l2; this has it (specification E46).
    """

    mass1: Float[Array, ""] = eqx.field(converter=as_parameter, default=1.0)
    mass2: Float[Array, ""] = eqx.field(converter=as_parameter, default=1.0)
    length1: Float[Array, ""] = eqx.field(converter=as_parameter, default=1.0)
    length2: Float[Array, ""] = eqx.field(converter=as_parameter, default=1.0)
    gravity: Float[Array, ""] = eqx.field(converter=as_parameter, default=9.81)

    @property
    def initial(self) -> Float[Array, "4"]:
        return jnp.array([1.0, 0.0, 0.0, 0.0])

    def energy(self, q: Float[Array, " d"], p: Float[Array, " d"]) -> Float[Array, ""]:
        m1, m2, l1, l2 = self.mass1, self.mass2, self.length1, self.length2
        bend = q[0] - q[1]
        cross = 2.0 * m2 * l1 * l2 * p[0] * p[1] * jnp.cos(bend)
        above = m2 * l2**2 * p[0] ** 2 + (m1 + m2) * l1**2 * p[1] ** 2 - cross
        below = 2.0 * l1**2 * l2**2 * m2 * (m1 + m2 * jnp.sin(bend) ** 2)
        height = (m1 + m2) * l1 * jnp.cos(q[0]) + m2 * l2 * jnp.cos(q[1])
        return above / below - self.gravity * height
