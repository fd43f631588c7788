"""Numbers that learn: positive, bounded, positive definite, frozen; an optimiser sees free real numbers."""

import abc
import math
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


def number(value: Any) -> Any:
    """A bare number or array in the working precision, which loops carry; what learns or is said to be known stays."""
    return value if isinstance(value, AbstractKnown | AbstractParameter) else jnp.asarray(value, dtype=float)


def require(holds: Any, sentence: str) -> None:
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

    **Raises:** `InputError` where an entry is not positive and finite.
    """

    free: Array

    def __init__(self, value: Any):
        value = jnp.asarray(value, dtype=float)
        require(jnp.isfinite(value), "`Positive` needs finite numbers, but was given NaN or infinity; give a start.")
        require(
            value > 0,
            "`Positive` needs positive numbers, but was given 0 or less; use `Learnt` for any sign.",
        )
        self.free = jnp.log(value)

    @property
    def value(self) -> Array:
        return jnp.exp(self.free)

    def log_jacobian(self) -> Float[Array, ""]:
        return jnp.sum(self.free)


class Bounded(AbstractParameter):
    """A number or array that learns between `lower` and `upper`, through its logit; it starts at `value`.

    **Raises:** `InputError` where a bound is not finite or an entry not strictly between the bounds.
    """

    free: Array
    lower: Array
    upper: Array

    def __init__(self, value: Any, lower: Any, upper: Any):
        value, lower, upper = (jnp.asarray(number, dtype=float) for number in (value, lower, upper))
        require(
            jnp.isfinite(lower) & jnp.isfinite(upper),
            "`Bounded` needs finite bounds, but one is infinite or no number; use `Positive` for a bound at 0 alone.",
        )
        require(
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


class AbstractMatrixParameter(AbstractParameter):
    """A symmetric matrix that learns as a whole: its entries have no densities of their own.

    Its density is over the entries on and below the diagonal that are free to move.
    """


class PositiveDefinite(AbstractMatrixParameter):
    """A symmetric positive definite matrix that learns: `Dense(PositiveDefinite(covariance))`. It starts at `value`.

    `free` holds the Cholesky factor L, value = L L': the logarithms of its diagonal, then what is below it, row by row
    (log-Cholesky; Pinheiro and Bates 1996).

    **Raises:** `InputError` where the matrix is not square, symmetric and positive definite.
    """

    free: Array

    def __init__(self, value: Any):
        L = _checked_cholesky(value, "PositiveDefinite")
        self.free = jnp.concatenate([jnp.log(jnp.diagonal(L)), L[jnp.tril_indices(L.shape[0], -1)]])

    @property
    def dim(self) -> int:
        """The matrix is of shape (dim, dim)."""
        return (math.isqrt(8 * self.free.shape[-1] + 1) - 1) // 2

    @property
    def value(self) -> Float[Array, "dim dim"]:
        diagonal, below = jnp.exp(self.free[: self.dim]), self.free[self.dim :]
        L = jnp.diag(diagonal).at[jnp.tril_indices(self.dim, -1)].set(below)
        return L @ L.T

    def log_jacobian(self) -> Float[Array, ""]:
        # dS/dL has the determinant 2^d prod L_ii^(d - i + 1), i = 1..d (Muirhead 1982, theorem 2.1.9).
        powers = jnp.arange(self.dim + 1, 1, -1)
        return self.dim * math.log(2) + powers @ self.free[: self.dim]


class Correlation(AbstractMatrixParameter):
    """A correlation matrix that learns: `Correlated(variances, Correlation(matrix))`. It starts at `value`.

    `free` holds the inverse hyperbolic tangents of its canonical partial correlations, row by row (Lewandowski,
    Kurowicka and Joe 2009).

    **Raises:** `InputError` where the matrix is not symmetric and positive definite with a diagonal of ones.
    """

    free: Array

    def __init__(self, value: Any):
        L = _checked_cholesky(value, "Correlation")
        require(
            jnp.abs(jnp.diagonal(jnp.asarray(value)) - 1.0) < 1e-12,
            "`Correlation` needs ones on the diagonal; divide by the standard deviations, or use `PositiveDefinite`.",
        )
        left = jnp.cumsum(L[:, ::-1] ** 2, axis=1)[:, ::-1]
        partial = L / jnp.sqrt(jnp.where(left > 0, left, 1.0))
        self.free = jnp.arctanh(partial[jnp.tril_indices(L.shape[0], -1)])

    @property
    def dim(self) -> int:
        """The matrix is of shape (dim, dim)."""
        return (math.isqrt(8 * self.free.shape[-1] + 1) + 1) // 2

    @property
    def value(self) -> Float[Array, "dim dim"]:
        partial = jnp.eye(self.dim).at[jnp.tril_indices(self.dim, -1)].set(jnp.tanh(self.free))
        L = partial * jnp.exp(0.5 * self._log_left())
        return (L @ L.T).at[jnp.diag_indices(self.dim)].set(1.0)

    def _log_left(self) -> Float[Array, "dim dim"]:
        """What the columns before j leave of the unit length of row i, squared, as a logarithm."""
        nothing = jnp.zeros((self.dim, self.dim))
        # log(1 - tanh(a)^2) without the difference of ones.
        spent = 2 * (math.log(2) - jnp.logaddexp(self.free, -self.free))
        spent = nothing.at[jnp.tril_indices(self.dim, -1)].set(spent)
        return jnp.cumsum(spent, axis=1) - spent

    def log_jacobian(self) -> Float[Array, ""]:
        left, below = 0.5 * self._log_left(), jnp.tril_indices(self.dim, -1)
        tanh = jnp.sum(2 * (math.log(2) - jnp.logaddexp(self.free, -self.free)))
        # From partial correlations to the rows of L, and from these to R = L L'; both maps are triangular.
        return tanh + jnp.sum(left[below]) + jnp.arange(self.dim - 1, -1, -1) @ jnp.diagonal(left)


def _checked_cholesky(value: Any, owner: str) -> Float[Array, "dim dim"]:
    matrix = jnp.asarray(value, dtype=float)
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or matrix.shape[0] == 0:
        raise InputError(f"`{owner}` needs a square matrix, but was given the shape {matrix.shape}.")
    L = jnp.linalg.cholesky(matrix)
    require(
        (jnp.abs(matrix - matrix.T) <= 1e-10 * jnp.max(jnp.abs(matrix))) & jnp.all(jnp.isfinite(L)),
        f"`{owner}` needs a symmetric positive definite matrix; `Dense` with a bare matrix takes a singular one.",
    )
    return L


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
