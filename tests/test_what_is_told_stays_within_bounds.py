"""A parameter that can only be positive is told as positive, and the simulation that is written back can be read, where
a step about a fit leads below zero, or a fit ends at a bound."""

import engine_cases as cases
import numpy as np
import pytest
from scipy.stats import norm

from symplearn._simulation_file import parse_simulation
from symplearn._simulation_text import simulation_text
from symplearn.diagnosis._augment import augmented
from symplearn.diagnosis._document import parameters
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._weighed import Estimate

TIMES = np.linspace(0.0, 10.0, 60)


def test_a_weight_that_rises_has_no_negative_gravity():
    """The Gaussian of a gravity that is positive by its file has its middle at -0.2: what is told is the part of it
    that is positive, by Mills' ratio, and what is written back is the bound."""
    weight = "[parameters]\ng = { value = 1.0, sd = 2.0, positive = true }\n"
    file = cases.simulation("p**2/2 + g*q", more=weight)
    p = cases.problem(file, [cases.recorded(TIMES, 0.1 * TIMES**2)], 0.1)
    priors, z = priors_without_effects(p), np.zeros(p.size)
    z[p.head] = -0.2
    below = Estimate((), "coloured", z, np.diag(np.where(p.active(()), 0.09, 0.0)), np.ones(1), 0.0, True)
    mean, sd = above_zero(-0.2, 0.3)
    # 1e-7: the bound of what is positive is not zero but 1e-9. Seen: 4e-9.
    assert parameters(p, priors, below, 1.0)["g"] == pytest.approx({"mean": mean, "sd": sd}, rel=1e-7)
    again = parse_simulation(simulation_text(augmented(file, p, priors, below, {}, {}, {})), "augmented.toml")
    assert 0.0 < again.parameters["g"].value < 1e-6


def above_zero(mean, sd):
    """Mean and standard deviation of what is above zero of a Gaussian, by its density and tail there (Mills' ratio)."""
    start = -mean / sd
    ratio = norm.pdf(start) / norm.sf(start)
    return mean + sd * ratio, sd * np.sqrt(1.0 + start * ratio - ratio**2)


@pytest.mark.parametrize(
    ("middle", "spread", "mean", "sd"),
    [
        (1.9 + 3e4, 0.3, 1.9 - 0.3**2 / 3e4, 0.3**2 / 3e4),
        (1.7, 1e9, 1.7, 0.4 / 12**0.5),
        (-1e9, 1.0, 1.5 + 1e-9, 1e-9),
    ],
    ids=["far beyond", "hardly known", "farther still"],
)
def test_what_is_cut_off_far_out_is_a_number(middle, spread, mean, sd):
    """Far beyond a limit a Gaussian falls off as an exponential, and one far wider than the limits is even between
    them: means and standard deviations are those of these two laws."""
    file = cases.simulation("p**2/2 + k*q**2/2", more="[parameters]\nk = { value = 1.7, lower = 1.5, upper = 1.9 }\n")
    p = cases.problem(file, [cases.recorded(TIMES, np.cos(1.4 * TIMES))], 0.1)
    priors, z = priors_without_effects(p), np.zeros(p.size)
    z[p.head] = middle
    one = Estimate((), "white", z, np.diag(np.where(p.active(()), spread**2, 0.0)), np.ones(1), 0.0, True)
    told = parameters(p, priors, one, 1.0)["k"]
    # 1e-6 of the width: the exponential's own error is of order 1e-10 at 1e5 sd. Seen: 2e-9, rounding at 1.5.
    assert told["mean"] == pytest.approx(mean, rel=0, abs=1e-6 * sd) and told["sd"] == pytest.approx(sd, rel=1e-6)


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
    again = parse_simulation(simulation_text(augmented(file, p, priors, beyond, {}, {}, {})), "augmented.toml")
    assert again.parameters["k"].value == 1.9
    assert 0.0 < again.terms[0].coefficients["c"].value < 1e-6
    assert 1.5 < parameters(p, priors, beyond, 1.0)["k"]["mean"] < 1.9
