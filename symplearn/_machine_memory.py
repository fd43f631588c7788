"""Numbers of machine code that lie in memory: tables that loops go along, and cells for what changes."""

import abc
import math
import sys
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, JaxprEqn
from llvmlite import ir

from ._machine_arithmetic import INTEGER, Arithmetic, Dual, Unsupported, kind_of, type_of

# Bytes of all tables that are filled when they are run: they lie on the stack, which threads have half a megabyte of.
_MOST_KEPT = 1 << 18


class AbstractCode(Arithmetic):
    """Writes traced operations into a function that is being built. A value is an array of `Dual`, or a table.

    The entries of a register are the slopes of a number along so many directions; or, with `beside`, registers are what
    is computed, of so many lanes side by side, and nothing has slopes. More than `most` operations are not written.
    """

    def __init__(self, builder: ir.IRBuilder, width: int, beside: bool = False, most: int = sys.maxsize):
        super().__init__(builder, width, most)
        self.beside, self.kept = beside, 0
        self._sloped: dict[int, tuple[Any, ClosedJaxpr]] = {}

    @abc.abstractmethod
    def evaluated(self, program: ClosedJaxpr, values: Sequence[Any]) -> list[Any]:
        """What a traced function yields."""

    def kept_as(self, dtype: Any) -> ir.Type:
        """The type in which a value is kept in memory."""
        return self.register_of(type_of(dtype)) if self.beside else type_of(dtype)

    def fitted(self, value: ir.Value, kind: ir.Type) -> ir.Value:
        """A value as one of a type: every lane has the same, if need be."""
        return self.wide(value) if isinstance(kind, ir.VectorType) else value

    def constant(self, array: Any) -> Any:
        """Numbers that are known when the code is written; those of a loop are looked up in a table."""
        plain = np.asarray(array)
        out = np.empty(plain.shape, object)
        for place in np.ndindex(plain.shape):
            out[place] = Dual(ir.Constant(type_of(plain.dtype), plain[place].item()))
        return out

    def table(self, values: np.ndarray) -> "Table":
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

    def _table_of_lanes(self, values: np.ndarray) -> "Table":
        """A table of what is known when it is run."""
        entries = [entry.value for entry in values.ravel()]
        if not self.beside or not entries:
            raise Unsupported("a loop along what is not known")
        found = self.room(self.register_of(kind_of(entries[0])), values.shape)
        for k, entry in enumerate(entries):
            found.write(self, ir.Constant(INTEGER, k), entry)
        return found

    def room(self, kind: ir.Type, shape: tuple[int, ...]) -> "Table":
        """Memory for a table that is written row by row."""
        self.kept += 8 * self.width * math.prod(shape)
        if self.kept > _MOST_KEPT:
            raise Unsupported("much that is kept on the way")
        with self.builder.goto_entry_block():
            return Table(self.builder.alloca(kind, math.prod(shape)), shape)

    def program_with_slopes(self, one: JaxprEqn) -> ClosedJaxpr:
        """A function that has a derivative of its own: values and slopes from values and slopes, traced once."""
        call, p = one.params["call_jaxpr"], one.primitive
        if id(call) not in self._sloped:
            function = lambda *some: p.bind(*some, **p.get_bind_params(one.params))  # noqa: E731
            shapes = tuple(jax.ShapeDtypeStruct(shaped(a).shape, shaped(a).dtype) for a in one.invars)
            program = jax.make_jaxpr(lambda values, slopes: jax.jvp(function, values, slopes))(shapes, shapes)
            self._sloped[id(call)] = call, program  # the first is kept, so that no other gets its number
        return self._sloped[id(call)][1]


class AbstractTable(abc.ABC):
    """Numbers in memory, row by row; they have no slopes."""

    shape: tuple[int, ...]

    @abc.abstractmethod
    def read(self, code: AbstractCode, entry: ir.Value) -> ir.Value:
        """One number, by its place among all."""

    @abc.abstractmethod
    def write(self, code: AbstractCode, entry: ir.Value, value: ir.Value) -> None:
        """Write one number."""

    def row(self, code: AbstractCode, place: ir.Value) -> np.ndarray:
        """One row."""
        out = np.empty(self.shape[1:], object)
        for at, entry in zip(np.ndindex(out.shape), self._entries(code, place), strict=True):
            out[at] = Dual(self.read(code, entry))
        return out

    def set_row(self, code: AbstractCode, place: ir.Value, values: np.ndarray) -> None:
        """Write one row."""
        for dual, entry in zip(values.ravel(), self._entries(code, place), strict=True):
            self.write(code, entry, dual.value)

    def _entries(self, code: AbstractCode, place: ir.Value) -> list[ir.Value]:
        """The places of a row's numbers among all."""
        size, build = math.prod(self.shape[1:]), code.builder
        first = build.mul(place, ir.Constant(INTEGER, size))
        return [build.add(first, ir.Constant(INTEGER, k)) for k in range(size)]


class Table(AbstractTable):
    """Numbers that lie end to end."""

    def __init__(self, pointer: ir.Value, shape: tuple[int, ...]):
        self.pointer, self.shape = pointer, shape

    def read(self, code: AbstractCode, entry: ir.Value) -> ir.Value:
        return code.builder.load(code.builder.gep(self.pointer, [entry]))

    def write(self, code: AbstractCode, entry: ir.Value, value: ir.Value) -> None:
        code.builder.store(code.wide(value), code.builder.gep(self.pointer, [entry]))


def shaped(atom: Any) -> Any:
    """Shape and type of what stands for a value in a traced function."""
    return atom.aval


class Cells:
    """Values in memory, for what changes along a loop or is told by a branch."""

    def __init__(self, code: AbstractCode, atoms: Sequence[Any]):
        self.code, self.shapes, build = code, list(map(shaped, atoms)), code.builder
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
        for cells, one, sloped in zip(self.cells, self.shapes, self.sloped, strict=True):
            array = np.empty(one.shape, object)
            for (cell, slopes), place in zip(cells, np.ndindex(array.shape), strict=True):
                array[place] = Dual(build.load(cell), build.load(slopes) if sloped[place] else None)
            out.append(array)
        return out

    def slope_all(self) -> None:
        """Let every real number have slopes: what a loop does to them is not known before."""
        for sloped, one in zip(self.sloped, self.shapes, strict=True):
            sloped[...] = one.dtype == float and not self.code.beside
