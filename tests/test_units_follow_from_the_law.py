"""Units of coefficients follow from the law, in the sentences and in the report: force is p / t, speed q / t."""

import dataclasses

import pytest
import report_cases
from finding_cases import MOMENTA, TARGETS, UNITS

from symplearn._simulation_file import parse_simulation
from symplearn._vocabulary import VOCABULARY
from symplearn.diagnosis._units import coefficient_units
from symplearn.diagnosis._warnings import idle_units
from symplearn.report._units import coefficient_unit

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
    "unnamed_force": ["J/rad", "s", "rad"],
}


@pytest.mark.parametrize("name", list(VOCABULARY))
def test_units_follow_from_the_law(name):
    """Each coefficient's unit is that of the table by hand: force is p / t, speed q / t, and z has unit mass."""
    targets = TARGETS[VOCABULARY[name].target]
    units = coefficient_units(name, targets, UNITS, MOMENTA, "s")
    names = VOCABULARY[name].coefficients or ("kappa", "tau", "a")  # of what remembers
    assert units == dict(zip(names, EXPECTED[name], strict=True))
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


def test_units_in_the_report_follow_from_the_law():
    """A force is p / t and a speed q / t; where a unit is unknown, nothing is said."""
    record = report_cases.damped_pendulum(units={"theta": "m", "p": "N", "t": "s", "angle_deg": "V"})
    expected = {
        ("viscous_damping", "c"): "N/m",
        ("quadratic_drag", "c"): "N·s/m²",
        ("coulomb_friction", "f"): "N/s",
        ("constant_force", "f"): "N/s",
        ("linear_stiffness", "k"): "N/(m·s)",
        ("cubic_stiffness", "k"): "N/(m³·s)",
        ("impulse", "j"): "N",
        ("impulse", "t_star"): "s",
        ("viscous_damping", "k"): None,
        ("unnamed_force", "expression"): None,
    }
    for (effect, name), unit in expected.items():
        assert coefficient_unit({"effect": effect, "target": "theta"}, record, name) == unit
    assert coefficient_unit({"effect": "sensor_bias", "target": "angle_deg"}, record, "b") == "V"
    assert coefficient_unit({"effect": "sensor_drift", "target": "angle_deg"}, record, "r") == "V/s"
    assert coefficient_unit({"effect": "sensor_gain", "target": "angle_deg"}, record, "g") == ""
    unknown = dataclasses.replace(record, units={"theta": "m"})
    assert coefficient_unit({"effect": "viscous_damping", "target": "theta"}, unknown, "c") is None


def test_a_unit_of_nothing_is_told():
    """A unit of a name that the simulation does not have is a warning; of every kind of name that it has, none."""
    file = parse_simulation(
        """
[system]
coordinates = ["x"]
momenta = ["p"]
hamiltonian = "p**2/(2*m) + x**2/2"
[parameters]
m = 1.0
[forces]
p = "u"
[recording]
time = "t_s"
inputs = ["u"]
group = "run"
where = { ball = "tennis" }
[recording.observe]
x_m = "x"
[units]
x = "m"
p = "kg m/s"
m = "kg"
u = "N"
x_m = "m"
xm = "m"
t = "s"
t_s = "s"
H = "J"
run = "1"
ball = "1"
""",
        "units.toml",
    )
    [said] = idle_units(file)
    assert said.startswith("[units] has xm, which is no column")
