"""Operations that move or join the entries of small arrays, which the machine code holds one by one."""

import math
from collections.abc import Callable
from functools import reduce
from typing import Any

import numpy as np
from jax.extend.core import JaxprEqn

from ._machine_arithmetic import Arithmetic, Dual, Unsupported, known
from ._machine_rules import RULES

_Place = Callable[[Arithmetic, JaxprEqn, list[np.ndarray]], list[np.ndarray]]


def _moved(rule: Callable[[np.ndarray, Any], Any]) -> _Place:
    return lambda on, one, values: [rule(values[0], one.params)]


def _spread(on: Arithmetic, one: JaxprEqn, values: list[np.ndarray]) -> list[np.ndarray]:
    shape, sizes = one.params["shape"], np.ones(len(one.params["shape"]), int)
    sizes[list(one.params["broadcast_dimensions"])] = values[0].shape
    return [np.broadcast_to(values[0].reshape(sizes), shape)]


def _cut(array: np.ndarray, p: Any) -> np.ndarray:
    steps = p["strides"] or (1,) * array.ndim
    return array[tuple(map(slice, p["start_indices"], p["limit_indices"], steps))]


def _padded(on: Arithmetic, one: JaxprEqn, values: list[np.ndarray]) -> list[np.ndarray]:
    """Filled up at its ends and between, or cut at its ends."""
    array, filling = values
    for axis, (low, high, inner) in enumerate(one.params["padding_config"]):
        rows = np.moveaxis(array, axis, 0)
        size = low + high + len(rows) + inner * max(len(rows) - 1, 0)
        out = np.empty((size, *rows.shape[1:]), object)
        out[...] = filling[()]
        for k, row in enumerate(rows):
            if 0 <= (at := low + k * (inner + 1)) < size:
                out[at] = row
        array = np.moveaxis(out, 0, axis)
    return [array]


def _picked(on: Arithmetic, one: JaxprEqn, values: list[np.ndarray]) -> list[np.ndarray]:
    """Single entries, or rows, at places that are known."""
    (array, places), p = values, one.params
    axes, offsets = p["dimension_numbers"].start_index_map, p["dimension_numbers"].offset_dims
    where = _known_places(places)
    if set(p["slice_sizes"]) == {1} and not offsets and len(axes) == array.ndim:
        return [array[tuple(where[axes.index(axis)] for axis in range(array.ndim))]]
    if axes == (0,) and p["slice_sizes"] == (1, *array.shape[1:]) and offsets == _last(array.ndim - 1, places.ndim - 1):
        return [array[where[0]]]
    raise Unsupported("parts of an array, in an order of their own")


def _added(on: Arithmetic, one: JaxprEqn, values: list[np.ndarray]) -> list[np.ndarray]:
    """Single entries of a vector, or rows, added to at places that are known."""
    (array, places, more), numbers = values, one.params["dimension_numbers"]
    rows = _last(array.ndim - 1, places.ndim - 1)
    if numbers.scatter_dims_to_operand_dims != (0,) or numbers.inserted_window_dims != (0,):
        raise Unsupported("an array that is added to in parts of several axes")
    if numbers.update_window_dims != rows or places.shape[-1] != 1:
        raise Unsupported("an array that is added to in an order of its own")
    out = array.copy()
    for place, at in zip(_known_places(places)[0].ravel(), np.ndindex(places.shape[:-1]), strict=True):
        for k in np.ndindex(array.shape[1:]):
            out[(place, *k)] = RULES["add"](on, {}, out[(place, *k)], more[(*at, *k)])
    return [out]


def _last(number: int, after: int) -> tuple[int, ...]:
    """So many axes after others."""
    return tuple(range(after, after + number))


def _known_places(places: np.ndarray) -> np.ndarray:
    """Places as numbers, those of every axis along the first."""
    found = [known(place) for place in places.ravel()]
    if None in found:
        raise Unsupported("entries at places that are not known")
    return np.moveaxis(np.array(found, int).reshape(places.shape), -1, 0)


def _rows(on: Arithmetic, one: JaxprEqn, values: list[np.ndarray]) -> list[np.ndarray]:
    """The entries along an axis, which are arrays even where they are single numbers."""
    along = np.moveaxis(values[0], one.params["axis"], 0)
    return [along[k, ...] for k in range(len(along))]


def _counted(on: Any, one: JaxprEqn, values: list[np.ndarray]) -> list[np.ndarray]:
    p = one.params
    return [on.constant(np.indices(p["shape"])[p["dimension"]].astype(p["dtype"]))]


def _nothing(on: Any, one: JaxprEqn, values: list[np.ndarray]) -> list[np.ndarray]:
    shaped: Any = one.outvars[0].aval
    return [on.constant(np.zeros(shaped.shape, shaped.dtype))]


def _reduced(name: str) -> _Place:
    def rule(on: Arithmetic, one: JaxprEqn, values: list[np.ndarray]) -> list[np.ndarray]:
        axes = one.params["axes"]
        rows = np.moveaxis(values[0], axes, range(len(axes)))
        rows = rows.reshape(-1, *rows.shape[len(axes) :])
        if not len(rows):
            raise Unsupported("a sum of nothing")
        out = np.empty(rows.shape[1:], object)
        for place in np.ndindex(out.shape):
            out[place] = reduce(lambda a, b: RULES[name](on, {}, a, b), rows[(slice(None), *place)])
        return [out]

    return rule


def _contracted(on: Arithmetic, one: JaxprEqn, values: list[np.ndarray]) -> list[np.ndarray]:
    """Sums of products of two arrays over some axes, row by row of those that they share."""
    (along, other_along), (shared, other_shared) = one.params["dimension_numbers"]
    left, right = (_matrices(*some) for some in zip(values, (along, other_along), (shared, other_shared), strict=True))
    out = [_product(on, one, [a, b.T])[0] for a, b in zip(left[0], right[0], strict=True)]
    return [np.stack(out).reshape((*left[1], *left[2], *right[2]))]


def _matrices(array: np.ndarray, along: Any, shared: Any) -> tuple[np.ndarray, list[int], list[int]]:
    """An array as matrices whose columns are the axes `along`, one for each row of the `shared` axes; the sizes of
    these and of the others."""
    rest = [k for k in range(array.ndim) if k not in along and k not in shared]
    sizes = [[array.shape[k] for k in axes] for axes in (shared, rest, along)]
    turned = array.transpose(*shared, *rest, *along)
    return turned.reshape([math.prod(some) for some in sizes]), sizes[0], sizes[1]


def _product(on: Arithmetic, one: JaxprEqn, values: list[np.ndarray]) -> list[np.ndarray]:
    """A product of two matrices, or of two stacks of them. Terms that are known to be zero are left out."""
    left, right = values
    if left.ndim > 2:
        return [np.stack([_product(on, one, list(pair))[0] for pair in zip(left, right, strict=True)])]
    out = np.empty((len(left), right.shape[1]), object)
    for i, j in np.ndindex(out.shape):
        pairs = [pair for pair in zip(left[i], right[:, j], strict=True) if 0.0 not in map(known, pair)]
        terms = [RULES["mul"](on, {}, *pair) for pair in pairs]
        out[i, j] = reduce(lambda a, b: RULES["add"](on, {}, a, b), terms) if terms else Dual(on.number(0.0))
    return [out]


PLACED: dict[str, _Place] = {
    "broadcast_in_dim": _spread,
    "dot_general": _contracted,
    "concatenate": lambda on, one, values: [np.concatenate(values, one.params["dimension"])],
    # Nothing in particular: zeros, which products leave out.
    "empty2": _nothing,
    "gather": _picked,
    "iota": _counted,
    "pad": _padded,
    "reduce_and": _reduced("and"),
    "reduce_max": _reduced("max"),
    "reduce_min": _reduced("min"),
    "reduce_or": _reduced("or"),
    "reduce_sum": _reduced("add"),
    "reshape": _moved(lambda array, p: array.reshape(p["new_sizes"])),
    "rev": _moved(lambda array, p: np.flip(array, p["dimensions"])),
    "scatter-add": _added,
    "slice": _moved(_cut),
    "small_product": _product,
    "split": lambda on, one, values: np.split(values[0], np.cumsum(one.params["sizes"])[:-1], one.params["axis"]),
    "squeeze": _moved(lambda array, p: np.squeeze(array, p["dimensions"])),
    "stack": lambda on, one, values: [np.stack(values, one.params["axis"])],
    "unstack": _rows,
    "transpose": _moved(lambda array, p: np.transpose(array, p["permutation"])),
}
