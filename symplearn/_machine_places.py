"""Operations that move or join the entries of small arrays, which the machine code holds one by one."""

from collections.abc import Callable
from functools import reduce
from typing import Any

import numpy as np
from jax.extend.core import JaxprEqn

from ._machine_rules import RULES, Arithmetic, Unsupported, known

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
    (array, filling), ends = values, one.params["padding_config"]
    if any(low < 0 or high < 0 or inner for low, high, inner in ends):
        raise Unsupported("an array that is cut at its ends, or filled between")
    out = np.empty([n + low + high for n, (low, high, _) in zip(array.shape, ends, strict=True)], object)
    out[...] = filling[()]
    out[tuple(slice(low, low + n) for n, (low, _, _) in zip(array.shape, ends, strict=True))] = array
    return [out]


def _picked(on: Arithmetic, one: JaxprEqn, values: list[np.ndarray]) -> list[np.ndarray]:
    """Entries of a vector at places that are known."""
    vector, places = values
    plain = vector.ndim == 1 and one.params["slice_sizes"] == (1,) and not one.params["dimension_numbers"].offset_dims
    found = [known(place) for place in places.ravel()]
    if not plain or None in found:
        raise Unsupported("entries at places that are not known")
    return [vector[np.array(found, int).reshape(places.shape[:-1])]]


def _counted(on: Any, one: JaxprEqn, values: list[np.ndarray]) -> list[np.ndarray]:
    p = one.params
    return [on.constant(np.indices(p["shape"])[p["dimension"]].astype(p["dtype"]))]


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


PLACED: dict[str, _Place] = {
    "broadcast_in_dim": _spread,
    "concatenate": lambda on, one, values: [np.concatenate(values, one.params["dimension"])],
    "gather": _picked,
    "iota": _counted,
    "pad": _padded,
    "reduce_max": _reduced("max"),
    "reduce_min": _reduced("min"),
    "reduce_sum": _reduced("add"),
    "reshape": _moved(lambda array, p: array.reshape(p["new_sizes"])),
    "rev": _moved(lambda array, p: np.flip(array, p["dimensions"])),
    "slice": _moved(_cut),
    "split": lambda on, one, values: np.split(values[0], np.cumsum(one.params["sizes"])[:-1], one.params["axis"]),
    "squeeze": _moved(lambda array, p: np.squeeze(array, p["dimensions"])),
    "stack": lambda on, one, values: [np.stack(values, one.params["axis"])],
    "transpose": _moved(lambda array, p: np.transpose(array, p["permutation"])),
}
