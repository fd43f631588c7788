"""A parameter that can only be positive is told as positive, and the simulation that is written back can be read, where
a step about a fit leads below zero, or a fit ends at a bound."""

import engine_cases as cases
import numpy as np
import pytest

from symplearn._simulation_file import parse_simulation
from symplearn._simulation_text import simulation_text
from symplearn.diagnosis._augment import augmented
from symplearn.diagnosis._document import parameters
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._weighed import Estimate

TIMES = np.linspace(0.0, 10.0, 60)


def test_a_weight_that_rises_has_no_negative_gravity():
    """The Gaussian of a gravity that is positive by its file has its middle at -0.2: what is told is the part of it
    that is positive, by sums over a grid, and what is written back is the bound."""
    weight = "[parameters]\ng = { value = 1.0, sd = 2.0, positive = true }\n"
    file = cases.simulation("p**2/2 + g*q", more=weight)
    p = cases.problem(file, [cases.recorded(TIMES, 0.1 * TIMES**2)], 0.1)
    priors, z = priors_without_effects(p), np.zeros(p.size)
    z[p.head] = -0.2
    below = Estimate((), "coloured", z, np.diag(np.where(p.active(()), 0.09, 0.0)), np.ones(1), 0.0, True)
    mean, sd = positive_part(-0.2, 0.3)
    assert parameters(p, priors, below, 1.0)["g"] == pytest.approx({"mean": mean, "sd": sd}, rel=1e-5)  # the grid's
    again = parse_simulation(simulation_text(augmented(file, p, priors, below, {}, {})), "augmented.toml")
    assert 0.0 < again.parameters["g"].value < 1e-6


def positive_part(mean, sd):
    """Mean and standard deviation of what is above zero of a Gaussian."""
    x = (np.arange(1_000_000) + 0.5) * 1e-5 * sd
    density = np.exp(-0.5 * ((x - mean) / sd) ** 2)
    middle = np.sum(x * density) / np.sum(density)
    return middle, np.sqrt(np.sum((x - middle) ** 2 * density) / np.sum(density))


def test_what_ends_at_a_limit_is_written_back():
    """A stiffness that ends at its upper limit, and a known friction that would be negative, are read again from the
    simulation that is written back: at the limit, and hardly above zero."""
    more = """[parameters]
k = { value = 1.7, lower = 1.5, upper = 1.9 }
[[terms]]
effect = "viscous_damping"
target = "q"
c = { value = 0.01, sd = 0.05 }
"""
    file = cases.simulation("p**2/2 + k*q**2/2", more=more)
    p = cases.problem(file, [cases.recorded(TIMES, np.cos(1.4 * TIMES))], 0.1)
    priors, z = priors_without_effects(p), np.zeros(p.size)
    z[p.head : p.head + 2] = 2.1, -0.004
    beyond = Estimate((), "white", z, np.diag(np.where(p.active(()), 1e-4, 0.0)), np.ones(1), 0.0, True)
    again = parse_simulation(simulation_text(augmented(file, p, priors, beyond, {}, {})), "augmented.toml")
    assert again.parameters["k"].value == 1.9
    assert 0.0 < again.terms[0].coefficients["c"].value < 1e-6
    assert 1.5 < parameters(p, priors, beyond, 1.0)["k"]["mean"] < 1.9
