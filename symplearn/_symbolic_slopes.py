"""SymPy trees -> JAX functions whose first derivatives are trees as well.

Derivatives along many directions are then a few products of what is worked out once for all of them.
"""

from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
import sympy
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from ._derivative import bottom_up
from ._symbolic import TooLarge, derivative, jax_function

# Nodes times symbols: of more, SymPy differentiates longer (a second) than the slopes save.
_WORTH = 20_000


def with_slopes(
    expressions: Sequence[sympy.Expr], symbols: Sequence[sympy.Symbol]
) -> Callable[[Float[Array, "n_symbols ..."]], Float[Array, "n_expressions ..."]]:
    """`jax_function`, differentiated by its expressions' own derivatives; by JAX where these are too large."""
    plain, trees = jax_function(expressions, symbols), list(map(sympy.sympify, expressions))
    used = [(k, one) for k, one in enumerate(symbols) if any(one in e.free_symbols for e in trees)]
    if len(bottom_up(trees)) * len(used) > _WORTH:
        return plain
    try:
        table = [[(k, derivative(e, one)) for k, (_, one) in enumerate(used) if one in e.free_symbols] for e in trees]
    except TooLarge:
        return plain
    slopes = jax_function([slope for row in table for _, slope in row], symbols)

    def evaluated(function: Any, values: Sequence[Array]) -> tuple[Array, ...]:
        known = {one: value for (_, one), value in zip(used, values, strict=True)}
        return tuple(function.entries(known, values[0].dtype, values[0].shape))

    @jax.custom_jvp
    def entries(*values: Array) -> tuple[Array, ...]:
        return evaluated(plain, values)

    def along(values: Sequence[Array], tangents: Sequence[Any]) -> tuple[Any, Any]:
        each = iter(evaluated(slopes, values))
        moved = [[(next(each), tangents[k]) for k, _ in row] for row in table]
        return evaluated(plain, values), tuple(_sum(row, values[0]) for row in moved)

    entries.defjvp(along, symbolic_zeros=True)

    def function(values: Array) -> Array:
        return jnp.stack(entries(*(values[place] for place, _ in used))) if used else plain(values)

    return function


def _sum(products: Sequence[tuple[Array, Any]], like: Array) -> Array:
    """Sum of products, those left out in which nothing changes."""
    some = [slope * tangent for slope, tangent in products if not isinstance(tangent, SymbolicZero)]
    return reduce(jnp.add, some) if some else jnp.zeros_like(like)
