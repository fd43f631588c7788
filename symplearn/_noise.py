"""Additive Gaussian noise of the dynamics and of the readings. Dissertation (2.5).

Bare numbers in a noise are known; wrap them in `Positive` to learn them. All numbers are variances.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._parameters import AbstractKnown, AbstractParameter


def _number(value: Any) -> Any:
    return value if isinstance(value, AbstractKnown | AbstractParameter) else jnp.asarray(value, dtype=float)


class ScaledIdentity(AbstractKnown):
    """The covariance `variance` times the identity of size `dim`."""

    variance: Any = eqx.field(converter=_number)
    dim: int = eqx.field(static=True)

    @property
    def matrix(self) -> Float[Array, "dim dim"]:
        """The covariance matrix."""
        return self.variance * jnp.eye(self.dim)


class Diagonal(AbstractKnown):
    """The covariance with `variances` (dim,) on its diagonal."""

    variances: Any = eqx.field(converter=_number)

    @property
    def matrix(self) -> Float[Array, "dim dim"]:
        """The covariance matrix."""
        return jnp.diag(self.variances)


class Dense(AbstractKnown):
    """A known covariance (dim, dim), symmetric and positive semi-definite."""

    covariance: Any = eqx.field(converter=_number)

    @property
    def matrix(self) -> Float[Array, "dim dim"]:
        """The covariance matrix."""
        return self.covariance


class AdditiveGaussian(eqx.Module):
    """Independent zero-mean Gaussian noise: one draw per reading, or one per data interval.

    As process noise its variances are per data interval, as in the dissertation, and not comparable across
    sampling intervals; use `WienerIncrement` where intervals differ.
    """

    structure: Any

    def covariance(self, interval: Any = None) -> Float[Array, "dim dim"]:
        """The covariance of one draw."""
        return self.structure.matrix


class WienerIncrement(eqx.Module):
    """Process noise that adds up over time: the structure's variances are per unit time, times the
    interval's length.

    `interval` needs a `length`, as `Interval` has.
    """

    structure: Any

    def covariance(self, interval: Any) -> Float[Array, "dim dim"]:
        """The covariance of the noise gathered over one data interval."""
        return self.structure.matrix * interval.length
