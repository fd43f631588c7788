"""Arrays of many numbers in machine code: they lie in memory, and functions of their own compute with them."""

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from llvmlite import ir

from ._machine_arithmetic import DOUBLE, INTEGER

# Arrays of real numbers with so many entries are blocks, where there are blocks at all.
MANY = 32


class Stretch:
    """A stretch of a workspace. It may be used again for something else as soon as nothing refers to it."""

    def __init__(self, of: "Workspace", size: int, unused: bool):
        self.of, self.size = of, size
        self.first = of.more(size) if unused or not of.free[size] else of.free[size].pop()

    def __del__(self) -> None:
        self.of.free[self.size].append(self.first)


class Workspace:
    """Memory in which machine code computes with blocks; it begins at `begin`, and `span` numbers fill a register where
    there is a single lane.

    What is worked out once is written to the part `before` of a function, which comes before its loop over time.
    """

    def __init__(self, builder: ir.IRBuilder, width: int, span: int, begin: ir.Value):
        self.builder, self.width, self.span, self.begin = builder, width, span, begin
        self.size = 0
        self.free: dict[int, list[int]] = defaultdict(list)
        self.kernels: dict[Any, ir.Function] = {}
        self.packed: dict[Any, Block] = {}
        self.before: ir.Block | None = None

    @property
    def step(self) -> int:
        """Entries along an axis that are worked out together: there are lanes side by side, or entries."""
        return self.span if self.width == 1 else 1

    def more(self, size: int) -> int:
        """Where a stretch that was never used begins."""
        self.size += size
        return self.size - size

    def block(self, shape: tuple[int, ...], unused: bool = False) -> "Block":
        """A new block, each of whose rows begins a register. It is `unused` where nothing else is ever kept, as it must
        be for what outlasts a turn of a loop."""
        sizes = list(shape)
        last = next((k for k in reversed(range(len(sizes))) if sizes[k] > 1), None)
        if last is not None:
            sizes[last] += -sizes[last] % self.step
        whole = np.empty(sizes, np.int8)
        stretch = Stretch(self, whole.size * self.width + -(whole.size * self.width) % 8, unused)
        with self.builder.goto_entry_block():
            pointer = self.builder.gep(self.begin, [ir.Constant(INTEGER, stretch.first)])
        return Block(pointer, whole, whole, self.width, stretch=stretch).part(*map(slice, shape))


@dataclass(frozen=True, eq=False)
class Block:
    """Many numbers in memory, of one lane or of lanes side by side. How they lie is told by an array of bytes of which
    `layout` is a view: what moves entries of arrays moves these.

    `unit` is how many numbers lie from one entry to the next; of a block that is `alone` every lane has the same. What
    is `fixed` never changes.
    """

    pointer: ir.Value
    whole: np.ndarray
    layout: np.ndarray
    unit: int
    alone: bool = False
    fixed: bool = False
    stretch: Stretch | None = None

    @property
    def shape(self) -> tuple[int, ...]:
        return self.layout.shape

    @property
    def size(self) -> int:
        return self.layout.size

    def moved(self, rule: Callable[[np.ndarray], np.ndarray]) -> "Block | None":
        """The same numbers in another order; None where that takes a copy."""
        layout = rule(self.layout)
        if layout.size and not np.may_share_memory(layout, self.whole):
            return None
        return Block(self.pointer, self.whole, layout, self.unit, self.alone, self.fixed, self.stretch)

    def viewed(self, rule: Callable[[np.ndarray], np.ndarray]) -> "Block":
        """The same, of a rule that takes no copy: of parts, and of axes in another order."""
        found = self.moved(rule)
        assert found is not None
        return found

    def part(self, *where: Any) -> "Block":
        """Some entries, by places or slices along its axes."""
        return self.viewed(lambda layout: layout[(*where, ...)])

    def at(self, builder: ir.IRBuilder, place: ir.Value) -> "Block":
        """A row that is known when the code is run."""
        distance = ir.Constant(INTEGER, self.layout.strides[0] * self.unit)
        pointer = builder.gep(self.start(builder), [builder.mul(place, distance)])
        row = np.empty(self.whole.size, np.int8)
        layout = np.lib.stride_tricks.as_strided(row, self.shape[1:], self.layout.strides[1:])
        return Block(pointer, row, layout, self.unit, self.alone, False, self.stretch)

    def start(self, builder: ir.IRBuilder) -> ir.Value:
        """Where the first entry is."""
        first = _address(self.layout) - _address(self.whole)
        return builder.gep(self.pointer, [ir.Constant(INTEGER, first * self.unit)])

    @cached_property
    def side(self) -> "Side":
        return Side(tuple(n * self.unit for n in self.layout.strides), self.alone, self.stretch is not None)


@dataclass(frozen=True, eq=False)
class Pending:
    """A product of matrices, left @ right.T, that is not worked out before something is to be added to it."""

    left: Block
    right: Block

    @property
    def shape(self) -> tuple[int, ...]:
        return self.left.shape[0], self.right.shape[0]


@dataclass(frozen=True)
class Side:
    """How the entries of a block lie, for a function that computes with it: how far apart, whether every lane has the
    same, and whether there is something behind a row's end that may be read, and lost."""

    strides: tuple[int, ...]
    alone: bool
    roomy: bool


def pointers() -> ir.Type:
    return DOUBLE.as_pointer()


def _address(array: np.ndarray) -> int:
    return int(array.__array_interface__["data"][0])
