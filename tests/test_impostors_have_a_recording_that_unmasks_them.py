"""What the present recording cannot tell apart, the next measurement tells: every two effects have their recording."""

import itertools
import re

import pytest
from finding_cases import TARGETS

from symplearn._vocabulary import VOCABULARY
from symplearn.diagnosis._impostors import SHOWS
from symplearn.diagnosis._next import all_rows, next_measurement

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
    force = ("unnamed_force", ("theta",))
    assert "which form the force without a name has" in next_measurement([[force], [force]], "mismatch", 0.0, 0.0)
    assert next_measurement([[one]], "consistent", 0.97, 0.0).startswith("none is needed")
    assert next_measurement([], "consistent", 0.5, 0.0).startswith("none is needed")
    assert "free decay of x" in next_measurement([[one]], "consistent", 0.3, 0.0)
    for verdict, unexplained in (("unexplained", 0.8), ("mismatch", 0.2)):
        assert "more channels and a faster sampling" in next_measurement([[one]], verdict, 0.0, unexplained)
    assert "range it was found in" in next_measurement([[one]], "mismatch", 0.0, 0.0)
    assert "two known places" in next_measurement([[("sensor_gain", y)]], "mismatch", 0.0, 0.0)


def test_rows_that_were_kept_from_names_in_doubt_are_asked_first():
    """Where some were held out and the answer is likely only; not where it is sure, or none were."""
    assert "--holdout 0: a share of 0.25" in all_rows(0.25, 0.6)
    assert all_rows(0.25, 0.95) == all_rows(0.0, 0.6) == ""
