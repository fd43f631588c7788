"""Counts the floating-point operations of a traced program: a scan's body times its length, 2 n - 1 for a dot product.

One operation for each entry of an element-wise result, as in section 2.3.2 of the dissertation; comparing, choosing and
moving numbers is free; a Cholesky factorisation is n^3 / 3, as there.
"""

import math

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr

_ARITHMETIC = set(
    """add add_any sub mul div neg abs sqrt rsqrt square integer_pow exp log sin cos tanh logistic pow max min
    log1p""".split()
)
_LOOPS = {"scan", "loop_of_lanes"}
_SUMS = {"reduce_sum", "reduce_max", "reduce_min", "reduce_prod"}
_FREE = set(
    """broadcast_in_dim reshape transpose concatenate slice dynamic_slice squeeze select_n iota eq ne lt le gt ge and or
    not is_finite convert_element_type gather scatter pad rev reduce_and reduce_or stop_gradient copy sign split
    dynamic_update_slice expand_dims copy_p finite_or_zero platform_index clamp
    stack optimization_barrier""".split()
)


def operations(function, *arguments) -> int:
    """Operations that `function(*arguments)` takes."""
    return _count(jax.make_jaxpr(function)(*arguments).jaxpr)


def _count(program: Jaxpr) -> int:
    return sum(_cost(equation) for equation in program.eqns)


def _cost(equation) -> int:
    name, size = equation.primitive.name, max((math.prod(out.aval.shape) for out in equation.outvars), default=0)
    inner = [part for part in jax.tree.leaves(equation.params, is_leaf=_is_program) if _is_program(part)]
    if inner:
        bodies = [_count(part.jaxpr if isinstance(part, ClosedJaxpr) else part) for part in inner]
        return equation.params.get("length", 1) * sum(bodies) if name in _LOOPS else max(bodies)
    if name == "dot_general":
        (over, _), _ = equation.params["dimension_numbers"]
        terms = math.prod(equation.invars[0].aval.shape[axis] for axis in over)
        return size * (2 * terms - 1)
    if name in _SUMS:
        return math.prod(equation.invars[0].aval.shape) - size
    if name == "small_product":
        return size * (2 * equation.invars[0].aval.shape[-1] - 1)
    if name == "cholesky":
        return equation.invars[0].aval.shape[-1] ** 3 // 3
    if name in _ARITHMETIC:
        return size if _is_real(equation.outvars[0]) else 0
    assert name in _FREE, f"`{name}` is not priced"
    return 0


def _is_real(variable) -> bool:
    return jax.numpy.issubdtype(variable.aval.dtype, jax.numpy.floating)


def _is_program(part) -> bool:
    return isinstance(part, ClosedJaxpr | Jaxpr)
