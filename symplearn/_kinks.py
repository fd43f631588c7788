"""Functions with a kink, as SymPy functions that stay what they are.

SymPy's own `Abs`, `sign`, `Min` and `Max` ask far-reaching questions about signs when they are built, and
their derivatives leave `DiracDelta` behind. These do neither: away from the kink the derivative is the
classical one, and at the kink it is the mean of both sides, as JAX has it.
"""

from typing import Any

import sympy


class _Kink(sympy.Function):
    """Real whatever its arguments; evaluated only where they are numbers."""

    word = ""

    def _eval_is_extended_real(self) -> bool:
        return True

    def _eval_is_finite(self) -> bool:
        return True

    def _sympystr(self, printer: Any) -> str:
        return f"{self.word}({', '.join(printer._print(a) for a in self.args)})"

    def _latex(self, printer: Any, exp: str | None = None) -> str:
        inside = ", ".join(printer._print(a) for a in self.args)
        text = rf"\operatorname{{{self.word}}}\left({inside}\right)"
        return text if exp is None else rf"{{{text}}}^{{{exp}}}"


class Step(_Kink):
    """0 below zero, 1 above, 1/2 at zero. Its derivative is taken as zero."""

    nargs = 1
    word = "step"

    @classmethod
    def eval(cls, arg: sympy.Expr) -> sympy.Expr | None:
        return (1 + sympy.sign(arg)) / 2 if arg.is_Number else None

    def fdiff(self, argindex: int = 1) -> sympy.Expr:
        return sympy.S.Zero


class Sign(_Kink):
    """-1, 0 or 1. Its derivative is taken as zero."""

    nargs = 1
    word = "sign"

    @classmethod
    def eval(cls, arg: sympy.Expr) -> sympy.Expr | None:
        return sympy.sign(arg) if arg.is_Number else None

    def fdiff(self, argindex: int = 1) -> sympy.Expr:
        return sympy.S.Zero


class Absolute(_Kink):
    """The absolute value of a real number."""

    nargs = 1
    word = "abs"

    @classmethod
    def eval(cls, arg: sympy.Expr) -> sympy.Expr | None:
        return abs(arg) if arg.is_Number else None

    def fdiff(self, argindex: int = 1) -> sympy.Expr:
        return Sign(self.args[0])

    def _latex(self, printer: Any, exp: str | None = None) -> str:
        text = rf"\left|{printer._print(self.args[0])}\right|"
        return text if exp is None else rf"{text}^{{{exp}}}"


class Maximum(_Kink):
    """The larger of two numbers."""

    nargs = 2
    word = "max"

    @classmethod
    def eval(cls, a: sympy.Expr, b: sympy.Expr) -> sympy.Expr | None:
        return sympy.Max(a, b) if a.is_Number and b.is_Number else None

    def fdiff(self, argindex: int = 1) -> sympy.Expr:
        a, b = self.args if argindex == 1 else self.args[::-1]
        return Step(a - b)


class Minimum(_Kink):
    """The smaller of two numbers."""

    nargs = 2
    word = "min"

    @classmethod
    def eval(cls, a: sympy.Expr, b: sympy.Expr) -> sympy.Expr | None:
        return sympy.Min(a, b) if a.is_Number and b.is_Number else None

    def fdiff(self, argindex: int = 1) -> sympy.Expr:
        a, b = self.args if argindex == 1 else self.args[::-1]
        return Step(b - a)


KINKS = (
    Absolute, Sign, Step, Maximum, Minimum,
    sympy.Abs, sympy.sign, sympy.Heaviside, sympy.Max, sympy.Min, sympy.Piecewise,
)  # fmt: skip
