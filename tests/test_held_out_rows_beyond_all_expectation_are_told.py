"""An answer says by how much held-out rows lie beyond what it expects, and warns where that is no chance."""

from dataclasses import replace

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis._calibrate import calibrate
from symplearn.diagnosis._document import fit
from symplearn.diagnosis._outlook import Outlook
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._trajectory import Stepper
from symplearn.diagnosis._warnings import missed
from symplearn.diagnosis._weighed import weigh_white

NOISE, TIMES = 0.05, np.linspace(0.0, 40.0, 200)
LATE = TIMES > 0.75 * TIMES[-1]


def told(late=0.0, outlier=0.0, holdout=0.25):
    """What `fit` tells of a spring whose held-out rows swing on with so much more, and one of which is an outlier."""
    q = np.cos(TIMES) + np.where(LATE, late * np.sin(3 * TIMES), 0.0)
    q += NOISE * np.random.default_rng(2).normal(size=len(q))
    q[190] += outlier
    file = cases.simulation("p**2/2 + q**2/2", more=f"[recording.noise]\ny = {NOISE}\n")
    recorded = cases.recorded(TIMES, q)
    p = cases.problem(file, [recorded], 0.02, holdout=holdout)
    stepper, rows = Stepper(p), [r.fitted for r in p.rows]
    priors = replace(priors_without_effects(p), precision=np.full(p.size, 1e-9))
    begin = np.zeros((1, p.size))
    begin[0, 0] = 1.0
    estimate = weigh_white(p, calibrate(stepper, begin, [()], priors, rows), priors, rows)[0]
    return fit(p, estimate, [Outlook(stepper, estimate, 0, np.zeros(1))], [recorded], 1.0)


@pytest.mark.parametrize("outlier", [0.0, 100 * NOISE])
def test_rows_that_go_on_are_as_expected(outlier):
    """A spring that swings on as it did is missed by once what is expected, and nothing is said; an outlier of a
    hundred sd, which is none of the answer's faults, changes nothing."""
    found = told(outlier=outlier)
    # Fifty errors tell their root mean square to a tenth; without the two worst it is a tenth lower.
    assert found["holdout_misfit"]["y"] == pytest.approx(0.9, abs=0.25)
    assert missed(found) == []


def test_rows_that_do_not_are_told():
    """Another swing of six sd among them is four times what is expected, in the document and in a sentence."""
    found = told(late=6 * NOISE)
    expected = np.sqrt(1 + 0.5 * 6**2)  # the mean square of a sine is a half
    assert found["holdout_misfit"]["y"] == pytest.approx(expected, rel=0.1)  # as many errors, and the worst left out
    (sentence,) = missed(found)
    assert " y " in sentence and f"{found['holdout_misfit']['y']:.2g} times" in sentence


def test_without_held_out_rows_nothing_is_said():
    found = told(holdout=0.0)
    assert found["holdout_misfit"] is None and missed(found) == []
