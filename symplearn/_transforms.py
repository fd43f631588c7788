"""How a mean and a covariance pass through a function: unscented, cubature, Gauss-Hermite and Taylor moments.

One interface: `transform(function, mean, root)` with Var[x] = root root' gives `Moments`, whose covariances are
products of factors and so cannot lose positive definiteness. Dissertation (2.6)-(2.7), Algorithm 5 corrected.
"""

import abc
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._counts import refuse_count
from ._small_products import product

# Points of a Gauss-Hermite grid beyond which a particle filter would be the better tool.
_MOST_POINTS = 50_000


class Moments(NamedTuple):
    """The joint first two moments of x and f(x).

    E[f] = `mean`, Var[f] = `factor factor'`, Cov[x, f] = `source factor'`, Var[x] = `source source'`; `factor` is
    (output, column), `source` (state, column).
    """

    mean: Float[Array, " output"]
    factor: Float[Array, "output column"]
    source: Float[Array, "state column"]

    @property
    def covariance(self) -> Float[Array, "output output"]:
        """Var[f]."""
        return product(self.factor, self.factor.T)


class Images:
    """A function with a way of its own, which may be None, to its images of many points at once, side by side."""

    def __init__(self, function: Callable[[Any], Any], side_by_side: Callable[[Any], Any] | None = None):
        self.function, self.own = function, side_by_side

    def __call__(self, x: Float[Array, " state"]) -> Float[Array, " output"]:
        return self.function(x)

    def side_by_side(self, points: Float[Array, "state point"]) -> Float[Array, "output point"]:
        """The images of the columns."""
        return (self.own or jax.vmap(self.function, in_axes=1, out_axes=1))(points)


def _images(function: Callable[[Any], Any], points: Float[Array, "state point"]) -> Float[Array, "output point"]:
    return (function if isinstance(function, Images) else Images(function)).side_by_side(points)


def with_noise(moments: Moments, *factors: Float[Array, "output _"]) -> Moments:
    """The moments with independent noise added: more columns in the factor, none of them from x."""
    extra = [jnp.zeros((moments.source.shape[0], factor.shape[1])) for factor in factors]
    factor = jnp.concatenate([moments.factor, *factors], axis=1)
    return Moments(moments.mean, factor, jnp.concatenate([moments.source, *extra], axis=1))


class AbstractTransform(eqx.Module):
    """A rule for the moments of a function of a Gaussian."""

    @abc.abstractmethod
    def __call__(
        self,
        function: Callable[[Any], Any],
        mean: Float[Array, " state"],
        root: Float[Array, "state state"],
    ) -> Moments:
        """The moments of `function(x)` for x with this mean and the covariance root root'."""


class UnscentedTransform(AbstractTransform):
    """The scaled unscented transform with 2d + 1 sigma points. Wan and van der Merwe (2000); Algorithm 5.

    The default is well conditioned. The dissertation uses (1e-3, 2, 0), whose weights of about 1e6 cost some
    six digits. The moments are summed over differences from the centre point, and beta >= alpha**2 keeps
    every covariance positive semi-definite.

    **Raises:** `ValueError` where alpha <= 0 or beta < alpha**2.
    """

    alpha: float = eqx.field(static=True, default=1.0)
    beta: float = eqx.field(static=True, default=2.0)
    kappa: float = eqx.field(static=True, default=0.0)

    def __check_init__(self):
        if self.alpha <= 0 or self.beta < self.alpha**2:
            raise ValueError(
                f"`UnscentedTransform` needs alpha > 0 and beta >= alpha**2, but was given "
                f"alpha={self.alpha}, beta={self.beta}. Use the default (1, 2, 0) or (1e-3, 2, 0)."
            )

    def spread(self, dim: int) -> float:
        """d + lambda = alpha^2 (d + kappa), the squared stretch of the sigma points."""
        if dim + self.kappa <= 0:
            raise ValueError(f"`UnscentedTransform` needs dim + kappa > 0, but dim={dim}, kappa={self.kappa}.")
        return self.alpha**2 * (dim + self.kappa)

    def __call__(self, function, mean, root) -> Moments:
        dim = mean.shape[0]
        centre, half = mean[:, None], math.sqrt(self.spread(dim)) * root
        outputs = _images(function, jnp.concatenate([centre, centre + half, centre - half], axis=1))
        deviations = outputs[:, 1:] - outputs[:, :1]
        weight = 0.5 / self.spread(dim)
        shift = weight * jnp.sum(deviations, axis=1)
        # sum_i w_i (D_i - shift)(D_i - shift)' with sum_i w_i = 2 + beta - alpha^2 and a zero centre difference.
        rest = math.sqrt(self.beta - self.alpha**2) * shift
        odd, even = _halves(deviations, math.sqrt(weight))
        return _collected(outputs[:, 0] + shift, root, odd, even, rest[:, None])


STANDARD = UnscentedTransform()


class Cubature(AbstractTransform):
    """The third-degree spherical cubature rule with 2d points of equal weight. Arasaratnam and Haykin (2009).

    The unscented transform at (1, 0, 0), whose beta the unscented one refuses: here the sum of squares is written about
    the mean, so it stays positive.
    """

    def __call__(self, function, mean, root) -> Moments:
        dim = mean.shape[0]
        centre, half = mean[:, None], math.sqrt(dim) * root
        outputs = _images(function, jnp.concatenate([centre + half, centre - half], axis=1))
        average = jnp.mean(outputs, axis=1)
        odd, even = _halves(outputs - average[:, None], math.sqrt(0.5 / dim))
        return _collected(average, root, odd, even)


class Taylor(AbstractTransform):
    """First-order Taylor: the mean's image and the Jacobian at the mean, the extended Kalman filter's moments.

    Exact for an affine function.
    """

    def __call__(self, function, mean, root) -> Moments:
        image, push = jax.linearize(function, mean)
        return Moments(image, jax.vmap(push, in_axes=1, out_axes=1)(root), root)


class GaussHermite(AbstractTransform):
    """The product rule of `order` points a dimension, exact for polynomials of degree 2 order - 1 in each variable.

    It takes order^d points: for few dimensions.

    **Raises:** `InputError` where the order is no whole number of at least 2; `ValueError` where the grid has more than
    50,000 points.
    """

    order: int = eqx.field(static=True, default=5)

    def __check_init__(self):
        refuse_count("GaussHermite", "order", self.order, least=2)

    def __call__(self, function, mean, root) -> Moments:
        dim = mean.shape[0]
        if self.order**dim > _MOST_POINTS:
            raise ValueError(
                f"`GaussHermite({self.order})` takes {self.order}^{dim} points in {dim} dimensions; use `Cubature` or "
                "`UnscentedTransform`."
            )
        nodes, roots = _hermite_grid(self.order, dim)
        offsets = product(root, jnp.asarray(nodes.T))
        outputs = _images(function, mean[:, None] + offsets)
        average = product(outputs, jnp.asarray(roots**2))
        factor = jnp.asarray(roots) * (outputs - average[:, None])
        return Moments(average, factor, jnp.asarray(roots) * offsets)


@functools.cache
def _hermite_grid(order: int, dim: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (point, dim) of the standard normal and the square roots of their weights."""
    x, w = np.polynomial.hermite_e.hermegauss(order)
    grid = np.stack(np.meshgrid(*[x] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
    weights = np.stack(np.meshgrid(*[w / w.sum()] * dim, indexing="ij"), axis=-1).reshape(-1, dim).prod(axis=1)
    return grid, np.sqrt(weights)


def _halves(deviations: Array, root_weight: float) -> tuple[Array, Array]:
    """Columns of the odd and the even part of opposite points: x correlates with the odd ones only."""
    plus, minus = jnp.split(deviations, 2, axis=1)
    scale = root_weight / math.sqrt(2.0)
    return scale * (plus - minus), scale * (plus + minus)


def _collected(mean: Array, root: Array, odd: Array, *rest: Array) -> Moments:
    return with_noise(Moments(mean, odd, root), *rest)
