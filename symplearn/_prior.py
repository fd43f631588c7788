"""Prior densities over what a model learns, in nats. Dissertation sec. 2.1 for the conventions."""

import abc
import math
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from ._errors import InputError
from ._parameters import log_jacobian_of, named_parameters, value_of


class AbstractDensity(eqx.Module):
    """A density over one number; entries of an array are independent."""

    @abc.abstractmethod
    def log_density(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        """The log density of each entry, in nats."""


class Normal(AbstractDensity):
    """N(mean, variance): the second number is the variance, not the standard deviation."""

    mean: Any = eqx.field(converter=jnp.asarray, default=0.0)
    variance: Any = eqx.field(converter=jnp.asarray, default=1.0)

    def log_density(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        return -0.5 * ((value - self.mean) ** 2 / self.variance + jnp.log(2 * math.pi * self.variance))


class Laplace(AbstractDensity):
    """The double exponential with density exp(-|x| / scale) / (2 scale); its MAP is an L1 penalty."""

    scale: Any = eqx.field(converter=jnp.asarray, default=1.0)

    def log_density(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        return -jnp.abs(value) / self.scale - jnp.log(2 * self.scale)


class HalfNormal(AbstractDensity):
    """|x| for x ~ N(0, variance): `variance` is that of the underlying normal, as half-N(0, V) in the
    dissertation."""

    variance: Any = eqx.field(converter=jnp.asarray, default=1.0)

    def log_density(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        inside = 0.5 * jnp.log(2 / (math.pi * self.variance)) - value**2 / (2 * self.variance)
        return jnp.where(value >= 0, inside, -jnp.inf)


class Flat(AbstractDensity):
    """The improper density 1 over the value: over v itself, not log v, for a `Positive` leaf."""

    def log_density(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        return jnp.zeros_like(value)


class Prior(eqx.Module):
    """A density for each leaf that learns, by the leaf's name or the beginning of it.

    `Prior({"dynamics": Laplace(0.1), "process_noise": HalfNormal(1.0)})`; the longest beginning wins. One
    density alone, as `Prior(Flat())`, is for every leaf.

    **Raises:** `InputError`, in `log_density`, where a leaf has no density or a name fits no leaf.
    """

    densities: dict[str, AbstractDensity]

    def __init__(self, densities: Mapping[str, AbstractDensity] | AbstractDensity):
        self.densities = {"": densities} if isinstance(densities, AbstractDensity) else dict(densities)

    def log_density(self, model: PyTree) -> Float[Array, ""]:
        """The log density of the free coordinates, in nats: of the values, with the Jacobian of the map."""
        leaves = named_parameters(model)
        self._refuse_unknown(leaves)
        total = jnp.zeros(())
        for name, leaf in leaves.items():
            total += jnp.sum(self.density_of(name).log_density(value_of(leaf))) + log_jacobian_of(leaf)
        return total

    def density_of(self, name: str) -> AbstractDensity:
        """The density of the leaf called `name`."""
        fitting = [start for start in self.densities if _begins(name, start)]
        if not fitting:
            raise InputError(
                f"`{name}` learns but has no prior. Give it one, as Prior({{'{name}': Normal(0.0, 1.0)}}); "
                "or say Flat(); or wrap it in Frozen."
            )
        return self.densities[max(fitting, key=len)]

    def _refuse_unknown(self, leaves: Mapping[str, Any]) -> None:
        for start in self.densities:
            if not any(_begins(name, start) for name in leaves):
                known = ", ".join(leaves) or "nothing"
                raise InputError(f"The prior names `{start}`, but what learns is: {known}.")


def _begins(name: str, start: str) -> bool:
    return start in ("", name) or name.startswith(start + ".")
