"""A Hamiltonian that is a neural network: the NSSNN of Xiong et al. (2021). Dissertation sec. 5.3.1.2."""

import abc
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

import integrators as ig

from ._counts import refuse_count
from ._keys import refuse_key


class AbstractInitialisation(eqx.Module):
    """How the weights and biases of one linear layer are drawn."""

    @abc.abstractmethod
    def __call__(
        self, key: PRNGKeyArray, inputs: int, outputs: int
    ) -> tuple[Float[Array, "outputs inputs"], Float[Array, " outputs"]]:
        """The weights and the biases of a layer with so many inputs and outputs."""


class AuthorsInitialisation(AbstractInitialisation):
    """Weights U[-sqrt(6 / inputs), sqrt(6 / inputs)], as the script of the NSSNN's authors draws them.

    Biases are U[-1 / sqrt(inputs), 1 / sqrt(inputs)], PyTorch's default, which the script leaves alone.
    """

    def __call__(self, key, inputs, outputs):
        weights, biases = jax.random.split(key)
        wide, narrow = math.sqrt(6.0 / inputs), 1.0 / math.sqrt(inputs)
        return _uniform(weights, (outputs, inputs), wide), _uniform(biases, (outputs,), narrow)


class Xavier(AbstractInitialisation):
    """Weights U[-a, a] with a = sqrt(6 / (inputs + outputs)), biases 0. Glorot and Bengio (2010), (16).

    The dissertation's text names this one.
    """

    def __call__(self, key, inputs, outputs):
        return _uniform(key, (outputs, inputs), math.sqrt(6.0 / (inputs + outputs))), jnp.zeros(outputs, dtype=float)


def _uniform(key: PRNGKeyArray, shape: tuple[int, ...], bound: float) -> Array:
    return jax.random.uniform(key, shape, float, -bound, bound)


class Layer(eqx.Module):
    """One linear layer: weights (outputs, inputs) and biases (outputs,)."""

    weights: Any
    biases: Any

    def __call__(self, z: Float[Array, " inputs"]) -> Float[Array, " outputs"]:
        return self.weights @ z + self.biases


class NSSNN(ig.AbstractHamiltonian):
    """H(q, p) as a network of linear layers with a sigmoid after each but the last. Xiong et al. (2021), 5.3.1.2.

    As published there are six layers: 2 `dim` inputs, five times `width` units, one output. With dim 1 and width 64
    that makes 16,897 numbers, all of which learn; only the last bias has no effect on the motion.

    **Arguments:** `dim` - degrees of freedom; `width` - units of a hidden layer; `depth` - linear layers; `key` - of
    `jax.random.key`; `initialisation` - `AuthorsInitialisation()` or `Xavier()`.

    **Raises:** `InputError` where a size is not a whole number of at least 1, or the depth is below 2.
    """

    layers: tuple[Layer, ...]
    dim: int = eqx.field(static=True)

    def __init__(
        self,
        dim: int,
        width: int = 64,
        depth: int = 6,
        *,
        key: PRNGKeyArray,
        initialisation: AbstractInitialisation | None = None,
    ):
        refuse_key(key)
        for name, given, least in (("dim", dim, 1), ("width", width, 1), ("depth", depth, 2)):
            refuse_count("NSSNN", name, given, least)
        draw = AuthorsInitialisation() if initialisation is None else initialisation
        sizes = [2 * dim, *[width] * (depth - 1), 1]
        keys = jax.random.split(key, depth)
        self.layers = tuple(Layer(*draw(k, m, n)) for k, m, n in zip(keys, sizes[:-1], sizes[1:], strict=True))
        self.dim = dim

    def energy(self, q: Float[Array, " d"], p: Float[Array, " d"]) -> Float[Array, ""]:
        return self._energy(jnp.concatenate([q, p]))

    def velocity(self, q: Float[Array, " d"], p: Float[Array, " d"]) -> Float[Array, " d"]:
        return self._gradient(q, p)[self.dim :]

    def slope(self, q: Float[Array, " d"], p: Float[Array, " d"]) -> Float[Array, " d"]:
        return self._gradient(q, p)[: self.dim]

    def vector_field(self, x: Float[Array, " two_d"]) -> Float[Array, " two_d"]:
        """dx/dt at the phase point x, by one sweep back through the network."""
        slope, velocity = ig.split(self._gradient(*ig.split(x)))
        return jnp.concatenate([velocity, -slope])

    def _energy(self, z: Float[Array, " two_d"]) -> Float[Array, ""]:
        for layer in self.layers[:-1]:
            z = jax.nn.sigmoid(layer(z))
        return self.layers[-1](z)[0]

    def _gradient(self, q: Array, p: Array) -> Float[Array, " two_d"]:
        """[dH/dq; dH/dp]. Asked for at one point twice, as by `Tao`, XLA computes it once."""
        return jax.grad(self._energy)(jnp.concatenate([q, p]))
