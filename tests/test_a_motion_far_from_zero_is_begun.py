"""A motion far from where starts are drawn, about zero, is begun from what was read first."""

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis._drawn import scattered
from symplearn.diagnosis._missed import share_missed
from symplearn.diagnosis._start import first_fits, on_first_readings, priors_without_effects
from symplearn.diagnosis._trajectory import Stepper

TIMES = np.arange(0.0, 60.0, 0.4)
# Prey that would grow by 0.6 a year, eaten by hunters that would die out by 0.8 a year.
GROWTH, DEATH, START = 0.6, 0.8, (30.0, 10.0)
NOISE, SUBSTEP = 0.03, 0.1


def hunted(eaten: float, fed: float):
    """Prey and hunters after Lotka and Volterra, counted, and the problem of the simulation by their logarithms, of
    which the prey alone is counted."""

    def rates(t, x):
        return [x[0] * (GROWTH - eaten * x[1]), x[1] * (fed * x[0] - DEATH)]

    counted = cases.solved(rates, [START[0] * 0.02 / fed, START[1] * 0.04 / eaten], TIMES)
    prey = counted[:, 0] * np.exp(NOISE * np.random.default_rng(3).normal(size=len(TIMES)))
    file = cases.simulation(
        f"{DEATH}*x - {fed}*exp(x) + {GROWTH}*y - {eaten}*exp(y)", ("x",), ("y",), observe={"prey": "exp(x)"}
    )
    return counted, cases.problem(file, [cases.recorded(TIMES, prey, columns=("prey",))], SUBSTEP)


@pytest.mark.parametrize("eaten, fed", [(0.04, 0.02), (4e-5, 2e-5)])
def test_a_population_is_begun_by_its_logarithm(eaten, fed):
    """Thousands of prey, or single ones, and hunters that nobody counts: the start is found of both, from no prior."""
    counted, problem = hunted(eaten, fed)
    stepper = Stepper(problem, 1)
    fits = first_fits(stepper, priors_without_effects(problem), [problem.rows[0].fitted])
    begin = fits.z[0, [0, problem.equations.width]]
    # The noise of 3 % leaves the start open in the few rows that are followed: 0.011 was seen. From anywhere else the
    # hunters alone are off by millions.
    np.testing.assert_allclose(begin, np.log(counted[0]), atol=0.1)


def test_starts_read_what_was_read_first():
    """Nearly all drawn starts are moved to where they read the first reading; what no reading depends on stays as it
    was drawn."""
    _, problem = hunted(0.04, 0.02)
    priors = priors_without_effects(problem)
    drawn = scattered(problem, priors)
    moved = on_first_readings(Stepper(problem, 1), drawn, priors)
    width = problem.equations.width
    first = problem.rows[0].readings[0, 0]
    # From far above exp overflows, and nothing is moved. Of those within five of zero all read it to 1e-10; a start
    # that does to 1e-6 is as good, far within the noise.
    within = np.abs(drawn[:, 0]) < 5.0
    assert np.isclose(np.exp(moved[within, 0]), first, rtol=1e-6).mean() > 0.9
    np.testing.assert_array_equal(moved[:, width:], drawn[:, width:])


def test_what_is_known_of_a_start_stays():
    """A start of known mean and spread stays as it was drawn."""
    file = cases.simulation("p**2/2 + q**2/2", more="[initial]\nq = { value = 1.0, sd = 0.1 }\np = 0.0")
    problem = cases.problem(file, [cases.recorded(TIMES, 5.0 + np.cos(TIMES))], SUBSTEP)
    priors = priors_without_effects(problem)
    drawn = scattered(problem, priors)
    np.testing.assert_array_equal(on_first_readings(Stepper(problem, 1), drawn, priors), drawn)


def test_shares_are_of_what_readings_vary_by():
    """Readings of a known swing that a trajectory at rest misses altogether, and the swing itself not at all."""
    problem = cases.problem(cases.simulation("p**2/2 + q**2/2"), [cases.recorded(TIMES, np.cos(TIMES))], SUBSTEP)
    lanes = np.zeros((2, problem.size))
    lanes[1, 0] = 1.0
    rows = [problem.rows[0].fitted]
    shares = share_missed(problem, Stepper(problem, 1).predict(lanes, [()] * 2, rows), rows)
    read = np.cos(TIMES[: rows[0]])
    # Steps of the integrator make 3e-6; shares are held against a tenth at least.
    np.testing.assert_allclose(shares, [np.sqrt(np.mean(read**2)) / read.std(), 0.0], atol=1e-3)
