"""Where what lasts among the readings' errors leaves hardly any white noise, steps are as short as all of the errors
ask, not as that noise alone would."""

import engine_cases as cases
import numpy as np
from test_a_clock_may_wander import TIMES, late

from symplearn.diagnosis import Options
from symplearn.diagnosis._build import Restriction
from symplearn.diagnosis._find import searched
from symplearn.diagnosis._found import speaker


def test_a_clock_that_wanders_does_not_shorten_the_steps():
    """A spring with quadratic drag, read up to a hundredth of a cycle early or late and otherwise to 2e-5, whose error
    a clock takes whole: the white noise that is left asks for four times as many substeps as are needed."""
    rates = lambda t, x: [x[1], -x[0] - 0.03 * abs(x[1]) * x[1]]  # noqa: E731
    q = cases.solved(rates, [1.0, 0.0], np.append(-1.0, TIMES + late(0)))[1:, 0]
    readings = q + 2e-5 * np.random.default_rng(2).normal(size=len(q))
    file = cases.simulation("p**2/2 + k*q**2/2", more="[parameters]\nk = { value = 1.0, sd = 0.1 }\n")
    options = Options(restriction=Restriction(("quadratic_drag",)))
    found, stepper, *_ = searched(file, [cases.recorded(TIMES, readings)], options, np.inf)
    (best,) = [c for c in found.estimates if found.odds(c) == max(map(found.odds, found.estimates))]
    told = speaker(found.estimates[best])
    assert told.kind == "clock" and told.noise < 1e-4 and found.is_fine
    assert np.max(stepper.problem.rows[0].spans.step) > 0.9 * np.diff(TIMES).max()
