"""A loop of many lanes as machine code: every number of eight lanes side by side in one register."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jax.extend.core import Jaxpr
from llvmlite import ir

from ._foreign_call import POINTERS, handler, numbers, with_memory
from ._machine_arithmetic import BIT, INTEGER, SHORT, Dual, Unsupported, type_of
from ._machine_blocks import MANY, Block, Workspace, pointers
from ._machine_cells import Cells
from ._machine_code import Code
from ._machine_flow import looped
from ._machine_kernels import copied
from ._machine_loops import counted
from ._machine_memory import AbstractCode, AbstractTable
from ._machine_sizes import is_worth_blocks, largest_array, largest_product
from ._native import span
from ._scan_sizes import ScanSizes

# How many lanes one register may have.
WIDTHS = (1, 4, 8)
# Operations of a function. Beyond, a single lane gains nothing: Cherry's gradient, of 28 thousand, took as long as by
# XLA and 7 s to compile. Of several lanes it gained fourfold.
_MOST = {1: 20_000, 4: 40_000, 8: 40_000}
# Numbers that every step of a loop is given beside those that change.
_MOST_GIVEN = 1024
# Products of numbers in one of matrices from which on that is not written number by number.
_LARGE = 1024
_BYTE = ir.IntType(8)


def filling(lanes: int, program: Jaxpr) -> int:
    """How many lanes so many are filled up to, so that they fill registers: one that holds all, or several."""
    if largest_product(program) >= _LARGE:
        return lanes
    width = next((width for width in WIDTHS if width >= lanes), WIDTHS[-1])
    return lanes + -lanes % width


def lane_loop(p: Any, known: Mapping[int, np.ndarray], beside: Sequence[bool], lanes: int) -> ir.Module:
    """A module whose function `called` runs a loop of JAX, of parameters `p`, for so many lanes, which had better fill
    registers. The arguments that are known by their place are written into it.

    Of arguments that are `beside` each other in lanes, and of all results, the last axis is that of lanes.
    """
    program = p["jaxpr"].jaxpr
    width = max(width for width in WIDTHS if lanes % width == 0)
    if largest_product(program) >= _LARGE:
        # Matrices fill registers by themselves. Of eight lanes side by side they would fill no fast memory: 16 networks
        # of width 32 took a third longer.
        return _module(p, known, beside, lanes, 1, True)
    try:
        return _module(p, known, beside, lanes, width, False)
    except Unsupported:
        if largest_array(program) < MANY:
            raise
    return _module(p, known, beside, lanes, width, True)


def _module(
    p: Any, known: Mapping[int, np.ndarray], beside: Sequence[bool], lanes: int, width: int, blocks: bool
) -> ir.Module:
    """The same with so many lanes side by side, where arrays of many numbers are blocks in memory, or all numbers in
    registers."""
    if blocks and not is_worth_blocks(p):
        raise Unsupported("many numbers of which no matrices are made")
    module = ir.Module("lanes")
    work = ir.Function(module, ir.FunctionType(ir.VoidType(), [POINTERS, POINTERS]), "work")
    if blocks:
        inside = ir.Function(module, ir.FunctionType(ir.VoidType(), [POINTERS, POINTERS, pointers()]), "inside")
        inside.linkage = "internal"
        written = _Lanes(p, known, beside, lanes, width, inside)
        written.write()
        with_memory(work, inside, written.code.work.size)
    else:
        _Lanes(p, known, beside, lanes, width, work).write()
    handler(module, work)
    return module


class _Stream(AbstractTable):
    """A table of XLA: numbers of one lane after those of the other, or the same for all."""

    def __init__(self, pointer: ir.Value, shape: tuple[int, ...], dtype: Any, lanes: int | None, first: ir.Value):
        self.pointer, self.shape, self.dtype, self.lanes, self.first = pointer, shape, dtype, lanes, first
        self.kind = type_of(dtype)

    def block(self, code: AbstractCode, shape: tuple[int, ...], place: ir.Value | None, fixed: bool = False) -> Block:
        """All numbers, or a row of them, as a block."""
        build, apart = code.builder, self.lanes or 1
        first = ir.Constant(INTEGER, 0) if self.lanes is None else self.first
        if place is not None:
            first = build.add(build.mul(place, ir.Constant(INTEGER, math.prod(shape) * apart)), first)
        layout = np.empty(shape, np.int8)
        alone = self.lanes is None and code.width > 1
        return Block(build.gep(self.pointer, [first]), layout, layout, apart, alone, fixed)

    def row(self, code: AbstractCode, place: ir.Value) -> Any:
        if code.is_many(self.shape[1:], self.dtype):
            return self.block(code, self.shape[1:], place)
        return super().row(code, place)

    def set_row(self, code: AbstractCode, place: ir.Value, values: Any) -> None:
        if isinstance(values, Block) or code.is_many(values.shape, self.dtype):
            copied(code.work, self.block(code, values.shape, place), code.block_of(values))
        else:
            super().set_row(code, place, values)

    def set_all(self, code: AbstractCode, values: Any) -> None:
        """Write all numbers."""
        if isinstance(values, Block):
            copied(code.work, self.block(code, values.shape, None), values)
            return
        for k, entry in enumerate(values.ravel()):
            self.write(code, ir.Constant(INTEGER, k), entry.value)

    def read(self, code: AbstractCode, entry: ir.Value) -> ir.Value:
        found = code.builder.load(self._at(code, entry), align=self._aligned)
        if self.kind != BIT:
            return found
        nothing = ir.Constant(found.type, None if isinstance(found.type, ir.VectorType) else 0)
        return code.builder.icmp_unsigned("!=", found, nothing)

    def write(self, code: AbstractCode, entry: ir.Value, value: ir.Value) -> None:
        wide = code.wide(value)
        if self.kind == BIT:
            wide = code.builder.zext(wide, code.register_of(_BYTE))
        code.builder.store(wide, self._at(code, entry), align=self._aligned)

    @property
    def _aligned(self) -> int:
        """Bytes at whose multiples numbers lie: their own."""
        return 1 if self.kind == BIT else 4 if self.kind == SHORT else 8

    def _at(self, code: AbstractCode, entry: ir.Value) -> ir.Value:
        build = code.builder
        if self.lanes is None:
            return build.gep(self.pointer, [entry])
        entry = build.add(build.mul(entry, ir.Constant(INTEGER, self.lanes)), self.first)
        kind = _BYTE if self.kind == BIT else self.kind
        return build.bitcast(build.gep(self.pointer, [entry]), code.register_of(kind).as_pointer())


class _Lanes:
    """Writes the loop over lanes around that over time."""

    def __init__(
        self,
        p: Any,
        known: Mapping[int, np.ndarray],
        beside: Sequence[bool],
        lanes: int,
        width: int,
        function: ir.Function,
    ):
        self.p, self.known, self.beside, self.lanes = p, known, beside, lanes
        self.arguments, self.results, *memory = function.args
        self.build = ir.IRBuilder(function.append_basic_block("entry"))
        self.width = width
        work = Workspace(self.build, self.width, span(), memory[0]) if memory else None
        self.code = Code(self.build, self.width, beside=True, most=_MOST[self.width], work=work)

    def write(self) -> None:
        with counted(self.build, ir.Constant(INTEGER, self.lanes), self.width) as first:
            self._some(first)
        self.build.ret_void()

    def _some(self, first: ir.Value) -> None:
        """The loop over time of the lanes from `first` on."""
        p, program = self.p, self.p["jaxpr"].jaxpr
        sizes = ScanSizes.of(p)
        given, last, carried = sizes.given, sizes.last, sizes.carried
        streams = [self._stream(self.arguments, k, atom, k >= last, self.lanes if self.beside[k] else None, first)
                   for k, atom in enumerate(program.invars)]  # fmt: skip
        values = [self.code.constant(self.known[k]) if k in self.known else self._all(stream, k < given)
                  for k, stream in enumerate(streams[:last])]  # fmt: skip
        self._prepare()
        cells = Cells(self.code, program.invars[given:last])
        cells.store(values[given:])
        rooms = [self._stream(self.results, k, atom, k >= carried, self.lanes, first)
                 for k, atom in enumerate(program.outvars)]  # fmt: skip
        looped(self.code, p, values[:given], cells, streams[last:], rooms[carried:])
        self._prepared()
        for room, array in zip(rooms[:carried], cells.load(), strict=True):
            room.set_all(self.code, array)

    def _gathered(self, block: Block) -> Block:
        """A block that never changes, with entries that lie next to each other: a copy, where lanes lie in between."""
        if not block.fixed or self.width > 1 or block.unit == 1:
            return block
        into = self.code.work.block(block.shape, unused=True)
        copied(self.code.work, into, block, exact=False)
        return Block(into.pointer, into.whole, into.layout, into.unit, False, True, into.stretch)

    def _prepare(self) -> None:
        """Leave a place, before the loop over time, for what is worked out once."""
        if self.code.space is not None:
            before, after = map(self.build.append_basic_block, ("before", "after"))
            self.build.branch(before)
            self.code.space.before, self.after = before, after
            self.build.position_at_end(after)

    def _prepared(self) -> None:
        if self.code.space is not None:
            with self.build.goto_block(self.code.space.before):
                self.build.branch(self.after)

    def _stream(self, buffers: ir.Value, k: int, atom: Any, along: bool, lanes: int | None, first: ir.Value) -> _Stream:
        shape, dtype = atom.aval.shape, atom.aval.dtype
        kind = type_of(dtype)
        pointer = numbers(self.build, buffers, k, _BYTE if kind == BIT else kind)
        return _Stream(pointer, (self.p["length"], *shape) if along else shape, dtype, lanes, first)

    def _all(self, stream: _Stream, fixed: bool) -> Any:
        """All numbers of a table; `fixed` where they never change."""
        if self.code.is_many(stream.shape, stream.dtype):
            return self._gathered(stream.block(self.code, stream.shape, None, fixed))
        out = np.empty(stream.shape, object)
        if out.size > _MOST_GIVEN:
            raise Unsupported("many numbers that are given to every step")
        for k, at in enumerate(np.ndindex(out.shape)):
            out[at] = Dual(stream.read(self.code, ir.Constant(INTEGER, k)))
        return out
