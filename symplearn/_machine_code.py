"""A traced function, with its slopes along many directions, as machine code.

XLA runs small operations one after the other, from memory to memory; here all that a trajectory's row takes stays in
registers: every number as a scalar, and its slopes along the directions, which are carried beside it (forward mode), in
one register. Arithmetic, branches, loops, and tables that are read are known; `Unsupported` is raised for all else,
which is then XLA's work.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal
from llvmlite import ir

from ._machine_places import PLACED
from ._machine_rules import INTEGER, RULES, Arithmetic, Dual, Unsupported, type_of


class Table:
    """Numbers in memory, row by row, that are only read; they have no slopes."""

    def __init__(self, pointer: ir.Value, shape: tuple[int, ...]):
        self.pointer, self.shape = pointer, shape


class Code(Arithmetic):
    """Writes traced operations into a function that is being built. A value is an array of `Dual`, or a `Table`."""

    def __init__(self, builder: ir.IRBuilder, width: int):
        super().__init__(builder, width)
        self._sloped: dict[int, tuple[Any, ClosedJaxpr]] = {}

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
            found.update(zip(one.outvars, self._applied(one, [value(atom) for atom in one.invars]), strict=True))
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

    def constant(self, array: Any) -> Any:
        """Numbers that are known when the code is written; those of a loop are looked up in a table."""
        plain = np.asarray(array)
        out = np.empty(plain.shape, object)
        for place in np.ndindex(plain.shape):
            out[place] = Dual(ir.Constant(type_of(plain.dtype), plain[place].item()))
        return out

    def table(self, values: np.ndarray) -> Table:
        """A table of known numbers."""
        entries = [entry.value for entry in values.ravel()]
        if not all(isinstance(entry, ir.Constant) for entry in entries):
            raise Unsupported("a loop along what is not known")
        row = ir.Constant(ir.ArrayType(entries[0].type, len(entries)), entries)
        module = self.builder.module
        kept = ir.GlobalVariable(module, row.type, module.get_unique_name("table"))
        kept.initializer, kept.global_constant, kept.linkage = row, True, "internal"
        zero = ir.Constant(INTEGER, 0)
        return Table(self.builder.gep(kept, [zero, zero]), values.shape)

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
                [(build.alloca(type_of(s.dtype)), build.alloca(code.register) if s.dtype == float else None)
                 for _ in range(math.prod(s.shape))]
                for s in self.shapes
            ]  # fmt: skip
        self.sloped = [np.zeros(s.shape, bool) for s in self.shapes]

    def store(self, values: Sequence[np.ndarray]) -> None:
        build = self.code.builder
        for cells, array, sloped in zip(self.cells, values, self.sloped, strict=True):
            for (cell, slopes), entry, place in zip(cells, array.ravel(), np.ndindex(array.shape), strict=True):
                build.store(entry.value, cell)
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
            sloped[...] = shaped.dtype == float


def _inlined(code: Code, one: JaxprEqn, values: list[Any]) -> list[Any]:
    return code.evaluated(one.params["jaxpr"], values)


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


def _each(function: Callable[..., Dual], *arrays: np.ndarray) -> np.ndarray:
    """A function of the entries of arrays."""
    out = np.empty(arrays[0].shape, object)
    for place in np.ndindex(out.shape):
        out[place] = function(*(array[place] for array in arrays))
    return out


def _branches(code: Code, one: JaxprEqn, values: list[Any]) -> list[Any]:
    if one.params.get("branches_platforms") is not None:
        raise Unsupported("a branch by platform")
    index, operands, build = values[0][()].value, values[1:], code.builder
    cells, end, here, blocks = Cells(code, one.outvars), build.append_basic_block("joined"), build.block, []
    for program in one.params["branches"]:
        blocks.append(build.append_basic_block("branch"))
        build.position_at_end(blocks[-1])
        cells.store(code.evaluated(program, operands))
        build.branch(end)
    build.position_at_end(here)
    choice = build.switch(index, blocks[-1])
    for k, block in enumerate(blocks[:-1]):
        choice.add_case(ir.Constant(index.type, k), block)
    build.position_at_end(end)
    return cells.load()


def _while(code: Code, one: JaxprEqn, values: list[Any]) -> list[Any]:
    p, build = one.params, code.builder
    asked, given = p["cond_nconsts"], p["cond_nconsts"] + p["body_nconsts"]
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
    p, build = one.params, code.builder
    given, last = p["num_consts"], p["num_consts"] + p["num_carry"]
    if len(one.outvars) > p["num_carry"]:
        raise Unsupported("a loop that tells what it passes")
    tables, length, step = [code.table(array) for array in values[last:]], p["length"], ir.Constant(INTEGER, 1)
    cells = Cells(code, one.outvars)
    cells.store(values[given:last])
    cells.slope_all()
    with build.goto_entry_block():
        count = build.alloca(INTEGER)
    build.store(ir.Constant(INTEGER, 0), count)
    again, inside, end = map(build.append_basic_block, ("again", "inside", "end"))
    build.branch(again)
    build.position_at_end(again)
    k, now = build.load(count), cells.load()
    build.cbranch(build.icmp_signed("<", k, ir.Constant(INTEGER, length)), inside, end)
    build.position_at_end(inside)
    place = build.sub(ir.Constant(INTEGER, length - 1), k) if p["reverse"] else k
    rows = [code.row(table, place) for table in tables]
    cells.store(code.evaluated(p["jaxpr"], [*values[:given], *now, *rows]))
    build.store(build.add(k, step), count)
    build.branch(again)
    build.position_at_end(end)
    return now


def _looked_up(code: Code, one: JaxprEqn, values: list[Any]) -> list[Any]:
    """A row of a table."""
    table, first, *_ = values
    sizes = one.params["slice_sizes"]
    if not isinstance(table, Table) or sizes != (1, *table.shape[1:]):
        raise Unsupported("a part of an array that moves")
    place = first[()].value
    place = place if place.type == INTEGER else code.builder.sext(place, INTEGER)
    return [code.row(table, place).reshape(sizes)]


_PARTS: dict[str, Callable[[Code, JaxprEqn, list[Any]], list[Any]]] = {
    "cond": _branches,
    "custom_jvp_call": _by_its_own_slopes,
    "dynamic_slice": _looked_up,
    "jit": _inlined,
    "scan": _scan,
    "while": _while,
}
