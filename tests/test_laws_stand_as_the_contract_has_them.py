"""Every law stands as a line with its numbers, and in the equations of motion where it acts."""

import engine_cases as cases
import pytest
import sympy
from finding_cases import EVERY, candidate, values
from sympy.parsing.sympy_parser import (
    convert_xor,
    implicit_multiplication,
    parse_expr,
    split_symbols,
    standard_transformations,
)

from symplearn.diagnosis._law_text import equation_lines, law_text, stated

LAWS = {
    ("viscous_damping", None): "F = -0.0296 v",
    ("quadratic_drag", None): "F = -0.0296 |v| v",
    ("coulomb_friction", None): "F = -0.1234 sign(v)",
    ("relative_damping", None): "F_x = -0.0296 (v_x - v_y), F_y = -F_x",
    ("self_excitation", None): "F = 0.0296 (1 - theta^2/0.7^2) v",
    ("constant_force", None): "F = 0.1234",
    ("linear_stiffness", None): "F = -2.5 theta",
    ("quadratic_stiffness", None): "F = -2.5 theta^2",
    ("cubic_stiffness", None): "F = -2.5 theta^3",
    ("coupling_spring", None): "V = 2.5 (x - y)^2 / 2",
    ("contact_stop", "upper"): "F = -2.5 max(theta - 0.7, 0)",
    ("contact_stop", "lower"): "F = 2.5 max(0.7 - theta, 0)",
    ("central_correction", None): "V = -0.05 / (x^2 + y^2)^(3/2)",
    ("gyroscopic_coupling", None): "F_x = 0.05 v_y, F_y = -0.05 v_x",
    ("periodic_forcing", None): "F = 0.7 cos(2 t + 0.3)",
    ("impulse", None): "the momentum jumps by 0.11 at t = 12.3",
    ("parametric_modulation", None): "k -> k (1 + 0.7 cos(2 t + 0.3))",
    ("parameter_drift", None): "k -> k (1 + 0.012 (t - t_0))",
    ("regime_change", None): "k -> k (1 + 0.2) from t = 12.3 on",
    ("hidden_oscillator", None): "H gains P^2/2 + 2^2 z^2/2 - 0.4 theta z",
    ("parameter_error", None): "k -> k (1 + 0.2)",
    ("sensor_noise", None): "sd -> 1.8 sd",
    ("sensor_bias", None): "y = h(x) + 0.05",
    ("sensor_gain", None): "y = (1 + 0.05) h(x)",
    ("sensor_drift", None): "y = h(x) + 0.012 (t - t_0)",
    ("sensor_delay", None): "y(t) = h(x(t - 0.02))",
    ("sensor_outliers", None): "a fraction 0.03 of the readings is off, with standard deviation 0.5",
    ("unnamed_force", None): "F = -0.3*theta**3 - -1e-3",
}


@pytest.mark.parametrize(("name", "side"), EVERY)
def test_every_law_is_the_line_of_the_contract(name, side):
    """The law with its numbers is the line written here by hand; an expression of the user's stands as it is."""
    assert law_text(candidate(name, side), values(name)) == LAWS[name, side]


def test_negative_coefficients_make_one_sign():
    """A negative number turns the sign before it instead of standing beside it."""
    for name, side, changed, line in [
        ("linear_stiffness", None, {"k": -2.5}, "F = 2.5 theta"),
        ("constant_force", None, {"f": -1e-5}, "F = -1e-05"),
        ("contact_stop", "upper", {"a": -0.7}, "F = -2.5 max(theta + 0.7, 0)"),
        ("contact_stop", "lower", {"a": -0.7, "k": -1.0}, "F = -1 max(-0.7 - theta, 0)"),
        ("gyroscopic_coupling", None, {"b": -0.05}, "F_x = -0.05 v_y, F_y = 0.05 v_x"),
        ("central_correction", None, {"b": -0.05}, "V = 0.05 / (x^2 + y^2)^(3/2)"),
        ("periodic_forcing", None, {"phi": -0.3}, "F = 0.7 cos(2 t - 0.3)"),
        ("parameter_drift", None, {"r": -0.012}, "k -> k (1 - 0.012 (t - t_0))"),
        ("sensor_bias", None, {"b": -0.05}, "y = h(x) - 0.05"),
    ]:
        assert law_text(candidate(name, side), values(name, **changed)) == line


PARTS = ["x", "y"], ["p_x", "p_y"], ["volt"], "p_x**2/2 + p_y**2/2", {"p_y": "gain*u"}, {"volt": "2*x--1"}


def test_equations_have_every_effect_in_its_place():
    """All effects at once: forces on their own equations, two for a hidden oscillator, parameters and readings last."""
    chosen = [
        (candidate("viscous_damping", targets=("x",)), {"c": 0.03}),
        (candidate("constant_force", targets=("y",)), {"f": -0.4}),
        (candidate("coupling_spring"), {"k": 0.2}),
        (candidate("relative_damping"), {"c": 0.1}),
        (candidate("gyroscopic_coupling"), {"b": 0.3}),
        (candidate("central_correction"), {"b": 0.05}),
        (candidate("contact_stop", "lower", ("y",)), {"k": 7.0, "a": -1.5}),
        (candidate("periodic_forcing", targets=("x",)), {"a": 0.5, "omega": 2.0, "phi": -1.0}),
        (candidate("unnamed_force", targets=("y",)), {"expression": "a--b"}),
        (candidate("hidden_oscillator", targets=("y",)), {"omega": 3.0, "kappa": 0.6}),
        (candidate("impulse", targets=("x",)), {"j": -0.2, "t_star": 4.5}),
        (candidate("parameter_drift"), {"r": -0.01}),
        (candidate("regime_change"), {"d": 0.25, "t_star": 6.0}),
        (candidate("parametric_modulation", targets=("m",)), {"a": 0.1, "omega": 2.1, "phi": 0.3}),
        (candidate("parameter_error", targets=("g",)), {"d": -0.02}),
        (candidate("sensor_gain"), {"g": 0.05}),
        (candidate("sensor_delay"), {"tau": 0.02}),
        (candidate("sensor_bias"), {"b": -0.3}),
        (candidate("sensor_drift"), {"r": 0.004}),
        (candidate("sensor_noise"), {"s": 1.5}),
        (candidate("sensor_outliers"), {"e": 0.03, "sd": 2.0}),
    ]
    assert equation_lines(*PARTS, chosen) == (
        "H = p_x**2/2 + p_y**2/2",
        "dx/dt = dH/dp_x",
        "dp_x/dt = -dH/dx - 0.03 dx/dt - 0.2 (x - y) - 0.1 (dx/dt - dy/dt) + 0.3 dy/dt "
        "- 0.15 x / (x^2 + y^2)^(5/2) + 0.5 cos(2 t - 1)",
        "dy/dt = dH/dp_y",
        "dp_y/dt = -dH/dy + gain*u - 0.4 + 0.2 (x - y) + 0.1 (dx/dt - dy/dt) - 0.3 dx/dt "
        "- 0.15 y / (x^2 + y^2)^(5/2) + 7 max(-1.5 - y, 0) + (a--b) + 0.6 z",
        "dz/dt = P_z",
        "dP_z/dt = -9 z + 0.6 y",
        "p_x jumps by -0.2 at t = 4.5",
        "k(t) = k (1 - 0.01 (t - t_0)) (1 + 0.25 step(t - 6))",
        "m(t) = m (1 + 0.1 cos(2.1 t + 0.3))",
        "g -> g (1 - 0.02)",
        "volt = 1.05 [2*x--1 at t - 0.02] - 0.3 + 0.004 (t - t_0)",
        "scatter of volt: sd -> 1.5 sd",
        "scatter of volt: a fraction 0.03 of the readings is off, with standard deviation 2",
    )


@pytest.mark.parametrize(
    ("known", "line"), [("-c*p/m + u", "- c*p/m + u"), ("  - k*q", "- k*q"), ("u - c*p", "+ u - c*p")]
)
def test_a_known_force_that_begins_with_a_minus_is_taken_away(known, line):
    """What is added to -dH/dq is one sum with it, whatever sign it begins with."""
    lines = equation_lines(["q"], ["p"], [], "p**2/2", {"p": known}, {}, [])
    assert lines[2] == f"dp/dt = -dH/dq {line}"


def test_terms_of_the_file_stand_in_the_equations():
    """What a simulation has already is part of its equations, with the recordings that it is in, of a force without a
    name as of one with; before what is found and after."""
    known = """
[[terms]]
effect = "viscous_damping"
target = "x"
c = 0.3
recordings = [1, 3]
[[terms]]
effect = "contact_stop"
side = "lower"
target = "x"
k = { value = 7.0, sd = 0.1 }
a = -1.5
[[terms]]
effect = "unnamed_force"
target = "x"
expression = "-2*w"
memory = { w = "x - w" }
[[terms]]
effect = "impulse"
target = "x"
j = 0.2
t_star = 4.5
recordings = [2]
[[terms]]
effect = "sensor_bias"
target = "volt"
b = 0.3
"""
    file = cases.simulation("p**2/2", ("x",), ("p",), {"volt": "x"}, known)
    lines = equation_lines(("x",), ("p",), ("volt",), "p**2/2", {}, {"volt": "x"}, stated(file.terms))
    assert lines == (
        "H = p**2/2",
        "dx/dt = dH/dp",
        "dp/dt = -dH/dx - 0.3 dx/dt (recordings 1, 3 only) + 7 max(-1.5 - x, 0) + (-2*w)",
        "dw/dt = x - w",
        "p jumps by 0.2 at t = 4.5 (recording 2 only)",
        "volt = x + 0.3",
    )


def test_equations_without_effects_are_the_simulation():
    """Nothing chosen, nothing added; and a hidden coordinate takes a name that is free."""
    assert equation_lines(*PARTS, []) == (
        "H = p_x**2/2 + p_y**2/2",
        "dx/dt = dH/dp_x",
        "dp_x/dt = -dH/dx",
        "dy/dt = dH/dp_y",
        "dp_y/dt = -dH/dy + gain*u",
        "volt = 2*x--1",
    )
    hidden = (candidate("hidden_oscillator", targets=("z",)), {"omega": 1.0, "kappa": 2.0})
    lines = equation_lines(["z"], ["p"], [], "p**2/2", {}, {}, [hidden, hidden])
    assert lines[2] == "dp/dt = -dH/dz + 2 z_hidden + 2 z_hidden2"
    assert lines[3:] == ("dz_hidden/dt = P_z_hidden", "dP_z_hidden/dt = -1 z_hidden + 2 z",
                         "dz_hidden2/dt = P_z_hidden2", "dP_z_hidden2/dt = -1 z_hidden2 + 2 z")  # fmt: skip


@pytest.mark.parametrize(("name", "b"), [("coupling_spring", "k"), ("central_correction", "b")])
def test_forces_in_equations_are_slopes_of_the_potential_in_words(name, b):
    """The force that SymPy derives from the law's V is the one in the equations of motion."""
    one, numbers = candidate(name), {b: 0.5}
    potential = parsed(law_text(one, numbers).removeprefix("V = "))
    lines = equation_lines(["x", "y"], ["p_x", "p_y"], [], "0", {}, {}, [(one, numbers)])
    for q, line in zip("xy", (lines[2], lines[4]), strict=True):
        force = parsed(line.split(f"-dH/d{q} ")[1])
        assert sympy.simplify(force + potential.diff(sympy.Symbol(q))) == 0


def parsed(text):
    """An expression as it is written by hand, with `^` and without `*`."""
    rules = (*standard_transformations, convert_xor, split_symbols, implicit_multiplication)
    return sympy.nsimplify(parse_expr(text, transformations=rules), rational=True)
