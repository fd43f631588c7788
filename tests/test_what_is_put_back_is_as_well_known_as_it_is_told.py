"""A calibrated parameter comes back with the uncertainty that is told of it, wider where evidence was discounted."""

from types import SimpleNamespace

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis._answer import Answer
from symplearn.diagnosis._document import parameters
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._weighed import Estimate

TIMES = np.linspace(0.0, 10.0, 101)


@pytest.mark.parametrize("tempered", [1.0, 0.25])
def test_the_prior_of_the_next_file_is_the_posterior_told(tempered):
    """By a factor of two where log evidences count a quarter."""
    file = cases.simulation("p**2/2 + k*q**2/2", more="[parameters]\nk = { value = 1.0, sd = 0.5 }")
    problem = cases.problem(file, [cases.recorded(TIMES, np.cos(TIMES))], 0.05)
    priors, z = priors_without_effects(problem), np.zeros(problem.size)
    z[problem.head] = 1.1
    estimate = Estimate((), "white", z, 0.01 * np.eye(problem.size), np.array([0.1]), 0.0, True)
    answer = Answer.__new__(Answer)
    answer.file, answer.problem, answer.after = file, problem, estimate
    answer.found, answer.posterior = SimpleNamespace(priors=priors), SimpleNamespace(tempered=tempered)
    told = parameters(problem, priors, estimate, 1.0 / tempered)["k"]
    back = answer._whole().parameters["k"]
    assert (back.value, back.sd) == pytest.approx((told["mean"], told["sd"])) == (1.1, 0.1 / np.sqrt(tempered))
