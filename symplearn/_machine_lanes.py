"""A loop of many lanes as machine code: every number of eight lanes side by side in one register."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from llvmlite import ir

from ._foreign_call import POINTERS, handler, numbers
from ._machine_code import Cells, Code, Table, looped
from ._machine_rules import INTEGER, Dual, Unsupported, type_of

# How many lanes one register may have.
WIDTHS = (1, 4, 8)
# Operations of a function. Beyond, a single lane gains nothing: Cherry's gradient, of 28 thousand, took as long as by
# XLA and 7 s to compile. Of several lanes it gained fourfold.
_MOST = {1: 20_000, 4: 40_000, 8: 40_000}
# Numbers that every step of a loop is given beside those that change.
_MOST_GIVEN = 1024
_BIT, _BYTE = ir.IntType(1), ir.IntType(8)


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


class _Stream(Table):
    """A table of XLA: numbers of one lane after those of the other, or the same for all."""

    def __init__(self, pointer: ir.Value, shape: tuple[int, ...], dtype: Any, lanes: int | None, first: ir.Value):
        super().__init__(pointer, shape)
        self.kind, self.lanes, self.first = type_of(dtype), lanes, first


class _LaneCode(Code):
    """Code that reads and writes XLA's tables."""

    def row(self, table: Table, place: ir.Value) -> np.ndarray:
        if not isinstance(table, _Stream):
            return super().row(table, place)
        out = np.empty(table.shape[1:], object)
        for k, at in enumerate(np.ndindex(out.shape)):
            out[at] = Dual(self.read(table, self._entry(place, out.size, k)))
        return out

    def set_row(self, table: Table, place: ir.Value, values: np.ndarray) -> None:
        if not isinstance(table, _Stream):
            super().set_row(table, place, values)
            return
        for k, entry in enumerate(values.ravel()):
            self.write(table, self._entry(place, values.size, k), entry.value)

    def _entry(self, place: ir.Value, size: int, k: int) -> ir.Value:
        build = self.builder
        return build.add(build.mul(place, ir.Constant(INTEGER, size)), ir.Constant(INTEGER, k))

    def read(self, stream: _Stream, entry: ir.Value) -> ir.Value:
        """One number, of every lane."""
        build = self.builder
        found = build.load(self._at(stream, entry), align=self._aligned(stream))
        if stream.kind != _BIT:
            return found
        return build.icmp_unsigned(
            "!=", found, ir.Constant(found.type, None if isinstance(found.type, ir.VectorType) else 0)
        )

    def write(self, stream: _Stream, entry: ir.Value, value: ir.Value) -> None:
        """Write one number of every lane."""
        wide = self.wide(value)
        if stream.kind == _BIT:
            wide = self.builder.zext(wide, self.register_of(_BYTE))
        self.builder.store(wide, self._at(stream, entry), align=self._aligned(stream))

    def _aligned(self, stream: _Stream) -> int:
        return 1 if stream.kind == _BIT else 4 if stream.kind == ir.IntType(32) else 8

    def _at(self, stream: _Stream, entry: ir.Value) -> ir.Value:
        build = self.builder
        if stream.lanes is None:
            return build.gep(stream.pointer, [entry])
        entry = build.add(build.mul(entry, ir.Constant(INTEGER, stream.lanes)), stream.first)
        kind = _BYTE if stream.kind == _BIT else stream.kind
        return build.bitcast(build.gep(stream.pointer, [entry]), self.register_of(kind).as_pointer())


class _Lanes:
    """Writes the loop over lanes around that over time."""

    def __init__(
        self, p: Any, known: Mapping[int, np.ndarray], beside: Sequence[bool], lanes: int, function: ir.Function
    ):
        self.p, self.known, self.beside, self.lanes = p, known, beside, lanes
        self.arguments, self.results = function.args
        self.build = ir.IRBuilder(function.append_basic_block("entry"))
        self.width = max(width for width in WIDTHS if lanes % width == 0)
        self.code = _LaneCode(self.build, self.width, beside=True, most=_MOST[self.width])

    def write(self) -> None:
        build = self.build
        with build.goto_entry_block():
            count = build.alloca(INTEGER)
        build.store(ir.Constant(INTEGER, 0), count)
        again, inside, end = map(build.append_basic_block, ("lanes", "some", "done"))
        build.branch(again)
        build.position_at_end(again)
        first = build.load(count)
        build.cbranch(build.icmp_signed("<", first, ir.Constant(INTEGER, self.lanes)), inside, end)
        build.position_at_end(inside)
        self._some(first)
        build.store(build.add(first, ir.Constant(INTEGER, self.width)), count)
        build.branch(again)
        build.position_at_end(end)
        build.ret_void()

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
                self.code.write(room, ir.Constant(INTEGER, k), entry.value)

    def _stream(self, buffers: ir.Value, k: int, atom: Any, along: bool, lanes: int | None, first: ir.Value) -> _Stream:
        shape, dtype = atom.aval.shape, atom.aval.dtype
        kind = type_of(dtype)
        pointer = numbers(self.build, buffers, k, _BYTE if kind == _BIT else kind)
        return _Stream(pointer, (self.p["length"], *shape) if along else shape, dtype, lanes, first)

    def _all(self, stream: _Stream) -> np.ndarray:
        """All numbers of a table."""
        out = np.empty(stream.shape, object)
        if out.size > _MOST_GIVEN:
            raise Unsupported("many numbers that are given to every step")
        for k, at in enumerate(np.ndindex(out.shape)):
            out[at] = Dual(self.code.read(stream, ir.Constant(INTEGER, k)))
        return out
