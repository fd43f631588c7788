"""Trajectories with their sensitivities as machine code: one function for all rows of a recording."""

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import llvmlite.binding as llvm
import numpy as np
from jax import ShapeDtypeStruct
from jax.extend.core import ClosedJaxpr
from jaxtyping import Bool, Float, Int
from llvmlite import ir

import integrators as ig

from .._augmented import Equations
from .._augmented_flow import SimulatedFlow, SimulatedReading, Span
from .._augmented_system import Switches
from .._componentwise import componentwise
from .._machine_code import DOUBLE, INTEGER, Code, Table
from ._course import Course

WIDTH = 8  # directions in one register
# Rows of a table whose number is not known when its code is written; they are never counted.
_MANY = 1 << 30
_SWITCHES = len(jax.tree.leaves(Switches()))
_POINTERS = 12


@dataclass(frozen=True)
class Rail:
    """What a recording gives to its trajectories, as the machine reads it."""

    times: Float[np.ndarray, " time"]
    inputs: Float[np.ndarray, "time input"]
    starts: Float[np.ndarray, " time"]
    steps: Float[np.ndarray, " time"]
    pieces: Int[np.ndarray, " time"]
    means: Float[np.ndarray, "time substep input"]

    @classmethod
    def of(cls, course: Course) -> "Rail":
        """The rail of a course."""
        spans = course.spans
        reals = (course.times, course.inputs, spans.start, spans.step, spans.inputs)
        times, inputs, starts, steps, means = (np.ascontiguousarray(leaf, float) for leaf in reals)
        return cls(times, inputs, starts, steps, np.ascontiguousarray(spans.pieces, np.int64), means)

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        return self.times, self.inputs, self.starts, self.steps, self.pieces, self.means


@lru_cache(maxsize=4)
def native_rows(equations: Equations, integrator: ig.AbstractIntegrator, inputs: int) -> "NativeRows":
    """The machine code of a simulation, written once; `Unsupported` where there is none."""
    return NativeRows(equations, integrator, inputs)


class NativeRows:
    """Readings and phase points at the rows of a recording, and their slopes along `WIDTH` directions."""

    def __init__(self, equations: Equations, integrator: ig.AbstractIntegrator, inputs: int):
        sizes = 2 * equations.width, len(equations.parameters), equations.size
        self.state, self.shown = sizes[0], len(equations.columns) + sizes[0]
        self._engine = _compiled(_module(_traced(equations, integrator, sizes, inputs), sizes, inputs))
        kinds = [ctypes.c_int64, ctypes.c_int64, *[ctypes.c_void_p] * _POINTERS]
        self._run = ctypes.CFUNCTYPE(None, *kinds)(self._engine.get_function_address("rows"))

    def __call__(
        self, values: Float[np.ndarray, " taken"], slopes: Float[np.ndarray, "taken direction"], rail: Rail,
        switches: Bool[np.ndarray, " switch"], path: Float[np.ndarray, "time state"] | None,
        out: Float[np.ndarray, "time shown"], along: Float[np.ndarray, "direction time shown"],
    ) -> None:  # fmt: skip
        """Write the rows to `out` and `along`, from the values of the start, the parameters and the coefficients, end
        to end, and their slopes.

        Phase points stand beside the readings; with a `path` they are those that arrive from its row before.
        """
        arrays = values, slopes, *rail.arrays, switches, *(() if path is None else (path,)), out, along
        assert all(array.flags.c_contiguous for array in arrays), "the machine reads what lies end to end"
        first = [array.ctypes.data for array in (values, slopes, *rail.arrays, switches)]
        stride = int(np.prod(rail.means.shape[1:]))
        begun = None if path is None else path.ctypes.data
        self._run(len(out), stride, *first, begun, out.ctypes.data, along.ctypes.data)


def _traced(equations: Equations, integrator: ig.AbstractIntegrator, sizes: Sequence[int], inputs: int) -> ClosedJaxpr:
    """One row of a trajectory: what it shows and where it leads to, and the slopes of both."""
    number, along = ShapeDtypeStruct((), float), ShapeDtypeStruct((WIDTH,), float)
    values, slopes = (tuple((one,) * n for n in sizes) for one in (number, along))
    span = number, number, ShapeDtypeStruct((), int), ShapeDtypeStruct((_MANY, inputs), float) if inputs else ()
    moment, switches = (number, (number,) * inputs), (ShapeDtypeStruct((), bool),) * _SWITCHES

    def row(x: Any, parameters: Any, coefficients: Any, moment: Any, span: Any, switches: Any) -> Any:
        t, u = moment
        means = span[3] if inputs else jnp.zeros((1, 0))
        model = equations, _vector(parameters), _vector(coefficients), Switches(*switches)
        flow = SimulatedFlow(model[0], integrator, *model[1:])
        read = SimulatedReading(*model)
        after = flow(_vector(x), Span(span[0], span[1], means, span[2]))
        return tuple(read(_vector(x), (t, _vector(u)))), tuple(after)

    def moved(values: Any, slopes: Any, moment: Any, span: Any, switches: Any) -> Any:
        step = lambda *free: componentwise(row)(*free, moment, span, switches)  # noqa: E731
        return jax.vmap(lambda *one: jax.jvp(step, values, one), out_axes=(None, 0))(*slopes)

    return jax.make_jaxpr(moved)(values, slopes, moment, span, switches)


def _vector(entries: Sequence[Any]) -> Any:
    return jnp.stack(entries) if entries else jnp.zeros((0,))


def _module(program: ClosedJaxpr, sizes: Sequence[int], inputs: int) -> ir.Module:
    """The function `rows`: a traced row, again and again."""
    module = ir.Module("trajectory")
    pointer = DOUBLE.as_pointer()
    kinds = [
        INTEGER,
        INTEGER,
        *[pointer] * 6,
        INTEGER.as_pointer(),
        pointer,
        ir.IntType(8).as_pointer(),
        *[pointer] * 3,
    ]
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), kinds), "rows")
    _Rows(program, function, sizes, inputs).write()
    return module


class _Rows:
    """Writes the loop over rows."""

    def __init__(self, program: ClosedJaxpr, function: ir.Function, sizes: Sequence[int], inputs: int):
        self.program, self.sizes, self.inputs = program, sizes, inputs
        self.build = ir.IRBuilder(function.append_basic_block("entry"))
        self.code = Code(self.build, WIDTH)
        (self.rows, self.stride, self.values, self.slopes, self.times, self.u, self.starts, self.steps, self.pieces,
         self.means, self.switches, self.path, self.out, self.along) = function.args  # fmt: skip

    def write(self) -> None:
        build, state = self.build, self.sizes[0]
        values = [self.entry(self.values, self.place(k)) for k in range(sum(self.sizes))]
        slopes = [self.register(self.slopes, self.place(k)) for k in range(sum(self.sizes))]
        on = [build.trunc(self.entry(self.switches, self.place(k)), ir.IntType(1)) for k in range(_SWITCHES)]
        count, *cells = self.code.cells([self.place(0), *values[:state], *slopes[:state]])
        anew = build.icmp_unsigned("!=", self.path, ir.Constant(self.path.type, None))
        again, inside, end = map(build.append_basic_block, ("rows", "row", "done"))
        build.branch(again)
        build.position_at_end(again)
        k, *now = [build.load(cell) for cell in (count, *cells)]
        build.cbranch(build.icmp_signed("<", k, self.rows), inside, end)
        build.position_at_end(inside)
        begun = self.begun(anew, k, now, slopes)
        given = [*begun[:state], *values[state:], *begun[state:], *slopes[state:], *self.given(k), *on]
        found = self.code.evaluated(self.program, given)
        shown = (len(found) - 2 * state) // 2
        seen, new, seen_along, new_along = np.split(np.array(found, object), np.cumsum([shown, state, shown]))
        self.told(k, [*seen, *now[:state]], [*seen_along, *now[state:]])
        for cell, value in zip(cells, [*new, *map(self.code.splat, new_along)], strict=True):
            build.store(value, cell)
        build.store(build.add(k, self.place(1)), count)
        build.branch(again)
        build.position_at_end(end)
        build.ret_void()

    def place(self, k: int) -> ir.Constant:
        return ir.Constant(INTEGER, k)

    def entry(self, array: ir.Value, place: ir.Value) -> ir.Value:
        return self.build.load(self.build.gep(array, [place]))

    def register(self, array: ir.Value, place: ir.Value) -> ir.Value:
        """The slopes of one entry, which lie side by side."""
        first = self.build.gep(array, [self.build.mul(place, self.place(WIDTH))])
        kind = ir.VectorType(DOUBLE, WIDTH).as_pointer()
        return self.build.load(self.build.bitcast(first, kind), align=8)  # as NumPy's arrays are

    def begun(self, anew: ir.Value, k: ir.Value, now: Sequence[ir.Value], slopes: Sequence[ir.Value]) -> list[ir.Value]:
        """Where a row begins: where the one before has led, or on a path."""
        build, state = self.build, self.sizes[0]
        cells = self.code.cells(now)
        for cell, value in zip(cells, now, strict=True):
            build.store(value, cell)
        with build.if_then(anew):
            for j in range(state):
                place = build.add(build.mul(k, self.place(state)), self.place(j))
                build.store(self.entry(self.path, place), cells[j])
                build.store(slopes[j], cells[state + j])
        return [build.load(cell) for cell in cells]

    def given(self, k: ir.Value) -> list[Any]:
        """What a recording gives to one row: its moment and the span that follows."""
        build, inputs = self.build, self.inputs
        first = build.mul(k, self.place(inputs))
        u = [self.entry(self.u, build.add(first, self.place(j))) for j in range(inputs)]
        spans = [self.entry(array, k) for array in (self.starts, self.steps, self.pieces)]
        means = [Table(build.gep(self.means, [build.mul(k, self.stride)]), (_MANY, inputs))] if inputs else []
        return [self.entry(self.times, k), *u, *spans, *means]

    def told(self, k: ir.Value, values: Sequence[ir.Value], slopes: Sequence[ir.Value]) -> None:
        """Write down one row, and its slopes, one direction after the other."""
        build, shown = self.build, self.place(len(values))
        first, apart = build.mul(k, shown), build.mul(self.rows, shown)
        for j, (value, slope) in enumerate(zip(values, slopes, strict=True)):
            place, wide = build.add(first, self.place(j)), self.code.splat(slope)
            build.store(value, build.gep(self.out, [place]))
            for direction in range(WIDTH):
                cell = build.gep(self.along, [build.add(place, build.mul(apart, self.place(direction)))])
                build.store(build.extract_element(wide, ir.Constant(ir.IntType(32), direction)), cell)


def _compiled(module: ir.Module) -> Any:
    """The engine that holds the machine code of a module."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    machine = llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), opt=2, jit=True
    )
    checked = llvm.parse_assembly(str(module))
    checked.verify()
    options = llvm.create_pipeline_tuning_options(speed_level=2)
    builder = llvm.create_pass_builder(machine, options)
    builder.getModulePassManager().run(checked, builder)
    engine = llvm.create_mcjit_compiler(checked, machine)
    engine.finalize_object()
    return engine
