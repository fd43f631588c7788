"""Every effect of the vocabulary is said in words: its law, numbers and units, what it does, what would test it."""

import itertools
import math
import re

import pytest
import sympy
from sympy.parsing.sympy_parser import (
    convert_xor,
    implicit_multiplication,
    parse_expr,
    split_symbols,
    standard_transformations,
)

from symplearn._effects import EFFECTS, Candidate, Effect
from symplearn._vocabulary import COLUMN, COORDINATE, PAIR, PARAMETER, VOCABULARY
from symplearn.diagnosis._impostors import SHOWS
from symplearn.diagnosis._law_text import equation_lines, law_text
from symplearn.diagnosis._next import next_measurement
from symplearn.diagnosis._units import coefficient_units
from symplearn.diagnosis._words import finding_sentence, in_words

TARGETS = {COORDINATE: ("theta",), PAIR: ("x", "y"), PARAMETER: ("k",), COLUMN: ("volt",)}
VALUES = {
    "c": 0.0296, "f": 0.1234, "k": 2.5, "a": 0.7, "b": 0.05, "omega": 2.0, "phi": 0.3, "j": 0.11, "t_star": 12.3,
    "r": 0.012, "d": 0.2, "kappa": 0.4, "s": 1.8, "g": 0.05, "tau": 0.02, "e": 0.03, "sd": 0.5,
}  # fmt: skip
EVERY = [(name, None) for name in VOCABULARY if name != "contact_stop"]
EVERY += [("contact_stop", "upper"), ("contact_stop", "lower")]


def candidate(name, side=None, targets=None):
    """An effect on the usual target of its kind."""
    word = VOCABULARY[name]
    effect = EFFECTS.get(name) or Effect(name, amplitudes=0)
    targets = targets or TARGETS[word.target]
    return Candidate(effect, targets, tuple(range(len(targets))), side)


def values(name, **changed):
    """The contract's coefficients of an effect."""
    if name == "unnamed_force":
        return {"expression": "-0.3*theta**3 - -1e-3"}
    return {c: changed.get(c, VALUES[c]) for c in VOCABULARY[name].coefficients}


def said(name, side=None, units=None, share=None, rivals=(), only=None, **changed):
    """The sentence of a finding, with standard deviations of a twentieth."""
    estimates = {
        c: v if isinstance(v, str) else {"mean": v, "sd": abs(v) / 20, "interval95": [0.9 * v, 1.1 * v]}
        for c, v in values(name, **changed).items()
    }
    return finding_sentence(candidate(name, side), estimates, share, units or {}, rivals, only)


@pytest.mark.parametrize(("name", "side"), EVERY)
def test_every_effect_has_a_sentence_with_its_numbers(name, side):
    """Targets, coefficients with sd and unit, recordings, strength and rivals stand in the sentence."""
    units = {c: f"u_{c}" for c in VOCABULARY[name].coefficients}
    text = said(name, side, units, share=0.034, rivals=["quadratic_drag(theta)", "sensor_bias(volt)"], only=[1, 3])
    for target in TARGETS[VOCABULARY[name].target]:
        assert re.search(rf"\b{target}\b", text)
    for c in VOCABULARY[name].coefficients:
        assert f"{c} = {VALUES[c]:.4g} +- {VALUES[c] / 20:.4g} u_{c}" in text
    assert "in recordings 1 and 3 only" in text
    assert "about 3.4 % of the forces" in text
    assert text.endswith("hardly tells it from a quadratic drag on theta or a constant error in the readings of volt.")
    assert not re.search(r"[{}]|None|nan|inf\b|  ", text)


@pytest.mark.parametrize(("name", "side"), EVERY)
def test_a_sentence_without_units_rivals_or_share_is_short(name, side):
    """What is not known is left out: two sentences, none with an empty place."""
    text = said(name, side)
    assert len(re.findall(r"\.(?= [A-Z\d]|$)", text)) == 2
    assert not re.search(r"None|recordings? \d|hardly|forces already|[ (] [.,;:]", text)


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


UNITS = {"theta": "rad", "p_theta": "J s", "x": "m", "y": "m", "p_x": "N", "p_y": "Q", "volt": "V"}
MOMENTA = {"theta": "p_theta", "x": "p_x", "y": "p_y"}
EXPECTED = {
    "viscous_damping": ["J·s/rad"],
    "quadratic_drag": ["J·s²/rad²"],
    "coulomb_friction": ["J"],
    "relative_damping": ["N/m"],
    "self_excitation": ["J·s/rad", "rad"],
    "constant_force": ["J"],
    "linear_stiffness": ["J/rad"],
    "quadratic_stiffness": ["J/rad²"],
    "cubic_stiffness": ["J/rad³"],
    "coupling_spring": ["N/(m·s)"],
    "contact_stop": ["J/rad", "rad"],
    "central_correction": ["N·m^4/s"],
    "gyroscopic_coupling": ["N/m"],
    "periodic_forcing": ["J", "rad/s", "rad"],
    "impulse": ["J s", "s"],
    "parametric_modulation": ["", "rad/s", "rad"],
    "parameter_drift": ["1/s"],
    "regime_change": ["", "s"],
    "hidden_oscillator": ["rad/s", "√(J/(s²·rad))"],
    "parameter_error": [""],
    "sensor_noise": [""],
    "sensor_bias": ["V"],
    "sensor_gain": [""],
    "sensor_drift": ["V/s"],
    "sensor_delay": ["s"],
    "sensor_outliers": ["", "V"],
    "unnamed_force": [],
}


@pytest.mark.parametrize("name", list(VOCABULARY))
def test_units_follow_from_the_law(name):
    """Each coefficient's unit is that of the table by hand: force is p / t, speed q / t, and z has unit mass."""
    targets = TARGETS[VOCABULARY[name].target]
    units = coefficient_units(name, targets, UNITS, MOMENTA, "s")
    assert units == dict(zip(VOCABULARY[name].coefficients, EXPECTED[name], strict=True))
    # Without any unit given, only pure numbers and angles are known.
    bare = coefficient_units(name, targets, {}, MOMENTA, None)
    assert bare == {c: "rad" if c == "phi" else "" if unit == "" else None for c, unit in units.items()}


def test_units_are_multiplied_as_far_as_they_can_be_read():
    """Symbols of one kind cancel; what cannot be read stays in brackets; a unit that stands alone stays as written."""
    for momentum, place, time, c, f, j in [
        ("kg m²/s", "rad", "s", "kg·m²/(s·rad)", "kg·m²/s²", "kg m²/s"),
        ("kg*m/s", "m", "s", "kg/s", "kg·m/s²", "kg*m/s"),
        ("kg·m·s^-1", "m", "min", "kg/s", "kg·m/(s·min)", "kg·m·s^-1"),
        ("kg m s⁻¹", "°", "s", "kg·m/(s·°)", "kg·m/s²", "kg m s⁻¹"),
        ("kg m**2/s", "1", "s", "kg·m²/s", "kg·m²/s²", "kg m**2/s"),
        ("a/b c", "m/s", "s", "(a/b c)·s/m", "(a/b c)/s", "a/b c"),
        ("1", "1", "1", "", "", ""),
        ("<b>", "%", "s", "(<b>)/%", "(<b>)/s", "<b>"),
    ]:
        units = {"q": place, "p": momentum}
        for effect, name, unit in [("viscous_damping", "c", c), ("constant_force", "f", f), ("impulse", "j", j)]:
            assert coefficient_units(effect, ("q",), units, {"q": "p"}, time)[name] == unit


def test_a_law_between_unlike_coordinates_has_no_unit():
    """A spring between an angle and a length has no unit; the gyroscopic law has one."""
    for name in ("coupling_spring", "relative_damping", "central_correction"):
        assert set(coefficient_units(name, ("theta", "x"), UNITS, MOMENTA, "s").values()) == {None}
    assert coefficient_units("gyroscopic_coupling", ("theta", "x"), UNITS, MOMENTA, "s") == {"b": "J·s/m"}


@pytest.mark.parametrize(
    ("name", "changed", "words"),
    [
        ("periodic_forcing", {}, f"period of {math.pi:.4g} +- {math.pi / 20:.4g} s"),
        ("parametric_modulation", {}, "swings by 70 +- 3.5 % to either side, with a period of 3.142"),
        ("hidden_oscillator", {}, "Its own period is 3.142 +- 0.1571 s"),
        ("impulse", {"j": -0.11}, "jumps down by 0.11"),
        ("impulse", {}, "jumps up by 0.11"),
        ("parameter_drift", {}, "grows by 1.2 +- 0.06 % per s"),
        ("parameter_drift", {"r": -0.012}, "falls by 1.2 +- 0.06 % per s"),
        ("regime_change", {}, "From t = 12.3 +- 0.615 s on it is 20 +- 1 % higher"),
        ("regime_change", {"d": -0.2}, "20 +- 1 % lower"),
        ("parameter_error", {"d": -0.2}, "20 +- 1 % lower than given"),
        ("sensor_noise", {}, "80 % larger than given"),
        ("sensor_noise", {"s": 0.6}, "40 % smaller than given"),
        ("sensor_bias", {"b": -0.05}, "0.05 V too low"),
        ("sensor_gain", {"g": -0.05}, "5 +- 0.25 % too small"),
        ("sensor_drift", {"r": -0.012}, "down by 0.012 V/s"),
        ("sensor_delay", {}, "what was 0.02 s before"),
        ("sensor_outliers", {}, "3 +- 0.15 % of the readings are off, by errors with a standard deviation of 0.5"),
        ("linear_stiffness", {"k": -2.5}, "lowers the frequency"),
        ("linear_stiffness", {}, "raises the frequency"),
        ("cubic_stiffness", {"k": -2.5}, "frequency falls with the amplitude"),
        ("quadratic_stiffness", {}, "stiffer towards positive theta"),
        ("quadratic_stiffness", {"k": -1.0}, "stiffer towards negative theta"),
        ("self_excitation", {}, "feeds energy in while theta stays within a = 0.7 rad and takes it out beyond"),
        ("self_excitation", {"c": -0.1}, "takes energy out while theta stays within"),
        ("coupling_spring", {}, "raises the frequency at which x and y move against each other"),
        ("central_correction", {"b": -0.05}, "repels"),
        ("constant_force", {"f": -1.0}, "pushes towards negative theta"),
    ],
)
def test_what_it_does_has_the_sign_and_number_of_its_coefficients(name, changed, words):
    """Periods are 2 pi / omega; per cent, direction and time follow from the coefficients by hand."""
    units = coefficient_units(name, TARGETS[VOCABULARY[name].target], UNITS, MOMENTA, "s")
    assert words in said(name, units=units, **changed)


def test_a_stop_acts_on_its_own_side():
    """The upper stop acts above its place, the lower one below."""
    assert "only while theta is above 0.7" in said("contact_stop", "upper")
    assert "only while theta is below -0.7" in said("contact_stop", "lower", a=-0.7)


def test_rivals_are_plain_words():
    """Every effect as a rival reads without underscores or brackets; what is no effect stays as it was."""
    for name in VOCABULARY:
        targets = TARGETS[VOCABULARY[name].target]
        words = in_words(f"{name}({', '.join(targets)})")
        assert not re.search(r"[_(),]", words) and words.endswith(" and ".join(targets))
    assert in_words("relative_damping(x, y)") == "a relative damping between x and y"
    assert in_words("regime_change(k) in recording 2") == "a sudden change of k in recording 2"
    assert in_words("sensor_gain(angle (deg), raw)") == "a wrong scale in the readings of angle (deg), raw"
    assert in_words("something else") == "something else"


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


q, k, y = ("theta",), ("k",), ("volt",)
IMPOSTORS = [
    (("viscous_damping", q), ("quadratic_drag", q), "twice the amplitude"),
    (("viscous_damping", q), ("coulomb_friction", q), "nearly died"),
    (("quadratic_drag", q), ("coulomb_friction", q), "theta starts at twice the amplitude"),
    (("constant_force", q), ("sensor_bias", y), "turned round"),
    (("viscous_damping", q), ("sensor_bias", y), "longer recording"),
    (("sensor_gain", y), ("cubic_stiffness", q), "half the amplitude"),
    (("sensor_gain", y), ("linear_stiffness", q), "known place"),
    (("parameter_error", k), ("linear_stiffness", q), "measurement of k by itself"),
    (("linear_stiffness", q), ("cubic_stiffness", q), "several amplitudes"),
    (("constant_force", q), ("quadratic_stiffness", q), "one at rest"),
    (("regime_change", k), ("parameter_drift", k), "longer"),
    (("regime_change", k), ("impulse", q), "stays changed"),
    (("impulse", q), ("parameter_drift", k), "does not come back"),
    (("sensor_delay", y), ("viscous_damping", q), "known timing"),
    (("hidden_oscillator", q), ("periodic_forcing", q), "at rest and one at another amplitude"),
    (("periodic_forcing", q), ("parameter_drift", k), "several of the supposed periods"),
    (("periodic_forcing", q), ("sensor_drift", y), "several of the supposed periods"),
    (("periodic_forcing", q), ("parametric_modulation", k), "at rest or at a small amplitude"),
    (("hidden_oscillator", q), ("viscous_damping", q), "several beats"),
    (("impulse", q), ("contact_stop", q), "same place in every swing"),
    (("gyroscopic_coupling", ("x", "y")), ("central_correction", ("x", "y")), "both senses"),
    (("parameter_drift", k), ("viscous_damping", q), "started later"),
    (("relative_damping", ("x", "y")), ("viscous_damping", ("x",)), "x and y move together"),
    (("coupling_spring", ("x", "y")), ("linear_stiffness", ("x",)), "x and y move together"),
    (("contact_stop", q), ("cubic_stiffness", q), "inside the stop"),
    (("sensor_noise", y), ("sensor_outliers", y), "histogram"),
    (("sensor_bias", y), ("sensor_drift", y), "at rest"),
    (("self_excitation", q), ("viscous_damping", q), "very small start"),
]


@pytest.mark.parametrize(("one", "other", "words"), IMPOSTORS)
def test_each_pair_of_impostors_has_its_recording(one, other, words):
    """The recording that unmasks a pair is named whichever is likelier, alone or beside what both have in common."""
    shared = ("sensor_outliers", ("other",))
    for pair in ((one, other), (other, one)):
        assert words in next_measurement([[pair[0]], [pair[1]]], "mismatch", 0.0, 0.0)
        assert words in next_measurement([[shared, pair[0]], [pair[1], shared]], "mismatch", 0.0, 0.0)


def test_viscous_with_a_constant_force_against_a_bias_is_unmasked():
    """A combination against a single impostor of it gets a recording too."""
    pair = [[("viscous_damping", q), ("constant_force", q)], [("sensor_bias", y)]]
    assert "a bias does not" in next_measurement(pair, "mismatch", 0.0, 0.0)


def test_any_two_effects_get_a_recording():
    """Every pair of the vocabulary, and every effect that may or may not be there, has advice without open places."""
    for first, second in itertools.product(VOCABULARY, repeat=2):
        one, other = ((name, TARGETS[VOCABULARY[name].target]) for name in (first, second))
        for rivals in ([[one], [other]], [[one], [one, other]], [[one, other], [one]], [[one]]):
            for verdict, as_it_is in (("mismatch", 0.01), ("consistent", 0.4), ("unexplained", 0.01)):
                text = next_measurement(rivals, verdict, as_it_is, 0.01)
                assert re.search(r"record|reading|measurement|start|orbit|decay|repeat", text), text
                assert not re.search(r"[{}]|\.$", text)
    assert set(SHOWS) == set(VOCABULARY)


def test_what_else_is_open_is_told_too():
    """Which target, which recording, whether anything at all, a remainder without a name, and where all is settled."""
    one = ("viscous_damping", ("x",))
    assert "x alone moves and in which y alone" in next_measurement(
        [[one], [("viscous_damping", ("y",))]], "mismatch", 0.0, 0.0
    )
    wrong = [[("sensor_bias", ("left",))], [("sensor_bias", ("right",))]]
    assert "which of them is wrong" in next_measurement(wrong, "mismatch", 0.0, 0.0)
    assert "belongs to one recording alone" in next_measurement([[one], [one]], "mismatch", 0.0, 0.0)
    assert next_measurement([[one]], "consistent", 0.97, 0.0).startswith("none is needed")
    assert next_measurement([], "consistent", 0.5, 0.0).startswith("none is needed")
    assert "free decay of x" in next_measurement([[one]], "consistent", 0.3, 0.0)
    for verdict, unexplained in (("unexplained", 0.8), ("mismatch", 0.2)):
        assert "more channels and a faster sampling" in next_measurement([[one]], verdict, 0.0, unexplained)
    assert "range it was found in" in next_measurement([[one]], "mismatch", 0.0, 0.0)
    assert "two known places" in next_measurement([[("sensor_gain", y)]], "mismatch", 0.0, 0.0)
