"""Numbers that learn: positive, bounded, frozen, each seen by an optimiser as a free real number."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

import integrators as ig

from ._errors import InputError


class AbstractParameter(eqx.Module):
    """A leaf that learns: `free` is unconstrained, `value` is what the model computes with."""

    free: eqx.AbstractVar[Array]

    @property
    @abc.abstractmethod
    def value(self) -> Array:
        """The constrained value."""

    @abc.abstractmethod
    def log_jacobian(self) -> Float[Array, ""]:
        """log |d value / d free|, summed over the entries."""


class AbstractKnown(eqx.Module):
    """A record whose bare numbers are known: only the parameters put into it, as `Positive`, learn."""


def _require(holds: Any, sentence: str) -> None:
    """Refuse concrete bad values; inside a transformation there is nothing to look at."""
    if not isinstance(holds, jax.core.Tracer) and not np.all(holds):
        raise InputError(sentence)


class Learnt(AbstractParameter):
    """A real number that learns, where a bare number would be known: a mean of a `Gaussian`."""

    free: Array

    def __init__(self, value: Any):
        self.free = jnp.asarray(value, dtype=float)

    @property
    def value(self) -> Array:
        return self.free

    def log_jacobian(self) -> Float[Array, ""]:
        return jnp.zeros((), self.free.dtype)


class Positive(AbstractParameter):
    """A positive number or array that learns, through its logarithm. `value` is where it starts.

    **Raises:** `InputError` where an entry is not positive.
    """

    free: Array

    def __init__(self, value: Any):
        value = jnp.asarray(value, dtype=float)
        _require(
            value > 0,
            "`Positive` needs positive numbers, but was given 0 or less. Use `Learnt` for any sign.",
        )
        self.free = jnp.log(value)

    @property
    def value(self) -> Array:
        return jnp.exp(self.free)

    def log_jacobian(self) -> Float[Array, ""]:
        return jnp.sum(self.free)


class Bounded(AbstractParameter):
    """A number or array that learns between `lower` and `upper`, through its logit; it starts at `value`.

    **Raises:** `InputError` where an entry is not strictly between the bounds.
    """

    free: Array
    lower: Array
    upper: Array

    def __init__(self, value: Any, lower: Any, upper: Any):
        value, lower, upper = (jnp.asarray(number, dtype=float) for number in (value, lower, upper))
        _require(
            (lower < value) & (value < upper),
            "`Bounded` needs lower < value < upper, but its value lies on or outside a bound.",
        )
        self.free = jnp.log(value - lower) - jnp.log(upper - value)
        self.lower, self.upper = lower, upper

    @property
    def value(self) -> Array:
        return self.lower + (self.upper - self.lower) * jax.nn.sigmoid(self.free)

    def log_jacobian(self) -> Float[Array, ""]:
        slope = jax.nn.log_sigmoid(self.free) + jax.nn.log_sigmoid(-self.free)
        return jnp.sum(slope + jnp.log(self.upper - self.lower))


class Frozen(AbstractKnown):
    """Anything that does not learn: a number, an array or a whole module, with every parameter inside."""

    value: Any


# The numbers of an integrator, as Tao's omega, are settings and never learn.
_KNOWN = (AbstractKnown, ig.AbstractIntegrator)


def _is_parameter(node: Any) -> bool:
    return isinstance(node, AbstractParameter)


def _is_leaf(node: Any) -> bool:
    return isinstance(node, AbstractParameter | Frozen)


def resolve(model: PyTree) -> PyTree:
    """The model in plain arrays: parameters replaced by their values, frozen ones cut off from derivatives.

    Resolving twice is the same as once.
    """

    def plain(node):
        if isinstance(node, Frozen):
            return jax.tree.map(_cut, resolve(node.value))
        return node.value if _is_parameter(node) else node

    return jax.tree.map(plain, model, is_leaf=_is_leaf)


def _cut(leaf: Any) -> Any:
    return jax.lax.stop_gradient(leaf) if eqx.is_inexact_array(leaf) else leaf


def partition(model: PyTree) -> tuple[PyTree, PyTree]:
    """The free arrays that learn, and the rest; `equinox.combine` puts them together again.

    A bare floating array learns, except in an integrator and in an `AbstractKnown`, such as a noise or an
    initial distribution.
    """
    return eqx.partition(model, _learns(model, known=False))


def _learns(tree: PyTree, known: bool) -> PyTree:
    """True at every array that learns, in the shape of `tree`."""

    def stops(node):
        return node is not tree and (_is_leaf(node) or isinstance(node, _KNOWN))

    def mark(node):
        if isinstance(node, Frozen):
            return jax.tree.map(lambda _: False, node)
        if _is_parameter(node):
            return eqx.tree_at(lambda p: p.free, jax.tree.map(lambda _: False, node), True)
        if isinstance(node, _KNOWN):
            return _learns(node, known=True)
        return not known and eqx.is_inexact_array(node)

    if _is_leaf(tree):
        return mark(tree)
    return jax.tree.map(mark, tree, is_leaf=stops)


def named_parameters(model: PyTree) -> dict[str, Any]:
    """The leaves that learn, bare arrays or parameters, by their path:
    `"process_noise.structure.variance"`."""
    spec = _learns(model, known=False)
    marked = jax.tree.map(
        lambda node, learns: node if any(jax.tree.leaves(learns)) else None, model, spec, is_leaf=_is_leaf
    )
    leaves = jax.tree_util.tree_flatten_with_path(marked, is_leaf=_is_parameter)[0]
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def value_of(leaf: Any) -> Array:
    """The value of a leaf that learns, bare or wrapped."""
    return leaf.value if _is_parameter(leaf) else leaf


def log_jacobian_of(leaf: Any) -> Float[Array, ""]:
    """log |d value / d free| of a leaf that learns; 0 for a bare array."""
    return leaf.log_jacobian() if _is_parameter(leaf) else jnp.zeros(())


Flattened = tuple[Float[Array, " parameter"], Callable[[Array], PyTree]]


def flatten(model: PyTree) -> Flattened:
    """The free coordinates of a model as one vector, and the function from such a vector back to the
    model."""
    learnt, rest = partition(model)
    vector, unravel = ravel_pytree(learnt)
    return vector, lambda free: eqx.combine(unravel(free), rest)
