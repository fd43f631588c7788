"""A loop of many lanes as machine code: every number of eight lanes side by side in one register."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from llvmlite import ir

from ._foreign_call import POINTERS, handler, numbers
from ._machine_arithmetic import BIT, INTEGER, SHORT, Dual, Unsupported, type_of
from ._machine_code import Code
from ._machine_flow import counted, looped
from ._machine_memory import AbstractCode, AbstractTable, Cells

# How many lanes one register may have.
WIDTHS = (1, 4, 8)
# Operations of a function. Beyond, a single lane gains nothing: Cherry's gradient, of 28 thousand, took as long as by
# XLA and 7 s to compile. Of several lanes it gained fourfold.
_MOST = {1: 20_000, 4: 40_000, 8: 40_000}
# Numbers that every step of a loop is given beside those that change.
_MOST_GIVEN = 1024
_BYTE = ir.IntType(8)


def filling(lanes: int) -> int:
    """How many lanes so many are filled up to, so that they fill registers: one that holds all, or several."""
    width = next((width for width in WIDTHS if width >= lanes), WIDTHS[-1])
    return lanes + -lanes % width


def lane_loop(p: Any, known: Mapping[int, np.ndarray], beside: Sequence[bool], lanes: int) -> ir.Module:
    """A module whose function `called` runs a loop of JAX, of parameters `p`, for so many lanes, which had better fill
    registers. The arguments that are known by their place are written into it.

    Of arguments that are `beside` each other in lanes, and of all results, the last axis is that of lanes.
    """
    module = ir.Module("lanes")
    work = ir.Function(module, ir.FunctionType(ir.VoidType(), [POINTERS, POINTERS]), "work")
    _Lanes(p, known, beside, lanes, work).write()
    handler(module, work)
    return module


class _Stream(AbstractTable):
    """A table of XLA: numbers of one lane after those of the other, or the same for all."""

    def __init__(self, pointer: ir.Value, shape: tuple[int, ...], dtype: Any, lanes: int | None, first: ir.Value):
        self.pointer, self.shape, self.kind, self.lanes, self.first = pointer, shape, type_of(dtype), lanes, first

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
        self, p: Any, known: Mapping[int, np.ndarray], beside: Sequence[bool], lanes: int, function: ir.Function
    ):
        self.p, self.known, self.beside, self.lanes = p, known, beside, lanes
        self.arguments, self.results = function.args
        self.build = ir.IRBuilder(function.append_basic_block("entry"))
        self.width = max(width for width in WIDTHS if lanes % width == 0)
        self.code = Code(self.build, self.width, beside=True, most=_MOST[self.width])

    def write(self) -> None:
        with counted(self.build, ir.Constant(INTEGER, self.lanes), self.width) as first:
            self._some(first)
        self.build.ret_void()

    def _some(self, first: ir.Value) -> None:
        """The loop over time of the lanes from `first` on."""
        p, program = self.p, self.p["jaxpr"].jaxpr
        given, last = p["num_consts"], p["num_consts"] + p["num_carry"]
        streams = [self._stream(self.arguments, k, atom, k >= last, self.lanes if self.beside[k] else None, first)
                   for k, atom in enumerate(program.invars)]  # fmt: skip
        values = [self.code.constant(self.known[k]) if k in self.known else self._all(stream)
                  for k, stream in enumerate(streams[:last])]  # fmt: skip
        cells = Cells(self.code, program.invars[given:last])
        cells.store(values[given:])
        rooms = [self._stream(self.results, k, atom, k >= p["num_carry"], self.lanes, first)
                 for k, atom in enumerate(program.outvars)]  # fmt: skip
        looped(self.code, p, values[:given], cells, streams[last:], rooms[p["num_carry"] :])
        for room, array in zip(rooms[: p["num_carry"]], cells.load(), strict=True):
            for k, entry in enumerate(array.ravel()):
                room.write(self.code, ir.Constant(INTEGER, k), entry.value)

    def _stream(self, buffers: ir.Value, k: int, atom: Any, along: bool, lanes: int | None, first: ir.Value) -> _Stream:
        shape, dtype = atom.aval.shape, atom.aval.dtype
        kind = type_of(dtype)
        pointer = numbers(self.build, buffers, k, _BYTE if kind == BIT else kind)
        return _Stream(pointer, (self.p["length"], *shape) if along else shape, dtype, lanes, first)

    def _all(self, stream: _Stream) -> np.ndarray:
        """All numbers of a table."""
        out = np.empty(stream.shape, object)
        if out.size > _MOST_GIVEN:
            raise Unsupported("many numbers that are given to every step")
        for k, at in enumerate(np.ndindex(out.shape)):
            out[at] = Dual(stream.read(self.code, ir.Constant(INTEGER, k)))
        return out
