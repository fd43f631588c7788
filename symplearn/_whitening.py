"""Where a sampler starts: the mode, and coordinates in which the density is about as wide in every direction."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._errors import InputError
from ._faults import IMPOSSIBLE
from ._log_posterior import gradient

# A width is measured where the log density has fallen by this: two standard deviations of a normal density.
_DROP = 2.0
# Widths are looked for at these multiples of the Hessian's.
_MULTIPLES = 2.0 ** np.arange(-8, 15)
# Differences of gradients do not resolve eigenvalues below a relative 1e-10.
_RESOLVED = 1e-10


class Whitening(eqx.Module):
    """Coordinates z with free = centre + root z, in which the density is roughly a standard normal one.

    `root` (parameter, parameter) is a square root of the covariance. `repaired` counts directions in which the
    Hessian is of no use, as where the density runs on to the edge of a range; their widths are measured on the
    density itself, and `statement` says so.
    """

    centre: Float[Array, " parameter"]
    root: Float[Array, "parameter parameter"]
    repaired: int = 0
    statement: str = ""

    def free(self, z: Float[Array, "*batch parameter"]) -> Float[Array, "*batch parameter"]:
        """The free coordinates of whitened ones."""
        return self.centre + z @ self.root.T

    def white(self, free: Float[Array, "*batch parameter"]) -> Float[Array, "*batch parameter"]:
        """The whitened coordinates of free ones."""
        return jnp.linalg.solve(self.root, (free - self.centre).reshape(-1, self.centre.size).T).T.reshape(free.shape)

    @property
    def log_volume(self) -> Float[Array, ""]:
        """log |d free / d z|."""
        return jnp.linalg.slogdet(self.root)[1]


def whiten(density: Any, centre: Float[Array, " parameter"]) -> Whitening:
    """Coordinates for a density around its mode `centre`, by its Hessian and by its fall along the Hessian's axes.

    Where the Hessian holds, the covariance is Laplace's. It does not hold at the kink of a Laplace prior, on a ridge
    or where the density falls more slowly than a normal one, as towards a vanishing process noise. So the distance at
    which it falls by two nats is measured along both ways of every axis, and the longer one counts.

    **Raises:** `InputError` where the density is not finite at the centre.
    """
    height, hessian = _curvature(density, centre)
    _refuse(height)
    axes, bad = _axes(np.asarray(hessian))
    widths, open_ended = _widths(density, centre, axes, height)
    repaired = int(np.sum(bad))
    return Whitening(centre, axes * widths, repaired, _statement(repaired, int(np.sum(open_ended)), centre.size))


def standard(density: Any, size: int) -> Whitening:
    """The coordinates of a density that is about a standard normal one; it is only looked at where it falls.

    **Raises:** `InputError` where the density is not finite at 0.
    """
    centre, axes = jnp.zeros(size), jnp.eye(size)
    height = _height(density, centre)
    _refuse(height)
    _, open_ended = _widths(density, centre, axes, height)
    return Whitening(centre, axes, 0, _statement(0, int(np.sum(open_ended)), size))


def _refuse(height: Array) -> None:
    if not bool(jnp.isfinite(height)) or float(height) < 0.5 * IMPOSSIBLE:
        raise InputError(f"The log density is {float(height):.3g} at the start; start where it is finite.")


@eqx.filter_jit
def _height(density, centre):
    return density(centre)


@eqx.filter_jit
def _curvature(density, centre):
    """The density's value, and the Hessian of minus it by central differences of its exact gradient, in two passes."""
    size = centre.size
    slope = gradient(lambda x: -density(x), size)

    def differences(steps):
        # One after the other: a batch of gradients takes twice as long to compile.
        offsets = jnp.concatenate([jnp.diag(steps), -jnp.diag(steps)])
        slopes = jax.lax.map(lambda offset: slope(centre + offset), offsets)
        return (slopes[:size] - slopes[size:]) / (2 * steps[:, None])

    def both(steps, _):
        rows = differences(steps)
        crude = jnp.diagonal(rows)
        # A thousandth of a standard deviation leaves a relative error of about 1e-7.
        good = crude > 0
        return jnp.where(good, 1e-3 / jnp.sqrt(jnp.where(good, crude, 1.0)), 1e-4), rows

    _, rows = jax.lax.scan(both, jnp.full(size, 1e-4), length=2)
    return density(centre), 0.5 * (rows[-1] + rows[-1].T)


def _axes(hessian: np.ndarray) -> tuple[Array, np.ndarray]:
    """The Hessian's axes as columns, each one standard deviation long, and which of them are of no use."""
    hessian = np.where(np.isfinite(hessian), hessian, 0.0)
    scales = np.sqrt(np.maximum(np.abs(np.diagonal(hessian)), 1e-6))
    eigenvalues, vectors = np.linalg.eigh(hessian / np.outer(scales, scales))
    bad = eigenvalues < _RESOLVED * max(eigenvalues[-1], 0.0)
    lengths = 1.0 / np.sqrt(np.maximum(np.abs(eigenvalues), np.where(bad, 1e-4, 1e-12)))
    return jnp.asarray(vectors / scales[:, None] * lengths), bad


@eqx.filter_jit
def _falls(density, centre, axes, height):
    """How far the log density has fallen, (axis, way, multiple)."""
    multiples = jnp.asarray(_MULTIPLES)
    steps = axes.T[:, None, None, :] * jnp.asarray([1.0, -1.0])[:, None, None] * multiples[:, None]
    values = jax.vmap(density)(centre + steps.reshape(-1, centre.size)).reshape(steps.shape[:3])
    return jnp.where(jnp.isfinite(values), height - values, jnp.inf)


def _widths(density: Any, centre: Array, axes: Array, height: Array) -> tuple[np.ndarray, np.ndarray]:
    """Half the distance of a fall by two nats, in units of the axes, and where there is no such fall."""
    falls = np.asarray(_falls(density, centre, axes, height))
    gone = np.asarray(falls > _DROP)
    first = np.where(gone.any(axis=2), gone.argmax(axis=2), len(_MULTIPLES) - 1)
    ways = np.indices(first.shape)
    # The square root of the fall of a normal density is linear in the distance.
    before = np.maximum(falls[*ways, np.maximum(first - 1, 0)], 0.0) ** 0.5
    after = np.minimum(falls[*ways, first], 1e6) ** 0.5
    near, far = _MULTIPLES[np.maximum(first - 1, 0)], _MULTIPLES[first]
    share = np.clip((_DROP**0.5 - before) / np.maximum(after - before, 1e-9), 0.0, 1.0)
    distance = near + share * (far - near)
    return np.max(distance, axis=1) / 2.0, ~np.all(np.any(gone, axis=2), axis=1)


def _statement(repaired: int, open_ended: int, size: int) -> str:
    parts = []
    if repaired:
        parts.append(
            f"The Hessian at the start is not positive definite in {repaired} of {size} directions: there the "
            "sampler's scale is where the log posterior falls by two nats."
        )
    if open_ended:
        parts.append(
            f"The log posterior does not fall along {open_ended} of {size} directions: it may not be a proper density; "
            "give every leaf a proper prior."
        )
    return " ".join(parts)
