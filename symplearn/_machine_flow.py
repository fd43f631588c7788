"""Calls, branches and loops as machine code, and parts of arrays that they look for."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn
from llvmlite import ir

from ._machine_arithmetic import INTEGER, Dual, Unsupported, kind_of, known
from ._machine_block_rules import stacked
from ._machine_blocks import Block
from ._machine_cells import Cells
from ._machine_kernels import copied
from ._machine_loops import counted
from ._machine_memory import AbstractCode, AbstractTable, BlockTable, shaped
from ._scan_sizes import ScanSizes

# Loops of at most so many steps are written down step by step where that tells places in arrays.
_FEW = 16


def each(function: Callable[..., Dual], *arrays: np.ndarray) -> np.ndarray:
    """A function of the entries of arrays."""
    out = np.empty(arrays[0].shape, object)
    for place in np.ndindex(out.shape):
        out[place] = function(*(array[place] for array in arrays))
    return out


def _inlined(code: AbstractCode, one: JaxprEqn, values: list[Any]) -> list[Any]:
    return code.evaluated(one.params["jaxpr"], values)


def _inlined_call(code: AbstractCode, one: JaxprEqn, values: list[Any]) -> list[Any]:
    return code.evaluated(one.params["call_jaxpr"], values)


def _inlined_open(code: AbstractCode, one: JaxprEqn, values: list[Any]) -> list[Any]:
    return code.evaluated(ClosedJaxpr(one.params["jaxpr"], ()), values)


def _by_its_own_slopes(code: AbstractCode, one: JaxprEqn, values: list[Any]) -> list[Any]:
    """A function with a derivative of its own."""
    if code.beside or all(entry.slope is None for array in values for entry in array.ravel()):
        return code.evaluated(one.params["call_jaxpr"], values)
    plain = [each(lambda dual: Dual(dual.value), array) for array in values]
    slopes = [each(lambda dual: Dual(dual.slope), array) for array in values]  # numbers to work with, here
    found = code.evaluated(code.program_with_slopes(one), [*plain, *slopes])
    half = len(found) // 2
    joined = lambda value, slope: Dual(value.value, slope.value)  # noqa: E731
    return [each(joined, *pair) for pair in zip(found[:half], found[half:], strict=True)]


def _without_slopes(code: AbstractCode, one: JaxprEqn, values: list[Any]) -> list[Any]:
    if not code.beside:
        raise Unsupported("slopes that are defined the other way round")
    return code.evaluated(one.params["call_jaxpr"], values)


def _branches(code: AbstractCode, one: JaxprEqn, values: list[Any]) -> list[Any]:
    if (choice := known(values[0].item())) is not None:
        return code.evaluated(one.params["branches"][int(choice)], values[1:])
    index, operands, build = values[0][()].value, values[1:], code.builder
    if isinstance(index.type, ir.VectorType):
        return _all_branches(code, one, index, operands)
    cells, end, here, blocks = Cells(code, one.outvars), build.append_basic_block("joined"), build.block, []
    for program in one.params["branches"]:
        blocks.append(build.append_basic_block("branch"))
        build.position_at_end(blocks[-1])
        cells.store(code.evaluated(program, operands))
        build.branch(end)
    build.position_at_end(here)
    ways = build.switch(index, blocks[-1])
    for k, block in enumerate(blocks[:-1]):
        ways.add_case(ir.Constant(index.type, k), block)
    build.position_at_end(end)
    return cells.load()


def _on_a_processor(code: AbstractCode, one: JaxprEqn, values: list[Any]) -> list[Any]:
    """Which of the ways to do something is that of a processor."""
    platforms = one.params["platforms"]
    mine = next(k for k, some in enumerate(platforms) if some is None or "cpu" in some)
    return [code.constant(np.asarray(mine, np.int32))]


def _all_branches(code: AbstractCode, one: JaxprEqn, index: ir.Value, operands: list[Any]) -> list[Any]:
    """What each lane's branch comes to, out of all of them."""
    found = [[code.in_registers(value) for value in code.evaluated(program, operands)]
             for program in one.params["branches"]]  # fmt: skip
    out = found[-1]
    for k, some in reversed(list(enumerate(found[:-1]))):
        mine = code.builder.icmp_signed("==", *code.pair(index, ir.Constant(kind_of(index), k)))
        pick = lambda a, b, mine=mine: Dual(code.chosen(mine, a.value, b.value))  # noqa: E731
        out = [each(pick, *np.broadcast_arrays(*pair)) for pair in zip(some, out, strict=True)]
    return out


def _while(code: AbstractCode, one: JaxprEqn, values: list[Any]) -> list[Any]:
    p, build = one.params, code.builder
    asked, given = p["cond_nconsts"], p["cond_nconsts"] + p["body_nconsts"]
    if code.beside and code.width > 1:
        raise Unsupported("a loop that every lane may leave at another time")
    cells = Cells(code, one.outvars)
    cells.store(values[given:])
    cells.slope_all()
    again, inside, end = map(build.append_basic_block, ("again", "inside", "end"))
    build.branch(again)
    build.position_at_end(again)
    now = cells.load()
    (goes_on,) = code.evaluated(p["cond_jaxpr"], [*values[:asked], *now])
    build.cbranch(goes_on[()].value, inside, end)
    build.position_at_end(inside)
    cells.store(code.evaluated(p["body_jaxpr"], [*values[asked:given], *now]))
    build.branch(again)
    build.position_at_end(end)
    return now


def _scan(code: AbstractCode, one: JaxprEqn, values: list[Any]) -> list[Any]:
    p, sizes = one.params, ScanSizes.of(one.params)
    given, last, length = sizes.given, sizes.last, p["length"]
    if code.beside and length <= _FEW and (p["unroll"] >= length or _asks_for_places(p["jaxpr"].jaxpr)):
        return _step_by_step(code, one, values)
    told = one.outvars[sizes.carried :]
    if told and not code.beside:
        raise Unsupported("a loop that tells what it passes")
    rooms = [code.room_for(shaped(atom).dtype, shaped(atom).shape) for atom in told]
    tables = [value if isinstance(value, AbstractTable) else code.table(value) for value in values[last:]]
    cells = Cells(code, one.outvars[: sizes.carried])
    cells.store(values[given:last])
    cells.slope_all()
    looped(code, p, values[:given], cells, tables, rooms)
    return [*cells.load(), *(_all_of(code, room) for room in rooms)]


def looped(
    code: AbstractCode,
    p: Any,
    given: Sequence[Any],
    cells: Cells,
    tables: Sequence[AbstractTable],
    rooms: Sequence[AbstractTable],
) -> None:
    """A loop along the rows of tables, of which the cells hold what changes; what is told is written to the rooms."""
    with counted(code.builder, ir.Constant(INTEGER, p["length"])) as k:
        place = code.builder.sub(ir.Constant(INTEGER, p["length"] - 1), k) if p["reverse"] else k
        found = code.evaluated(p["jaxpr"], [*given, *cells.load(), *(table.row(code, place) for table in tables)])
        carried = ScanSizes.of(p).carried
        for room, values in zip(rooms, found[carried:], strict=True):
            room.set_row(code, place, values)
        cells.store(found[:carried])


def _step_by_step(code: AbstractCode, one: JaxprEqn, values: list[Any]) -> list[Any]:
    """A short loop, every step of which is written down, so that places in arrays are known."""
    p, sizes = one.params, ScanSizes.of(one.params)
    given, last, carried = sizes.given, sizes.last, sizes.carried
    now, told = values[given:last], []
    for k in range(p["length"])[:: -1 if p["reverse"] else 1]:
        rows = [_row_of(code, value, k) for value in values[last:]]
        found = code.evaluated(p["jaxpr"], [*values[:given], *now, *rows])
        now = found[:carried]
        told.append(found[carried:])
    in_order = told[:: -1 if p["reverse"] else 1]
    found = [*now, *(stacked(code, column, 0) for column in zip(*in_order, strict=True))]
    shapes = map(shaped, one.outvars)
    return [code.settled(value, some.shape, some.dtype) for value, some in zip(found, shapes, strict=True)]


def _row_of(code: AbstractCode, value: Any, k: int) -> Any:
    """A row of an array, which may be a block."""
    if not isinstance(value, Block):
        return value[k, ...]
    return code.settled(value.part(k), value.shape[1:], "float64")


def _asks_for_places(program: Jaxpr) -> bool:
    """Whether a traced function looks at, or changes, a part of an array that moves."""
    moving = ("dynamic_slice", "dynamic_update_slice")
    return any(one.primitive.name in moving or any(map(_asks_for_places, programs_in(one))) for one in program.eqns)


def programs_in(one: JaxprEqn) -> list[Jaxpr]:
    """The traced functions that an operation is given."""
    kinds = ClosedJaxpr | Jaxpr
    parts = jax.tree.leaves(list(one.params.values()), is_leaf=lambda part: isinstance(part, kinds))
    return [part.jaxpr if isinstance(part, ClosedJaxpr) else part for part in parts if isinstance(part, kinds)]


def _all_of(code: AbstractCode, table: AbstractTable) -> Any:
    """All numbers of a table."""
    if isinstance(table, BlockTable):
        return code.settled(table.block, table.shape, "float64")
    rows = [table.row(code, ir.Constant(INTEGER, k)) for k in range(table.shape[0])]
    return np.stack(rows) if rows else np.empty(table.shape, object)


def _looked_up(code: AbstractCode, one: JaxprEqn, values: list[Any]) -> list[Any]:
    """A row of a table, or a part of an array at a place that is known."""
    table, first, *_ = values
    sizes = one.params["slice_sizes"]
    if isinstance(table, Block):
        return [_of_a_block(code, table, values[1:], sizes)]
    if not isinstance(table, AbstractTable):
        if sizes == (1, *table.shape[1:]) and known(values[1].item()) is None and code.width == 1:
            return [code.table(table).row(code, _within(code, values[1].item().value, len(table))).reshape(sizes)]
        starts = _starts(values[1:], table.shape, sizes)
        return [table[tuple(slice(at, at + size) for at, size in zip(starts, sizes, strict=True))]]
    if sizes != (1, *table.shape[1:]):
        raise Unsupported("a part of an array that moves")
    place = first[()].value
    place = place if place.type == INTEGER else code.builder.sext(place, INTEGER)
    return [table.row(code, place).reshape(sizes)]


def _of_a_block(code: AbstractCode, block: Block, places: Sequence[np.ndarray], sizes: Sequence[int]) -> Any:
    """A row of a block, or a part of it at a place that is known."""
    if sizes == (1, *block.shape[1:]) and code.moves(places[0].item()):
        found = block.at(code.builder, _within(code, places[0].item().value, block.shape[0]))
        return code.settled(found.viewed(lambda layout: layout[None]), sizes, "float64")
    starts = _starts(places, block.shape, sizes)
    part = block.part(*(slice(at, at + size) for at, size in zip(starts, sizes, strict=True)))
    return code.settled(part, sizes, "float64")


def _within(code: AbstractCode, place: ir.Value, count: int) -> ir.Value:
    """The nearest row that there is."""
    build, last = code.builder, ir.Constant(INTEGER, count - 1)
    place = place if place.type == INTEGER else build.sext(place, INTEGER)
    place = build.select(build.icmp_signed("<", place, last), place, last)
    return build.select(build.icmp_signed(">", place, ir.Constant(INTEGER, 0)), place, ir.Constant(INTEGER, 0))


def _replaced(code: AbstractCode, one: JaxprEqn, values: list[Any]) -> list[Any]:
    """An array with a part of it changed, at a place that is known."""
    array, part, *first = values
    place = first[0].item()
    dtype = shaped(one.outvars[0]).dtype
    if code.is_many(array.shape, dtype) and part.shape == (1, *array.shape[1:]) and code.moves(place):
        return [_with_row(code, array, part, _within(code, place.value, array.shape[0]))]
    array, part = map(code.in_registers, (array, part))
    starts = _starts(first, array.shape, part.shape)
    out = array.copy()
    out[tuple(slice(at, at + size) for at, size in zip(starts, part.shape, strict=True))] = part
    return [code.settled(out, out.shape, dtype)]


def _with_row(code: AbstractCode, array: Any, part: Any, place: ir.Value) -> Block:
    """A copy of an array of many numbers with another row, at a place that is known when the code is run."""
    into = code.work.block(array.shape)
    copied(code.work, into, code.block_of(array), exact=False)
    copied(code.work, into.at(code.builder, place), code.block_of(part).part(0))
    return into


def _starts(places: Sequence[np.ndarray], shape: Sequence[int], sizes: Sequence[int]) -> list[int]:
    """Where a part of an array begins, within it."""
    found = [known(place.item()) for place in places]
    if None in found:
        raise Unsupported("a part of an array that moves")
    return [min(max(int(at), 0), n - size) for at, n, size in zip(found, shape, sizes, strict=True)]


PARTS: dict[str, Callable[[AbstractCode, JaxprEqn, list[Any]], list[Any]]] = {
    "closed_call": _inlined_call,
    "cond": _branches,
    "custom_jvp_call": _by_its_own_slopes,
    "custom_vjp_call": _without_slopes,
    "dynamic_slice": _looked_up,
    "dynamic_update_slice": _replaced,
    "eval_jaxpr": _inlined_call,  # a closed call, from JAX 0.11 on
    "jit": _inlined,
    "platform_index": _on_a_processor,
    "remat2": _inlined_open,
    "scan": _scan,
    "while": _while,
}
