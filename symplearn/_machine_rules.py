"""How single numbers and their slopes along many directions are worked out, operation by operation."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jax.extend.core import JaxprEqn
from llvmlite import ir

from ._machine_arithmetic import BIT, DOUBLE, Arithmetic, Dual, Unsupported, kind_of, known, type_of


def ruled(on: Arithmetic, one: JaxprEqn, entries: Sequence[Dual]) -> Dual:
    """What an operation makes of some numbers."""
    name = one.primitive.name
    if any(entry.value is None for entry in entries):
        return _of_nothing(name, entries)
    if name in _PLAIN and all(known(entry) is not None for entry in entries):
        shaped: Any = one.outvars[0].aval
        kind = type_of(shaped.dtype)
        return Dual(ir.Constant(kind, _PLAIN[name](*(known(e) for e in entries), like=np.dtype(shaped.dtype).type)))
    return RULES[name](on, one.params, *entries)


def spared(name: str, entries: Sequence[Dual]) -> Dual | None:
    """What a product with zero, a sum with zero, or a product with one comes to without work; or None. What is no
    number is lost in a product with zero."""
    zeros, ones = ([k for k, entry in enumerate(entries) if known(entry) == value] for value in (0.0, 1.0))
    if name == "mul" and zeros:
        return entries[zeros[0]]
    if (name in ("add", "add_any") and zeros) or (name == "mul" and ones):
        return entries[1 - (zeros or ones)[0]]
    return entries[0] if name in ("sub", "div") and 1 in (zeros if name == "sub" else ones) else None


def _of_nothing(name: str, entries: Sequence[Dual]) -> Dual:
    """What an operation makes of slopes that are all zero: it is linear in them."""
    some = [entry for entry in entries if entry.value is not None]
    if name in ("mul", "neg", "convert_element_type", "copy") or not some:
        return Dual(None)
    if name in ("add", "add_any"):
        return some[0]
    raise Unsupported(f"{name} of slopes")


def _is_real(dual: Dual) -> bool:
    return bool(kind_of(dual.value) == DOUBLE)


_Rule = Callable[..., Dual]


def _linear(real: str, whole: str) -> _Rule:
    def rule(on: Arithmetic, p: Any, a: Dual, b: Dual) -> Dual:
        if not _is_real(a):
            return Dual(getattr(on.builder, whole)(*on.pair(a.value, b.value)))
        what = getattr(on, real)
        return Dual(what(a.value, b.value), what(a.slope, b.slope))

    return rule


def _product(on: Arithmetic, p: Any, a: Dual, b: Dual) -> Dual:
    if not _is_real(a):
        return Dual(on.builder.mul(*on.pair(a.value, b.value)))
    return Dual(on.times(a.value, b.value), on.plus(on.times(a.slope, b.value), on.times(a.value, b.slope)))


def _quotient(on: Arithmetic, p: Any, a: Dual, b: Dual) -> Dual:
    if not _is_real(a):
        return Dual(on.builder.sdiv(*on.pair(a.value, b.value)))
    value, left = on.over(a.value, b.value), None
    if a.slope is not None or b.slope is not None:
        left = on.minus(a.slope, on.times(value, b.slope))
        left = on.times(left, on.over(on.number(1.0), b.value))
    return Dual(value, left)


def _compared(sign: str) -> _Rule:
    def rule(on: Arithmetic, p: Any, a: Dual, b: Dual) -> Dual:
        if not _is_real(a):
            return Dual(on.builder.icmp_signed(sign, *on.pair(a.value, b.value)))
        return Dual(on.compared(sign, a.value, b.value))

    return rule


def _larger(sign: str) -> _Rule:
    def rule(on: Arithmetic, p: Any, a: Dual, b: Dual) -> Dual:
        build = on.builder
        if not _is_real(a):
            return Dual(on.chosen(build.icmp_signed(sign, *on.pair(a.value, b.value)), a.value, b.value))
        first = on.compared(sign, a.value, b.value)
        # What is no number stays so, on either side.
        stays = build.or_(*on.pair(first, on.compared("uno", a.value, a.value)))
        value = on.chosen(stays, a.value, b.value)
        if a.slope is None and b.slope is None:
            return Dual(value)
        half, one, none = map(on.number, (0.5, 1.0, 0.0))
        tied = on.chosen(on.compared("==", a.value, b.value), half, none)  # as JAX has it
        weight = on.chosen(first, one, tied)
        return Dual(value, on.plus(on.times(weight, a.slope), on.times(on.minus(one, weight), b.slope)))

    return rule


def _bounded(on: Arithmetic, p: Any, low: Dual, a: Dual, high: Dual) -> Dual:
    value = RULES["min"](on, p, RULES["max"](on, p, Dual(a.value), Dual(low.value)), Dual(high.value)).value
    if a.slope is None:
        return Dual(value)
    inside = on.builder.and_(*on.pair(on.compared("<", low.value, a.value), on.compared("<", a.value, high.value)))
    return Dual(value, on.chosen(inside, on.slope(a), ir.Constant(on.register, None)))


def _integer_power(on: Arithmetic, p: Any, a: Dual) -> Dual:
    y = p["y"]
    if not _is_real(a) or y == 0:
        raise Unsupported("a power of an integer, or of none")
    rate = None if a.slope is None else on.times(on.number(float(y)), on.power(a.value, y - 1))
    return Dual(on.power(a.value, y), on.times(rate, a.slope))


def _power(on: Arithmetic, p: Any, a: Dual, b: Dual) -> Dual:
    value, slope = on.called("pow", a.value, b.value), None
    if a.slope is not None:
        rate = on.times(b.value, on.called("pow", a.value, on.minus(b.value, on.number(1.0))))
        slope = on.times(rate, a.slope)
    if b.slope is not None:
        zero = on.compared("==", a.value, on.number(0.0))
        log = on.built_in("log", on.chosen(zero, on.number(1.0), a.value))  # as JAX has it
        slope = on.plus(slope, on.times(on.times(log, value), b.slope))
    return Dual(value, slope)


def _one_minus_square(on: Arithmetic, p: Any, a: Dual) -> Dual:
    """1 - x^2, from JAX 0.11 on an operation of its own, which is accurate near 1."""
    one = on.number(1.0)
    value = on.times(on.plus(one, a.value), on.minus(one, a.value))
    return Dual(value, None if a.slope is None else on.times(on.times(on.number(-2.0), a.value), a.slope))


def _direction(on: Arithmetic, p: Any, y: Dual, x: Dual) -> Dual:
    value, slope = on.called("atan2", y.value, x.value), None
    if y.slope is not None or x.slope is not None:
        square = on.plus(on.times(x.value, x.value), on.times(y.value, y.value))
        slope = on.minus(on.times(on.over(x.value, square), y.slope), on.times(on.over(y.value, square), x.slope))
    return Dual(value, slope)


def _sign(on: Arithmetic, a: ir.Value) -> ir.Value:
    stays = on.compared("ueq", a, on.number(0.0))  # zeros, and what is no number
    return on.chosen(stays, a, on.built_in("copysign", on.number(1.0), a))


def _size(on: Arithmetic, p: Any, a: Dual) -> Dual:
    if not _is_real(a):
        raise Unsupported("the size of an integer")
    return Dual(on.built_in("fabs", a.value), on.times(_sign(on, a.value), a.slope) if a.slope is not None else None)


def _chosen(on: Arithmetic, p: Any, which: Dual, *cases: Dual) -> Dual:
    if len(cases) != 2 or kind_of(which.value) != BIT:
        raise Unsupported("a choice among more than two")
    no, yes = cases
    slope = None
    if no.slope is not None or yes.slope is not None:
        slope = on.chosen(which.value, on.slope(yes), on.slope(no))
    return Dual(on.chosen(which.value, yes.value, no.value), slope)


def _converted(on: Arithmetic, p: Any, a: Dual) -> Dual:
    build, new, old = on.builder, type_of(p["new_dtype"]), kind_of(a.value)
    if new == old:
        return a
    to = ir.VectorType(new, on.width) if isinstance(a.value.type, ir.VectorType) else new
    if DOUBLE not in (new, old):
        if new == BIT:
            return Dual(build.icmp_signed("!=", *on.pair(a.value, ir.Constant(old, 0))))
        widened = build.zext if old == BIT else build.sext
        return Dual(build.trunc(a.value, to) if new.width < old.width else widened(a.value, to))
    if new == DOUBLE:
        return Dual((build.uitofp if old == BIT else build.sitofp)(a.value, to))
    return Dual(on.compared("!=", a.value, on.number(0.0)) if new == BIT else build.fptosi(a.value, to))


def _negative(on: Arithmetic, p: Any, a: Dual) -> Dual:
    if not _is_real(a):
        return Dual(on.builder.neg(a.value))
    return Dual(on.builder.fneg(a.value), None if a.slope is None else on.builder.fneg(a.slope))


def _finite(on: Arithmetic, p: Any, a: Dual) -> Dual:
    return Dual(on.compared("<", on.built_in("fabs", a.value), on.number(math.inf)))


def _cleaned(on: Arithmetic, a: ir.Value) -> ir.Value:
    """Zero for what is not finite."""
    return on.chosen(_finite(on, None, Dual(a)).value, a, on.number(0.0))


def _smooth(name: str, rate: Callable[[Arithmetic, ir.Value, ir.Value], ir.Value], built_in: bool = False) -> _Rule:
    """A function of one number, and its derivative by the number and by what it comes to."""

    def rule(on: Arithmetic, p: Any, a: Dual) -> Dual:
        value = on.built_in(name, a.value) if built_in else on.called(name, a.value)
        return Dual(value, None if a.slope is None else on.times(rate(on, a.value, value), a.slope))

    return rule


def _logistic(on: Arithmetic, p: Any, a: Dual) -> Dual:
    one = on.number(1.0)
    value = on.over(one, on.plus(one, on.called("exp", on.builder.fneg(a.value))))
    return Dual(value, None if a.slope is None else on.times(on.times(value, on.minus(one, value)), a.slope))


def _over_root(sign: float, square: float) -> Callable[[Arithmetic, ir.Value, ir.Value], ir.Value]:
    """1 / sqrt(sign + square x^2), the derivative of inverse functions."""

    def rate(on: Arithmetic, x: ir.Value, value: ir.Value) -> ir.Value:
        inside = on.plus(on.number(sign), on.times(on.number(square), on.times(x, x)))
        return on.over(on.number(1.0), on.built_in("sqrt", inside))

    return rate


def _over_square(square: float) -> Callable[[Arithmetic, ir.Value, ir.Value], ir.Value]:
    """1 / (1 + square x^2)."""
    return lambda on, x, value: on.over(
        on.number(1.0), on.plus(on.number(1.0), on.times(on.number(square), on.times(x, x)))
    )


def _one_and(square: float) -> Callable[[Arithmetic, ir.Value, ir.Value], ir.Value]:
    """1 + square f^2, of what a function comes to."""
    return lambda on, x, value: on.plus(on.number(1.0), on.times(on.number(square), on.times(value, value)))


def _bits(name: str) -> _Rule:
    return lambda on, p, a, b: Dual(getattr(on.builder, name)(*on.pair(a.value, b.value)))


RULES: dict[str, _Rule] = {
    "abs": _size,
    "acos": _smooth("acos", lambda on, x, f: on.builder.fneg(_over_root(1.0, -1.0)(on, x, f))),
    "acosh": _smooth("acosh", _over_root(-1.0, 1.0)),
    "add": _linear("plus", "add"),
    "add_any": _linear("plus", "add"),
    "and": _bits("and_"),
    "asin": _smooth("asin", _over_root(1.0, -1.0)),
    "asinh": _smooth("asinh", _over_root(1.0, 1.0)),
    "atan": _smooth("atan", _over_square(1.0)),
    "atan2": _direction,
    "atanh": _smooth("atanh", _over_square(-1.0)),
    "clamp": _bounded,
    "convert_element_type": _converted,
    "copy": lambda on, p, a: a,
    "cos": _smooth("cos", lambda on, x, f: on.builder.fneg(on.called("sin", x))),
    "cosh": _smooth("cosh", lambda on, x, f: on.called("sinh", x)),
    "div": _quotient,
    "eq": _compared("=="),
    "exp": _smooth("exp", lambda on, x, f: f),
    "finite_or_zero": lambda on, p, a: Dual(_cleaned(on, a.value), None if a.slope is None else _cleaned(on, a.slope)),
    "floor": lambda on, p, a: Dual(on.built_in("floor", a.value)),
    "ge": _compared(">="),
    "gt": _compared(">"),
    "integer_pow": _integer_power,
    "is_finite": _finite,
    "le": _compared("<="),
    "logistic": _logistic,
    "log": _smooth("log", lambda on, x, f: on.over(on.number(1.0), x)),
    "lt": _compared("<"),
    "max": _larger(">"),
    "min": _larger("<"),
    "mul": _product,
    "ne": _compared("!="),
    "neg": _negative,
    "not": lambda on, p, a: Dual(on.builder.not_(a.value)),
    "one_minus_square": _one_minus_square,
    "or": _bits("or_"),
    "pow": _power,
    "select_n": _chosen,
    "sign": lambda on, p, a: Dual(_sign(on, a.value)),
    "sin": _smooth("sin", lambda on, x, f: on.called("cos", x)),
    "sinh": _smooth("sinh", lambda on, x, f: on.called("cosh", x)),
    "sqrt": _smooth("sqrt", lambda on, x, f: on.over(on.number(0.5), f), built_in=True),
    "stop_gradient": lambda on, p, a: Dual(a.value),
    "square": lambda on, p, a: _integer_power(on, {"y": 2}, a),
    "sub": _linear("minus", "sub"),
    "tan": _smooth("tan", _one_and(1.0)),
    "tanh": _smooth("tanh", _one_and(-1.0)),
}
# Operations on places, which are worked out where these are known: to pick entries, one must know which.
_PLAIN: dict[str, Callable[..., Any]] = {
    "add": lambda a, b, like: like(a + b).item(),
    "convert_element_type": lambda a, like: like(a).item(),
    "lt": lambda a, b, like: bool(a < b),
    "select_n": lambda which, *cases, like: cases[int(which)],
}
