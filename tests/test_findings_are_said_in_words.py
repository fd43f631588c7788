"""Every effect is said in words: its numbers and units, what it does, and what it is hard to tell from."""

import math
import re

import pytest
from finding_cases import EVERY, MOMENTA, TARGETS, UNITS, VALUES, candidate, said

from symplearn._vocabulary import VOCABULARY
from symplearn.diagnosis._units import coefficient_units
from symplearn.diagnosis._words import finding_sentence, in_words


@pytest.mark.parametrize(("name", "side"), EVERY)
def test_every_effect_has_a_sentence_with_its_numbers(name, side):
    """Targets, coefficients with sd and unit, recordings, strength and rivals stand in the sentence."""
    units = {c: f"u_{c}" for c in VOCABULARY[name].coefficients}
    text = said(name, side, units, strength=0.034, rivals=["quadratic_drag(theta)", "sensor_bias(volt)"], only=[1, 3])
    for target in TARGETS[VOCABULARY[name].target]:
        assert re.search(rf"\b{target}\b", text)
    for c in VOCABULARY[name].coefficients:
        assert f"{c} = {VALUES[c]:.4g} +- {VALUES[c] / 20:.4g} u_{c}" in text
    assert "in recordings 1 and 3 only" in text
    otherwise = ("periodic_forcing", "contact_stop", "impulse", "hidden_oscillator", "self_excitation")
    assert ("about 3.4 % of the forces" in text) == (name not in otherwise)
    assert text.endswith("hardly tells it from a quadratic drag on theta or a constant error in the readings of volt.")
    assert not re.search(r"[{}]|None|nan|inf\b|  ", text)


@pytest.mark.parametrize(("name", "side"), EVERY)
def test_a_sentence_without_units_rivals_or_share_is_short(name, side):
    """What is not known is left out: two sentences, none with an empty place."""
    text = said(name, side)
    assert len(re.findall(r"\.(?= [A-Z\d]|$)", text)) == 2
    assert not re.search(r"None|recordings? \d|hardly|forces already|[ (] [.,;:]", text)


@pytest.mark.parametrize(
    ("name", "changed", "words"),
    [
        ("periodic_forcing", {}, f"period of {math.pi:.4g} +- {math.pi / 20:.4g} s"),
        ("parametric_modulation", {}, "swings by 70 +- 3.5 % to either side, with a period of 3.142"),
        ("hidden_oscillator", {}, "Its own period is 3.142 +- 0.1571 s"),
        ("impulse", {"j": -0.11}, "jumps down by 0.11"),
        ("impulse", {}, "jumps up by 0.11"),
        ("parameter_drift", {}, "grows by 1.2 +- 0.06 % per s"),
        ("parameter_drift", {"r": -0.012}, "shrinks by 1.2 +- 0.06 % per s"),
        ("regime_change", {}, "From t = 12.3 +- 0.615 s on it is 20 +- 1 % larger"),
        ("regime_change", {"d": -0.2}, "20 +- 1 % smaller"),
        ("parameter_error", {"d": -0.2}, "20 +- 1 % smaller than given"),
        ("sensor_noise", {}, "80 % larger than given"),
        ("sensor_noise", {"s": 0.6}, "40 % smaller than given"),
        ("sensor_bias", {"b": -0.05}, "0.05 V too low"),
        ("sensor_gain", {"g": -0.05}, "5 +- 0.25 % too small"),
        ("sensor_drift", {"r": -0.012}, "down by 0.012 V/s"),
        ("sensor_delay", {}, "what was 0.02 s before"),
        ("sensor_delay", {"tau": -0.02}, "is less late than the simulation has it: "),
        ("sensor_delay", {"tau": -0.02}, "It is so by 0.02 s"),
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


@pytest.mark.parametrize("name", ["impulse", "regime_change"])
def test_a_time_keeps_its_digits(name):
    """A time of a clock that has run for years is told to a thousandth, one of a short recording in four digits."""
    assert "at t = 1700000013.37" in (text := said(name, t_star=1700000013.37).replace("From t", "at t"))
    assert "t_star = 1700000013.37 +- " in text and "1.7e+09" not in text
    assert "t_star = 13.37 +- " in said(name, t_star=13.3712)


@pytest.mark.parametrize("name", ["viscous_damping", "quadratic_drag", "coulomb_friction", "relative_damping"])
def test_a_loss_that_is_taken_back_is_no_loss_left_out(name):
    """A negative coefficient is added to a known term that is too strong: nothing was left out, and less is lost."""
    (coefficient,) = VOCABULARY[name].coefficients
    text = said(name, **{coefficient: -0.2})
    assert "that the simulation has is too strong" in text and "less energy is taken out" in text
    assert "left out" not in text and "left out" in said(name, **{coefficient: 0.2})


def test_a_stop_acts_on_its_own_side():
    """The upper stop acts above its place, the lower one below."""
    assert "only while theta is above 0.7" in said("contact_stop", "upper")
    assert "only while theta is below -0.7" in said("contact_stop", "lower", a=-0.7)


def test_a_coordinate_called_like_a_coefficient_is_no_coefficient():
    """Of a stop on the coordinate `a` the place has an index in the law and beside it."""
    one, numbers = candidate("contact_stop", "upper", ("a",)), {"sd": 0.1, "interval95": [0, 1]}
    text = finding_sentence(one, {c: {"mean": VALUES[c], **numbers} for c in ("k", "a")}, None, {}, (), None)
    assert "F = -k max(a - a_0, 0), where k = 2.5 +- 0.1 and a_0 = 0.7 +- 0.1" in text


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
