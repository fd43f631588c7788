"""Where readings tell nothing of a direction of the start, runs and forecasts go on from what they do tell."""

from dataclasses import replace

import engine_cases as cases
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

from symplearn.diagnosis._calibrate import calibrate
from symplearn.diagnosis._forecast import forecast
from symplearn.diagnosis._outlook import Outlook
from symplearn.diagnosis._reach import covariance_within_reach
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._trajectory import Stepper
from symplearn.diagnosis._warnings import strayed
from symplearn.diagnosis._weighed import weigh_white

NOISE, TIMES, START = 0.005, np.linspace(0.0, 14.0, 120), [0.8, 0.6, -0.5, 0.9]


def fitted(file, run, start):
    """Stepper and estimate of three quarters of a recording, from a start like the true one."""
    p = cases.problem(file, [run], 0.02, holdout=0.25)
    stepper, rows, begin = Stepper(p), [r.fitted for r in p.rows], np.zeros((1, p.size))
    priors = priors_without_effects(p)
    begin[0, : len(start) // 2] = start[: len(start) // 2]
    begin[0, p.state // 2 : p.state // 2 + len(start) // 2] = start[len(start) // 2 :]
    return stepper, weigh_white(p, calibrate(stepper, begin, [()], priors, rows), priors, rows)[0]


@pytest.fixture(scope="module")
def orbit():
    """An orbit about mu = 1, of which the distance is read: recording, stepper, estimate."""
    path = cases.solved(cases.attracted(1.0), START, TIMES)
    y = np.hypot(path[:, 0], path[:, 1]) + NOISE * np.random.default_rng(5).normal(size=len(TIMES))
    file = cases.simulation("(px**2 + py**2)/2 - 1/sqrt(x**2 + y**2)", ("x", "y"), ("px", "py"),
                            {"range": "sqrt(x**2 + y**2)"}, f"[recording.noise]\nrange = {NOISE}\n")  # fmt: skip
    run = cases.recorded(TIMES, y, columns=("range",))
    return (run, *fitted(file, run, START))


def distance(x, times):
    """Distances of an orbit of given distance, radial and angular momentum at t = 0, by the radial equation."""
    # Tolerances seven orders below the noise.
    found = solve_ivp(lambda t, s: [s[1], x[2] ** 2 / s[0] ** 3 - 1 / s[0] ** 2], (0, times[-1]), x[:2], "DOP853",
                      times, rtol=1e-10, atol=1e-12)  # fmt: skip
    return found.y[0]


def test_the_held_out_run_errs_by_the_noise(orbit):
    """The held-out run of such an orbit errs by the noise, though its posterior is several times as wide along the
    tangent as the orbit is large: as a trajectory, and under a tiny missing force, filtered about it; with all of that
    width, too."""
    run, stepper, estimate = orbit
    local, state = stepper.problem.local(0), stepper.problem.state
    whole = estimate.covariance[np.ix_(local, local)]
    assert np.sqrt(np.linalg.eigvalsh(whole[:state, :state])[-1]) > 3.0
    for intensity, spread in ((0.0, None), (1e-12, None), (1e-12, whole)):
        outlook = Outlook(stepper, estimate, 0, np.full(2, intensity))
        if spread is not None:
            outlook.__dict__["_within_reach"] = spread
        n = outlook.rows.fitted
        errors = outlook.held_out_errors(TIMES[n:], run.readings[n:])
        assert np.sqrt(np.mean(errors**2)) < 1.3 * NOISE  # 30 rows: sd of their rms is 0.13 of the noise


def test_a_run_that_strays_is_said(orbit):
    """A held-out run that leaves the readings by ten times their range is a warning, with the recording's number where
    there are several; one that follows them is none."""
    run, stepper, estimate = orbit
    here, away = (Outlook(stepper, estimate, 0, np.zeros(2)) for _ in range(2))
    far = here.run.copy()
    far[-1] += 20 * np.ptp(run.readings)
    away.__dict__["run"] = far
    assert strayed(here, run, is_one_of_several=True) == []
    (line,) = strayed(away, run, is_one_of_several=True)
    assert "the held-out run of range in recording 1 leaves all that was read" in line


@pytest.mark.parametrize("intensity", [None, pytest.param(1e-12, marks=pytest.mark.slow)], ids=["none", "tiny"])
def test_the_forecast_is_as_wide_as_the_radial_equation_says(orbit, intensity):
    """Mean and sd of the forecast distance are those of SciPy's least squares on the radial equation, which knows no
    angle, without a missing force and, by another way, under a tiny one."""
    run, stepper, estimate = orbit
    later = TIMES[-1] + 0.25 * np.arange(1, 25)
    least = least_squares(lambda x: (distance(x, TIMES) - run.readings[:, 0]) / NOISE, [1.0, 0.14, 1.02], x_scale="jac")
    expected = distance(least.x, later)
    covariance = np.linalg.inv(least.jac.T @ least.jac)
    steps = np.linalg.cholesky(covariance).T
    sd = np.sqrt(sum((distance(least.x + step, later) - expected) ** 2 for step in steps))
    one = replace(estimate, intensity=None if intensity is None else np.full(2, intensity))
    found = forecast(stepper, run, one, one, later, 1.0, seed=0).columns["range"]
    # Held-out readings count by Student's t, which moves a mean by a fraction of its sd.
    assert np.abs(found["after"] - expected).max() < 1.0 * sd.max()
    # Within a third: 128 draws give an sd to 6 %, and Student's t takes a tenth of the held-out weight; 4 % was seen.
    # With the whole width along the tangent it was 15, some 16,000 times as large.
    np.testing.assert_allclose(found["after_sd"].mean(), sd.mean(), rtol=0.35)


def test_where_readings_are_linear_nothing_is_shortened():
    """Of a spring, whose readings go linearly with its start, all of the posterior is within reach."""
    y = np.cos(TIMES) + NOISE * np.random.default_rng(6).normal(size=len(TIMES))
    file = cases.simulation("(p**2 + q**2)/2", more=f"[recording.noise]\ny = {NOISE}\n")
    stepper, estimate = fitted(file, cases.recorded(TIMES, y), [1.0, 0.0])
    local = stepper.problem.local(0)
    whole = estimate.covariance[np.ix_(local, local)]
    # Nothing is taken off where a share is one: round-off, of entries of 1e-7 and of zeros.
    np.testing.assert_allclose(covariance_within_reach(stepper, estimate, 0), whole, rtol=1e-12, atol=1e-18)
