"""A fit that rests against a bound is integrated inside it: what a step through the bound would gain is not earned."""

import numpy as np
import pytest
from scipy.integrate import dblquad, quad

from symplearn.diagnosis._evidence import laplace

RNG = np.random.default_rng(3)
COLUMNS = RNG.normal(size=(2, 30))
MEAN, SD = np.array([0.5, 2.0]), np.array([1.5, 1.2])
FREE = (np.full(2, -np.inf), np.full(2, np.inf))


def log_density(error, z, begin):
    """Unnormalised log likelihood of a linear model that was fitted at `begin`, and the log of normal priors."""
    left = error - (z - begin) @ COLUMNS
    prior = -0.5 * ((z - MEAN) / SD) ** 2 - 0.5 * np.log(2 * np.pi * SD**2)
    return -0.5 * float(left @ left) + float(prior.sum())


def evaluated(error, begin, bounds, active=(True, True), precision=SD**-2.0):
    columns = np.concatenate([error[None], COLUMNS])
    return laplace(columns @ columns.T, 0.0, begin, MEAN, precision, np.array(active), {}, bounds)


@pytest.mark.parametrize("push", [-0.3, -2.0, -8.0])
@pytest.mark.parametrize("side", [0, 1])
def test_one_entry_is_integrated_on_the_side_that_is_left(push, side):
    """Of one free entry, pushed weakly or hard against a lower or an upper bound: SciPy's quadrature."""
    begin, sign = np.array([1.0, 2.0]), 1 - 2 * side
    error = sign * push * COLUMNS[0] / (COLUMNS[0] @ COLUMNS[0]) * 3
    bounds = tuple(bound.copy() for bound in FREE)
    bounds[side][0] = begin[0]
    found = evaluated(error, begin, bounds, (True, False))
    top = log_density(error, begin, begin)
    inside = (begin[0], np.inf) if side == 0 else (-np.inf, begin[0])
    mass, _ = quad(lambda x: np.exp(log_density(error, np.array([x, begin[1]]), begin) - top), *inside)
    held = -0.5 * ((begin[1] - MEAN[1]) / SD[1]) ** 2 - 0.5 * np.log(2 * np.pi * SD[1] ** 2)
    # SciPy's quadrature is good to 1e-8 of the mass.
    assert found.log_evidence == pytest.approx(top + np.log(mass) - held, abs=1e-6)
    assert found.promised == 0.0 and not found.step.any()
    assert found.covariance[0, 0] > 0


def test_the_others_follow():
    """Beside an entry at its bound a free one takes its step; the evidence is that of the half plane."""
    begin = np.array([1.0, 2.0])
    error = -9.0 * COLUMNS[0] / (COLUMNS[0] @ COLUMNS[0]) + 0.4 * COLUMNS[1]
    bounds = (np.array([1.0, -np.inf]), FREE[1])
    found = evaluated(error, begin, bounds)
    top = log_density(error, begin, begin)
    mass, _ = dblquad(lambda y, x: np.exp(log_density(error, np.array([x, y]), begin) - top), 1.0, 4.0, -2.0, 6.0)
    # The quadrature ends at 4, -2 and 6, and is good to 1e-8 of what is inside.
    assert found.log_evidence == pytest.approx(top + np.log(mass), abs=1e-5)
    assert found.step[0] == 0.0 and found.step[1] > 0.1


def test_an_entry_without_a_prior_has_an_evidence_at_its_bound():
    """A calibrated value of flat prior owes no more than it does inside: the evidence is finite, and that of a bound
    which is hardly pushed against is half of the free one."""
    begin, flat = np.array([1.0, 2.0]), np.array([0.0, SD[1] ** -2.0])
    error = -1e-9 * COLUMNS[0]
    at_bound = evaluated(error, begin, (np.array([1.0, -np.inf]), FREE[1]), (True, False), flat)
    free = evaluated(error, begin, FREE, (True, False), flat)
    # The push of 1e-9 moves it by as much.
    assert at_bound.log_evidence == pytest.approx(free.log_evidence - np.log(2), abs=1e-6)


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("apart", [0.0, 0.1, 0.3])
def test_near_its_bound_an_entry_is_integrated_inside(apart, side):
    """Of an entry that stands near a bound, or at it and is pushed away, what lies beyond does not count: SciPy's
    quadrature over both entries."""
    begin, sign = np.array([1.0, 2.0]), 1 - 2 * side
    error = sign * COLUMNS[0] / (COLUMNS[0] @ COLUMNS[0]) + 0.4 * COLUMNS[1]
    bounds = tuple(bound.copy() for bound in FREE)
    bounds[side][0] = begin[0] - sign * apart
    found = evaluated(error, begin, bounds)
    top = log_density(error, begin, begin)
    x = (bounds[side][0], bounds[side][0] + sign * 3.0)
    mass, _ = dblquad(lambda y, x: np.exp(log_density(error, np.array([x, y]), begin) - top), min(x), max(x), -2.0, 6.0)
    # The quadrature is good to 1e-8 of what is inside, SciPy's probability of a quadrant to 1e-5.
    assert found.log_evidence == pytest.approx(top + np.log(mass), abs=1e-4)
    assert found.log_evidence < evaluated(error, begin, FREE).log_evidence - 0.01


def test_far_inside_its_bounds_nothing_changes():
    """An entry many standard deviations from its bounds is integrated as if there were none."""
    begin = np.array([1.0, 2.0])
    error = 5.0 * COLUMNS[0] / (COLUMNS[0] @ COLUMNS[0])
    free = evaluated(error, begin, FREE)
    assert evaluated(error, begin, (np.array([-1.0, -np.inf]), FREE[1])).log_evidence == free.log_evidence
