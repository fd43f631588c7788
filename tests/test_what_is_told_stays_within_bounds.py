"""A parameter that can only be positive is told as positive, and the simulation that is written back can be read, where
a step about a fit leads below zero."""

import engine_cases as cases
import numpy as np

from symplearn._simulation_file import parse_simulation
from symplearn._simulation_text import simulation_text
from symplearn.diagnosis._augment import augmented
from symplearn.diagnosis._document import parameters
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._weighed import Estimate

TIMES = np.linspace(0.0, 10.0, 60)


def test_a_weight_that_rises_has_no_negative_gravity():
    """The Gaussian of a gravity that is positive by its file has its middle at -0.2: what is told is the bound, with
    the Gaussian's width, in the answer and in the simulation that is written back."""
    weight = "[parameters]\ng = { value = 1.0, sd = 2.0, positive = true }\n"
    file = cases.simulation("p**2/2 + g*q", more=weight)
    p = cases.problem(file, [cases.recorded(TIMES, 0.1 * TIMES**2)], 0.1)
    priors, z = priors_without_effects(p), np.zeros(p.size)
    z[p.head] = -0.2
    below = Estimate((), "coloured", z, np.diag(np.where(p.active(()), 0.09, 0.0)), np.ones(1), 0.0, True)
    told = parameters(p, priors, below, 1.0)["g"]
    assert 0.0 < told["mean"] < 1e-6 and told["sd"] == 0.3
    again = parse_simulation(simulation_text(augmented(file, p, priors, below, {}, {})), "augmented.toml")
    assert again.parameters["g"].value == told["mean"]
