"""Numbers of machine code, their slopes along many directions, and the arithmetic that both are worked out with."""

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from llvmlite import ir

DOUBLE, INTEGER = ir.DoubleType(), ir.IntType(64)
BIT, SHORT = ir.IntType(1), ir.IntType(32)
_TYPES = {"float64": DOUBLE, "bool": BIT, "int32": SHORT, "int64": INTEGER}


class Unsupported(Exception):
    """An operation, or a type, that is not made into machine code here."""


@dataclass(frozen=True)
class Dual:
    """A number, and its slopes in one register; None where nothing moves it.

    Where slopes are themselves worked with as numbers, the value is a register, or None for one of zeros.
    """

    value: Any
    slope: Any = None


def type_of(dtype: Any) -> ir.Type:
    """The machine's type of an array's entries."""
    if str(dtype) not in _TYPES:
        raise Unsupported(f"numbers of type {dtype}")
    return _TYPES[str(dtype)]


def kind_of(value: ir.Value) -> ir.Type:
    """The type of a number, or of a register's entries."""
    return value.type.element if isinstance(value.type, ir.VectorType) else value.type


def known(dual: Dual) -> Any:
    """What a constant is; None for anything else."""
    return dual.value.constant if isinstance(dual.value, ir.Constant) else None


# ln 2 in two parts, of which the first has so few digits that its products with exponents are exact.
_LN2 = 6.93147180369123816490e-01, 1.90821492927058770002e-10
# A number whose sum with another has that one's nearest integer in its last bits.
_NEAREST = 1.5 * 2.0**52
# Beyond, an exponential is not finite, or as good as zero.
_LARGEST, _SMALLEST = 709.782712893384, -708.0


class Arithmetic:
    """Writes arithmetic of numbers and of registers; `Unsupported` beyond `most` operations of two of them."""

    def __init__(self, builder: ir.IRBuilder, width: int, most: int = sys.maxsize):
        self.builder, self.width, self.most, self.written = builder, width, most, 0
        self.register = self.register_of(DOUBLE)

    def register_of(self, kind: ir.Type) -> ir.Type:
        """The type of a register of some type of entries; a single one needs none."""
        return kind if self.width == 1 else ir.VectorType(kind, self.width)

    def slope(self, dual: Dual) -> ir.Value:
        """The slopes of a number, zeros where there are none."""
        return ir.Constant(self.register, None) if dual.slope is None else self.wide(dual.slope)

    def wide(self, value: ir.Value) -> ir.Value:
        """A register with the same in every direction."""
        if self.width == 1 or isinstance(value.type, ir.VectorType):
            return value
        empty = ir.Constant(ir.VectorType(value.type, self.width), ir.Undefined)
        first = self.builder.insert_element(empty, value, ir.Constant(SHORT, 0))
        places = ir.Constant(ir.VectorType(SHORT, self.width), [0] * self.width)
        return self.builder.shuffle_vector(first, empty, places)

    def pair(self, a: ir.Value, b: ir.Value) -> tuple[ir.Value, ir.Value]:
        """Two numbers, or two registers where one of them is; they are about to become one."""
        self.written += 1
        if self.written > self.most:
            raise Unsupported("a long function")
        if isinstance(a.type, ir.VectorType) or isinstance(b.type, ir.VectorType):
            return self.wide(a), self.wide(b)
        return a, b

    def number(self, value: float) -> ir.Constant:
        return ir.Constant(DOUBLE, value)

    def plus(self, a: Any, b: Any) -> Any:
        """A sum; None is nothing."""
        if a is None or b is None:
            return b if a is None else a
        return self.builder.fadd(*self.pair(a, b), flags=("contract",))

    def minus(self, a: Any, b: Any) -> Any:
        if a is None or b is None:
            return a if b is None else self.builder.fneg(b)
        return self.builder.fsub(*self.pair(a, b), flags=("contract",))

    def times(self, a: Any, b: Any) -> Any:
        """A product; None is nothing."""
        if a is None or b is None:
            return None
        return self.builder.fmul(*self.pair(a, b), flags=("contract",))

    def over(self, a: ir.Value, b: ir.Value) -> ir.Value:
        return self.builder.fdiv(*self.pair(a, b))

    def chosen(self, which: ir.Value, yes: ir.Value, no: ir.Value) -> ir.Value:
        """One of two, numbers or registers."""
        if isinstance(which.type, ir.VectorType):
            return self.builder.select(which, self.wide(yes), self.wide(no))
        return self.builder.select(which, *self.pair(yes, no))

    def compared(self, sign: str, a: ir.Value, b: ir.Value) -> ir.Value:
        """A comparison of real numbers, which what is no number fails; but it differs from all."""
        compare = self.builder.fcmp_unordered if sign in ("!=", "ueq", "uno") else self.builder.fcmp_ordered
        return compare(sign, *self.pair(a, b))

    def called(self, name: str, *values: ir.Value) -> ir.Value:
        """A function of the C library, of every entry of registers."""
        if not any(isinstance(value.type, ir.VectorType) for value in values):
            return self._called(name, DOUBLE, values)
        if name == "exp":
            return exponential(self, *values)
        wide, out = [self.wide(value) for value in values], ir.Constant(self.register, ir.Undefined)
        for k in range(self.width):
            place = ir.Constant(SHORT, k)
            one = self._called(name, DOUBLE, [self.builder.extract_element(value, place) for value in wide])
            out = self.builder.insert_element(out, one, place)
        return out

    def _called(self, name: str, of: ir.Type, values: Sequence[ir.Value]) -> ir.Value:
        """A function; the C library's error number is not looked at, so that equal calls are one."""
        kind, module = ir.FunctionType(of, [of] * len(values)), self.builder.module
        function = module.globals.get(name)
        if function is None:
            function = ir.Function(module, kind, name)
            for attribute in ("nounwind", "readnone"):
                function.attributes.add(attribute)
        return self.builder.call(function, values)

    def built_in(self, name: str, *values: ir.Value) -> ir.Value:
        """A function that LLVM knows."""
        if not any(isinstance(value.type, ir.VectorType) for value in values):
            return self._called(f"llvm.{name}.f64", DOUBLE, values)
        return self._called(f"llvm.{name}.v{self.width}f64", self.register, [self.wide(value) for value in values])

    def power(self, a: ir.Value, exponent: int) -> ir.Value:
        """An integer power by squaring."""
        left, square, out = abs(exponent), a, None
        while left:
            if left & 1:
                out = square if out is None else self.times(out, square)
            left >>= 1
            square = self.times(square, square) if left else square
        out = self.number(1.0) if out is None else out
        return self.over(self.number(1.0), out) if exponent < 0 else out


def exponential(on: Arithmetic, x: ir.Value) -> ir.Value:
    """exp of every entry of a register: 2^n exp(r), with |r| of at most ln 2 / 2, whose series ends below rounding."""
    whole, build = ir.VectorType(INTEGER, on.width), on.builder
    shifted = on.plus(on.times(x, on.number(1.0 / math.log(2.0))), on.number(_NEAREST))
    n = on.minus(shifted, on.number(_NEAREST))
    r = on.minus(on.minus(x, on.times(n, on.number(_LN2[0]))), on.times(n, on.number(_LN2[1])))
    series: ir.Value = on.number(1.0 / math.factorial(13))
    for k in reversed(range(13)):
        series = on.plus(on.times(series, r), on.number(1.0 / math.factorial(k)))
    exponent = build.shl(build.bitcast(shifted, whole), on.wide(ir.Constant(INTEGER, 52)))
    found = build.bitcast(build.add(build.bitcast(series, whole), exponent), on.register)
    found = on.chosen(on.compared(">", x, on.number(_LARGEST)), on.number(math.inf), found)
    found = on.chosen(on.compared("<", x, on.number(_SMALLEST)), on.number(0.0), found)
    return on.chosen(on.compared("uno", x, x), x, found)
