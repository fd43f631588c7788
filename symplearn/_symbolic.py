"""SymPy trees -> array functions and derivatives, by walking the tree.

Nothing is printed to source and executed (no `lambdify`). Equal subtrees are evaluated once.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any

import jax.numpy as jnp
import numpy as np
import sympy
from jax import lax
from jaxtyping import Array, Float
from sympy.functions.elementary.piecewise import ExprCondPair

from ._kinks import Absolute, Maximum, Minimum, Sign, Step

LARGEST = 200_000  # nodes of a derivative; beyond, differentiating is refused


class TooLarge(Exception):
    """The derivative of an expression has more nodes than can be worked with."""


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

    Called with values of shape `(n_symbols,)` it returns `(n_expressions,)`, in the dtype of the values.
    """

    expressions: tuple[sympy.Expr, ...]
    symbols: tuple[sympy.Symbol, ...]
    operations: _Operations

    def __post_init__(self) -> None:
        unknown = set().union(*(e.free_symbols for e in self.expressions)) - set(self.symbols)
        if unknown:
            raise ValueError(f"expressions hold {sorted(map(str, unknown))}, expected only {self.symbols}")

    @cached_property
    def _order(self) -> list[sympy.Basic]:
        return _bottom_up(self.expressions)

    def __call__(self, values: Any) -> Any:
        xp = self.operations.np
        if len(values) != len(self.symbols):
            raise ValueError(f"expected {len(self.symbols)} values {self.symbols}, received {len(values)}")
        known = dict(zip(self.symbols, values, strict=True))
        walk = _Walk(self.operations, values.dtype, known)
        for part in self._order:
            walk(part)
        results = [walk(e) for e in self.expressions]
        return xp.stack(results) if results else xp.zeros((0,), values.dtype)


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


def _bottom_up(expressions: Sequence[sympy.Basic]) -> list[sympy.Basic]:
    """Every distinct subtree once, arguments before what is made of them: deep trees need no deep recursion."""
    order: dict[sympy.Basic, None] = {}
    stack = [(e, False) for e in reversed(expressions)]
    while stack:
        expr, is_ready = stack.pop()
        if expr in order:
            continue
        if is_ready or not expr.args:
            order[expr] = None
        else:
            stack.append((expr, True))
            # The value-condition pairs of a `Piecewise` are no values themselves.
            stack.extend((a, False) for a in expr.args)
    return [e for e in order if not isinstance(e, ExprCondPair)]


class _Walk:
    """Evaluates a tree bottom-up, each distinct subtree once."""

    def __init__(self, operations: _Operations, dtype: Any, known: dict[sympy.Basic, Any]):
        self.xp, self.integer_pow = operations.np, operations.integer_pow
        self.dtype, self.known = dtype, known
        self.shape = next(iter(known.values())).shape if known else ()

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

    def piecewise(self, expr: sympy.Piecewise) -> Any:
        result = self.constant(math.nan)
        for value, condition in reversed(expr.args):
            result = self.xp.where(self(condition), self(value), result)
        return result


_SLOPES: dict[Any, Callable[[sympy.Expr], sympy.Expr]] = {
    sympy.sin: sympy.cos,
    sympy.cos: lambda u: -sympy.sin(u),
    sympy.tan: lambda u: 1 + sympy.tan(u) ** 2,
    sympy.asin: lambda u: (1 - u**2) ** sympy.Rational(-1, 2),
    sympy.acos: lambda u: -((1 - u**2) ** sympy.Rational(-1, 2)),
    sympy.atan: lambda u: 1 / (1 + u**2),
    sympy.sinh: sympy.cosh,
    sympy.cosh: sympy.sinh,
    sympy.tanh: lambda u: 1 - sympy.tanh(u) ** 2,
    sympy.asinh: lambda u: (1 + u**2) ** sympy.Rational(-1, 2),
    sympy.acosh: lambda u: (u**2 - 1) ** sympy.Rational(-1, 2),
    sympy.atanh: lambda u: 1 / (1 - u**2),
    sympy.exp: sympy.exp,
    sympy.log: lambda u: 1 / u,
    sympy.Abs: Sign,
    Absolute: Sign,
    sympy.sign: lambda u: sympy.S.Zero,
    Sign: lambda u: sympy.S.Zero,
    Step: lambda u: sympy.S.Zero,
    sympy.Heaviside: lambda u: sympy.S.Zero,
}


def derivative(expr: sympy.Expr, symbol: sympy.Symbol) -> sympy.Expr:
    """d expr / d symbol, without `DiracDelta` or unevaluated `Derivative`.

    d|x| = sign(x) dx, d sign(x) = 0, and max and min differentiate the branch that is taken (the mean of both
    where they are equal).

    **Raises** `TooLarge` where the result would have more than 200,000 nodes.
    """
    walk = _Derivative(symbol)
    for part in _bottom_up([expr]):
        if isinstance(part, sympy.Expr):
            walk(part)
    return walk(expr)


def gradient(expr: sympy.Expr, symbols: Sequence[sympy.Symbol]) -> list[sympy.Expr]:
    """`derivative` by each of `symbols`."""
    return [derivative(expr, s) for s in symbols]


class _Derivative:
    """Differentiates a tree bottom-up, each distinct subtree once."""

    def __init__(self, symbol: sympy.Symbol):
        self.symbol = symbol
        self.known: dict[sympy.Basic, sympy.Expr] = {}
        self.nodes = 0

    def __call__(self, expr: sympy.Expr) -> sympy.Expr:
        if expr not in self.known:
            self.known[expr] = self.differentiated(expr)
        return self.known[expr]

    def differentiated(self, expr: sympy.Expr) -> sympy.Expr:
        if expr == self.symbol:
            return sympy.S.One
        if not expr.args or self.symbol not in expr.free_symbols:
            return sympy.S.Zero
        if expr.is_Add:
            return sympy.Add(*map(self, expr.args))
        if expr.is_Mul:
            return self.product(expr.args)
        if expr.is_Pow:
            return self.power(expr.base, expr.exp)
        return self.applied(expr)

    def product(self, factors: Sequence[sympy.Expr]) -> sympy.Expr:
        moving = [i for i, f in enumerate(factors) if self(f) != 0]
        self.nodes += len(moving) * len(factors)
        if self.nodes > LARGEST:
            raise TooLarge(f"a derivative of the expression has more than {LARGEST:,} nodes")
        return sympy.Add(*(sympy.Mul(*factors[:i], self(factors[i]), *factors[i + 1 :]) for i in moving))

    def power(self, base: sympy.Expr, exponent: sympy.Expr) -> sympy.Expr:
        if self.symbol not in exponent.free_symbols:
            return exponent * base ** (exponent - 1) * self(base)
        slope = self(exponent) * sympy.log(base)
        if self.symbol in base.free_symbols:
            slope += exponent * self(base) / base
        return base**exponent * slope

    def applied(self, expr: sympy.Expr) -> sympy.Expr:
        function, arguments = expr.func, expr.args
        if function in _SLOPES:
            return _SLOPES[function](arguments[0]) * self(arguments[0])
        if function is sympy.atan2:
            y, x = arguments
            return (x * self(y) - y * self(x)) / (x**2 + y**2)
        if function in (Maximum, sympy.Max, Minimum, sympy.Min):
            return self.branch(Maximum if function in (Maximum, sympy.Max) else Minimum, arguments)
        if function is sympy.Piecewise:
            return sympy.Piecewise(*((self(value), condition) for value, condition in arguments))
        raise ValueError(f"no derivative is known for {function} in {expr}")

    def branch(self, function: Any, arguments: Sequence[sympy.Expr]) -> sympy.Expr:
        first, *others = arguments
        if not others:
            return self(first)
        second = reduce(function, others)
        chosen = Step(first - second) if function is Maximum else Step(second - first)
        return chosen * self(first) + (1 - chosen) * self(second)
