"""Operations on arrays of which some are blocks: those of many numbers, which lie in memory."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jax.extend.core import JaxprEqn

from ._machine_arithmetic import Dual, Unsupported
from ._machine_blocks import Block, Pending
from ._machine_kernels import copied, entrywise, multiplied, summed
from ._machine_memory import AbstractCode, alike, is_real, shaped
from ._machine_places import PLACED
from ._machine_rules import RULES, spared

_Values = list[Any]
# Products of numbers that are kept before they are summed.
_MOST = 1 << 14


def applied(code: AbstractCode, one: JaxprEqn, values: _Values, turned: bool, joined: bool) -> _Values:
    """What an operation yields, of which something is, or may become, a block; `turned` where a matrix is about to
    have its rows and columns exchanged, `joined` where it is only ever added to something."""
    name = one.primitive.name
    found: Sequence[Any]
    if any(isinstance(value, Pending) for value in values):
        return [_with_pending(code, values)]
    real = all(is_real(shaped(atom).dtype) for atom in (*one.outvars, *one.invars[name == "select_n" :]))
    if name == "dot_general" and real:
        found = _contracted(code, one, values, turned, joined)
    elif name in _BY_BLOCKS and real:
        found = _BY_BLOCKS[name](code, one, values)
    elif name in RULES and real and _is_plain(one, values):
        found = [_entry_by_entry(code, one, values)]
    else:
        found = code.plainly(one, [code.in_registers(value) for value in values])
    return [code.settled(value, shaped(atom).shape, shaped(atom).dtype)
            for value, atom in zip(found, one.outvars, strict=True)]  # fmt: skip


def _plainly(code: AbstractCode, one: JaxprEqn, values: _Values) -> _Values:
    """By numbers in registers."""
    return list(code.plainly(one, [code.in_registers(value) for value in values]))


def _is_plain(one: JaxprEqn, values: _Values) -> bool:
    """Whether entries are chosen all alike, if it is a choice."""
    return one.primitive.name != "select_n" or (len(values) == 3 and _alike(values[0]) is not None)


def _alike(value: Any) -> Dual | None:
    """The number that all entries of an array are, if so it is."""
    return None if isinstance(value, Block) else alike(value)


def _entry_by_entry(code: AbstractCode, one: JaxprEqn, values: _Values) -> Any:
    shape = shaped(one.outvars[0]).shape
    numbers = [_alike(value) for value in values]
    stand = [Dual(None) if number is None else number for number in numbers]
    less = spared(one.primitive.name, stand) if len(values) == 2 else None
    for number, value in zip(stand, values, strict=True):
        if less is number:
            return value if value.shape == shape else _full(number, shape)
    if None not in numbers:
        return _full(code.ruled(one, stand), shape)
    # Sides of length one are spread along the others'.
    operands = [_moved(code, code.block_of(value), lambda layout: np.broadcast_to(layout, shape))
                if number is None else number.value
                for value, number in zip(values, numbers, strict=True)]  # fmt: skip
    rule, key = RULES[one.primitive.name], (one.primitive.name, one.params.get("y"))
    into = code.work.block(shape)
    entrywise(code.work, lambda on, *some: rule(on, one.params, *some), key, into, *operands, exact=False)
    return into


def _full(number: Dual, shape: tuple[int, ...]) -> np.ndarray:
    single = np.empty((), object)
    single[()] = number
    return np.broadcast_to(single, shape)


def _moved(code: AbstractCode, value: Any, rule: Callable[[np.ndarray], np.ndarray]) -> Any:
    """An array whose entries are the same in another order."""
    if not isinstance(value, Block):
        return rule(value)
    return value.moved(rule) or _end_to_end(code, value).viewed(rule)


def _end_to_end(code: AbstractCode, block: Block) -> Block:
    """A copy whose rows lie end to end, so that they are of any shape."""
    into, layout = code.work.block(block.shape), np.empty(block.shape, np.int8)
    found = Block(into.pointer, layout, layout, into.unit, stretch=into.stretch)
    copied(code.work, found, block)
    return found


def _kth(rule: Any, code: AbstractCode, one: JaxprEqn, k: int) -> Callable[[np.ndarray], np.ndarray]:
    """One of what an operation yields of a single array."""
    return lambda layout: rule(code, one, [layout])[k]


def _by_moving(name: str) -> Callable[[AbstractCode, JaxprEqn, _Values], _Values]:
    """What moves entries of arrays, of blocks as well."""

    def rule(code: AbstractCode, one: JaxprEqn, values: _Values) -> _Values:
        if not isinstance(values[0], Block):
            return PLACED[name](code, one, values)
        count = len(one.outvars)
        return [_moved(code, values[0], _kth(PLACED[name], code, one, k)) for k in range(count)]

    return rule


def _spread(code: AbstractCode, one: JaxprEqn, values: _Values) -> _Values:
    number = _alike(values[0])
    if number is not None:
        return [_full(number, one.params["shape"])]
    sizes = np.ones(len(one.params["shape"]), int)
    sizes[list(one.params["broadcast_dimensions"])] = values[0].shape
    rule = lambda array: np.broadcast_to(array.reshape(sizes), one.params["shape"])  # noqa: E731
    return [_moved(code, code.block_of(values[0]), rule)]


def _joined(code: AbstractCode, one: JaxprEqn, values: _Values) -> _Values:
    into, axis, first = code.work.block(shaped(one.outvars[0]).shape), one.params["dimension"], 0
    for value in values:
        size = value.shape[axis]
        if size:
            part = into.part(*[slice(None)] * axis, slice(first, first + size))
            copied(code.work, part, code.source(value))
        first += size
    return [into]


def stacked(code: AbstractCode, values: Sequence[Any], axis: int) -> Any:
    """Arrays of one shape along a new axis; a block where there is one among them."""
    if not any(isinstance(value, Block) for value in values):
        return np.stack(values, axis)
    if len(values) == 1:
        return _moved(code, values[0], lambda layout: np.expand_dims(layout, axis))
    shape = values[0].shape
    into = code.work.block((*shape[:axis], len(values), *shape[axis:]))
    for k, value in enumerate(values):
        copied(code.work, into.part(*[slice(None)] * axis, k), code.source(value))
    return into


def _padded(code: AbstractCode, one: JaxprEqn, values: _Values) -> _Values:
    array, filling = values
    config = one.params["padding_config"]
    if any(low < 0 or high < 0 or inner for low, high, inner in config):
        return _plainly(code, one, values)
    into = code.work.block(shaped(one.outvars[0]).shape)
    copied(code.work, into, filling[()].value, exact=False)
    where = tuple(slice(low, low + n) for (low, _, _), n in zip(config, array.shape, strict=True))
    if math.prod(array.shape):
        copied(code.work, into.part(*where), code.source(array))
    return [into]


def _sum(code: AbstractCode, one: JaxprEqn, values: _Values) -> _Values:
    return [_summed(code, code.block_of(values[0]), one.params["axes"])]


def _summed(code: AbstractCode, block: Block, axes: Sequence[Any]) -> Any:
    """Sums along axes."""
    kept = [k for k in range(len(block.shape)) if k not in axes]
    turned = block.viewed(lambda layout: layout.transpose(*kept, *axes)[None])
    into = code.work.block((1, *(block.shape[k] for k in kept)))
    summed(code.work, into, turned, len(kept) + 1)
    return into.part(0)


def _with_pending(code: AbstractCode, values: _Values) -> Any:
    """A product that is pending, with rows and columns exchanged, or added to something."""
    if len(values) == 1:
        return Pending(values[0].right, values[0].left)
    later, other = values if isinstance(values[0], Pending) else reversed(values)
    more = _product(code, other.left, other.right) if isinstance(other, Pending) else code.block_of(other)
    return _product(code, later.left, later.right, more)


def _contracted(code: AbstractCode, one: JaxprEqn, values: _Values, turned: bool, joined: bool) -> _Values:
    """A sum of products over some axes, as a product of two matrices."""
    along, shared = one.params["dimension_numbers"]
    if shared[0]:
        return [_row_by_row(code, values, along, shared)]
    left, right = (_matrix(code, value, axes) for value, axes in zip(values, along, strict=True))
    shape = shaped(one.outvars[0]).shape
    if joined and code.is_many(shape, "float64") and shape == (left.shape[0], right.shape[0]):
        return [Pending(left, right)]
    # Rows are the first's and columns the second's; the other way round where that is asked for next.
    if turned:
        found = _product(code, right, left).viewed(np.transpose)
    else:
        found = _product(code, left, right)
    return [_moved(code, found, lambda layout: layout.reshape(shape))]


def _row_by_row(code: AbstractCode, values: _Values, along: Any, shared: Any) -> Any:
    """Sums of products of which some axes are shared: all products, and their sums."""
    kept = [[k for k in range(len(value.shape)) if k not in (*axes, *own)]
            for value, axes, own in zip(values, along, shared, strict=True)]  # fmt: skip
    orders = [(*own, *rest, *axes) for own, rest, axes in zip(shared, kept, along, strict=True)]
    left = code.block_of(values[0]).viewed(lambda layout: layout.transpose(orders[0]))
    right = code.block_of(values[1]).viewed(lambda layout: layout.transpose(orders[1]))
    first, free, other = len(shared[0]), len(kept[0]), len(kept[1])
    sizes = (*left.shape[: first + free], *right.shape[first : first + other], *left.shape[first + free :])
    if math.prod(sizes) > _MOST:
        raise Unsupported("many products of matrices side by side")
    into = code.work.block(sizes)
    spread = lambda layout, where: np.broadcast_to(np.expand_dims(layout, tuple(where)), sizes)  # noqa: E731
    factors = [left.viewed(lambda layout: spread(layout, range(first + free, first + free + other))),
               right.viewed(lambda layout: spread(layout, range(first, first + free)))]  # fmt: skip
    entrywise(code.work, lambda on, a, b: RULES["mul"](on, {}, a, b), ("mul", None), into, *factors, exact=False)
    return _summed(code, into, range(first + free + other, len(sizes)))


def _matrix(code: AbstractCode, value: Any, axes: Sequence[int]) -> Block:
    """An array as a matrix, of whose columns the axes are made."""
    block = code.block_of(value)
    rest = [k for k in range(len(block.shape)) if k not in axes]
    sizes = [math.prod(block.shape[k] for k in some) for some in (rest, axes)]
    turned = _moved(code, block, lambda layout: layout.transpose(*rest, *axes))
    found = _moved(code, turned, lambda layout: layout.reshape(sizes))
    assert isinstance(found, Block)
    return found


def _product(code: AbstractCode, rows: Block, columns: Block, more: Block | None = None) -> Block:
    """rows @ columns.T, added to `more`; the latter's rows are what registers hold."""
    into, turned = code.work.block((rows.shape[0], columns.shape[0])), columns.viewed(np.transpose)
    if code.work.step > 1 and turned.side.strides[1] != 1 and turned.shape[1] > 1:
        turned = _side_by_side(code, turned)
    multiplied(code.work, into, rows, turned, more)
    return into


def _side_by_side(code: AbstractCode, block: Block) -> Block:
    """A copy whose rows lie as such; made once, before any loop, of what never changes."""
    if not block.fixed:
        into = code.work.block(block.shape)
        copied(code.work, into, block, exact=False)
        return into
    key = id(block.pointer), block.side, block.shape
    if key not in code.work.packed:
        into = code.work.block(block.shape, unused=True)
        assert code.work.before is not None
        with code.builder.goto_block(code.work.before):
            copied(code.work, into, block, exact=False)
        code.work.packed[key] = into
    return code.work.packed[key]


def _small_product(code: AbstractCode, one: JaxprEqn, values: _Values) -> _Values:
    left, right = (code.block_of(value) for value in values)
    if len(left.shape) != 2:
        return _plainly(code, one, values)
    return [_product(code, left, right.viewed(np.transpose))]


_BY_BLOCKS: dict[str, Callable[[AbstractCode, JaxprEqn, _Values], _Values]] = {
    "broadcast_in_dim": _spread,
    "concatenate": _joined,
    "copy": lambda code, one, values: values,
    "pad": _padded,
    "reduce_sum": _sum,
    "small_product": _small_product,
    "stack": lambda code, one, values: [stacked(code, values, one.params["axis"])],
    "stop_gradient": lambda code, one, values: values,
    **{name: _by_moving(name) for name in ("reshape", "rev", "slice", "split", "squeeze", "transpose", "unstack")},
}
