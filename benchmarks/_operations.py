"""Counts the floating-point operations of a traced program: a scan's body times its length, 2 n - 1 for a dot product.

One operation for each entry of an element-wise result, as in section 2.3.2 of the dissertation; comparing, choosing and
moving numbers is free; a Cholesky factorisation is n^3 / 3, as there.
"""

import math

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr

_ARITHMETIC = set(
    """add add_any sub mul div neg abs sqrt rsqrt square integer_pow exp log sin cos tanh logistic pow max min
    log1p one_minus_square""".split()
)
_LOOPS = {"scan", "loop_of_lanes", "loop_of_many_lanes"}
_SUMS = {"reduce_sum", "reduce_max", "reduce_min", "reduce_prod"}
_FREE = set(
    """broadcast_in_dim reshape transpose concatenate slice dynamic_slice squeeze select_n iota eq ne lt le gt ge and or
    not is_finite convert_element_type gather scatter pad rev reduce_and reduce_or stop_gradient copy sign split
    dynamic_update_slice expand_dims copy_p finite_or_zero platform_index clamp
    stack unstack optimization_barrier zeros_like tile sort floor""".split()
)


def operations(function, *arguments) -> int:
    """Operations that `function(*arguments)` takes."""
    return _count(jax.make_jaxpr(function)(*arguments).jaxpr, _cost)


def bytes_of_products(function, *arguments) -> int:
    """Bytes of what all products of matrices are given and yield: what memory has to move where no cache keeps it."""
    return _count(jax.make_jaxpr(function)(*arguments).jaxpr, _touched)


def _touched(equation) -> int:
    atoms = (*equation.invars, *equation.outvars) if equation.primitive.name == "dot_general" else ()
    return sum(math.prod(atom.aval.shape) * atom.aval.dtype.itemsize for atom in atoms)


def _count(program: Jaxpr, cost) -> int:
    return sum(_within(equation, cost) for equation in program.eqns)


def _within(equation, cost) -> int:
    """The cost of an operation, or of all those in a function that it calls."""
    inner = [part for part in jax.tree.leaves(equation.params, is_leaf=_is_program) if _is_program(part)]
    if not inner:
        return cost(equation)
    bodies = [_count(part.jaxpr if isinstance(part, ClosedJaxpr) else part, cost) for part in inner]
    if equation.primitive.name not in _LOOPS:
        return max(bodies)
    # Machine code of many lanes holds the function of one.
    return equation.params["length"] * equation.params.get("lanes", 1) * sum(bodies)


def _cost(equation) -> int:
    name, size = equation.primitive.name, max((math.prod(out.aval.shape) for out in equation.outvars), default=0)
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
    assert name in _FREE or name.startswith("random_"), f"`{name}` is not priced"
    return 0


def _is_real(variable) -> bool:
    return jax.numpy.issubdtype(variable.aval.dtype, jax.numpy.floating)


def _is_program(part) -> bool:
    return isinstance(part, ClosedJaxpr | Jaxpr)
