"""A number that depends on arrays, with machine code in its value and in its slopes."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

from ._lane_loops import with_lane_loops


def with_swift_slopes(function: Callable[..., Array]) -> Callable[..., Array]:
    """The same function of arrays to a number, with loops that are machine code in its value and in its slopes.

    Those are its reverse, whichever way it is differentiated, or, where it has none, XLA's.
    """

    @jax.custom_jvp
    def swift(*args: Any) -> Array:
        return with_lane_loops(function)(*args)

    def rule(primals: Sequence[Any], tangents: Sequence[Any]) -> tuple[Any, Any]:  # JAX has numbers among them
        moved = [k for k, one in enumerate(tangents) if _moves(one)]
        along = [tangents[k] for k in moved]

        def of(*some: Any) -> Array:
            all_of = dict(enumerate(primals)) | dict(zip(moved, some, strict=True))
            return function(*(all_of[k] for k in range(len(primals))))

        begin = [primals[k] for k in moved]
        try:
            value, slopes = with_lane_loops(jax.value_and_grad(of, range(len(moved))))(*begin)
        except ValueError as error:
            # A propagator with a loop of traced length has no reverse.
            if "Reverse-mode differentiation" not in str(error):
                raise
            value, slope = jax.jvp(of, begin, along)
            return value, slope
        parts = [jnp.sum(slope * one) for slope, one in zip(slopes, along, strict=True)]
        return value, sum(parts[1:], parts[0])

    swift.defjvp(rule, symbolic_zeros=True)
    return swift


def _moves(tangent: Any) -> bool:
    return type(tangent) is not SymbolicZero and tangent.dtype != jax.dtypes.float0
