"""How much work a traced function is, as far as it tells how that is best done."""

import math
from typing import Any

from jax.extend.core import Jaxpr, JaxprEqn

from ._machine_flow import programs_in
from ._machine_memory import shaped
from ._scan_sizes import ScanSizes

# Products of numbers, in those of matrices, for each number that a step yields on the way, from which on blocks are
# worth their memory: XLA does the rest as well. A chain of eight springs has 0.4 and took up to three times as long
# with blocks, a network of width 4 has 0.6, of width 32 three to six.
_WORTH = 0.5
# The same for each number that a step leaves to the next: these are copied. A Householder reflection has two.
_WORTH_COPIES = 8


def largest_array(program: Jaxpr) -> int:
    """Entries of the largest array in a traced function."""
    own = [math.prod(shaped(atom).shape) for one in program.eqns for atom in (*one.invars, *one.outvars)]
    return max([0, *own, *(largest_array(inner) for one in program.eqns for inner in programs_in(one))])


def largest_product(program: Jaxpr) -> int:
    """Products of numbers in the largest product of matrices in a traced function."""
    found = [0]
    for one in program.eqns:
        if one.primitive.name == "dot_general":
            found.append(_products_of(one))
        found += map(largest_product, programs_in(one))
    return max(found)


def _products_of(one: JaxprEqn) -> int:
    """Rows times columns, rows times what is summed over, and that times columns: the root of all of them."""
    return math.isqrt(math.prod(math.prod(shaped(atom).shape) for atom in (*one.invars, *one.outvars)))


def is_worth_blocks(p: Any) -> bool:
    """Whether a loop's time is that of products of matrices."""
    program, left = p["jaxpr"].jaxpr, sum(one.size for one in p["jaxpr"].out_avals[: ScanSizes.of(p).carried])
    return _work(program) >= max(_WORTH * _yielded(program), _WORTH_COPIES * left)


def _yielded(program: Jaxpr) -> int:
    """Numbers that all operations of a traced function yield, in loops as often as they go round."""
    found = 0
    for one in program.eqns:
        inner = programs_in(one)
        found += one.params.get("length", 1) * sum(map(_yielded, inner))
        found += 0 if inner else sum(math.prod(shaped(atom).shape) for atom in one.outvars)
    return found


def _work(program: Jaxpr) -> int:
    """Products of numbers in all products of matrices of a traced function, in loops as often as they go round."""
    found = 0
    for one in program.eqns:
        if one.primitive.name == "dot_general":
            found += _products_of(one)
        found += one.params.get("length", 1) * sum(map(_work, programs_in(one)))
    return found
