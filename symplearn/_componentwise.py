"""A function of small vectors as the same function of their components, one by one.

Vectors that are put together of parts and taken apart again keep a compiler from working on many trajectories, or many
directions, at once: every entry is computed behind a branch of its own. With the components apart an operation is the
same for all of them and becomes one instruction for four or eight. What comes out is the same to round-off.
"""

import math
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, TypeAlias, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal
from jaxtyping import Array

# Arrays of more entries stay whole: what is recorded along a trajectory, but no phase point and no parameters.
_SMALL = 256

# A NumPy array of scalars if it is small, else itself.
_Value: TypeAlias = Any


def componentwise(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same function of the same arrays, by components; its loops and branches stay what they are.

    Made for functions of a few small vectors, under `jax.vmap` or `jax.jvp` and `jax.vmap`.
    """

    def by_components(*arguments: Any) -> Any:
        program, shapes = jax.make_jaxpr(function, return_shape=True)(*arguments)
        done = _evaluated(program, [_apart(jnp.asarray(leaf)) for leaf in jax.tree.leaves(arguments)])
        leaves, tree = jax.tree.flatten(shapes)
        return jax.tree.unflatten(tree, list(map(_whole, done, leaves)))

    return by_components


def _evaluated(program: ClosedJaxpr, values: Sequence[_Value]) -> list[_Value]:
    """What a traced function yields."""
    inner = program.jaxpr
    known = dict(zip(inner.constvars, map(_known, program.consts), strict=True))
    known.update(zip(inner.invars, values, strict=True))

    def value(atom: Any) -> _Value:
        if not isinstance(atom, Literal):
            return known[atom]
        shaped: Any = atom.aval
        return _known(np.asarray(atom.val, shaped.dtype))

    for one in inner.eqns:
        known.update(zip(one.outvars, _applied(one, [value(atom) for atom in one.invars]), strict=True))
    return [value(atom) for atom in inner.outvars]


def _applied(one: JaxprEqn, values: list[_Value]) -> Sequence[_Value]:
    """What one operation yields."""
    name = one.primitive.name
    if name in _BY_PARTS:
        return _BY_PARTS[name](one, values)
    small = all(_is_small(atom.aval) for atom in (*one.invars, *one.outvars))
    if small and name in _ALIKE:
        return [_each(one, values)]
    if small and name in _PLACED:
        found = _PLACED[name](values, one.params)
        if found is not None:
            return found
    return _as_it_is(one, values)


def _as_it_is(one: JaxprEqn, values: Sequence[_Value]) -> list[_Value]:
    """An operation on whole arrays."""
    whole = [_whole(value, atom.aval) for value, atom in zip(values, one.invars, strict=True)]
    done = one.primitive.bind(*whole, **one.primitive.get_bind_params(one.params))
    return list(map(_apart, done if one.primitive.multiple_results else [done]))


def _each(one: JaxprEqn, values: Sequence[_Value]) -> np.ndarray:
    """An operation that treats every entry alike."""
    together, shaped = np.broadcast_arrays(*values), cast(Any, one.outvars[0].aval)
    out, plain = np.empty(together[0].shape, object), _PLAIN.get(one.primitive.name)
    for place in np.ndindex(out.shape):
        entries = [array[place] for array in together]
        if plain and all(isinstance(entry, np.generic) for entry in entries):
            out[place] = plain(*entries, dtype=shaped.dtype)
        else:
            out[place] = one.primitive.bind(*entries, **one.params)
    return out


def _is_small(shaped: Any) -> bool:
    return math.prod(shaped.shape) <= _SMALL


def _known(array: Any) -> _Value:
    """A constant by its entries, as NumPy has them if it is one throughout."""
    if isinstance(array, jax.core.Tracer) or not _is_small(array):
        return _apart(array)
    plain = np.asarray(array)
    out = np.empty(plain.shape, object)
    for place in np.ndindex(plain.shape):
        out[place] = plain[place]
    return out


def _apart(array: Array) -> _Value:
    """An array by its entries."""
    if not _is_small(array):
        return array
    out = np.empty(array.shape, object)
    flat = lax.reshape(array, (out.size,))
    for k, place in enumerate(np.ndindex(out.shape)):
        out[place] = lax.index_in_dim(flat, k, keepdims=False)
    return out


def _whole(value: _Value, shaped: Any) -> Any:
    """An array of its entries."""
    if not _is_small(shaped):
        return value
    if not value.size:
        return jnp.zeros(shaped.shape, shaped.dtype)
    entries = _loose(value, shaped)
    return jnp.stack(entries).reshape(shaped.shape) if shaped.shape else entries[0]


def _loose(value: _Value, shaped: Any) -> Any:
    """What a loop or a branch carries of a value."""
    if not _is_small(shaped):
        return value
    return [lax.convert_element_type(entry, shaped.dtype) for entry in value.ravel()]


def _bound(loose: Any, shaped: Any) -> _Value:
    """The value that is carried."""
    if not _is_small(shaped):
        return loose
    out = np.empty(shaped.shape, object)
    for place, entry in zip(np.ndindex(out.shape), loose, strict=True):
        out[place] = entry
    return out


def _inlined(one: JaxprEqn, values: list[_Value]) -> Sequence[_Value]:
    return _evaluated(one.params["jaxpr"], values)


def _branches(one: JaxprEqn, values: list[_Value]) -> Sequence[_Value]:
    if one.params.get("branches_platforms") is not None:
        return _as_it_is(one, values)
    index, *operands = values
    shapes = [atom.aval for atom in one.outvars]

    def branch(program: ClosedJaxpr) -> Callable[[], Any]:
        return lambda: list(map(_loose, _evaluated(program, operands), shapes))

    return list(map(_bound, lax.switch(index[()], list(map(branch, one.params["branches"]))), shapes))


def _while(one: JaxprEqn, values: list[_Value]) -> Sequence[_Value]:
    p, shapes = one.params, [atom.aval for atom in one.outvars]
    asked, given = p["cond_nconsts"], p["cond_nconsts"] + p["body_nconsts"]

    def goes_on(carry: Any) -> Array:
        return _evaluated(p["cond_jaxpr"], [*values[:asked], *map(_bound, carry, shapes)])[0][()]

    def body(carry: Any) -> Any:
        return list(
            map(_loose, _evaluated(p["body_jaxpr"], [*values[asked:given], *map(_bound, carry, shapes)]), shapes)
        )

    return list(map(_bound, lax.while_loop(goes_on, body, list(map(_loose, values[given:], shapes))), shapes))


def _scan(one: JaxprEqn, values: list[_Value]) -> Sequence[_Value]:
    p, given, last = one.params, one.params["num_consts"], one.params["num_consts"] + one.params["num_carry"]
    shapes = [atom.aval for atom in one.outvars[: p["num_carry"]]]
    inner = p["jaxpr"].in_avals[last:], p["jaxpr"].out_avals[p["num_carry"] :]
    ahead = [_columns(value, atom.aval) for value, atom in zip(values[last:], one.invars[last:], strict=True)]

    def step(carry: Any, rows: Any) -> tuple[Any, Any]:
        now = [_apart(row) if isinstance(row, Array) else _bound(row, shaped)
               for row, shaped in zip(rows, inner[0], strict=True)]  # fmt: skip
        out = _evaluated(p["jaxpr"], [*values[:given], *map(_bound, carry, shapes), *now])
        kept, told = out[: len(shapes)], out[len(shapes) :]
        return list(map(_loose, kept, shapes)), list(map(_whole, told, inner[1]))

    begun = list(map(_loose, values[given:last], shapes))
    carry, told = lax.scan(step, begun, ahead, p["length"], p["reverse"], p["unroll"])
    return [*map(_bound, carry, shapes), *map(_apart, told)]


def _columns(value: _Value, shaped: Any) -> Any:
    """What a loop goes along: of a small array an array for every entry of a row."""
    if not _is_small(shaped):
        return value
    rows = value.reshape(len(value), -1).T
    return [np.array(list(row), shaped.dtype) if all(isinstance(entry, np.generic) for entry in row)
            else jnp.stack(list(row)) for row in rows]  # fmt: skip


_BY_PARTS: dict[str, Callable[[JaxprEqn, list[_Value]], Sequence[_Value]]] = {
    "jit": _inlined,
    "cond": _branches,
    "while": _while,
    "scan": _scan,
}
# Operations on places, which are worked out where these are known: to pick entries, one must know which.
_PLAIN: dict[str, Callable[..., Any]] = {
    "add": lambda a, b, dtype: dtype.type(a + b),
    "convert_element_type": lambda a, dtype: dtype.type(a),
    "lt": lambda a, b, dtype: dtype.type(a < b),
    "select_n": lambda which, *cases, dtype: dtype.type(cases[int(which)]),
}
# Operations that treat every entry alike.
_ALIKE = frozenset(
    "abs acos acosh add add_any and asin asinh atan atan2 atanh ceil clamp convert_element_type copy copy_p cos cosh "
    "div eq erf exp exp2 expm1 floor ge gt integer_pow is_finite le log log1p logistic lt max min mul ne neg not or "
    "pow rem round rsqrt select_n sign sin sinh sqrt square stop_gradient sub tan tanh xor".split()
)


def _spread(values: list[_Value], p: Any) -> list[_Value] | None:
    sizes = np.ones(len(p["shape"]), int)
    sizes[list(p["broadcast_dimensions"])] = values[0].shape
    return [np.broadcast_to(values[0].reshape(sizes), p["shape"])]


def _cut(values: list[_Value], p: Any) -> list[_Value] | None:
    steps = p["strides"] or (1,) * values[0].ndim
    return [values[0][tuple(map(slice, p["start_indices"], p["limit_indices"], steps))]]


def _padded(values: list[_Value], p: Any) -> list[_Value] | None:
    value, filling = values
    if any(low < 0 or high < 0 or inner for low, high, inner in p["padding_config"]):
        return None
    out = np.full([n + low + high for n, (low, high, _) in zip(value.shape, p["padding_config"], strict=True)], None)
    out[...] = filling
    out[tuple(slice(low, low + n) for n, (low, _, _) in zip(value.shape, p["padding_config"], strict=True))] = value
    return [out]


def _split(values: list[_Value], p: Any) -> list[_Value] | None:
    return np.split(values[0], np.cumsum(p["sizes"])[:-1], p["axis"])


def _picked(values: list[_Value], p: Any) -> list[_Value] | None:
    """Entries of a vector at places that are known."""
    vector, places = values
    plain = vector.ndim == 1 and p["slice_sizes"] == (1,) and not p["dimension_numbers"].offset_dims
    if not plain or not all(isinstance(place, np.integer) for place in places.ravel()):
        return None
    return [vector[places[..., 0].astype(int)]]


def _reduced(operation: Callable[[Any, Any], Any]) -> Callable[[list[_Value], Any], list[_Value] | None]:
    def rule(values: list[_Value], p: Any) -> list[_Value] | None:
        axes = p["axes"]
        rows = np.moveaxis(values[0], axes, range(len(axes)))
        rows = rows.reshape(-1, *rows.shape[len(axes) :])
        if not rows.size:
            return None
        out = np.empty(rows.shape[1:], object)
        for place in np.ndindex(out.shape):
            out[place] = reduce(operation, rows[(slice(None), *place)])
        return [out]

    return rule


# Operations that only move entries, or join a few.
_PLACED: dict[str, Callable[[list[_Value], Any], list[_Value] | None]] = {
    "broadcast_in_dim": _spread,
    "concatenate": lambda values, p: [np.concatenate(values, p["dimension"])],
    "stack": lambda values, p: [np.stack(values, p["axis"])],
    "gather": _picked,
    "iota": lambda values, p: [_known(np.indices(p["shape"])[p["dimension"]].astype(p["dtype"]))],
    "pad": _padded,
    "reduce_max": _reduced(lax.max),
    "reduce_min": _reduced(lax.min),
    "reduce_sum": _reduced(lax.add),
    "reshape": lambda values, p: None if p["dimensions"] else [values[0].reshape(p["new_sizes"])],
    "rev": lambda values, p: [np.flip(values[0], p["dimensions"])],
    "slice": _cut,
    "split": _split,
    "squeeze": lambda values, p: [np.squeeze(values[0], p["dimensions"])],
    "transpose": lambda values, p: [np.transpose(values[0], p["permutation"])],
}
