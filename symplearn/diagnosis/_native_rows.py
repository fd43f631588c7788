"""Trajectories with their sensitivities as machine code: one function for all rows of a recording."""

import ctypes
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import jax
import numpy as np
from jax import ShapeDtypeStruct
from jax.extend.core import ClosedJaxpr
from jaxtyping import Bool, Float, Int

import integrators as ig

from .._augmented import Equations
from .._augmented_flow import SimulatedFlow, SimulatedReading, Span
from .._augmented_system import Switches
from .._machine_arithmetic import Unsupported
from .._native import compiled
from ._course import Course
from ._row_loop import MANY, POINTERS, row_loop
from ._row_loop import WIDTH as WIDTH

_SWITCHES = len(jax.tree.leaves(Switches()))


@dataclass(frozen=True)
class Rail:
    """What a recording gives to its trajectories, as the machine reads it."""

    times: Float[np.ndarray, " time"]
    inputs: Float[np.ndarray, "time known"]
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

    def since(self, row: int) -> "Rail":
        """The same from a row on."""
        return Rail(*(array[row:] for array in self.arrays))

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        return self.times, self.inputs, self.starts, self.steps, self.pieces, self.means

    @cached_property
    def places(self) -> list[int]:
        """Where the arrays lie in memory."""
        assert all(array.flags.c_contiguous for array in self.arrays), "the machine reads what lies end to end"
        return [array.ctypes.data for array in self.arrays]


@dataclass(frozen=True)
class Blocks:
    """What the machine takes and writes of lanes and of blocks of `WIDTH` directions, each of one of the `lanes`:
    values of the start, the parameters and the coefficients, end to end, and their slopes."""

    lanes: Int[np.ndarray, " block"]
    values: Float[np.ndarray, "lane taken"]
    switches: Bool[np.ndarray, "lane switch"]
    slopes: Float[np.ndarray, "block taken direction"]
    paths: Float[np.ndarray, "lane time state"] | None
    out: Float[np.ndarray, "lane time shown"]
    along: Float[np.ndarray, "block direction time shown"]


@lru_cache(maxsize=4)
def native_rows(equations: Equations, integrator: ig.AbstractIntegrator, known: int) -> "NativeRows | None":
    """The machine code of a simulation, written once; None where there is none, or the work is not a processor's.

    `known` is how many numbers a row knows of the inputs.
    """
    if jax.default_backend() != "cpu":
        return None
    try:
        return NativeRows(equations, integrator, known)
    except Unsupported:
        return None


class NativeRows:
    """Readings and phase points at the rows of a recording, and their slopes along `WIDTH` directions."""

    def __init__(self, equations: Equations, integrator: ig.AbstractIntegrator, known: int):
        sizes = 2 * equations.width, len(equations.parameters), equations.size
        self.state, self.shown = sizes[0], len(equations.columns) + sizes[0]
        program = _traced(equations, integrator, sizes, known)
        self._engine = compiled(row_loop(program, sizes, (known, len(equations.inputs)), _SWITCHES))
        kinds = [ctypes.c_int64, ctypes.c_int64, *[ctypes.c_void_p] * POINTERS]
        self._run = ctypes.CFUNCTYPE(None, *kinds)(self._engine.get_function_address("rows"))

    def __call__(self, blocks: Blocks, some: Int[np.ndarray, " some"], rail: Rail) -> None:
        """Write what some blocks show, and their slopes, along a recording's rows.

        Phase points stand beside the readings; with paths they are those that arrive from a path's row before.
        """
        lanes = blocks.lanes[some]
        of_lanes = [_places(array, lanes) for array in (blocks.values, blocks.switches, blocks.out)]
        begun = [None] * len(some) if blocks.paths is None else _places(blocks.paths, lanes)
        of_blocks = [_places(array, some) for array in (blocks.slopes, blocks.along)]
        rows, stride, given = blocks.out.shape[1], math.prod(rail.means.shape[1:]), rail.places
        for values, on, out, path, slopes, along in zip(*of_lanes, begun, *of_blocks, strict=True):
            self._run(rows, stride, values, slopes, *given, on, path, out, along)


def _places(array: np.ndarray, some: Int[np.ndarray, " some"]) -> list[int]:
    """Where some of an array's entries lie in memory."""
    assert array.flags.c_contiguous, "the machine reads what lies end to end"
    return (array.ctypes.data + array.strides[0] * some).tolist()


def _traced(equations: Equations, integrator: ig.AbstractIntegrator, sizes: Sequence[int], known: int) -> ClosedJaxpr:
    """One row of a trajectory: what it shows, and where it leads to."""
    inputs = len(equations.inputs)

    def row(x: Any, parameters: Any, coefficients: Any, t: Any, u: Any, start: Any, step: Any, pieces: Any, means: Any,
            *switches: Any) -> Any:  # fmt: skip
        switched = Switches(*switches)
        flow = SimulatedFlow(equations, integrator, parameters, coefficients, switched)
        read = SimulatedReading(equations, parameters, coefficients, switched)
        return read(x, (t, u)), flow(x, Span(start, step, means, pieces))

    def shaped(*shape: int, dtype: type = float) -> ShapeDtypeStruct:
        return ShapeDtypeStruct(shape, dtype)

    span = shaped(), shaped(), shaped(dtype=int), shaped(MANY if inputs else 1, inputs)
    switches = [shaped(dtype=bool)] * _SWITCHES
    return jax.make_jaxpr(row)(*(shaped(n) for n in sizes), shaped(), shaped(known), *span, *switches)
