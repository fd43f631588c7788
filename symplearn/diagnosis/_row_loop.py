"""The loop over a recording's rows, as machine code around a traced row."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jax.extend.core import ClosedJaxpr
from llvmlite import ir

from .._machine_arithmetic import DOUBLE, INTEGER, Dual
from .._machine_cells import Cells
from .._machine_code import Code
from .._machine_loops import counted
from .._machine_memory import Table

WIDTH = 8  # directions in one register
# Rows of a table whose number is not known when its code is written; they are never counted.
MANY = 1 << 30
# Pointers that the function takes.
POINTERS = 12


def row_loop(program: ClosedJaxpr, sizes: Sequence[int], inputs: tuple[int, int], switches: int) -> ir.Module:
    """A module with the function `rows(count, stride, ...)`, which runs `program` for every row.

    Its pointers are those of values, slopes, times, inputs, starts, steps, numbers of substeps, means of inputs
    (`stride` numbers a row), switches, a path or nothing, readings and phase points, and their slopes. `sizes` are
    those of a phase point, the parameters and the coefficients, which the values hold end to end; `inputs` how many
    numbers a row knows of them, and how many they are.
    """
    module = ir.Module("trajectory")
    real, whole, bits = (kind.as_pointer() for kind in (DOUBLE, INTEGER, ir.IntType(8)))
    kinds = [INTEGER, INTEGER, *[real] * 6, whole, real, bits, *[real] * 3]
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), kinds), "rows")
    _Rows(program, function, sizes, inputs, switches).write()
    return module


def _place(k: int) -> ir.Constant:
    return ir.Constant(INTEGER, k)


def _array(entries: Sequence[Any]) -> np.ndarray:
    """A vector of numbers."""
    out = np.empty(len(entries), object)
    out[:] = [entry if isinstance(entry, Dual) else Dual(entry) for entry in entries]
    return out


class _Rows:
    """Writes the loop."""

    def __init__(
        self, program: ClosedJaxpr, function: ir.Function, sizes: Sequence[int], inputs: tuple[int, int], switches: int
    ):
        self.program, self.sizes, (self.known, self.inputs) = program, sizes, inputs
        self.build = ir.IRBuilder(function.append_basic_block("entry"))
        self.code = Code(self.build, WIDTH)
        (self.rows, self.stride, self.values, self.slopes, self.times, self.u, self.starts, self.steps, self.pieces,
         self.means, on, self.path, self.out, self.along) = function.args  # fmt: skip
        self.on = [self.build.trunc(self.entry(on, _place(k)), ir.IntType(1)) for k in range(switches)]

    def write(self) -> None:
        build, phase_point = self.build, self.program.jaxpr.invars[:1]
        taken = [Dual(self.entry(self.values, _place(k)), self.register(k)) for k in range(sum(self.sizes))]
        x, *numbers = np.split(_array(taken), np.cumsum(self.sizes[:2]))
        arrived, begun = Cells(self.code, phase_point), Cells(self.code, phase_point)
        arrived.store([x])
        with counted(build, self.rows) as k:
            now = arrived.load()
            begun.store(now)
            self.on_the_path(k, x, begun)
            given = [*begun.load(), *numbers, *self.given(k), *(_array([bit]).reshape(()) for bit in self.on)]
            seen, after = self.code.evaluated(self.program, given)
            self.told(k, [*seen, *now[0]])
            arrived.store([after])
        build.ret_void()

    def entry(self, array: ir.Value, place: ir.Value) -> ir.Value:
        return self.build.load(self.build.gep(array, [place]))

    def register(self, k: int) -> ir.Value:
        """The slopes of one value, which lie side by side."""
        first = self.build.gep(self.slopes, [_place(k * WIDTH)])
        # As NumPy's arrays are aligned.
        return self.build.load(self.build.bitcast(first, self.code.register.as_pointer()), align=8)

    def on_the_path(self, k: ir.Value, x: np.ndarray, begun: Cells) -> None:
        """Let a row begin on the path, if there is one, with the slopes of the start."""
        build, first = self.build, self.build.mul(k, _place(len(x)))
        with build.if_then(build.icmp_unsigned("!=", self.path, ir.Constant(self.path.type, None))):
            points = [self.entry(self.path, build.add(first, _place(j))) for j in range(len(x))]
            begun.store([_array([Dual(value, dual.slope) for value, dual in zip(points, x, strict=True)])])

    def given(self, k: ir.Value) -> list[Any]:
        """What a recording gives to one row: its time and inputs, and the span that follows."""
        build, inputs = self.build, self.inputs
        first = build.mul(k, _place(self.known))
        t, *span = (
            _array([self.entry(array, k)]).reshape(()) for array in (self.times, self.starts, self.steps, self.pieces)
        )
        u = _array([self.entry(self.u, build.add(first, _place(j))) for j in range(self.known)])
        table = Table(build.gep(self.means, [build.mul(k, self.stride)]), (MANY, inputs))
        start, step, pieces = span
        return [t, u, start, step, pieces, table if inputs else np.empty((1, 0), object)]

    def told(self, k: ir.Value, duals: Sequence[Dual]) -> None:
        """Write down one row, and its slopes, one direction after the other."""
        build, shown = self.build, _place(len(duals))
        first, apart = build.mul(k, shown), build.mul(self.rows, shown)
        for j, dual in enumerate(duals):
            place, slopes = build.add(first, _place(j)), self.code.slope(dual)
            build.store(dual.value, build.gep(self.out, [place]))
            for direction in range(WIDTH):
                cell = build.gep(self.along, [build.add(place, build.mul(apart, _place(direction)))])
                build.store(build.extract_element(slopes, ir.Constant(ir.IntType(32), direction)), cell)
