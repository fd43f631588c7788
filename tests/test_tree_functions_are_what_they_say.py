"""A tree as a JAX function: values, derivatives, identity; and which Hamiltonians are separable."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy

from symplearn import _symbolic_slopes
from symplearn._expression import parse_expression, symbol
from symplearn._separable import is_separable
from symplearn._symbolic import TooLarge, derivative, gradient, jax_function, numpy_function
from symplearn._symbolic_slopes import with_slopes

NAMES = ("x", "y", "p")
SYMBOLS = tuple(map(symbol, NAMES))
POINT = jnp.array([0.7, 1.3, -0.4])

SMOOTH = [
    "x**2*sin(y)/p + 3",
    "atan2(y, x) + asin(x)*acos(p) - atan(x*y)",
    "x**y + x**2.5 + x**(1/3) + x**-3 + 1/sqrt(y)",
    "sinh(x)*cosh(y)*tanh(p) + tan(x)",
    "exp(-x**2)*log(y)*sqrt(x*y)",
    "abs(p)*p + sign(p)*x",
    "max(x, y, p) + min(x, p)*y",
    "x**(5/2) - (x**2 + y)**(-3/2)",
    "2**x + 0*y + p",
    "5",
]


def parsed(text):
    return parse_expression(text, NAMES, where="test")


@pytest.mark.parametrize("text", SMOOTH)
def test_the_symbolic_gradient_is_jaxs(text):
    """JAX's derivative of the function and the function of the symbolic derivative agree."""
    expr = parsed(text)
    automatic = jax.grad(lambda v: jax_function([expr], SYMBOLS)(v)[0])(POINT)
    symbolic = jax_function(gradient(expr, SYMBOLS), SYMBOLS)(POINT)
    np.testing.assert_allclose(symbolic, automatic, rtol=1e-13, atol=1e-14)  # a few roundings


def test_slopes_that_are_trees_are_those_of_the_function():
    """Worked out beforehand, in forward and in reverse mode, of one point and of many, slopes are JAX's own."""
    expressions = [parsed(text) for text in SMOOTH]
    plain, ours = jax_function(expressions, SYMBOLS), with_slopes(expressions, SYMBOLS)
    np.testing.assert_array_equal(ours(POINT), plain(POINT))
    # The same products in another order; entries are about one, and those that cancel are left with their round-off.
    for mode in (jax.jacfwd, jax.jacrev):
        both = (jax.jit(mode(function))(POINT) for function in (ours, plain))
        np.testing.assert_allclose(*both, rtol=1e-13, atol=1e-14)  # a few roundings
    many = POINT[:, None] * jnp.array([1.0, 0.9])
    along = (jax.jit(lambda x, f=function: jax.jvp(f, (x,), (x,))[1])(many) for function in (ours, plain))
    np.testing.assert_allclose(*along, rtol=1e-13)  # a few roundings; none cancels. Seen: 6e-16
    twice = (jax.jit(jax.jacfwd(jax.jacfwd(function)))(POINT) for function in (ours, plain))
    np.testing.assert_allclose(*twice, rtol=1e-12, atol=1e-13)  # a few more
    assert "custom_jvp_call" in str(jax.make_jaxpr(ours)(POINT))


def test_large_trees_are_left_to_jax(monkeypatch):
    """What SymPy would differentiate too long is differentiated by JAX, to the same slopes."""
    large = sympy.Add(*(sympy.sin(k * SYMBOLS[0]) * sympy.cos(k * SYMBOLS[1]) for k in range(1, 30)))
    small = with_slopes([large], SYMBOLS)
    monkeypatch.setattr(_symbolic_slopes, "_WORTH", 200)
    function = with_slopes([large], SYMBOLS)
    assert "custom_jvp_call" in str(jax.make_jaxpr(small)(POINT))
    assert "custom_jvp_call" not in str(jax.make_jaxpr(function)(POINT))
    # Sums of thirty terms of up to thirty, each rounded.
    np.testing.assert_allclose(jax.jacfwd(function)(POINT), jax.jacfwd(small)(POINT), rtol=0, atol=1e-12)


@pytest.mark.parametrize("text", SMOOTH)
def test_numpy_and_jax_agree(text):
    """Both array libraries give the same numbers from the same tree."""
    expr = parsed(text)
    many = np.asarray(POINT)[:, None] * np.array([1.0, 0.9])
    ours = jax.vmap(jax_function([expr], SYMBOLS), in_axes=1, out_axes=1)(jnp.asarray(many))
    np.testing.assert_allclose(numpy_function([expr], SYMBOLS)(many), ours, rtol=1e-13)


@pytest.mark.parametrize("exponent", [1.5, 3.5, -2.5, -7.5, 9.5])
def test_half_integer_powers_are_powers(exponent):
    """A root and a product, by which they are worked out, give Python's own power."""
    function = jax_function([parsed(f"y**({int(2 * exponent)}/2)")], SYMBOLS)
    np.testing.assert_allclose(function(POINT)[0], 1.3**exponent, rtol=1e-14)  # round-off of ten products


def test_it_lives_in_jit_vmap_jacfwd_and_scan():
    """One function serves every transformation, and its values are strongly typed doubles."""
    function = jax_function([parsed("x*y + 2"), parsed("p/3"), parsed("1")], SYMBOLS)
    assert function(POINT).dtype == jnp.float64 and not function(POINT).weak_type
    jacobian = jax.jit(jax.vmap(jax.jacfwd(function)))(jnp.stack([POINT, 2 * POINT]))
    x, y, _ = POINT
    np.testing.assert_allclose(jacobian[0], [[y, x, 0], [0, 0, 1 / 3], [0, 0, 0]])
    last, _ = jax.lax.scan(lambda v, _: (function(v), None), POINT, length=3)
    assert last.shape == (3,)


def test_equal_expressions_make_equal_functions():
    """A function may be a static argument: equal trees do not compile twice."""
    traces = []

    def evaluated(function, values):
        traces.append(1)
        return function(values)

    compiled = jax.jit(evaluated, static_argnums=0)
    for _ in range(2):
        compiled(jax_function([parsed("x*sin(y)")], SYMBOLS), POINT)
    assert len(traces) == 1
    assert jax_function([parsed("x")], SYMBOLS) != jax_function([parsed("y")], SYMBOLS)


def test_an_unknown_symbol_is_an_error():
    """A tree with a symbol that has no value is refused when the function is made."""
    with pytest.raises(ValueError, match="'p'"):
        jax_function([parsed("x*p")], SYMBOLS[:2])


def test_sympys_own_kinks_are_served():
    """Abs, sign, Max, Min, Heaviside and Piecewise evaluate and differentiate without DiracDelta."""
    x, y, _ = SYMBOLS
    expr = sympy.Abs(x - y) * x + sympy.Max(x, y) + sympy.Min(x, 2 * y) * sympy.sign(x) + sympy.Heaviside(y)
    expr += sympy.Piecewise((x**2, x < 0.5), (x**3, True))
    # |x - y| = y - x, max = y, min = x, sign = 1 at this point, so x y - x^2 + y + x + 1 + x^3.
    at = np.asarray(POINT)
    assert numpy_function([expr], SYMBOLS)(at)[0] == pytest.approx(0.7 * 1.3 - 0.49 + 1.3 + 0.7 + 1 + 0.343)
    slopes = gradient(expr, (x, y))
    assert not any(s.has(sympy.DiracDelta, sympy.Derivative) for s in slopes)
    assert numpy_function(slopes, SYMBOLS)(at) == pytest.approx([1.3 - 1.4 + 1 + 3 * 0.49, 0.7 + 1])


def test_slopes_at_a_kink_are_the_mean_of_both_sides():
    """d|x| is 0 at 0, d max(x, 0) is 1/2, d sign(x) is 0 everywhere."""
    x = SYMBOLS[0]
    zero = np.zeros(1)
    for text, slope in (("abs(x)", 0.0), ("max(x, 0)", 0.5), ("min(x, 0)", 0.5), ("sign(x)", 0.0)):
        expr = parsed(text)
        assert numpy_function([derivative(expr, x)], (x,))(zero)[0] == slope
        assert jax.grad(lambda v, e=expr: jax_function([e], (x,))(v)[0])(jnp.zeros(1))[0] == slope


def test_kinks_survive_sympys_own_operations():
    """Substituting, differentiating and printing by SymPy keep abs, sign, min and max what they are."""
    x, y, _ = SYMBOLS
    expr = parsed("abs(x)*max(x, y)")
    assert expr.subs({x: -2, y: 3}) == 6
    assert str(expr) == "abs(x)*max(x, y)"
    assert parse_expression(str(expr), NAMES, where="test") == expr
    assert not sympy.diff(expr, x).has(sympy.Derivative)


def test_a_derivative_too_large_is_refused():
    """A product of thousands of factors is not differentiated into millions of nodes."""
    x = SYMBOLS[0]
    factors = sympy.Mul(*(x + i for i in range(1, 1500)))
    with pytest.raises(TooLarge):
        derivative(factors, x)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("p**2/2 + cos(x)", True),
        ("p**2/(2*y) - y*cos(x)", True),
        ("(p + x)**2 - 2*p*x", True),
        ("(p**2 + x**2)*(p**2 - x**2)", True),
        ("log((1 + p**2)*(1 + x**2))", True),
        ("p**2*(sin(x)**2 + cos(x)**2)", True),
        ("sqrt(1 + p**2) + abs(x)", True),
        ("(p + x)**2", False),
        ("p**2/(2*(1 + x**2))", False),
        ("exp(p + x)", False),
        ("max(p, x)", False),
        ("abs(p - x)", False),
        ("p**2*x**2/2", False),
        ("(p + x + y)**100", False),
        ("1e-9*p*x + p**2/2", False),
    ],
)
def test_separable_is_told_by_the_mixed_derivative(text, expected):
    """H = T(p) + U(q) is recognised however it is written, and never claimed wrongly."""
    assert is_separable(parsed(text), [symbol("x")], [symbol("p")]) is expected


def test_deep_trees_need_no_deep_recursion():
    """An expression nested to the limit is evaluated and differentiated like any other."""
    x = SYMBOLS[0]
    expr = parsed("sin(" * 99 + "x" + ")" * 99)
    at, slope = 0.7, 1.0
    for _ in range(99):
        at, slope = np.sin(at), slope * np.cos(at)
    values = numpy_function([expr, derivative(expr, x)], (x,))(np.array([0.7]))
    np.testing.assert_allclose(values, [at, slope], rtol=1e-12)  # 99 roundings
    tower = parsed("x**" * 99 + "x")
    assert jnp.isfinite(jax.grad(lambda v: jax_function([tower], (x,))(v)[0])(jnp.array([0.7])))
