"""The answer is of the fitted rows; where these lack nothing and all rows together do, that is said beside it."""

import engine_cases as cases
import numpy as np
import pytest

from symplearn import diagnose
from symplearn.diagnosis import Options
from symplearn.diagnosis._build import Restriction
from symplearn.report._html import html_report
from symplearn.report._verdict import verdict_sentence

TIMES, BLOW = 0.25 * np.arange(240), 50.1
NOISE = 0.03


def swung(blow, seed):
    """An undamped spring of one radian a second, struck at a time in the rows that are held out; closed form."""
    later = np.maximum(TIMES - BLOW, 0.0)
    return np.cos(TIMES) + blow * np.sin(later) + NOISE * np.random.default_rng(seed).normal(size=len(TIMES))


def answer(readings, holdout=0.25, restricted=("impulse", "viscous_damping", "constant_force")):
    file = cases.simulation("p**2/2 + k*q**2/2", more="[parameters]\nk = { value = 1.0, sd = 0.02 }\n")
    options = Options(restriction=Restriction(restricted), holdout=holdout)
    return diagnose(file, [cases.recorded(TIMES, readings)], options)


@pytest.mark.slow
def test_a_blow_in_held_out_rows_is_told_beside_the_answer():
    """Of a blow at 50.1 the rows up to 45 know nothing, and the verdict is of them; all rows show it, by far, and the
    sentence, the warning and the advice send the reader there."""
    found = answer(swung(0.12, 0))
    document = found.document
    assert document["verdict"] == "consistent" and not document["findings"]
    assert document["all_rows"]["as_it_is"] < 1e-3
    assert document["all_rows"]["likeliest"]["findings"] == [{"effect": "impulse", "target": "q"}]
    assert document["all_rows"]["likeliest"]["probability"] > 0.9
    (told,) = [one for one in document["warnings"] if "--holdout 0" in one]
    assert "impulse of q" in told
    assert "--holdout 0" in document["next_measurement"]
    assert "not with all of them" in verdict_sentence(found)
    assert "in the fitted rows" in document["location"]["where"]
    report = html_report(found)
    assert "impulse on q" in report and "their noise leads one to expect" not in report


def test_what_is_found_with_all_rows_fitted_is_what_was_told():
    """With nothing held out the same blow is the verdict, and there is nothing to tell beside it."""
    document = answer(swung(0.12, 0), holdout=0.0).document
    assert [one["effect"] for one in document["findings"]] == ["impulse"]
    assert document["all_rows"] is None


@pytest.mark.parametrize("seed", range(2))
def test_rows_that_lack_nothing_ask_for_nothing(seed):
    """Two springs without a blow: nothing is told of held-out rows."""
    document = answer(swung(0.0, seed)).document
    assert document["verdict"] == "consistent" and document["all_rows"] is None
    assert not any("--holdout" in one for one in document["warnings"])
