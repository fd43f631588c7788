"""Memory for what changes along a loop of machine code, or is told by a branch."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ._machine_arithmetic import Dual
from ._machine_blocks import Block
from ._machine_kernels import copied
from ._machine_memory import AbstractCode, shaped


class Cells:
    """Values in memory, for what changes along a loop or is told by a branch."""

    def __init__(self, code: AbstractCode, atoms: Sequence[Any]):
        self.code, self.shapes, build = code, list(map(shaped, atoms)), code.builder
        self.blocks = [code.work.block(s.shape) if code.is_many(s.shape, s.dtype) else None for s in self.shapes]
        with build.goto_entry_block():
            self.cells = [
                [(build.alloca(code.kept_as(s.dtype)),
                  build.alloca(code.register) if s.dtype == float and not code.beside else None)
                 for _ in range(0 if block else math.prod(s.shape))]
                for s, block in zip(self.shapes, self.blocks, strict=True)
            ]  # fmt: skip
        self.sloped = [np.zeros(s.shape, bool) for s in self.shapes]

    def store(self, values: Sequence[Any]) -> None:
        build = self.code.builder
        values = [self._apart(value) for value in values]
        for block, cells, array, sloped in zip(self.blocks, self.cells, values, self.sloped, strict=True):
            if block is not None:
                copied(self.code.work, block, self.code.source(array), exact=False)
                continue
            for (cell, slopes), entry, place in zip(cells, array.ravel(), np.ndindex(array.shape), strict=True):
                build.store(self.code.fitted(entry.value, cell.type.pointee), cell)
                if slopes is not None:
                    build.store(self.code.slope(entry), slopes)
                    sloped[place] |= entry.slope is not None

    def _apart(self, value: Any) -> Any:
        """A value that does not lie in these cells, of which another may be written first."""
        own = [block.stretch for block in self.blocks if block]
        if not isinstance(value, Block) or value.stretch not in own:
            return value
        into = self.code.work.block(value.shape)
        copied(self.code.work, into, value, exact=False)
        return into

    def load(self) -> list[Any]:
        """The values; what has had no slope wherever it was stored has none."""
        build, out = self.code.builder, list[Any]()
        for block, cells, one, sloped in zip(self.blocks, self.cells, self.shapes, self.sloped, strict=True):
            if block is not None:
                out.append(block)
                continue
            array = np.empty(one.shape, object)
            for (cell, slopes), place in zip(cells, np.ndindex(array.shape), strict=True):
                array[place] = Dual(build.load(cell), build.load(slopes) if sloped[place] else None)
            out.append(array)
        return out

    def slope_all(self) -> None:
        """Let every real number have slopes: what a loop does to them is not known before."""
        for sloped, one in zip(self.sloped, self.shapes, strict=True):
            sloped[...] = one.dtype == float and not self.code.beside
