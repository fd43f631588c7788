"""Building a SymPy tree that can never blow up, however the text is written.

SymPy works exactly and at once: left alone it multiplies out `9**9**9**9`. Here every number is a fraction
of integers up to 10,000, or a float; what has no symbol in it is computed in double precision; and each new
node is looked over before it is built upon, so no exact number can grow from node to node.
"""

import math
from collections.abc import Callable, Sequence

import sympy

from ._kinks import Absolute, Maximum, Minimum, Sign

EXACT = 10_000  # largest numerator and denominator that is kept exact


class NotANumber(Exception):
    """A part of the expression has no finite real value; its text says why."""


def number(value: float) -> sympy.Number:
    """The SymPy number for a double: an integer where it is a small one, a float otherwise."""
    if not math.isfinite(value):
        raise NotANumber("is too large for a double-precision number")
    if value == int(value) and abs(value) <= EXACT:
        return sympy.Integer(int(value))
    return sympy.Float(value)


def total(terms: Sequence[sympy.Expr]) -> sympy.Expr:
    """The sum of `terms`."""
    return terms[0] if len(terms) == 1 else settled(sympy.Add(*terms))


def product(factors: Sequence[sympy.Expr]) -> sympy.Expr:
    """The product of `factors`."""
    return factors[0] if len(factors) == 1 else settled(sympy.Mul(*factors))


def reciprocal(expr: sympy.Expr) -> sympy.Expr:
    """1/expr."""
    if expr.is_zero:
        raise NotANumber("divides by zero")
    return settled(sympy.Pow(expr, -1))


def power(base: sympy.Expr, exponent: sympy.Expr) -> sympy.Expr:
    """base**exponent."""
    if base.is_Number and exponent.is_Number:
        return _computed(_real_power, base, exponent)
    if exponent.is_Float:
        exponent = _fraction(exponent)
    return settled(sympy.Pow(base, exponent))


def _fraction(exponent: sympy.Float) -> sympy.Number:
    """x**2.0 and x**0.5 are written with exact exponents, so that derivatives stay clean."""
    numerator, denominator = float(exponent).as_integer_ratio()
    small = abs(numerator) <= EXACT and denominator <= 8
    return sympy.Rational(numerator, denominator) if small else exponent


def _real_power(base: float, exponent: float) -> float:
    value = base**exponent
    if isinstance(value, complex):
        raise NotANumber("is a root of a negative number")
    return value


def _computed(function: Callable[..., float], *numbers: sympy.Number) -> sympy.Number:
    """`function` of plain numbers, in double precision."""
    try:
        return number(function(*map(float, numbers)))
    except OverflowError:
        raise NotANumber("is too large for a double-precision number") from None
    except ZeroDivisionError:
        raise NotANumber("divides by zero") from None
    except ValueError:
        raise NotANumber("has no real value") from None


def settled(expr: sympy.Expr) -> sympy.Expr:
    """`expr` with every long exact number turned into a float.

    **Raises** `NotANumber` where a part of it is infinite, undefined or complex.
    """
    long = {}
    for atom in expr.atoms():
        if not atom.is_Number:
            if atom in (sympy.I, sympy.zoo):
                raise NotANumber("divides by zero" if atom is sympy.zoo else "has no real value")
            continue
        if atom in (sympy.nan, sympy.oo, -sympy.oo):
            raise NotANumber("has no finite value")
        if atom.is_Float or max(abs(atom.p), atom.q) > EXACT:
            replaced = _computed(float, atom)
            if not atom.is_Float:
                long[atom] = replaced
    return expr.xreplace(long) if long else expr


def _balanced(function: Callable[..., sympy.Expr], arguments: Sequence[sympy.Expr]) -> sympy.Expr:
    """max and min of many as a balanced tree of pairs: its depth is the logarithm of their number."""
    if len(arguments) == 1:
        return arguments[0]
    half = len(arguments) // 2
    return function(_balanced(function, arguments[:half]), _balanced(function, arguments[half:]))


# word: (SymPy function, its value for plain numbers, number of arguments; None for two or more)
FUNCTIONS: dict[str, tuple[Callable[..., sympy.Expr], Callable[..., float], int | None]] = {
    "sin": (sympy.sin, math.sin, 1),
    "cos": (sympy.cos, math.cos, 1),
    "tan": (sympy.tan, math.tan, 1),
    "asin": (sympy.asin, math.asin, 1),
    "acos": (sympy.acos, math.acos, 1),
    "atan": (sympy.atan, math.atan, 1),
    "atan2": (sympy.atan2, math.atan2, 2),
    "sinh": (sympy.sinh, math.sinh, 1),
    "cosh": (sympy.cosh, math.cosh, 1),
    "tanh": (sympy.tanh, math.tanh, 1),
    "exp": (sympy.exp, math.exp, 1),
    "log": (sympy.log, math.log, 1),
    "sqrt": (sympy.sqrt, math.sqrt, 1),
    "abs": (Absolute, abs, 1),
    "sign": (Sign, lambda x: float((x > 0) - (x < 0)), 1),
    "min": (Minimum, min, None),
    "max": (Maximum, max, None),
}


def call(word: str, arguments: Sequence[sympy.Expr]) -> sympy.Expr:
    """The function called `word` of `arguments`, whose number has been checked."""
    function, value, _ = FUNCTIONS[word]
    if all(a.is_Number for a in arguments):
        return _computed(value, *arguments)
    if function in (Minimum, Maximum):
        return _balanced(function, arguments)
    return settled(function(*arguments))
