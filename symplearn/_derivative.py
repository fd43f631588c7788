"""Derivatives of SymPy trees that never leave `DiracDelta` or an unevaluated `Derivative` behind."""

from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any

import sympy
from sympy.functions.elementary.piecewise import ExprCondPair

from ._kinks import Absolute, Maximum, Minimum, Sign, Step

LARGEST = 200_000  # nodes of a derivative; beyond, differentiating is refused


class TooLarge(Exception):
    """The derivative of an expression has more nodes than can be worked with."""


def bottom_up(expressions: Sequence[sympy.Basic]) -> list[sympy.Basic]:
    """Every distinct subtree once, arguments first: deep trees then need no deep recursion."""
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
    for part in bottom_up([expr]):
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
