"""Square roots of covariances: triangular factors that exist for singular covariances too, without LAPACK's.

Small matrices a column at a time. For them a call of LAPACK costs more than the arithmetic, its QR has no derivative
where the rank is deficient, as with a state that is known exactly, and batches of a hundred thousand of its solves were
seen to hang on two cores (jaxlib 0.10.2).
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ._small_products import product

# In double precision; another's are as many times its own round-off.
# Squared length of what is left of a row, over that of the row: below it, only round-off is left.
_SPENT = 1e-26
# A pivot below this share of its diagonal entry is round-off of a singular covariance: its column is dropped.
_SINGULAR = 1e-14
# A dropped column of a semidefinite matrix is at most 1e-7 of the diagonal; ten times more is an indefinite matrix.
_INDEFINITE = 1e-6
# Loops over the columns of a small matrix are laid out flat up to this size, which XLA fuses better.
_FLAT = 16
# Up to so many rows an orthogonalisation is laid out flat, too; with 16 its gradient took twice as long as in a loop.
_FEW_ROWS = 12
# Beyond so many rows whole panels of them are freed of each other by products, 804 rows 13 times as fast as row by row.
_MANY_ROWS, _PANEL = 128, 32
# Beyond so many a triangle no longer fits the fast memory, and LAPACK's inverse of 804 rows took a sixth of the loop's.
_LARGE = 512


def _coarser(array: Array) -> float:
    """The round-off of an array's numbers, over that of double precision."""
    return float(jnp.finfo(array.dtype).eps / jnp.finfo(np.float64).eps)


def triangularise(rows: Float[Array, "size column"]) -> tuple[Float[Array, "size size"], Bool[Array, " size"]]:
    """The lower triangular L with L L' = rows rows', and which of its pivots are not zero.

    By modified Gram-Schmidt on the rows, as accurate for L as Householder's QR (Bjorck 1967), so the covariance L L' is
    positive semidefinite whatever happens. A row that depends on those before it gets a zero column.
    """
    triangle, _, good = _orthogonalised(rows)
    return triangle, good


@jax.custom_jvp
def _orthogonalised(rows: Array) -> tuple[Array, Array, Array]:
    """L, the orthonormal Q (size, column) with rows = L Q, zero where a pivot is, and which pivots are not."""
    size = rows.shape[0]
    if size > _MANY_ROWS:
        return _panel_by_panel(rows)
    return _row_by_row(rows) if size <= _FEW_ROWS else _column_by_column(rows, jnp.sum(rows**2, axis=1))


@_orthogonalised.defjvp
def _(primals, tangents):
    """With M = L^-1 dA Q' the directions turn by T - T', T the transpose of M's strict upper triangle.

    Walter & Lehmann, arXiv:1001.1654, have it for QR. Going back through the orthogonalisation instead took four times
    as long in a batch of 64.
    """
    triangle, directions, good = _orthogonalised(*primals)
    size, inverse = len(good), _inverse(triangle, good)
    along = product(tangents[0], directions.T)
    turned = jnp.where(np.tri(size, k=-1, dtype=bool), product(inverse, along).T, 0.0)
    lower = np.tri(size, dtype=bool) & good
    of_triangle = jnp.where(lower, along + product(triangle, turned - turned.T), 0.0)
    of_directions = product(inverse, tangents[0] - product(of_triangle, directions))
    return (triangle, directions, good), (of_triangle, of_directions, np.zeros(good.shape, jax.dtypes.float0))


def _row_by_row(rows):
    """For few rows, laid out flat: each is freed of those before it."""
    triangle: list[Array] = []
    directions: list[Array] = []
    good: list[Array] = []
    spent = _SPENT * _coarser(rows) ** 2
    for rest in rows:
        # Rows of very different size are the rule, a precise channel beside a coarse one: each is judged by its own.
        scale = jnp.sum(rest * rest)
        entries = []
        for direction in directions:
            entries.append(jnp.sum(rest * direction))
            rest = rest - entries[-1] * direction
        square = jnp.sum(rest * rest)
        good.append(square > spent * scale)
        length = jnp.sqrt(jnp.where(good[-1], square, 1.0))
        directions.append(jnp.where(good[-1], rest / length, 0.0))
        later = [jnp.zeros_like(length)] * (len(rows) - len(good))
        triangle.append(jnp.stack([*entries, jnp.where(good[-1], length, 0.0), *later]))
    return jnp.stack(triangle), jnp.stack(directions), jnp.stack(good)


def _column_by_column(rows, scales):
    """For more rows: each frees all later ones of itself. `scales` are the squared lengths that they began with."""
    size, spent = rows.shape[0], _SPENT * _coarser(rows) ** 2

    def column(rest, data):
        j, here, below, scale = data
        row = _entry(rest, j)
        square = product(row, row)
        good = square > spent * scale
        length = jnp.sqrt(jnp.where(good, square, 1.0))
        direction = jnp.where(good, row / length, 0.0)
        entries = jnp.where(below, product(rest, direction), 0.0)
        entries = jnp.where(here & good, length, entries)
        return rest - jnp.outer(entries, direction), (entries, direction, good)

    data = np.arange(size), np.eye(size, dtype=bool), np.tri(size, k=-1, dtype=bool).T, scales
    _, (columns, directions, good) = jax.lax.scan(column, rows, data)
    return columns.T, directions, good


def _panel_by_panel(rows):
    """For very many: each panel, orthogonalised by itself, frees all later rows of itself at once.

    Block Gram-Schmidt with the modified one inside (Barlow 2019), as accurate for L as that by single rows.
    """
    size, columns = rows.shape
    number = -(-size // _PANEL)
    # Rows of zeros make the last panel whole: their pivots are zero.
    rows = jnp.concatenate([rows, jnp.zeros((number * _PANEL - size, columns), rows.dtype)])
    scales = jnp.sum(rows**2, axis=1)

    def panel(rest, first):
        own = jax.lax.dynamic_slice_in_dim(rest, first, _PANEL)
        inner, directions, good = _column_by_column(own, jax.lax.dynamic_slice_in_dim(scales, first, _PANEL))
        later = (np.arange(len(rest)) >= first + _PANEL)[:, None]
        entries = jnp.where(later, product(rest, directions.T), 0.0)
        triangle = jax.lax.dynamic_update_slice_in_dim(entries, inner, first, 0)
        return rest - product(entries, directions), (triangle, directions, good)

    _, (triangles, directions, good) = jax.lax.scan(panel, rows, _PANEL * np.arange(number))
    triangle = jnp.swapaxes(triangles, 0, 1).reshape(len(rows), -1)
    return triangle[:size, :size], directions.reshape(-1, columns)[:size], good.reshape(-1)[:size]


def _inverse(L, good):
    """L^-1, with zeros in the rows of zero pivots, whose columns are zero in L."""
    size = L.shape[0]
    if size > _LARGE:
        unit = np.eye(size, dtype=L.dtype)
        whole = jnp.where((unit > 0) & ~good, 1.0, L)
        return jnp.where(good[:, None], jax.scipy.linalg.solve_triangular(whole, unit, lower=True), 0.0)
    if size > _FEW_ROWS:
        return _inverse_in_a_loop(L, good)
    rows: list[Array] = []
    for j, unit in enumerate(np.eye(size, dtype=L.dtype)):
        rest = unit
        for k in range(j):
            rest = rest - L[j, k] * rows[k]
        # Entry by entry: with all pivots from one sum, a batch of 64 filters took half as long again.
        rows.append(jnp.where(good[j], rest / jnp.where(good[j], L[j, j], 1.0), 0.0))
    return jnp.stack(rows)


def _inverse_in_a_loop(L, good):
    size = L.shape[0]
    pivots = jnp.where(good, jnp.diagonal(L), 1.0)

    def row(found, data):
        j, below, unit, pivot, fine = data
        new = jnp.where(fine, (unit - product(below, found)) / pivot, 0.0)
        return jax.lax.dynamic_update_index_in_dim(found, new, j, 0), None

    data = np.arange(size), jnp.tril(L, -1), np.eye(size, dtype=L.dtype), pivots, good
    return jax.lax.scan(row, jnp.zeros_like(L), data)[0]


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

    A column whose pivot is below 1e-14 of its diagonal entry, in double precision, is set to zero, together with its
    derivative. A matrix that is clearly indefinite gives NaN, which the filter reports.
    """
    size = covariance.shape[0]
    order = np.arange(size)
    singular, indefinite = _SINGULAR * _coarser(covariance), _INDEFINITE * _coarser(covariance) ** 0.5
    scales = jax.lax.stop_gradient(jnp.abs(jnp.diagonal(covariance)))

    def column(rest, j):
        # `rest` stays symmetric.
        row, scale = _entry(rest, j), _entry(scales, j)
        pivot, below = _entry(row, j), jnp.where(order >= j, row, 0.0)
        good = pivot > singular * scale
        spoilt = ~good & jnp.any(jnp.abs(below) > indefinite * jnp.sqrt(scales * scale))
        root = jnp.sqrt(jnp.where(good, pivot, 1.0))
        entries = jnp.where(good, below / root, jnp.where(spoilt, jnp.nan, 0.0))
        return rest - jnp.outer(entries, entries), entries

    return jax.lax.scan(column, covariance, np.arange(size))[1].T
