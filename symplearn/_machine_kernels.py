"""Functions of machine code that compute with blocks: entry by entry, sums along axes, and products of matrices.

Each is written once for arrays of the same shapes that lie the same way, and called wherever such are met.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

from llvmlite import ir

from ._machine_arithmetic import INTEGER, SHORT, Arithmetic, Dual
from ._machine_blocks import Block, Side, Workspace, pointers
from ._machine_loops import counted

_Rule = Callable[..., Dual]
# Rows and columns, in registers, of the part of a product that is held in registers while it is summed.
_ROWS, _COLUMNS = 4, 4


def entrywise(work: Workspace, rule: _Rule, key: Any, into: Block, *operands: Block | ir.Value, exact: bool) -> None:
    """A rule of single numbers for every entry of blocks of one shape, and of numbers. Where the result is not `exact`,
    what lies between its rows may be written as well."""
    if not into.size:
        return
    blocks = [one for one in operands if isinstance(one, Block)]
    axes = _axes(into, *blocks)
    sides = [Side(strides, one.side.alone, one.side.roomy)
             for strides, one in zip(axes[1:], (into, *blocks), strict=True)]  # fmt: skip
    rest = [one for one in operands if not isinstance(one, Block)]
    order = tuple(isinstance(one, Block) for one in operands)
    named = ("entrywise", key, tuple(axes[0]), tuple(sides), order, tuple(str(one.type) for one in rest), exact)

    def body(writer: "_Writer", places: Sequence[ir.Value], numbers: Sequence[ir.Value]) -> None:
        def one(at: Sequence[ir.Value], count: int) -> None:
            loaded = iter([writer.load(side, place, at, count)
                           for side, place in zip(sides[1:], places[1:], strict=True)])  # fmt: skip
            plain = iter(numbers)
            entries = [Dual(next(loaded) if is_block else next(plain)) for is_block in order]
            writer.store(sides[0], places[0], at, writer.math.wide(rule(writer.math, *entries).value), count, exact)

        writer.along(axes[0], one)

    _called(work, named, body, (into, *blocks), rest)


def copied(work: Workspace, into: Block, value: Block | ir.Value, exact: bool = True) -> None:
    """Write a block, or the same number everywhere, to a block."""
    entrywise(work, lambda on, one: one, "copy", into, value, exact=exact)


def summed(work: Workspace, into: Block, block: Block, kept: int) -> None:
    """Sums over all axes of a block but the first so many, which there must be."""
    shape, sides = block.shape, (into.side, block.side)
    named = ("summed", shape, sides, kept)

    def body(writer: "_Writer", places: Sequence[ir.Value], numbers: Sequence[ir.Value]) -> None:
        def one(at: Sequence[ir.Value], count: int) -> None:
            total = writer.accumulator()
            turned = Side((*sides[1].strides[kept:], *sides[1].strides[:kept]), sides[1].alone, sides[1].roomy)
            with writer.loops(shape[kept:]) as inner:
                entry = writer.load(turned, places[1], [*inner, *at], count)
                writer.build.store(writer.math.plus(writer.build.load(total), entry), total)
            writer.store(sides[0], places[0], at, writer.build.load(total), count, True)

        writer.along(shape[:kept], one)

    _called(work, named, body, (into, block), ())


def multiplied(work: Workspace, into: Block, rows: Block, columns: Block, more: Block | None) -> None:
    """The product of a matrix with another, of which registers hold entries of a row: they must lie next to each other
    where there is one lane. It is added to `more`."""
    (count, along), width = rows.shape, columns.shape[1]
    blocks = [into, rows, columns, *([] if more is None else [more])]
    sides = [one.side for one in blocks]
    named = ("multiplied", count, along, width, tuple(sides))

    def body(writer: "_Writer", places: Sequence[ir.Value], numbers: Sequence[ir.Value]) -> None:
        _product(writer, (count, along, width), sides, places)

    _called(work, named, body, blocks, ())


def _product(writer: "_Writer", sizes: tuple[int, int, int], sides: Sequence[Side], places: Sequence[ir.Value]) -> None:
    """By parts that are held in registers while they are summed."""
    count, along, width = sizes
    registers = -(-width // writer.step)
    tall = count if count <= _ROWS + 1 else _ROWS
    for first, number, step in _parts(count, tall):
        with writer.counting(first, number, step) as i:
            *inner, (begin, many, wide) = _parts(registers, min(registers, _COLUMNS))
            # The last register of a row may be filled in part.
            for first_of, number_of, columns, rest in (
                *((*part, None) for part in inner),
                (begin, many - 1, wide, None),
                (begin + (many - 1) * wide, 1, wide, width),
            ):
                if number_of:
                    with writer.counting(first_of, number_of, columns) as j:
                        _part(writer, along, (i, step), (j, columns), sides, places, rest)


def _part(
    writer: "_Writer",
    along: int,
    tall: tuple[ir.Value, int],
    wide: tuple[ir.Value, int],
    sides: Sequence[Side],
    places: Sequence[ir.Value],
    width: int | None,
) -> None:
    """Some rows and columns of a product, from entry (i, j) on; `width` is that of all, where these are the last."""
    (i, rows), (j, columns) = tall, wide
    build, step = writer.build, writer.step
    tail = (width - 1) % step + 1 if width is not None else step
    exact = sides[0].strides[0] % step != 0  # rows that do not begin a register each have others behind them
    counts = [*[step] * (columns - 1), tail]
    at = [build.add(i, ir.Constant(INTEGER, k)) for k in range(rows)]
    across = [build.mul(build.add(j, ir.Constant(INTEGER, k)), ir.Constant(INTEGER, step)) for k in range(columns)]
    sums = [[writer.accumulator() for _ in range(columns)] for _ in range(rows)]
    for side, place in zip(sides[3:], places[3:], strict=True):
        for row, held in zip(at, sums, strict=True):
            for total, first, n in zip(held, across, counts, strict=True):
                build.store(writer.load(side, place, [row, first], n), total)
    with counted(build, ir.Constant(INTEGER, along)) as k:
        entries = [writer.load(sides[2], places[2], [k, place], n) for place, n in zip(across, counts, strict=True)]
        for row, held in zip(at, sums, strict=True):
            factor = writer.one(sides[1], places[1], [row, k])
            for total, entry in zip(held, entries, strict=True):
                build.store(writer.math.plus(build.load(total), writer.math.times(factor, entry)), total)
    for row, held in zip(at, sums, strict=True):
        for total, place, n in zip(held, across, counts, strict=True):
            writer.store(sides[0], places[0], [row, place], build.load(total), n, exact)


def _parts(number: int, size: int) -> list[tuple[int, int, int]]:
    """Where parts of so many begin, how many there are, and how large they are: those that are whole, and the rest."""
    whole, rest = divmod(number, size)
    return [(0, whole, size), *([(whole * size, 1, rest)] if rest else [])]


def _axes(*blocks: Block) -> list[Any]:
    """The shape of blocks, and how far apart their entries lie along each axis, with as few axes as possible."""
    strides = [one.side.strides for one in blocks]
    axes = [(n, *along) for n, *along in zip(blocks[0].shape, *strides, strict=True) if n > 1]
    found: list[tuple[int, ...]] = []
    for axis in axes:
        if found and all(outer == inner * axis[0] for outer, inner in zip(found[-1][1:], axis[1:], strict=True)):
            axis = (found.pop()[0] * axis[0], *axis[1:])
        found.append(axis)
    return [tuple(column) for column in zip(*(found or [(1, *(1 for _ in blocks))]), strict=True)]


def _called(
    work: Workspace, named: Any, body: Callable[..., None], blocks: Sequence[Block], numbers: Sequence[ir.Value]
) -> None:
    """Call the function of a name, written by `body` if there is none yet; not where nothing is to be written."""
    if not blocks[0].size:
        return
    kinds = [*(pointers() for _ in blocks), *(one.type for one in numbers)]
    if named not in work.kernels:
        module = work.builder.module
        function = ir.Function(module, ir.FunctionType(ir.VoidType(), kinds), module.get_unique_name("kernel"))
        function.linkage = "internal"
        for attribute in ("noinline", "nounwind"):
            function.attributes.add(attribute)
        for place in function.args[: len(blocks)]:
            place.add_attribute("noalias")
        writer = _Writer(function, work)
        body(writer, function.args[: len(blocks)], function.args[len(blocks) :])
        writer.build.ret_void()
        work.kernels[named] = function
    work.builder.call(work.kernels[named], [*(one.start(work.builder) for one in blocks), *numbers])


class _Writer:
    """Writes one function that computes with blocks."""

    def __init__(self, function: ir.Function, work: Workspace):
        self.build, self.step, self.lanes = ir.IRBuilder(function.append_basic_block("entry")), work.step, work.width
        self.math = Arithmetic(self.build, work.span if work.width == 1 else work.width)

    def along(self, shape: Sequence[int], one: Callable[[Sequence[ir.Value], int], None]) -> None:
        """Do something at every entry, or at every register of entries of a row."""
        *outer, last = shape
        whole, rest = divmod(last, self.step)
        with self.loops(outer) as at:
            if whole:
                with self.counting(0, whole, self.step) as k:
                    one([*at, k], self.step)
            if rest:
                one([*at, ir.Constant(INTEGER, whole * self.step)], rest)

    @contextmanager
    def loops(self, shape: Sequence[int]) -> Iterator[list[ir.Value]]:
        """Loops in loops, around what is written within."""
        with ExitStack() as stack:
            yield [stack.enter_context(counted(self.build, ir.Constant(INTEGER, n))) for n in shape]

    @contextmanager
    def counting(self, first: int, number: int, step: int) -> Iterator[ir.Value]:
        """`first`, `first` + `step`, ..., so many of them."""
        if number == 1:
            yield ir.Constant(INTEGER, first)
            return
        with counted(self.build, ir.Constant(INTEGER, number * step), step) as k:
            yield self.build.add(k, ir.Constant(INTEGER, first)) if first else k

    def accumulator(self) -> ir.Value:
        """A register, of zeros."""
        with self.build.goto_entry_block():
            found = self.build.alloca(self.math.register)
        self.build.store(ir.Constant(self.math.register, None), found)
        return found

    def one(self, side: Side, begin: ir.Value, at: Sequence[ir.Value]) -> ir.Value:
        """One entry, of all lanes, or everywhere in a register."""
        place = self._place(side, begin, at)
        if self.lanes == 1 or side.alone:
            return self.math.wide(self.build.load(place))
        return self._register(place)

    def load(self, side: Side, begin: ir.Value, at: Sequence[ir.Value], count: int) -> ir.Value:
        """One entry of all lanes, or so many entries along the last axis."""
        stride = side.strides[-1]
        if self.lanes > 1 or stride == 0:
            return self.one(side, begin, at)
        place = self._place(side, begin, at)
        if stride == 1 and (count == self.step or side.roomy):
            return self._register(place)
        found = ir.Constant(self.math.register, None)
        for k in range(count):
            entry = self.build.load(self.build.gep(place, [ir.Constant(INTEGER, k * stride)]))
            found = self.build.insert_element(found, entry, ir.Constant(SHORT, k))
        return found

    def store(
        self, side: Side, begin: ir.Value, at: Sequence[ir.Value], value: ir.Value, count: int, exact: bool
    ) -> None:
        """Write one entry of all lanes, or so many entries along the last axis."""
        place, stride = self._place(side, begin, at), side.strides[-1]
        if self.lanes > 1 or (stride == 1 and (count == self.step or not exact)):
            self.build.store(value, self.build.bitcast(place, self.math.register.as_pointer()), align=8)
            return
        for k in range(count):
            entry = self.build.extract_element(value, ir.Constant(SHORT, k))
            self.build.store(entry, self.build.gep(place, [ir.Constant(INTEGER, k * stride)]))

    def _register(self, place: ir.Value) -> ir.Value:
        return self.build.load(self.build.bitcast(place, self.math.register.as_pointer()), align=8)

    def _place(self, side: Side, begin: ir.Value, at: Sequence[ir.Value]) -> ir.Value:
        where: Any = ir.Constant(INTEGER, 0)
        for k, stride in zip(at, side.strides, strict=True):
            where = self.build.add(where, self.build.mul(k, ir.Constant(INTEGER, stride)))
        return self.build.gep(begin, [where])
