"""Is H = T(p) + U(q)?"""

import math
from collections.abc import Sequence

import numpy as np
import sympy

from ._kinks import KINKS
from ._symbolic import TooLarge, derivative, numpy_function

_MOST_TERMS = 300  # of an expanded expression
_MOST_OPERATIONS = 150  # of a derivative that is handed to SymPy's `simplify`


def is_separable(hamiltonian: sympy.Expr, q_symbols: Sequence[sympy.Symbol], p_symbols: Sequence[sympy.Symbol]) -> bool:
    """True where H = T(p) + U(q): every mixed derivative d2H / dq dp is identically zero.

    False where that could not be shown with bounded work: a step that serves any H is then never wrong.
    """
    mixed = _mixed_part(hamiltonian, set(q_symbols), set(p_symbols))
    if mixed != 0 and _expanded_terms(mixed) <= _MOST_TERMS:
        mixed = _mixed_part(sympy.expand(mixed), set(q_symbols), set(p_symbols))
    if mixed == 0:
        return True
    if _has_mixed_kink(mixed, set(q_symbols), set(p_symbols)):
        return False
    try:
        pairs = [derivative(derivative(mixed, q), p) for q in q_symbols for p in p_symbols]
    except TooLarge:
        return False
    return not _is_seen_to_vary(pairs) and all(map(_is_shown_zero, pairs))


def _mixed_part(expr: sympy.Expr, q: set[sympy.Symbol], p: set[sympy.Symbol]) -> sympy.Expr:
    """The terms of a sum that hold both a coordinate and a momentum."""
    terms = sympy.Add.make_args(expr)
    return sympy.Add(*(t for t in terms if t.free_symbols & q and t.free_symbols & p))


def _has_mixed_kink(expr: sympy.Expr, q: set[sympy.Symbol], p: set[sympy.Symbol]) -> bool:
    """max(q, p) couples through where it bends, which no derivative away from the bend shows."""
    return any(k.free_symbols & q and k.free_symbols & p for k in expr.atoms(*KINKS))


def _expanded_terms(expr: sympy.Expr) -> float:
    """How many terms `expand` would make, at most."""
    if expr.is_Add:
        return sum(map(_expanded_terms, expr.args))
    if expr.is_Pow and expr.exp.is_Integer:
        terms, power = _expanded_terms(expr.base), abs(int(expr.exp))
        return 1.0 if terms == 1 else math.exp(min(700.0, power * math.log(terms)))
    if expr.args:
        return min(math.prod(map(_expanded_terms, expr.args)), 1e300)
    return 1.0


def _is_seen_to_vary(pairs: Sequence[sympy.Expr]) -> bool:
    """Whether a mixed derivative is clearly not zero somewhere: a cheap refutation."""
    symbols = sorted(set().union(*(e.free_symbols for e in pairs)), key=str)
    if not symbols:
        return any(e != 0 for e in pairs)
    points = np.random.default_rng(0).uniform(0.3, 1.7, (len(symbols), 5))
    with np.errstate(all="ignore"):
        values = numpy_function(pairs, symbols)(points)
    return bool(np.any(np.abs(values) > 1e-6))


def _is_shown_zero(expr: sympy.Expr) -> bool:
    if expr == 0:
        return True
    if expr.count_ops() > _MOST_OPERATIONS:
        return False
    return bool(sympy.expand(expr) == 0 or sympy.simplify(expr) == 0)
