"""Whether matrices are what they are given for, and fit together: by shape, also inside a transformation."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._errors import InputError
from ._parameters import AbstractMatrixParameter, AbstractParameter, Frozen, Learnt

# Sums of products in single precision are off by some 1e-7 of the largest; of what is meant one way above the diagonal
# and another below it, no test can tell such errors.
_ROUND_OFF = 1e-6


def shape_of(given: Any) -> tuple[int, ...] | None:
    """The shape of a number or an array, bare or wrapped; None where it cannot be told."""
    given = _bare(given)
    if isinstance(given, AbstractMatrixParameter):
        return None if (dim := getattr(given, "dim", None)) is None else (dim, dim)
    if isinstance(given, AbstractParameter):
        return jnp.shape(given.free)
    return None if given is None or isinstance(given, eqx.Module) else np.shape(given)


def length_of(given: Any) -> int | None:
    """How many numbers the last axis has, as a vector or the columns of a matrix; None where it cannot be told."""
    shape = shape_of(given)
    return shape[-1] if shape else None


def _bare(given: Any) -> Any:
    """A number or an array without what keeps it from learning, or lets it learn freely."""
    while isinstance(given, Frozen | Learnt):
        given = given.value
    return given


def refuse_matrix(owner: str, name: str, given: Any, is_square: bool = False) -> None:
    """Refuse, with `InputError`, what is no matrix, or not a square one."""
    shape = shape_of(given)
    if shape is not None and (len(shape) < 2 or (is_square and shape[-1] != shape[-2])):
        needed = "square matrix (d, d)" if is_square else "matrix"
        raise InputError(f"`{owner}` needs a {needed} as its {name}, but was given the shape {shape}; give all rows.")


def refuse_negative(owner: str, name: str, given: Any) -> None:
    """Refuse, with `InputError`, a known number below 0, of which no root is real."""
    if given is None or isinstance(given, eqx.Module | jax.core.Tracer):
        return
    least = np.min(np.asarray(given, dtype=float), initial=0.0)
    if least < 0.0:
        raise InputError(f"`{owner}` needs a {name} of at least 0, but was given {least:g}; correct its sign.")


def refuse_asymmetric(owner: str, name: str, given: Any) -> None:
    """Refuse, with `InputError`, what is not square or not symmetric: of two triangles one would be ignored."""
    refuse_matrix(owner, name, given, is_square=True)
    given = _bare(given)
    if given is None or isinstance(given, eqx.Module | jax.core.Tracer):
        return
    matrix = np.asarray(given, dtype=float)
    if matrix.size == 0:
        return
    # What is not a number is left to the filter, which says so.
    with np.errstate(invalid="ignore"):
        apart = np.abs(matrix - np.swapaxes(matrix, -1, -2)) > _ROUND_OFF * np.max(np.abs(matrix))
    if np.any(apart):
        i, j = (int(k) for k in np.argwhere(apart)[0][-2:])
        raise InputError(
            f"`{owner}` needs a symmetric {name}, but was given {matrix[..., i, j].ravel()[0]:g} in row {i}, column "
            f"{j} and {matrix[..., j, i].ravel()[0]:g} across the diagonal; give both the same number."
        )


def refuse_misfit(what: str, given: int | None, state: int) -> None:
    """Refuse, with `InputError`, a part of a model that is made for a state of another size."""
    if given is not None and given != state:
        raise InputError(f"The {what} is for {given} numbers, but the state has {state}; make them the same.")
