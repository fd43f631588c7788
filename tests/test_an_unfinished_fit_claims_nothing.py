"""A fit that did not converge is weighed where it is; a wrong noise is tried with what it would gain."""

from dataclasses import replace

import engine_cases as cases
import numpy as np
import pytest
from scipy.stats import norm
from scipy.stats import t as student

from symplearn.diagnosis._calibrate import calibrate
from symplearn.diagnosis._scan import noise_starts
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._trajectory import Stepper
from symplearn.diagnosis._weighed import correlated, weigh_white

GIVEN, TRUE = 0.05, 0.1
TIMES = 0.2 * np.arange(60)
FILE = f"""
[parameters]
k = {{ value = 1.0, sd = 0.3 }}

[initial]
q = {{ value = 0.9, sd = 0.3 }}
p = {{ value = 0.0, sd = 0.3 }}

[recording.noise]
y = {GIVEN}
"""


@pytest.fixture(scope="module")
def stepper():
    noise = TRUE * np.random.default_rng(0).normal(size=len(TIMES))
    file = cases.simulation("p**2/2 + k*q**2/2", more=FILE)
    return Stepper(cases.problem(file, [cases.recorded(TIMES, np.cos(TIMES) + noise)], 0.2))


@pytest.fixture(scope="module")
def priors(stepper):
    return priors_without_effects(stepper.problem)


def test_an_unfinished_fit_claims_nothing(stepper, priors):
    """The same point is worth less by what its step promises if the fit did not converge: never more than the optimum.

    A promise of a linear step from far off is worth nothing where the motion is not linear.
    """
    rows = [len(TIMES)]
    done = calibrate(stepper, priors.mean[None], [()], priors, rows)
    begun = calibrate(stepper, priors.mean[None], [()], priors, rows, iterations=0)
    assert done.converged[0] and not begun.converged[0]
    (best,) = weigh_white(stepper.problem, done, priors, rows)
    (claimed,) = weigh_white(stepper.problem, replace(begun, converged=np.array([True]), unearned=None), priors, rows)
    (owned,) = weigh_white(stepper.problem, begun, priors, rows)
    # What differs is half of what the fit took off the cost, and the spread of two Gram matrices at either end: 0.3
    # leaves that two fifths of the half.
    assert best.log_evidence - owned.log_evidence > 0.3 * (begun.cost[0] - done.cost[0]) > 10
    assert owned.log_evidence < claimed.log_evidence - 10


def test_a_fit_that_ended_in_a_kink_claims_hardly_more(stepper, priors):
    """Of what a step promises a fit that has ended all the same, as where no step keeps what it promises, earns half a
    nat."""
    begun = calibrate(stepper, priors.mean[None], [()], priors, [len(TIMES)], iterations=0)
    ended = replace(begun, converged=np.array([True]))
    (at_rest,), (owned,) = (weigh_white(stepper.problem, fits, priors, [len(TIMES)]) for fits in (ended, begun))
    # Round-off of sums of some tens.
    assert at_rest.log_evidence == pytest.approx(owned.log_evidence + 0.5, abs=1e-9)


def test_a_promise_is_weighed_with_the_errors_that_it_leaves(stepper, priors):
    """Of a start at rest, off by more than ten noises, a linear step may promise that nothing is left, and not more:
    heavier tails, which would excuse the errors before it, gain nothing beside that promise."""
    z = priors.mean.copy()
    z[0] = 0.0
    begun = calibrate(stepper, z[None], [()], priors, [len(TIMES)], iterations=0)
    errors = stepper.problem.rows[0].readings[:, 0] - begun.predictions[0].readings[0, :, 0]
    assert np.sqrt(np.mean(errors**2)) > 10 * GIVEN
    (claimed,) = weigh_white(
        stepper.problem, replace(begun, converged=np.array([True]), unearned=None), priors, [len(TIMES)]
    )
    # No reading is likelier than at the peak of the narrower law, Student's of five degrees of freedom.
    assert claimed.log_evidence < len(TIMES) * student.logpdf(0.0, 5, scale=np.sqrt(3 / 5) * GIVEN)


def test_a_wrong_noise_gains_what_the_scatter_says(stepper, priors):
    """The start of a wrongly given noise promises SciPy's log likelihood at the readings' own scatter less as given."""
    rows = [len(TIMES)]
    fits = calibrate(stepper, priors.mean[None], [()], priors, rows)
    (start,) = noise_starts(stepper.problem, fits, rows)
    (member,) = start.combination
    assert stepper.problem.candidate(member).effect.name == "sensor_noise"
    errors = stepper.problem.rows[0].readings[:, 0] - fits.predictions[0].readings[0, :, 0]
    scatter = np.sqrt(np.mean(errors**2))
    gain = norm.logpdf(errors, scale=scatter).sum() - norm.logpdf(errors, scale=GIVEN).sum()
    np.testing.assert_allclose(start.gain, gain, rtol=1e-9)  # round-off
    assert gain > 10


def test_a_wrong_noise_is_tried_beside_an_effect(stepper, priors):
    """Beside another effect that one keeps its value, wherever the new member stands in the combination."""
    problem = stepper.problem
    (drag,) = [m for m in problem.searched if problem.candidate(m).effect.name == "viscous_damping"]
    z = priors.mean.copy()
    z[problem.slots] = 0.03
    fits = calibrate(stepper, z[None], [(drag,)], replace(priors, scales=np.ones_like(priors.scales)), [len(TIMES)])
    (start,) = noise_starts(problem, fits, [len(TIMES)])
    assert len(start.combination) == 2
    place = dict(problem.placed(start.combination))[drag]
    np.testing.assert_array_equal(start.z[place], fits.z[0][dict(problem.placed((drag,)))[drag]])


def test_round_off_claims_nothing(stepper, priors):
    """Squared errors below zero, as round-off leaves them of a trajectory that ran away, are no evidence."""
    fits = calibrate(stepper, priors.mean[None], [()], priors, [len(TIMES)])
    grams = np.zeros((1, 1 + stepper.problem.size, 1 + stepper.problem.size))
    grams[0, 0, 0] = -1e6
    number = np.array([len(TIMES)])
    claimed = correlated(stepper.problem, fits, 0, grams, np.zeros(1), number, 0.0, priors)
    assert claimed.log_evidence == -np.inf


def test_a_step_that_no_number_can_take_gains_nothing(stepper, priors):
    """Errors of a thousand noises along one direction are gone after a step of a thousandth, and are still there where
    a trajectory is so sensitive that the step would be 1e-17 of what it is added to."""
    fits = calibrate(stepper, priors.mean[None], [()], priors, [len(TIMES)])
    size, number = 1 + stepper.problem.size, np.array([len(TIMES)])
    values = []
    for sensitivity in (1e6, 1e20):
        row = np.zeros(size)
        row[:2] = 1e3 * GIVEN, sensitivity * GIVEN  # the error, and its slope in q at the first row
        values.append(correlated(stepper.problem, fits, 0, np.outer(row, row)[None], np.zeros(1), number, 0.0, priors))
    taken, lost = (one.log_evidence for one in values)
    # Half of a thousand squared, and the log of the sensitivities' ratio, by which the posterior is narrower: 32.
    assert taken - lost == pytest.approx(0.5e6 + np.log(1e14), abs=1.0)  # round-off of 1e40 by 1e-17
