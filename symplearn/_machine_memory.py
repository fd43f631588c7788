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

from ._machine_arithmetic import DOUBLE, INTEGER, Arithmetic, Dual, Unsupported, kind_of, type_of
from ._machine_blocks import MANY, Block, Pending, Workspace
from ._machine_kernels import copied

# Entries of a block that may become numbers in registers, for an operation that has no other way.
_FEW = 256
# Bytes of all tables that are filled when they are run: they lie on the stack, which threads have half a megabyte of.
_MOST_KEPT = 1 << 18


class AbstractCode(Arithmetic):
    """Writes traced operations into a function that is being built. A value is an array of `Dual`, or a table.

    The entries of a register are the slopes of a number along so many directions; or, with `beside`, registers are what
    is computed, of so many lanes side by side, and nothing has slopes. More than `most` operations are not written.
    With a workspace, arrays of many numbers are blocks in it.
    """

    def __init__(
        self,
        builder: ir.IRBuilder,
        width: int,
        beside: bool = False,
        most: int = sys.maxsize,
        work: Workspace | None = None,
    ):
        super().__init__(builder, width, most)
        self.beside, self.kept, self.space = beside, 0, work
        self._sloped: dict[int, tuple[Any, ClosedJaxpr]] = {}

    @abc.abstractmethod
    def plainly(self, one: JaxprEqn, values: list[Any]) -> Sequence[Any]:
        """What an operation makes of arrays of numbers in registers."""

    @abc.abstractmethod
    def ruled(self, one: JaxprEqn, entries: Sequence[Dual]) -> Dual:
        """What an operation makes of single numbers."""

    @abc.abstractmethod
    def evaluated(self, program: ClosedJaxpr, values: Sequence[Any]) -> list[Any]:
        """What a traced function yields."""

    @property
    def work(self) -> Workspace:
        """The workspace, which there is where blocks are met."""
        assert self.space is not None
        return self.space

    def moves(self, place: Dual) -> bool:
        """Whether a place in an array is known no sooner than when the code is run, and then the same in every lane."""
        return not isinstance(place.value, ir.Constant) and not isinstance(place.value.type, ir.VectorType)

    def is_many(self, shape: Sequence[int], dtype: Any) -> bool:
        """Whether an array is a block, or of one number everywhere."""
        return self.space is not None and is_real(dtype) and math.prod(map(int, shape)) >= MANY

    def block_of(self, value: Any) -> Block:
        """An array as a block."""
        if isinstance(value, Block):
            return value
        into, number = self.work.block(value.shape), alike(value)
        if number is not None:
            copied(self.work, into, number.value, exact=False)
            return into
        for place in np.ndindex(value.shape):
            copied(self.work, into.part(*(slice(k, k + 1) for k in place)), value[place].value)
        return into

    def source(self, value: Any) -> "Block | ir.Value":
        """What is to be copied to a block: a number, if an array is the same everywhere, or a block."""
        number = None if isinstance(value, Block) else alike(value)
        return self.block_of(value) if number is None else number.value

    def in_registers(self, value: Any) -> Any:
        """An array as one of numbers in registers."""
        if not isinstance(value, Block):
            return value
        if value.size > _FEW:
            raise Unsupported("an operation on many numbers")
        first, out = value.start(self.builder), np.empty(value.shape, object)
        for place in np.ndindex(out.shape):
            at = sum(k * stride for k, stride in zip(place, value.side.strides, strict=True))
            pointer = self.builder.gep(first, [ir.Constant(INTEGER, at)])
            if self.width > 1 and not value.alone:
                pointer = self.builder.bitcast(pointer, self.register.as_pointer())
            out[place] = Dual(self.builder.load(pointer, align=8))
        return out

    def settled(self, value: Any, shape: Sequence[int], dtype: Any) -> Any:
        """An array as it is kept: in registers, or as a block."""
        if self.space is None or isinstance(value, Pending):
            return value
        if isinstance(value, Block):
            return value if self.is_many(shape, dtype) else self.in_registers(value)
        return self.block_of(value) if self.is_many(shape, dtype) and alike(value) is None else value

    def kept_as(self, dtype: Any) -> ir.Type:
        """The type in which a value is kept in memory."""
        return self.register_of(type_of(dtype)) if self.beside else type_of(dtype)

    def fitted(self, value: ir.Value, kind: ir.Type) -> ir.Value:
        """A value as one of a type: every lane has the same, if need be."""
        return self.wide(value) if isinstance(kind, ir.VectorType) else value

    def constant(self, array: Any) -> Any:
        """Numbers that are known when the code is written; those of a loop are looked up in a table."""
        plain = np.asarray(array)
        if self.is_many(plain.shape, plain.dtype):
            return self._block_of_constants(plain)
        out = np.empty(plain.shape, object)
        for place in np.ndindex(plain.shape):
            out[place] = Dual(ir.Constant(type_of(plain.dtype), plain[place].item()))
        return out

    def _block_of_constants(self, array: np.ndarray) -> Any:
        if (array == array.flat[0]).all():
            return np.broadcast_to(np.array(Dual(ir.Constant(DOUBLE, array.flat[0].item())), object), array.shape)
        row, module = ir.Constant(ir.ArrayType(DOUBLE, array.size), array.ravel().tolist()), self.builder.module
        kept = ir.GlobalVariable(module, row.type, module.get_unique_name("block"))
        kept.initializer, kept.global_constant, kept.linkage = row, True, "internal"
        zero, layout = ir.Constant(INTEGER, 0), np.empty(array.shape, np.int8)
        return Block(kept.gep([zero, zero]), layout, layout, 1, alone=True, fixed=True)

    def table(self, values: Any) -> "AbstractTable":
        """A table of numbers."""
        if isinstance(values, Block):
            return BlockTable(values)
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

    def room_for(self, dtype: Any, shape: tuple[int, ...]) -> "AbstractTable":
        """Memory for a table that is written row by row, of what is told along a loop."""
        if self.space is not None and is_real(dtype) and 0 not in shape:
            return BlockTable(self.space.block(shape))
        return self.room(self.kept_as(dtype), shape)

    def room(self, kind: ir.Type, shape: tuple[int, ...]) -> "Table":
        """The same on the stack."""
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


class BlockTable(AbstractTable):
    """A block as a table."""

    def __init__(self, block: Block):
        self.block, self.shape = block, block.shape

    def read(self, code: AbstractCode, entry: ir.Value) -> ir.Value:
        raise Unsupported("single numbers of a table that is a block")

    def write(self, code: AbstractCode, entry: ir.Value, value: ir.Value) -> None:
        raise Unsupported("single numbers of a table that is a block")

    def row(self, code: AbstractCode, place: ir.Value) -> Any:
        return code.settled(self.block.at(code.builder, place), self.shape[1:], "float64")

    def set_row(self, code: AbstractCode, place: ir.Value, values: Any) -> None:
        copied(code.work, self.block.at(code.builder, place), code.block_of(values))


def is_real(dtype: Any) -> bool:
    return str(dtype) == "float64"


def alike(value: np.ndarray) -> Dual | None:
    """The number that all entries of an array are, if so it is."""
    first = value.flat[0] if value.size else None
    return first if first is not None and all(one is first for one in value.flat) else None


def shaped(atom: Any) -> Any:
    """Shape and type of what stands for a value in a traced function."""
    return atom.aval
