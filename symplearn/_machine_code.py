"""A traced function, with its slopes along many directions, as machine code.

XLA runs small operations one after the other, from memory to memory; here all that a trajectory's row takes stays in
registers: every number as a scalar, and its slopes along the directions, which are carried beside it (forward mode), in
one register. Arithmetic, branches, loops, and tables that are read are known; `Unsupported` is raised for all else,
which is then XLA's work.
"""

import math
import sys
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal
from llvmlite import ir

from ._machine_places import PLACED
from ._machine_rules import INTEGER, RULES, Arithmetic, Dual, Unsupported, kind_of, known, type_of

# Loops of at most so many steps are written down step by step where that tells places in arrays.
_FEW = 16
# Bytes of all tables that are filled when they are run: they lie on the stack, which threads have half a megabyte of.
_MOST_KEPT = 1 << 18


class Table:
    """Numbers in memory, row by row, that are only read; they have no slopes."""

    def __init__(self, pointer: ir.Value, shape: tuple[int, ...]):
        self.pointer, self.shape = pointer, shape


class Code(Arithmetic):
    """Writes traced operations into a function that is being built. A value is an array of `Dual`, or a `Table`.

    The entries of a register are the slopes of a number along so many directions; or, with `beside`, registers are what
    is computed, of so many lanes side by side, and nothing has slopes. More than `most` operations are not written.
    """

    def __init__(self, builder: ir.IRBuilder, width: int, beside: bool = False, most: int = sys.maxsize):
        super().__init__(builder, width, most)
        self.beside, self.kept = beside, 0
        self._sloped: dict[int, tuple[Any, ClosedJaxpr]] = {}

    def kept_as(self, dtype: Any) -> ir.Type:
        """The type in which a value is kept in memory."""
        return self.register_of(type_of(dtype)) if self.beside else type_of(dtype)

    def fitted(self, value: ir.Value, kind: ir.Type) -> ir.Value:
        """A value as one of a type: every lane has the same, if need be."""
        return self.wide(value) if isinstance(kind, ir.VectorType) else value

    def evaluated(self, program: ClosedJaxpr, values: Sequence[Any]) -> list[Any]:
        """What a traced function yields."""
        inner = program.jaxpr
        found: dict[Any, Any] = dict(zip(inner.constvars, map(self.constant, program.consts), strict=True))
        found.update(zip(inner.invars, values, strict=True))

        def value(atom: Any) -> Any:
            if not isinstance(atom, Literal):
                return found[atom]
            return self.constant(np.asarray(atom.val, _shaped(atom).dtype))

        for one in inner.eqns:
            yielded = self._applied(one, [value(atom) for atom in one.invars])
            for atom, array in zip(one.outvars, yielded, strict=True):
                if array.shape != _shaped(atom).shape:
                    raise Unsupported(f"{one.primitive.name} as it is used here")
                found[atom] = array
        return [value(atom) for atom in inner.outvars]

    def _applied(self, one: JaxprEqn, values: list[Any]) -> Sequence[Any]:
        name = one.primitive.name
        if name in _PARTS:
            return _PARTS[name](self, one, values)
        if any(isinstance(value, Table) for value in values):
            raise Unsupported(f"{name} of a table")
        if name in PLACED:
            return PLACED[name](self, one, values)
        if name not in RULES:
            raise Unsupported(f"the operation {name}")
        return [_each(lambda *entries: self.ruled(one, entries), *np.broadcast_arrays(*values))]

    def ruled(self, one: JaxprEqn, entries: Sequence[Dual]) -> Dual:
        """What an operation makes of some numbers."""
        spared = self.spared(one.primitive.name, entries) if self.beside else None
        return super().ruled(one, entries) if spared is None else spared

    def constant(self, array: Any) -> Any:
        """Numbers that are known when the code is written; those of a loop are looked up in a table."""
        plain = np.asarray(array)
        out = np.empty(plain.shape, object)
        for place in np.ndindex(plain.shape):
            out[place] = Dual(ir.Constant(type_of(plain.dtype), plain[place].item()))
        return out

    def table(self, values: np.ndarray) -> Table:
        """A table of numbers."""
        entries = [entry.value for entry in values.ravel()]
        if not entries or not all(isinstance(entry, ir.Constant) for entry in entries):
            return self._table_of_lanes(values)
        row = ir.Constant(ir.ArrayType(entries[0].type, len(entries)), entries)
        module = self.builder.module
        kept = ir.GlobalVariable(module, row.type, module.get_unique_name("table"))
        kept.initializer, kept.global_constant, kept.linkage = row, True, "internal"
        zero = ir.Constant(INTEGER, 0)
        return Table(self.builder.gep(kept, [zero, zero]), values.shape)

    def _table_of_lanes(self, values: np.ndarray) -> Table:
        """A table of what is known when it is run."""
        entries = [entry.value for entry in values.ravel()]
        if not self.beside or not entries:
            raise Unsupported("a loop along what is not known")
        found = self.room(self.register_of(kind_of(entries[0])), values.shape)
        for k, entry in enumerate(entries):
            self.builder.store(self.wide(entry), self.cell(found, ir.Constant(INTEGER, k)))
        return found

    def room(self, kind: ir.Type, shape: tuple[int, ...]) -> Table:
        """Memory for a table that is written row by row."""
        self.kept += 8 * self.width * math.prod(shape)
        if self.kept > _MOST_KEPT:
            raise Unsupported("much that is kept on the way")
        with self.builder.goto_entry_block():
            return Table(self.builder.alloca(kind, math.prod(shape)), shape)

    def cell(self, table: Table, place: ir.Value) -> ir.Value:
        """Where one number of a table is."""
        return self.builder.gep(table.pointer, [place])

    def set_row(self, table: Table, place: ir.Value, values: np.ndarray) -> None:
        """Write one row of a table."""
        first = self.builder.mul(place, ir.Constant(INTEGER, values.size))
        for k, entry in enumerate(values.ravel()):
            self.builder.store(
                self.wide(entry.value), self.cell(table, self.builder.add(first, ir.Constant(INTEGER, k)))
            )

    def row(self, table: Table, place: ir.Value) -> np.ndarray:
        """One row of a table."""
        out = np.empty(table.shape[1:], object)
        first = self.builder.mul(place, ir.Constant(INTEGER, out.size))
        for k, at in enumerate(np.ndindex(out.shape)):
            cell = self.builder.gep(table.pointer, [self.builder.add(first, ir.Constant(INTEGER, k))])
            out[at] = Dual(self.builder.load(cell))
        return out

    def program_with_slopes(self, one: JaxprEqn) -> ClosedJaxpr:
        """A function that has a derivative of its own: values and slopes from values and slopes, traced once."""
        call, p = one.params["call_jaxpr"], one.primitive
        if id(call) not in self._sloped:
            function = lambda *some: p.bind(*some, **p.get_bind_params(one.params))  # noqa: E731
            shapes = tuple(jax.ShapeDtypeStruct(_shaped(a).shape, _shaped(a).dtype) for a in one.invars)
            program = jax.make_jaxpr(lambda values, slopes: jax.jvp(function, values, slopes))(shapes, shapes)
            self._sloped[id(call)] = call, program  # the first is kept, so that no other gets its number
        return self._sloped[id(call)][1]


def _shaped(atom: Any) -> Any:
    """Shape and type of what stands for a value in a traced function."""
    return atom.aval


class Cells:
    """Values in memory, for what changes along a loop or is told by a branch."""

    def __init__(self, code: Code, atoms: Sequence[Any]):
        self.code, self.shapes, build = code, list(map(_shaped, atoms)), code.builder
        with build.goto_entry_block():
            self.cells = [
                [(build.alloca(code.kept_as(s.dtype)),
                  build.alloca(code.register) if s.dtype == float and not code.beside else None)
                 for _ in range(math.prod(s.shape))]
                for s in self.shapes
            ]  # fmt: skip
        self.sloped = [np.zeros(s.shape, bool) for s in self.shapes]

    def store(self, values: Sequence[np.ndarray]) -> None:
        build = self.code.builder
        for cells, array, sloped in zip(self.cells, values, self.sloped, strict=True):
            for (cell, slopes), entry, place in zip(cells, array.ravel(), np.ndindex(array.shape), strict=True):
                build.store(self.code.fitted(entry.value, cell.type.pointee), cell)
                if slopes is not None:
                    build.store(self.code.slope(entry), slopes)
                    sloped[place] |= entry.slope is not None

    def load(self) -> list[np.ndarray]:
        """The values; what has had no slope wherever it was stored has none."""
        build, out = self.code.builder, []
        for cells, shaped, sloped in zip(self.cells, self.shapes, self.sloped, strict=True):
            array = np.empty(shaped.shape, object)
            for (cell, slopes), place in zip(cells, np.ndindex(array.shape), strict=True):
                array[place] = Dual(build.load(cell), build.load(slopes) if sloped[place] else None)
            out.append(array)
        return out

    def slope_all(self) -> None:
        """Let every real number have slopes: what a loop does to them is not known before."""
        for sloped, shaped in zip(self.sloped, self.shapes, strict=True):
            sloped[...] = shaped.dtype == float and not self.code.beside


def _inlined(code: Code, one: JaxprEqn, values: list[Any]) -> list[Any]:
    return code.evaluated(one.params["jaxpr"], values)


def _inlined_call(code: Code, one: JaxprEqn, values: list[Any]) -> list[Any]:
    return code.evaluated(one.params["call_jaxpr"], values)


def _inlined_open(code: Code, one: JaxprEqn, values: list[Any]) -> list[Any]:
    return code.evaluated(ClosedJaxpr(one.params["jaxpr"], ()), values)


def _by_its_own_slopes(code: Code, one: JaxprEqn, values: list[Any]) -> list[Any]:
    """A function with a derivative of its own."""
    if all(entry.slope is None for array in values for entry in array.ravel()):
        return code.evaluated(one.params["call_jaxpr"], values)
    plain = [_each(lambda dual: Dual(dual.value), array) for array in values]
    slopes = [_each(lambda dual: Dual(dual.slope), array) for array in values]  # numbers to work with, here
    found = code.evaluated(code.program_with_slopes(one), [*plain, *slopes])
    half = len(found) // 2
    joined = lambda value, slope: Dual(value.value, slope.value)  # noqa: E731
    return [_each(joined, *pair) for pair in zip(found[:half], found[half:], strict=True)]


def _without_slopes(code: Code, one: JaxprEqn, values: list[Any]) -> list[Any]:
    if not code.beside:
        raise Unsupported("slopes that are defined the other way round")
    return code.evaluated(one.params["call_jaxpr"], values)


def _each(function: Callable[..., Dual], *arrays: np.ndarray) -> np.ndarray:
    """A function of the entries of arrays."""
    out = np.empty(arrays[0].shape, object)
    for place in np.ndindex(out.shape):
        out[place] = function(*(array[place] for array in arrays))
    return out


def _branches(code: Code, one: JaxprEqn, values: list[Any]) -> list[Any]:
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


def _on_a_processor(code: Code, one: JaxprEqn, values: list[Any]) -> list[Any]:
    """Which of the ways to do something is that of a processor."""
    platforms = one.params["platforms"]
    mine = next(k for k, some in enumerate(platforms) if some is None or "cpu" in some)
    return [code.constant(np.asarray(mine, np.int32))]


def _all_branches(code: Code, one: JaxprEqn, index: ir.Value, operands: list[Any]) -> list[Any]:
    """What each lane's branch comes to, out of all of them."""
    found = [code.evaluated(program, operands) for program in one.params["branches"]]
    out = found[-1]
    for k, some in reversed(list(enumerate(found[:-1]))):
        mine = code.builder.icmp_signed("==", *code.pair(index, ir.Constant(kind_of(index), k)))
        pick = lambda a, b, mine=mine: Dual(code.chosen(mine, a.value, b.value))  # noqa: E731
        out = [_each(pick, *np.broadcast_arrays(*pair)) for pair in zip(some, out, strict=True)]
    return out


def _while(code: Code, one: JaxprEqn, values: list[Any]) -> list[Any]:
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


def _scan(code: Code, one: JaxprEqn, values: list[Any]) -> list[Any]:
    p = one.params
    given, last, length = p["num_consts"], p["num_consts"] + p["num_carry"], p["length"]
    if code.beside and length <= _FEW and (p["unroll"] >= length or _asks_for_places(p["jaxpr"].jaxpr)):
        return _step_by_step(code, one, values)
    told = one.outvars[p["num_carry"] :]
    if told and not code.beside:
        raise Unsupported("a loop that tells what it passes")
    rooms = [code.room(code.kept_as(_shaped(atom).dtype), _shaped(atom).shape) for atom in told]
    tables = [value if isinstance(value, Table) else code.table(value) for value in values[last:]]
    cells = Cells(code, one.outvars[: p["num_carry"]])
    cells.store(values[given:last])
    cells.slope_all()
    looped(code, p, values[:given], cells, tables, rooms)
    return [*cells.load(), *(_all_of(code, room) for room in rooms)]


def looped(
    code: Code, p: Any, given: Sequence[Any], cells: Cells, tables: Sequence[Table], rooms: Sequence[Table]
) -> None:
    """A loop along the rows of tables, of which the cells hold what changes; what is told is written to the rooms."""
    build, length, step = code.builder, p["length"], ir.Constant(INTEGER, 1)
    with build.goto_entry_block():
        count = build.alloca(INTEGER)
    build.store(ir.Constant(INTEGER, 0), count)
    again, inside, end = map(build.append_basic_block, ("again", "inside", "end"))
    build.branch(again)
    build.position_at_end(again)
    k = build.load(count)
    build.cbranch(build.icmp_signed("<", k, ir.Constant(INTEGER, length)), inside, end)
    build.position_at_end(inside)
    place = build.sub(ir.Constant(INTEGER, length - 1), k) if p["reverse"] else k
    found = code.evaluated(p["jaxpr"], [*given, *cells.load(), *(code.row(table, place) for table in tables)])
    for room, values in zip(rooms, found[p["num_carry"] :], strict=True):
        code.set_row(room, place, values)
    cells.store(found[: p["num_carry"]])
    build.store(build.add(k, step), count)
    build.branch(again)
    build.position_at_end(end)


def _step_by_step(code: Code, one: JaxprEqn, values: list[Any]) -> list[Any]:
    """A short loop, every step of which is written down, so that places in arrays are known."""
    p = one.params
    given, last, carried = p["num_consts"], p["num_consts"] + p["num_carry"], p["num_carry"]
    now, told = values[given:last], []
    for k in range(p["length"])[:: -1 if p["reverse"] else 1]:
        found = code.evaluated(p["jaxpr"], [*values[:given], *now, *(value[k, ...] for value in values[last:])])
        now = found[:carried]
        told.append(found[carried:])
    rows = told[:: -1 if p["reverse"] else 1]
    return [*now, *(np.stack(column) for column in zip(*rows, strict=True))]


def _asks_for_places(program: Any) -> bool:
    """Whether a traced function looks at, or changes, a part of an array that moves."""
    inner = [part for one in program.eqns for part in jax.tree.leaves(list(one.params.values()), is_leaf=_is_program)]
    names = {one.primitive.name for one in program.eqns}
    return bool(names & {"dynamic_slice", "dynamic_update_slice"}) or any(
        _asks_for_places(getattr(part, "jaxpr", part)) for part in inner if _is_program(part)
    )


def _is_program(part: Any) -> bool:
    return isinstance(part, (ClosedJaxpr, Jaxpr))


def _all_of(code: Code, table: Table) -> np.ndarray:
    """All numbers of a table."""
    rows = [code.row(table, ir.Constant(INTEGER, k)) for k in range(table.shape[0])]
    return np.stack(rows) if rows else np.empty(table.shape, object)


def _looked_up(code: Code, one: JaxprEqn, values: list[Any]) -> list[Any]:
    """A row of a table, or a part of an array at a place that is known."""
    table, first, *_ = values
    sizes = one.params["slice_sizes"]
    if not isinstance(table, Table):
        if sizes == (1, *table.shape[1:]) and known(values[1].item()) is None and code.width == 1:
            return [code.row(code.table(table), _within(code, values[1].item().value, len(table))).reshape(sizes)]
        starts = _starts(values[1:], table.shape, sizes)
        return [table[tuple(slice(at, at + size) for at, size in zip(starts, sizes, strict=True))]]
    if sizes != (1, *table.shape[1:]):
        raise Unsupported("a part of an array that moves")
    place = first[()].value
    place = place if place.type == INTEGER else code.builder.sext(place, INTEGER)
    return [code.row(table, place).reshape(sizes)]


def _within(code: Code, place: ir.Value, count: int) -> ir.Value:
    """The nearest row that there is."""
    build, last = code.builder, ir.Constant(INTEGER, count - 1)
    place = place if place.type == INTEGER else build.sext(place, INTEGER)
    place = build.select(build.icmp_signed("<", place, last), place, last)
    return build.select(build.icmp_signed(">", place, ir.Constant(INTEGER, 0)), place, ir.Constant(INTEGER, 0))


def _replaced(code: Code, one: JaxprEqn, values: list[Any]) -> list[Any]:
    """An array with a part of it changed, at a place that is known."""
    array, part, *first = values
    starts = _starts(first, array.shape, part.shape)
    out = array.copy()
    out[tuple(slice(at, at + size) for at, size in zip(starts, part.shape, strict=True))] = part
    return [out]


def _starts(places: Sequence[np.ndarray], shape: Sequence[int], sizes: Sequence[int]) -> list[int]:
    """Where a part of an array begins, within it."""
    found = [known(place.item()) for place in places]
    if None in found:
        raise Unsupported("a part of an array that moves")
    return [min(max(int(at), 0), n - size) for at, n, size in zip(found, shape, sizes, strict=True)]


_PARTS: dict[str, Callable[[Code, JaxprEqn, list[Any]], list[Any]]] = {
    "closed_call": _inlined_call,
    "cond": _branches,
    "custom_jvp_call": _by_its_own_slopes,
    "custom_vjp_call": _without_slopes,
    "dynamic_slice": _looked_up,
    "dynamic_update_slice": _replaced,
    "jit": _inlined,
    "platform_index": _on_a_processor,
    "remat2": _inlined_open,
    "scan": _scan,
    "while": _while,
}
