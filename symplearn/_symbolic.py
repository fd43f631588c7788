"""SymPy trees -> array functions, by walking the tree.

Nothing is printed to source and executed (no `lambdify`). Equal subtrees are evaluated once.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any

import jax.numpy as jnp
import numpy as np
import sympy
from jax import lax
from jaxtyping import Array, Float

from ._derivative import TooLarge as TooLarge
from ._derivative import bottom_up
from ._derivative import derivative as derivative
from ._derivative import gradient as gradient
from ._kinks import Absolute, Maximum, Minimum, Sign, Step


@dataclass(frozen=True)
class _Operations:
    """The array library that a tree is evaluated with."""

    np: Any
    integer_pow: Callable[[Any, int], Any]


_JAX = _Operations(jnp, lax.integer_pow)
_NUMPY = _Operations(np, lambda x, n: np.asarray(x) ** float(n))

_UNARY = {
    sympy.sin: "sin",
    sympy.cos: "cos",
    sympy.tan: "tan",
    sympy.asin: "arcsin",
    sympy.acos: "arccos",
    sympy.atan: "arctan",
    sympy.sinh: "sinh",
    sympy.cosh: "cosh",
    sympy.tanh: "tanh",
    sympy.asinh: "arcsinh",
    sympy.acosh: "arccosh",
    sympy.atanh: "arctanh",
    sympy.exp: "exp",
    sympy.log: "log",
    sympy.sign: "sign",
    Sign: "sign",
}
_PAIRWISE = {
    sympy.Max: "maximum",
    Maximum: "maximum",
    sympy.Min: "minimum",
    Minimum: "minimum",
    sympy.atan2: "arctan2",
}
_RELATIONS = {
    sympy.StrictLessThan: "less",
    sympy.LessThan: "less_equal",
    sympy.StrictGreaterThan: "greater",
    sympy.GreaterThan: "greater_equal",
    sympy.Equality: "equal",
    sympy.Unequality: "not_equal",
}


@dataclass(frozen=True)
class ArrayFunction:
    """Expressions as one function of an array. Equal expressions make equal, equally hashed functions.

    Called with values `(n_symbols,)` it returns `(n_expressions,)`, in the dtype of the values.
    """

    expressions: tuple[sympy.Expr, ...]
    symbols: tuple[sympy.Symbol, ...]
    operations: _Operations

    def __post_init__(self) -> None:
        unknown = set().union(*(e.free_symbols for e in self.expressions)) - set(self.symbols)
        if unknown:
            raise ValueError(f"expressions hold {sorted(map(str, unknown))}, expected only {self.symbols}")

    @cached_property
    def _used(self) -> list[tuple[int, sympy.Symbol]]:
        used = set().union(*(e.free_symbols for e in self.expressions))
        return [(place, symbol) for place, symbol in enumerate(self.symbols) if symbol in used]

    @cached_property
    def _order(self) -> list[sympy.Basic]:
        return bottom_up(self.expressions)

    def __call__(self, values: Any) -> Any:
        xp = self.operations.np
        if len(values) != len(self.symbols):
            raise ValueError(f"expected {len(self.symbols)} values {self.symbols}, received {len(values)}")
        # Only what is used: to JAX every entry taken is two operations to trace and to compile.
        results = self.entries({symbol: values[place] for place, symbol in self._used}, values.dtype, values.shape[1:])
        return xp.stack(results) if results else xp.zeros((0,), values.dtype)

    def entries(self, known: Mapping[sympy.Basic, Any], dtype: Any, shape: tuple[int, ...]) -> list[Any]:
        """What the expressions come to where their symbols are `known`, each of this `dtype` and `shape`."""
        walk = _Walk(self.operations, dtype, shape, dict(known))
        for part in self._order:
            walk(part)
        return [walk(e) for e in self.expressions]


def jax_function(
    expressions: Sequence[sympy.Expr], symbols: Sequence[sympy.Symbol]
) -> Callable[[Float[Array, " n_symbols"]], Float[Array, " n_expressions"]]:
    """The expressions as a JAX function of the values of `symbols`, for jit, vmap, jacfwd and scan.

    It is hashable and equal for equal expressions, so it may be a static argument. Derivatives at a kink
    are the mean of both sides.
    """
    return ArrayFunction(tuple(map(sympy.sympify, expressions)), tuple(symbols), _JAX)


def numpy_function(
    expressions: Sequence[sympy.Expr], symbols: Sequence[sympy.Symbol]
) -> Callable[[np.ndarray], np.ndarray]:
    """`jax_function` with NumPy underneath; values of shape `(n_symbols, ...)` are allowed."""
    return ArrayFunction(tuple(map(sympy.sympify, expressions)), tuple(symbols), _NUMPY)


class _Walk:
    """Evaluates a tree bottom-up, each distinct subtree once."""

    def __init__(
        self, operations: _Operations, dtype: Any, shape: tuple[int, ...], known: dict[sympy.Basic, Any]
    ):  # fmt: skip
        self.xp, self.integer_pow = operations.np, operations.integer_pow
        self.dtype, self.shape, self.known = dtype, shape, known

    def __call__(self, expr: sympy.Basic) -> Any:
        if expr not in self.known:
            self.known[expr] = self.evaluated(expr)
        return self.known[expr]

    def constant(self, value: float) -> Any:
        # Strongly typed: a weakly typed constant would cost a second trace.
        return self.xp.full(self.shape, value, self.dtype)

    def evaluated(self, expr: sympy.Basic) -> Any:
        if expr.is_Number or expr.is_NumberSymbol:
            return self.constant(float(expr))
        if expr.is_Add:
            return reduce(self.xp.add, map(self, expr.args))
        if expr.is_Mul:
            return self.product(expr)
        if expr.is_Pow:
            return self.power(expr.base, expr.exp)
        return self.applied(expr, expr.func)

    def product(self, expr: sympy.Mul) -> Any:
        """Numerator over denominator: one division instead of reciprocals."""
        over = [f for f in expr.args if f.is_Pow and f.exp.is_Number and f.exp.is_negative]
        above = [f for f in expr.args if f not in over]
        numerator = reduce(self.xp.multiply, map(self, above)) if above else self.constant(1.0)
        if not over:
            return numerator
        below = [self.power(f.base, -f.exp) for f in over]
        return numerator / reduce(self.xp.multiply, below)

    def power(self, base: sympy.Expr, exponent: sympy.Expr) -> Any:
        if exponent.is_Integer and abs(int(exponent)) < 2**31:
            return self.integer_pow(self(base), int(exponent)) if exponent != 1 else self(base)
        if abs(exponent) == sympy.S.Half:
            root = self.xp.sqrt(self(base))
            return root if exponent.is_positive else 1 / root
        if exponent.is_Rational and exponent.q == 2 and abs(exponent) < 8:
            # A root and a product are cheaper than a power.
            value = self.integer_pow(self(base), int(abs(exponent))) * self.xp.sqrt(self(base))
            return value if exponent.is_positive else 1 / value
        if base is sympy.E:
            return self.xp.exp(self(exponent))
        # A plain number as exponent: JAX then never takes the logarithm of the base for its derivative.
        value = float(exponent) if exponent.is_Number else self(exponent)
        return self.xp.power(self(base), value)

    def applied(self, expr: sympy.Basic, function: Any) -> Any:
        xp = self.xp
        if function in _UNARY:
            return getattr(xp, _UNARY[function])(self(expr.args[0]))
        if function in _PAIRWISE:
            return reduce(getattr(xp, _PAIRWISE[function]), map(self, expr.args))
        if function in (Absolute, sympy.Abs):
            # Not `abs`: JAX gives it the slope 1 at zero, where the mean of both sides is 0.
            return self(expr.args[0]) * xp.sign(self(expr.args[0]))
        if function in (Step, sympy.Heaviside):
            return 0.5 * (xp.sign(self(expr.args[0])) + 1)
        if function in _RELATIONS:
            return getattr(xp, _RELATIONS[function])(*map(self, expr.args))
        if function is sympy.Piecewise:
            return self.piecewise(expr)
        if expr in (sympy.true, sympy.false):
            return xp.full(self.shape, bool(expr))
        raise ValueError(f"no array operation is known for {function} in {expr}")

    def piecewise(self, expr: sympy.Expr) -> Any:
        result = self.constant(math.nan)
        for value, condition in reversed(expr.args):
            result = self.xp.where(self(condition), self(value), result)
        return result
