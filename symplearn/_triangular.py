"""Square roots of covariances: triangular factors that exist for singular covariances too, without LAPACK.

Small matrices a column at a time. For them a call of LAPACK costs more than the arithmetic, its QR has no derivative
where the rank is deficient, as with a state that is known exactly, and batches of a hundred thousand of its solves were
seen to hang on two cores (jaxlib 0.10.2).
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ._small_products import product

# Squared length of what is left of a row, over that of the row: below it, only round-off is left.
_SPENT = 1e-26
# A pivot below this share of its diagonal entry is round-off of a singular covariance: its column is dropped.
_SINGULAR = 1e-14
# A dropped column of a semidefinite matrix is at most 1e-7 of the diagonal; ten times more is an indefinite matrix.
_INDEFINITE = 1e-6
# Loops over the columns of a small matrix are laid out flat up to this size, which XLA fuses better.
_FLAT = 16


def triangularise(rows: Float[Array, "size column"]) -> tuple[Float[Array, "size size"], Bool[Array, " size"]]:
    """The lower triangular L with L L' = rows rows', and which of its pivots are not zero.

    By modified Gram-Schmidt on the rows, as accurate for L as Householder's QR (Bjorck 1967), so the covariance L L' is
    positive semidefinite whatever happens. A row that depends on those before it gets a zero column.
    """
    size = rows.shape[0]

    def column(rest, data):
        j, here, below, scale = data
        row = _entry(rest, j)
        square = product(row, row)
        good = square > _SPENT * scale
        length = jnp.sqrt(jnp.where(good, square, 1.0))
        direction = jnp.where(good, row / length, 0.0)
        entries = jnp.where(below, product(rest, direction), 0.0)
        entries = jnp.where(here & good, length, entries)
        return rest - jnp.outer(entries, direction), (entries, good)

    # Rows of very different size are the rule (a precise channel beside a coarse one), so each is judged by its own.
    scales = jax.lax.stop_gradient(jnp.sum(rows**2, axis=1))
    # Constants, or XLA would compute them anew at each call.
    data = np.arange(size), np.eye(size, dtype=bool), np.tri(size, k=-1, dtype=bool).T, scales
    _, (columns, good) = jax.lax.scan(column, rows, data, unroll=min(size, _FLAT))
    return columns.T, good


def _entry(array: Array, j: Array) -> Array:
    """array[j], for a j that is not negative: its sign would be computed each time, by a kernel of its own."""
    return jax.lax.dynamic_index_in_dim(array, j, keepdims=False, allow_negative_indices=False)


def forward_substitution(L: Float[Array, "size size"], vector: Float[Array, " size"]) -> Float[Array, " size"]:
    """L^-1 vector; a zero on the diagonal counts as 1, for a channel that is missing."""
    size = L.shape[0]

    def entry(rest, data):
        j, below = data
        pivot = _entry(below, j)
        value = _entry(rest, j) / jnp.where(pivot > 0.0, pivot, 1.0)
        return rest - value * below, value

    return jax.lax.scan(entry, vector, (np.arange(size), L.T), unroll=min(size, _FLAT))[1]


def lower_inverse(L: Float[Array, "size size"]) -> Float[Array, "size size"]:
    """L^-1, by substitution for each column of the identity."""
    return jax.vmap(forward_substitution, in_axes=(None, 1), out_axes=1)(L, jnp.eye(L.shape[0], dtype=L.dtype))


def semidefinite_cholesky(covariance: Float[Array, "state state"]) -> Float[Array, "state state"]:
    """Lower Cholesky factor of a covariance that may be singular, or zero; differentiable.

    A column whose pivot is below 1e-14 of its diagonal entry is set to zero, together with its derivative. A matrix
    that is clearly indefinite gives NaN, which the filter reports.
    """
    size = covariance.shape[0]
    order = np.arange(size)
    scales = jax.lax.stop_gradient(jnp.abs(jnp.diagonal(covariance)))

    def column(rest, j):
        # `rest` stays symmetric.
        row, scale = _entry(rest, j), _entry(scales, j)
        pivot, below = _entry(row, j), jnp.where(order >= j, row, 0.0)
        good = pivot > _SINGULAR * scale
        spoilt = ~good & jnp.any(jnp.abs(below) > _INDEFINITE * jnp.sqrt(scales * scale))
        root = jnp.sqrt(jnp.where(good, pivot, 1.0))
        entries = jnp.where(good, below / root, jnp.where(spoilt, jnp.nan, 0.0))
        return rest - jnp.outer(entries, entries), entries

    return jax.lax.scan(column, covariance, np.arange(size))[1].T
