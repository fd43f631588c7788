"""How the loops of a function are compiled, on request."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
from jax.extend.core import Jaxpr, JaxprEqn

from ._lane_loops import loop, with_lane_loops
from ._machine_arithmetic import Unsupported
from ._machine_flow import programs_in
from ._machine_lanes import lane_loop


@dataclass(frozen=True)
class CompiledLoop:
    """How one loop is compiled on a processor: how many `steps` it has, and `reason`, empty where it is machine code,
    and else why it is left to XLA."""

    steps: int
    reason: str

    def __str__(self) -> str:
        return f"a loop of {self.steps} steps: " + (f"by XLA, for {self.reason}" if self.reason else "machine code")


def loops_of(function: Callable[..., Any], *arguments: Any) -> tuple[CompiledLoop, ...]:
    """How the loops of a function, as of a score or of its gradient, are compiled on a processor; not those inside of
    other loops.

    Filters have machine code where it can be written: arithmetic of double precision, loops, branches, and products of
    matrices, as of networks; no sorting, no random numbers, and no long function of numbers that are worked out one by
    one, as with states of eight and more.
    """
    program = jax.make_jaxpr(with_lane_loops(function))(*arguments)
    return tuple(CompiledLoop(one.params["length"], _reason(one.params)) for one in _loops(program.jaxpr))


def _loops(program: Jaxpr) -> list[JaxprEqn]:
    """Loops of a traced function, and of those within it that are not loops themselves."""
    found = []
    for one in program.eqns:
        found += [one] if one.primitive is loop else [each for part in programs_in(one) for each in _loops(part)]
    return found


def _reason(p: Any) -> str:
    """Why a loop cannot be written; empty where it can."""
    try:
        lane_loop(p, p["known"].arrays, (False,) * len(p["jaxpr"].in_avals), 1)
    except Unsupported as error:
        return str(error)
    return ""
