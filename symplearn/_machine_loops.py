"""Counted loops of machine code."""

from collections.abc import Iterator
from contextlib import contextmanager

from llvmlite import ir

from ._machine_arithmetic import INTEGER


@contextmanager
def counted(build: ir.IRBuilder, end: ir.Value, step: int = 1) -> Iterator[ir.Value]:
    """A loop around what is written within, for 0, `step`, ... below the end."""
    with build.goto_entry_block():
        count = build.alloca(INTEGER)
    build.store(ir.Constant(INTEGER, 0), count)
    again, inside, done = map(build.append_basic_block, ("again", "inside", "done"))
    build.branch(again)
    build.position_at_end(again)
    k = build.load(count)
    build.cbranch(build.icmp_signed("<", k, end), inside, done)
    build.position_at_end(inside)
    yield k
    build.store(build.add(k, ir.Constant(INTEGER, step)), count)
    build.branch(again)
    build.position_at_end(done)
