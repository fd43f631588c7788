"""Prior densities over what a model learns, in nats. Dissertation sec. 2.1 for the conventions."""

import abc
import math
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from ._errors import InputError
from ._guard import guard
from ._parameters import (
    AbstractMatrixParameter,
    Correlation,
    PositiveDefinite,
    log_jacobian_of,
    named_parameters,
    require,
    resolve,
    value_of,
)


class AbstractDensity(eqx.Module):
    """A density over the value of a leaf."""

    @abc.abstractmethod
    def log_density(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        """The log density in nats, in parts that add up: of each entry, or of the whole. -inf outside the support."""


class AbstractEntrywise(AbstractDensity):
    """A density over one number; entries of an array are independent."""


class AbstractMatrixDensity(AbstractDensity):
    """A density over a symmetric matrix, with respect to its entries on and below the diagonal."""

    @abc.abstractmethod
    def suits(self, leaf: Any) -> bool:
        """Whether the leaf learns in the coordinates that the density is over."""


class Normal(AbstractEntrywise):
    """N(mean, variance): the second number is the variance, not the standard deviation."""

    mean: Any = eqx.field(converter=jnp.asarray, default=0.0)
    variance: Any = eqx.field(converter=jnp.asarray, default=1.0)

    def __check_init__(self):
        require(self.variance > 0, "`Normal` needs a positive variance, its second number.")
        require(jnp.isfinite(self.mean), "`Normal` needs a finite mean, its first number.")

    def log_density(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        return -0.5 * ((value - self.mean) ** 2 / self.variance + jnp.log(2 * math.pi * self.variance))


class Laplace(AbstractEntrywise):
    """The double exponential with density exp(-|x| / scale) / (2 scale); its MAP is an L1 penalty."""

    scale: Any = eqx.field(converter=jnp.asarray, default=1.0)

    def __check_init__(self):
        require(self.scale > 0, "`Laplace` needs a positive scale.")

    def log_density(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        return -jnp.abs(value) / self.scale - jnp.log(2 * self.scale)


class HalfNormal(AbstractEntrywise):
    """|x| for x ~ N(0, variance): `variance` is that of the underlying normal, as half-N(0, V) in the
    dissertation; libraries that ask for a scale want its square root."""

    variance: Any = eqx.field(converter=jnp.asarray, default=1.0)

    def __check_init__(self):
        require(self.variance > 0, "`HalfNormal` needs a positive variance, that of the underlying normal.")

    def log_density(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        inside = 0.5 * jnp.log(2 / (math.pi * self.variance)) - value**2 / (2 * self.variance)
        return jnp.where(value >= 0, inside, -jnp.inf)


class Flat(AbstractDensity):
    """The improper density 1 over the value: over v itself, not log v, for a `Positive` leaf."""

    def log_density(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        return jnp.zeros_like(value)


class InverseWishart(AbstractMatrixDensity):
    """The inverse Wishart density of a `PositiveDefinite` matrix; its mean is scale / (dof - dim - 1).

    **Arguments:** `dof` - above dim - 1; `scale` (dim, dim), symmetric and positive definite.

    **Raises:** `InputError` where they are not.
    """

    dof: Any = eqx.field(converter=jnp.asarray)
    scale: Any = eqx.field(converter=jnp.asarray)

    def __check_init__(self):
        if self.scale.ndim != 2 or self.scale.shape[0] != self.scale.shape[1]:
            raise InputError(f"`InverseWishart` needs a scale of shape (dim, dim), but was given {self.scale.shape}.")
        spread = jnp.all(jnp.isfinite(jnp.linalg.cholesky(self.scale))) & jnp.allclose(self.scale, self.scale.T)
        require(
            (self.dof > self.scale.shape[0] - 1) & spread,
            "`InverseWishart` needs a dof above dim - 1 and a symmetric, positive definite scale.",
        )

    def suits(self, leaf: Any) -> bool:
        return isinstance(leaf, PositiveDefinite) and leaf.dim == self.scale.shape[0]

    def log_density(self, value: Float[Array, "dim dim"]) -> Float[Array, ""]:
        dim, half = value.shape[0], 0.5 * self.dof
        L, inside = _cholesky(value)
        root = jnp.linalg.cholesky(self.scale)
        whitened = jax.scipy.linalg.solve_triangular(L, root, lower=True)
        norm = half * (_log_det(root) - dim * math.log(2)) - jax.scipy.special.multigammaln(half, dim)
        density = norm - (half + 0.5 * (dim + 1)) * _log_det(L) - 0.5 * jnp.sum(whitened**2)
        return jnp.where(inside, density, -jnp.inf)


class LKJ(AbstractMatrixDensity):
    """The density of a `Correlation`, proportional to det^(concentration - 1); 1 is uniform over the matrices.

    Lewandowski, Kurowicka and Joe (2009), with their normalisation (16).

    **Raises:** `InputError` where the concentration is not positive.
    """

    concentration: Any = eqx.field(converter=jnp.asarray, default=1.0)

    def __check_init__(self):
        require(self.concentration > 0, "`LKJ` needs a positive concentration.")

    def suits(self, leaf: Any) -> bool:
        return isinstance(leaf, Correlation)

    def log_density(self, value: Float[Array, "dim dim"]) -> Float[Array, ""]:
        L, inside = _cholesky(value)
        left = jnp.arange(value.shape[0] - 1, 0, -1)
        beta = self.concentration + 0.5 * (left - 1)
        powers = (2 * self.concentration - 2 + left) * left
        norm = powers.sum() * math.log(2) + left @ jax.scipy.special.betaln(beta, beta)
        return jnp.where(inside, (self.concentration - 1) * _log_det(L) - norm, -jnp.inf)


def _cholesky(matrix: Array) -> tuple[Array, Array]:
    """The factor of a matrix, and whether it has one; without one the identity's, with derivative 0."""
    inside = jnp.all(jnp.isfinite(jnp.linalg.cholesky(jax.lax.stop_gradient(matrix))))
    return jnp.linalg.cholesky(jnp.where(inside, matrix, jnp.eye(matrix.shape[0]))), inside


def _log_det(L: Array) -> Array:
    """log det L L'."""
    return 2 * jnp.sum(jnp.log(jnp.diagonal(L)))


class LogDensity(AbstractDensity):
    """Any log density of the user's: `LogDensity(lambda v: jax.scipy.stats.gamma.logpdf(v, 2.0))`.

    `function` maps the value of a leaf (a variance, not its logarithm) to nats, one number or one for each entry, by
    functions that JAX can differentiate. NaN counts as -inf, as of the logarithm of a negative number, and a
    derivative that is not finite as 0.
    """

    function: Callable[[Any], Any]

    def log_density(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        return _no_nan(self.function(guard(value)))


def _no_nan(density: Any) -> Array:
    density = jnp.asarray(density, dtype=float)
    return jnp.where(jnp.isnan(density), -jnp.inf, density)


class Prior(eqx.Module):
    """A density for each leaf that learns, by the leaf's name or the beginning of it.

    `Prior({"dynamics": Laplace(0.1), "process_noise": HalfNormal(1.0)})`; the longest beginning wins. One
    density alone, as `Prior(Flat())`, is for every leaf.

    `joint`, if given, is a function of the model in plain arrays (see `resolve`) and multiplies the densities of the
    leaves by one of several together: it returns nats, as `LogDensity` does.

    **Raises:** `InputError`, in `log_density`, where a leaf has no density, or one of another kind or number of values,
    or where a name fits no leaf.
    """

    densities: dict[str, AbstractDensity]
    joint: Callable[[Any], Any] | None

    def __init__(
        self,
        densities: Mapping[str, AbstractDensity] | AbstractDensity,
        joint: Callable[[Any], Any] | None = None,
    ):
        self.densities = {"": densities} if isinstance(densities, AbstractDensity) else dict(densities)
        self.joint = joint

    def log_density(self, model: PyTree) -> Float[Array, ""]:
        """The log density of the free coordinates, in nats: of the values, with the Jacobian of the map."""
        leaves = named_parameters(model)
        self._refuse_unknown(leaves)
        total = jnp.zeros(())
        for name, leaf in leaves.items():
            density = self.density_of(name)
            _require_suitable(name, leaf, density)
            total += jnp.sum(_parts(name, leaf, density)) + log_jacobian_of(leaf)
        return total if self.joint is None else total + jnp.sum(_no_nan(self.joint(resolve(guard(model)))))

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


def _parts(name: str, leaf: Any, density: AbstractDensity) -> Array:
    """The log density of a leaf. More numbers than the leaf has entries are refused: they would count entries twice."""
    value = value_of(leaf)
    if not isinstance(density, AbstractEntrywise):
        return density.log_density(value)
    try:
        parts = density.log_density(value)
    except (TypeError, ValueError):  # shapes that do not broadcast
        parts = None
    if parts is None or jnp.shape(parts) != jnp.shape(value):
        raise InputError(
            f"`{name}` has the shape {jnp.shape(value)}, which the numbers of its `{type(density).__name__}` do not "
            "fit; give one number for all entries, or one for each."
        )
    return parts


def _require_suitable(name: str, leaf: Any, density: AbstractDensity) -> None:
    """Refuse a density of numbers over a matrix that learns as a whole, and the other way round."""
    numbers_over_matrix = isinstance(leaf, AbstractMatrixParameter) and isinstance(density, AbstractEntrywise)
    if numbers_over_matrix or (isinstance(density, AbstractMatrixDensity) and not density.suits(leaf)):
        raise InputError(
            f"`{name}` is a {type(leaf).__name__} of shape {jnp.shape(value_of(leaf))}, and "
            f"`{type(density).__name__}` is no density of it. `InverseWishart` is for `PositiveDefinite` of its size, "
            "`LKJ` for a `Correlation`, `LogDensity` and `Flat` are for anything, the others for numbers."
        )
