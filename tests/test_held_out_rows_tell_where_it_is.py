"""A forecast begins where all rows put the phase point, and goes on with the parameters that belong there."""

from dataclasses import replace

import engine_cases as cases
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import norm

from symplearn.diagnosis._calibrate import calibrate
from symplearn.diagnosis._forecast import forecast
from symplearn.diagnosis._outlook import Outlook
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._taught import root_of, taught
from symplearn.diagnosis._trajectory import Stepper
from symplearn.diagnosis._weighed import weigh_white

NOISE, TIMES = 0.05, np.linspace(0.0, 40.0, 200)


def spring(outlier=0.0):
    """A spring that is fitted to three quarters of its rows, its stiffness free: stepper, estimate, readings."""
    q = cases.solved(lambda t, x: [x[1], -1.1 * x[0]], [1.0, 0.3], TIMES)[:, 0]
    y = q + NOISE * np.random.default_rng(0).normal(size=len(q))
    y[180] += outlier
    more = f"[parameters]\nk = {{ value = 1.1 }}\n[recording.noise]\ny = {NOISE}\n"
    file = cases.simulation("p**2/2 + k*q**2/2", more=more)
    p = cases.problem(file, [cases.recorded(TIMES, y)], 0.02, holdout=0.25)
    stepper, rows = Stepper(p), [r.fitted for r in p.rows]
    priors = replace(priors_without_effects(p), precision=np.full(p.size, 1e-9))
    begin = np.zeros((1, p.size))
    begin[0, [0, p.state // 2, p.head]] = 1.0, 0.3, 1.1
    fits = calibrate(stepper, begin, [()], priors, rows)
    return stepper, weigh_white(p, fits, priors, rows)[0], y


def swing(x, times):
    """The spring's closed form from start and stiffness."""
    w = np.sqrt(x[2])
    return x[0] * np.cos(w * times) + x[1] / w * np.sin(w * times)


def closed_form(y):
    """Start and stiffness by SciPy's least squares on the closed form, from all rows of `y`, and their covariance."""
    times = TIMES[: len(y)]
    found = least_squares(lambda x: (swing(x, times) - y) / NOISE, [1.0, 0.3, 1.1], x_scale="jac", xtol=1e-12)
    return found.x, np.linalg.inv(found.jac.T @ found.jac)


@pytest.fixture(scope="module")
def learnt():
    stepper, estimate, y = spring()
    p = stepper.problem
    where = [0, p.state // 2, p.state]
    found = taught(stepper, estimate, root_of(stepper, estimate, 1.0))
    return stepper, estimate, found, where, *closed_form(y)


def test_fit_and_held_out_rows_together_are_the_fit_of_all_rows(learnt):
    """Mean and covariance are those of SciPy's least squares on all rows at once; the fit alone is far from them."""
    stepper, estimate, found, where, expected, covariance = learnt
    sd = np.sqrt(np.diag(covariance))
    # Tails of Student's t take a tenth of the weight of the held-out readings, which are a quarter of all.
    assert np.all(np.abs(found.mean[where] - expected) < 0.3 * sd)
    # The same tenth, of which a standard deviation takes half: twice that is allowed.
    spread = (found.root @ found.root.T)[np.ix_(where, where)]
    np.testing.assert_allclose(np.sqrt(np.diag(spread)), sd, rtol=0.1)
    before = np.sqrt(np.diag(estimate.covariance))[[0, stepper.problem.state // 2, stepper.problem.head]]
    assert (before > 1.2 * sd).any()


ORBIT, SECONDS = np.array([0.7, -0.1, 0.3, 1.6, 1.5]), 0.13 * np.arange(150)


def orbit(x, times):
    """Phase points (time, 4) of a satellite of given start and attraction, by DOP853, from t = 0 on."""
    return cases.solved(cases.attracted(x[4]), x[:4], np.union1d(0.0, times))[-len(times) :]


@pytest.mark.slow
def test_a_forecast_goes_on_with_the_attraction_that_its_end_belongs_to():
    """Of an orbit whose attraction is free, size and period being known better than either tells of it: the forecast is
    that of SciPy's least squares on all rows to a third of the noise; from the same end under the attraction of the
    fitted rows it would be off by three times the noise."""
    y = orbit(ORBIT, SECONDS)[:, :2] + NOISE * np.random.default_rng(3).normal(size=(len(SECONDS), 2))
    more = f"[parameters]\nmu = {{ value = 1.5 }}\n[recording.noise]\nx = {NOISE}\ny = {NOISE}\n"
    file = cases.simulation("(px**2 + py**2)/2 - mu/sqrt(x**2 + y**2)", ("x", "y"), ("px", "py"),
                            {"x": "x", "y": "y"}, more)  # fmt: skip
    run = cases.recorded(SECONDS, y, columns=("x", "y"))
    p = cases.problem(file, [run], 0.02, holdout=0.25)
    stepper, rows = Stepper(p), [r.fitted for r in p.rows]
    priors, begin = replace(priors_without_effects(p), precision=np.full(p.size, 1e-9)), np.zeros((1, p.size))
    begin[0, [0, 1, p.state // 2, p.state // 2 + 1, p.head]] = ORBIT
    estimate = weigh_white(p, calibrate(stepper, begin, [()], priors, rows), priors, rows)[0]
    later = SECONDS[-1] + 0.13 * np.arange(1, 40)
    found = forecast(stepper, run, estimate, estimate, later, 1.0, seed=0).columns
    best = least_squares(lambda x: ((orbit(x, SECONDS)[:, :2] - y) / NOISE).ravel(), ORBIT, x_scale="jac").x
    expected = orbit(best, later)[:, :2]
    shown = np.stack([found["x"]["after"], found["y"]["after"]], axis=1)
    assert np.abs(shown - expected).max() < NOISE / 3  # 0.12 of it was seen: held-out rows count by Student's t
    end = orbit(best, SECONDS)[-1]
    other = orbit([*end, estimate.z[p.head]], later - SECONDS[-1])[:, :2]
    assert np.abs(other - expected).max() > 3 * NOISE  # 5.8 times it was seen


def test_held_out_density_knows_that_the_stiffness_is_uncertain(learnt):
    """The log density of the held-out readings is that of SciPy's predictive Gaussians from the fitted rows, also where
    start and stiffness are said to be ten times as uncertain: then it is 23 nats below that of what is known."""
    stepper, estimate, *_ = learnt
    y = stepper.problem.rows[0].readings[:, 0]
    fitted = stepper.problem.rows[0].fitted
    mean, covariance = closed_form(y[:fitted])
    late = TIMES[fitted:]
    steps = np.linalg.cholesky(covariance).T
    slopes = np.stack([swing(mean + step, late) - swing(mean, late) for step in steps])
    outlook = Outlook(stepper, estimate, 0, np.zeros(1))

    def expected(inflation):
        spread = np.sqrt(inflation * (slopes**2).sum(0) + NOISE**2)
        return norm.logpdf(y[fitted:], swing(mean, late), spread).sum()

    # Curvature over one and over ten standard deviations; 0.001 and 0.06 were seen.
    assert outlook.held_out(1.0).log_density == pytest.approx(expected(1.0), abs=0.01)
    assert outlook.held_out(100.0).log_density == pytest.approx(expected(100.0), abs=0.2)
    assert expected(0.0) > expected(100.0) + 20
    # Each row's variance, four standard deviations off: curvature is below 4 % of it.
    np.testing.assert_allclose(outlook._unsure(16.0)[:, 0], 16 * (slopes**2).sum(0), rtol=0.06)


def test_an_outlier_among_them_moves_little():
    """A reading that lies twenty sd off moves no unknown by half of an sd."""
    ends = []
    for outlier in (0.0, 20 * NOISE):
        stepper, estimate, _ = spring(outlier)
        ends.append(taught(stepper, estimate, root_of(stepper, estimate, 1.0)))
    sd = np.sqrt(np.maximum(np.diag(ends[0].root @ ends[0].root.T), 1e-300))
    assert np.all(np.abs(ends[1].mean - ends[0].mean) < 0.5 * sd + 1e-12)


def test_draws_of_a_gaussian_posterior_are_weighed_alike(learnt):
    """Where readings depend on the unknowns linearly, draws differ from their Gaussian by nothing."""
    stepper, _, found, *_ = learnt
    units = 0.1 * np.random.default_rng(1).normal(size=(6, len(found.mean)))
    linear = found.errors.left + np.einsum("dl,ltc->dtc", units @ found.root.T, found.errors.slopes)
    scale, readings = found.errors.scale, stepper.problem.rows[0].readings
    shown = readings - linear / scale
    np.testing.assert_allclose(found.log_weights(units, shown, readings), 0.0, atol=1e-9)  # round-off of 200 squares
    far = found.log_weights(units, shown + 3 * NOISE, readings)
    assert (far < -100).all()
