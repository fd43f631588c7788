"""Laplace's integral is exact where the readings are linear, and the inflation of its scores is what it says."""

import math

import numpy as np
import pytest
from scipy.integrate import dblquad, quad
from scipy.signal import lfilter
from scipy.stats import multivariate_normal, norm

from symplearn.diagnosis._evidence import _orthant, laplace, variance_inflation

# Round-off of a few solves with matrices whose condition is below 1e4.
ROUND_OFF = 1e-9


class Line:
    """Readings y = J theta + noise with independent Gaussian priors, linearised about `z`."""

    def __init__(self, J, y, sd, mean, scale, z):
        self.J, self.y, self.sd = np.asarray(J, float), np.asarray(y, float), sd
        self.mean, self.scale, self.z = (np.asarray(a, float) for a in (mean, scale, z))

    @property
    def precision(self):
        return self.scale**-2.0

    def laplace(self, active=None, lower=None):
        columns = np.column_stack([self.y - self.J @ self.z, self.J]) / self.sd
        offset = -0.5 * len(self.y) * math.log(2 * math.pi * self.sd**2)
        active = np.ones(len(self.z), bool) if active is None else active
        return laplace(columns.T @ columns, offset, self.z, self.mean, self.precision, active, lower or {})

    def likelihood(self, *theta):
        return np.exp(norm.logpdf(self.y, self.J @ np.array(theta), self.sd).sum())

    def unnormalised(self, *theta):
        return self.likelihood(*theta) * np.exp(norm.logpdf(theta, self.mean, self.scale).sum())


def line(seed=0, unknowns=3, number=12):
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(number, unknowns))
    truth, scale = rng.normal(size=unknowns), rng.uniform(0.5, 2.0, unknowns)
    y = J @ truth + 0.3 * rng.normal(size=number)
    return Line(J, y, 0.3, rng.normal(size=unknowns), scale, rng.normal(size=unknowns))


def test_evidence_and_posterior_are_those_of_the_joint_gaussian():
    """The log evidence equals scipy's N(y; J m, J S J' + R), wherever it is linearised, and so does the posterior."""
    model = line()
    S = np.diag(model.scale**2)
    marginal = model.J @ S @ model.J.T + model.sd**2 * np.eye(len(model.y))
    expected = multivariate_normal.logpdf(model.y, model.J @ model.mean, marginal)
    gain = S @ model.J.T @ np.linalg.inv(marginal)
    found = model.laplace()
    np.testing.assert_allclose(found.log_evidence, expected, rtol=ROUND_OFF)
    mean = model.mean + gain @ (model.y - model.J @ model.mean)
    np.testing.assert_allclose(model.z + found.step, mean, atol=ROUND_OFF)
    np.testing.assert_allclose(found.covariance, S - gain @ model.J @ S, atol=ROUND_OFF)


def test_a_step_promises_what_the_density_gains_by_it():
    """Where readings are linear, the log density rises from `z` to `z + step` by what was promised."""
    model = line()
    found = model.laplace()
    gained = np.log(model.unnormalised(*(model.z + found.step))) - np.log(model.unnormalised(*model.z))
    np.testing.assert_allclose(found.promised, gained, rtol=ROUND_OFF)
    assert found.promised > 1.0


def test_what_is_not_free_stays_and_costs_nothing():
    """An unknown that is not active keeps its value, has no spread, and drops out of the evidence."""
    model = line()
    active = np.array([True, False, True])
    found = model.laplace(active)
    rest = Line(model.J[:, active], model.y - model.J[:, 1] * model.z[1], model.sd,
                model.mean[active], model.scale[active], model.z[active])  # fmt: skip
    np.testing.assert_allclose(found.log_evidence, rest.laplace().log_evidence, rtol=ROUND_OFF)
    assert found.step[1] == 0 and not found.covariance[1].any() and not found.covariance[:, 1].any()


def test_a_flat_prior_is_integrated_at_the_density_one_over_root_two_pi():
    """A flat unknown is the limit of a wide Gaussian whose density at its centre is divided out."""
    model = line()
    wide = Line(model.J, model.y, model.sd, model.mean, [model.scale[0], 1e6, model.scale[2]], model.z)
    flat = Line(model.J, model.y, model.sd, model.mean, [model.scale[0], np.inf, model.scale[2]], model.z)
    # N(0 away from its mean | sd 1e6) is 1 / (1e6 sqrt(2 pi)); what is left is of order 1 / 1e6^2.
    expected = wide.laplace().log_evidence + math.log(1e6)
    np.testing.assert_allclose(flat.laplace().log_evidence, expected, atol=1e-8)


@pytest.mark.parametrize("size", [1.0, 100.0])
def test_a_direction_that_nothing_holds_leaves_the_others_exact(size):
    """Two flat unknowns that the readings know only by their sum: the sum is right, the evidence does not depend on
    where it is linearised."""
    J = np.repeat(size * np.random.default_rng(3).normal(size=(50, 1)), 2, axis=1)
    found = []
    for z in ([1.3, -0.1], [1.0, 1.0]):
        model = Line(J, 2.0 * J[:, 0], 0.1, [0.0, 0.0], [np.inf, np.inf], z)
        found.append(model.laplace())
        # A thousandth of the sum's own spread.
        assert abs((model.z + found[-1].step).sum() - 2.0) < 1e-3 * 0.1 / np.linalg.norm(J[:, 0])
    np.testing.assert_allclose(found[0].log_evidence, found[1].log_evidence, atol=1e-4)


@pytest.mark.parametrize("truth", [0.8, 0.1, -0.5], ids=["allowed", "at the bound", "forbidden"])
@pytest.mark.parametrize("bound", [0.0, -0.3])
def test_a_half_prior_is_integrated_over_its_half(truth, bound):
    """With one sign-bound unknown the evidence equals the integral over the allowed half, of the prior cut there."""
    J = np.array([[1.0], [0.5], [-0.7]])
    model = Line(J, J[:, 0] * truth + [0.05, -0.1, 0.02], 0.2, [0.0], [1.0], [0.4])
    cut = norm.sf(bound, 0.0, 1.0)
    integral = quad(model.unnormalised, bound, bound + 8, epsabs=0, epsrel=1e-11, points=[max(truth, bound) + 0.01])[0]
    found = model.laplace(lower={0: bound})
    np.testing.assert_allclose(found.log_evidence, math.log(integral / cut), atol=1e-8)


@pytest.mark.parametrize(
    "truth", [(0.5, 0.6), (0.05, 0.4), (-0.3, 0.3), (-0.3, -0.2)], ids=["inside", "edge", "one out", "both out"]
)
def test_two_half_priors_are_integrated_over_their_quadrant(truth):
    """With two correlated sign-bound unknowns the evidence equals the integral over the quadrant."""
    J = np.array([[1.0, 0.8], [0.5, -0.1], [-0.7, 0.3], [0.2, 0.9]])
    model = Line(J, J @ np.array(truth) + [0.05, -0.1, 0.02, 0.03], 0.2, [0.0, 0.0], [1.0, 0.7], [0.4, 0.1])
    integral = dblquad(lambda b, a: model.unnormalised(a, b), 0, 4, 0, 4, epsabs=0, epsrel=1e-8)[0]
    found = model.laplace(lower={0: 0.0, 1: 0.0})
    # The oracle is asked for 1e-8 of itself, a tenth of this. Seen: 7.5e-10.
    np.testing.assert_allclose(found.log_evidence, math.log(integral / 0.25), atol=1e-7)


@pytest.mark.parametrize("correlation", [-0.8, -0.3, 0.0, 0.6, 0.9999])
@pytest.mark.parametrize("reach", [(0.0, 0.0), (0.0, 1.2), (-0.7, 0.0), (0.4, -0.6), (-1.5, 1.0), (2.0, 3.0)])
def test_a_quadrant_is_integrated_exactly(reach, correlation):
    """Of two correlated normals the mass above two bounds is a single integral, a bound at nothing among them."""
    a, b = reach
    inside = lambda t: norm.pdf(t) * norm.cdf((b - correlation * t) / math.sqrt(1 - correlation**2))  # noqa: E731
    turn = b / correlation if correlation and abs(b / correlation) < 9 else 0.0  # where the integrand is steep
    # Asked for far less than what is compared below: of the smallest mass, 0.014, it may be off by 2e-12 of itself; the
    # tail beyond 9 holds 1e-19.
    mass = quad(inside, -9, a, epsabs=1e-14, epsrel=1e-11, limit=500, points=[min(turn, a)])[0]
    found = _orthant(np.array(reach), np.array([[1.0, correlation], [correlation, 1.0]]))
    # A cubature, as it was before, is asked for 1e-5 only. Seen: 1.2e-15.
    assert found == pytest.approx(math.log(mass), abs=1e-7)


@pytest.mark.parametrize("alike", [0.5, 0.9, 0.999])
@pytest.mark.parametrize("number", [3, 5, 8])
def test_many_that_go_together_are_integrated_over_their_orthant(number, alike):
    """Of equally correlated normals the mass above a bound is a single integral, however many there are and near to
    one as they may be."""
    for reach in (-1.5, 0.0, 1.0):
        inside = lambda t, r=reach: norm.pdf(t) * norm.cdf((r + np.sqrt(alike) * t) / np.sqrt(1 - alike)) ** number  # noqa: E731
        # The oracle is asked for 1e-10 of itself, so that its own error does not count; the tails beyond 9 hold 1e-19.
        mass = quad(inside, -9, 9, epsabs=0, epsrel=1e-10, limit=500, points=[-reach])[0]
        equal = np.full((number, number), alike) + (1 - alike) * np.eye(number)
        # A hundredth of a nat moves no probability by more than a hundredth of itself. Seen: 0.00045.
        assert _orthant(np.full(number, reach), equal) == pytest.approx(math.log(mass), abs=0.01)


@pytest.mark.parametrize("truth", [(-0.4, -0.5), (-1.0, -1.0), (-1.4, -1.5), (-3.0, -2.0)])
def test_two_forbidden_signs_cost_twice(truth):
    """Two unknowns that know nothing of each other: their evidence is the sum of two, however forbidden both are."""
    both = Line(np.eye(2), truth, 0.2, [0.0, 0.0], [1.0, 1.0], [0.0, 0.0]).laplace(lower={0: 0.0, 1: 0.0})
    alone = [Line([[1.0]], [y], 0.2, [0.0], [1.0], [0.0]).laplace(lower={0: 0.0}) for y in truth]
    # A tenth of a nat moves no probability by more than a tenth of itself.
    assert both.log_evidence == pytest.approx(sum(one.log_evidence for one in alone), abs=0.1)


def test_the_inflation_of_white_scores_is_one():
    """Scores of whitened rows have the variance that whitened rows would have."""
    scores = np.random.default_rng(0).normal(size=(2400, 200)) * np.geomspace(1e-3, 1e3, 200)
    # A variance of 12 sums is off by sqrt(2 / 11) = 0.43, its median over 200 columns by 0.04; three of them.
    assert 1.0 <= variance_inflation(scores) < 1.12


@pytest.mark.parametrize("a", [0.5, 0.8])
def test_the_inflation_of_autoregressive_scores_is_the_long_run_ratio(a):
    """For AR(1) scores the inflation is (1 + a) / (1 - a), the long-run variance over the short-run one."""
    white = np.random.default_rng(1).normal(size=(9600, 200))
    scores = lfilter([1.0], [1.0, -a], white, axis=0)[100:]
    # As above, 0.04 for each of three, the largest of which counts.
    np.testing.assert_allclose(variance_inflation(scores), (1 + a) / (1 - a), rtol=0.12)


def test_scores_that_are_all_zero_do_not_count():
    """Unknowns that no reading depends on neither inflate nor dilute; too few rows say nothing."""
    scores = np.random.default_rng(2).normal(size=(1200, 3)).cumsum(0)
    padded = np.concatenate([np.zeros((1200, 9)), scores], axis=1)
    assert variance_inflation(padded) == variance_inflation(scores) > 10
    assert variance_inflation(np.zeros((1200, 2))) == 1.0
    assert variance_inflation(scores[:40]) == 1.0


def test_what_ran_away_has_no_evidence():
    """Slopes that overflowed make a combination impossible, not the search fail."""
    gram = np.eye(4)
    gram[1, 2] = gram[2, 1] = np.inf
    found = laplace(gram, 0.0, np.zeros(3), np.zeros(3), np.ones(3), np.ones(3, bool), {})
    assert found.log_evidence == -np.inf and not found.covariance.any() and not found.step.any()
