"""Expressions have Python's arithmetic and precedence, and text is never more than an expression."""

import math
import time

import numpy as np
import pytest
import sympy

from symplearn._errors import InputError
from symplearn._expression import parse_expression, symbol
from symplearn._symbolic import derivative, numpy_function

NAMES = ("x", "y", "p")
POINT = {"x": 0.7, "y": 1.3, "p": -0.4, "t": 2.5}
WHERE = "f.toml, [system] hamiltonian"

# Literals of this file alone; Python's own eval is the oracle.
TEXTS = [
    "-x**2",
    "(-x)**2",
    "-x**-2",
    "2**-x",
    "x**2**y",
    "(x**2)**y",
    "2**3**2",
    "-2**2",
    "--x",
    "-+-x",
    "x--y",
    "x- -y",
    "2*-x",
    "x/-y",
    "x/y/p",
    "x/y*p",
    "x/(y*p)",
    "x-y-p",
    "x-(y-p)",
    "x-y+p",
    "x*y**2/p",
    "1/2*x",
    "1/2/x",
    "1e-3*x",
    ".5*x",
    "5.*x",
    "1.5E+2*x",
    "1e5",
    "x**0.5",
    "x**.25",
    "x**(1/3)",
    "x**-1",
    "x**2.0",
    "12345678901234567890*x",
    "1/3 + 1/7",
    "10/4*x",
    "pi*x/180",
    "cos(pi)",
    "sin(x)**2",
    "sin(x**2)",
    "-sin(-x)",
    "tan(x)+asin(x)-acos(x)*atan(x)",
    "atan2(y, x)",
    "atan2(p, -x)",
    "sinh(x)*cosh(y)/tanh(p)",
    "exp(-x)*log(y)",
    "sqrt(x*y)",
    "sqrt(x**2)",
    "sqrt(p**2)",
    "abs(p)*p",
    "sign(p)*x",
    "min(x, y, p)",
    "max(x, y, p)",
    "max(min(x, y), p)*2",
    "max(x, 3, 1)",
    "p**2/(2*x*y**2) - x*9.81*y*cos(p)",
    "(p + x)**3 - p**3",
    "x*t + cos(2*t)",
    "exp(log(x))",
    " x +\n\ty ",
    "((((x))))",
    "x*(y+p)*(y-p)/(y**2+1)**(3/2)",
    "2**0.5*x",
    "x+x+x-3*x+y",
    "7",
]


def sign(value):
    return (value > 0) - (value < 0)


ORACLE = {name: getattr(math, name) for name in dir(math) if name[0] != "_"} | {
    "abs": abs, "sign": sign, "min": min, "max": max, **POINT,
}  # fmt: skip


def value(expr, **changed):
    point = POINT | changed
    symbols = sorted(expr.free_symbols, key=str)
    return float(numpy_function([expr], symbols)(np.array([point[str(s)] for s in symbols]))[0])


@pytest.mark.parametrize("text", TEXTS)
def test_value_is_pythons(text):
    """An expression has the value that Python gives to the same text."""
    expected = eval(" ".join(text.split()), {"__builtins__": {}}, ORACLE)  # noqa: S307
    # 1e-13: a few roundings, of terms up to a hundred times the result.
    assert value(parse_expression(text, NAMES, where=WHERE)) == pytest.approx(expected, rel=1e-13, abs=1e-13)


@pytest.mark.parametrize("text", TEXTS)
@pytest.mark.parametrize("name", [*NAMES, "t"])
def test_derivative_is_the_finite_difference(text, name):
    """The symbolic derivative is the slope that a central difference measures."""
    expr = parse_expression(text, NAMES, where=WHERE)
    h = 1e-5
    measured = (value(expr, **{name: POINT[name] + h}) - value(expr, **{name: POINT[name] - h})) / (2 * h)
    slope = derivative(expr, symbol(name))
    assert not slope.has(sympy.Derivative, sympy.DiracDelta, sympy.Subs)
    # A central difference errs by h^2 f'''/6, 1e-10 times slopes up to 100, and by rounding, 1e-16 f/h.
    assert value(slope) == pytest.approx(measured, rel=1e-6, abs=1e-8 * (1 + abs(value(expr))))


def test_squares_keep_exact_exponents():
    """x**2 and x**2.0 differentiate to 2 x, not to 2.0 x**1.0."""
    for text in ("x**2", "x**2.0"):
        assert derivative(parse_expression(text, NAMES, where=WHERE), symbol("x")) == 2 * symbol("x")


REFUSED = [
    ("", "empty"),
    ("   ", "empty"),
    ("__import__('os')", "quotes"),
    ("__import__(os)", "unknown function"),
    ("eval(x)", "unknown function"),
    ("x.__class__", "attributes"),
    ("(x).real", "attributes"),
    ("x[0]", "indexing"),
    ("x < y", "comparisons"),
    ("x == y", "comparisons"),
    ("x = y", "comparisons"),
    ("'x'", "quotes"),
    ('"x"', "quotes"),
    ("x^2", r"\*\*"),
    ("2x", "missing before"),
    ("2 x", "missing before"),
    ("x y", "missing before"),
    ("x(y)", "missing after"),
    ("(x)(y)", "missing before"),
    ("2(x)", "missing before"),
    ("pi(2)", "missing after"),
    ("t(2)", "missing after"),
    ("(x)2", "missing before"),
    ("sin x", "without brackets"),
    ("sin", "without brackets"),
    ("sin*x", "without brackets"),
    ("sin()", "takes 1 argument"),
    ("sin(x, y)", "takes 1 argument"),
    ("atan2(x)", "takes 2 arguments"),
    ("min(x)", "two or more"),
    ("max()", "two or more"),
    ("z + x", "undeclared name `z`"),
    ("X", "did you mean `x`|known are"),
    ("x +", "too early"),
    ("* x", "unexpected"),
    ("x // y", "unexpected"),
    ("x % y", "unexpected"),
    ("x @ y", "unexpected"),
    ("x, y", "unexpected"),
    ("(x, y)", "closing bracket"),
    ("(x", "never closed"),
    ("x)", "unexpected"),
    ("()", "unexpected"),
    ("max(x, )", "unexpected"),
    ("٣*x", "unexpected"),
    ("x²", "unexpected"),
    ("xé", "unexpected"),
    ("x\u00a0+ y", "unexpected"),
    ("x\0y", "unexpected"),
    ("lambda: x", "unexpected|undeclared"),
    ("x if y else p", "missing before"),
    ("x; y", "single formula"),
    ("1_000*x", "missing before"),
    ("0x10", "missing before"),
    ("1j*x", "missing before"),
    ("1..real", "attributes|missing"),
    ("1e400*x", "too large"),
    ("9**9**9**9", "too large"),
    ("2**(10**9)", "too large"),
    ("x**(9**9**9)", "too large"),
    ("9" * 400, "too large"),
    ("1/0", "divides by zero"),
    ("x/(1-1)", "divides by zero"),
    ("x/(y-y)", "divides by zero"),
    ("0**-1", "divides by zero"),
    ("sqrt(-1)", "no real value"),
    ("(-8)**(1/3)", "negative number"),
    ("log(0)", "no real value"),
    ("asin(2)", "no real value"),
    ("exp(1000)", "too large"),
    ("inf", "undeclared"),
    ("nan", "undeclared"),
    ("(" * 101 + "x" + ")" * 101, "100 brackets"),
    ("x**" * 101 + "x", "100 deep"),
    ("x+" * 5000 + "x", "at most 10,000"),
    ("x" * 1_000_000, "at most 10,000"),
    ("(" * 10_000 + ")" * 10_000, "at most 10,000"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "reason"), REFUSED, ids=range(len(REFUSED)))
def test_everything_else_is_refused_in_one_sentence(text, reason):
    """What is not an expression is refused at once, with one line that names place and reason."""
    begin = time.process_time()
    with pytest.raises(InputError, match=reason) as refused:
        parse_expression(text, NAMES, where=WHERE)
    assert str(refused.value).startswith(WHERE) and "\n" not in str(refused.value)
    assert len(str(refused.value)) < 400
    assert time.process_time() - begin < 2  # seconds of this process's own work


def test_the_character_is_named():
    """The position is the character's, counted from 1."""
    with pytest.raises(InputError, match="`zz` at character 5;"):
        parse_expression("x + zz*y", NAMES, where=WHERE)


def test_the_nearest_name_is_suggested():
    """A misspelt name is met with the declared one."""
    with pytest.raises(InputError, match="did you mean `theta`"):
        parse_expression("cos(thetta)", ("theta", "p_theta"), where=WHERE)


MONSTERS = [
    "(" * 99 + "x" + "+y)**9999" * 99,
    "exp(64*log(" * 25 + "x" + "+x))" * 25,
    "(x+x)**9999*y",
    "(" * 40 + "x" + "+x)**999" * 40,
    "sin(" * 99 + "x" + ")" * 99,
    "abs(" * 99 + "x" + "-y)" * 99,
    "max(" * 99 + "x" + ",y)" * 99,
    "sqrt(" * 99 + "x" + "+y)" * 99,
    "max(" + "x," * 3000 + "y)",
    "x**" * 99 + "x",
    "-" * 9000 + "x",
    "x+" * 4999 + "x",
    "x*" * 4999 + "x",
    "x/" * 4999 + "y",
    "*".join(f"(x+{i}*sin(y*{i}))" for i in range(500)),
    "(" * 99 + "x" + "/y)**x" * 99,
    "1/(x+" * 99 + "y" + ")" * 99,
    "*".join(f"{i}/{i + 1}*x" for i in range(9000, 9600)),
    "(" + "+".join(f"x/{i}" for i in range(2, 1200)) + ")**9999",
    "0**x**0",
    "2**(x - x + 9999)*y",
]


@pytest.mark.parametrize("text", MONSTERS, ids=range(len(MONSTERS)))
def test_work_is_bounded_by_the_length(text):
    """Every text within the limits is parsed or refused in seconds, without huge numbers."""
    begin = time.process_time()
    try:
        expr = parse_expression(text, NAMES, where=WHERE)
    except InputError as refused:
        assert "\n" not in str(refused)
    else:
        exact = [max(abs(a.p), a.q) for a in expr.atoms(sympy.Rational)]
        assert max(exact, default=0) <= 10_000
    # Seconds of this process's own work, whatever else the machine does: the slowest takes 1, an unbounded one hours.
    assert time.process_time() - begin < 20
