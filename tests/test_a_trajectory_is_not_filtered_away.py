"""Where no force is missing, held-out rows go on from the fitted trajectory, whatever its start leaves open."""

import engine_cases as cases
import numpy as np
import pytest

from symplearn._smoother import smooth
from symplearn.diagnosis import _path_filter as path_filter
from symplearn.diagnosis._calibrate import calibrate
from symplearn.diagnosis._locate import where_sentence
from symplearn.diagnosis._outlook import Outlook
from symplearn.diagnosis._path_filter import filter_along
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._stochastic import run_filter
from symplearn.diagnosis._trajectory import Stepper
from symplearn.diagnosis._weighed import weigh_white

NOISE, TURNS = 0.05, 4


def binary(eccentricity, seed):
    """Sixty velocities along x, at any time, of an orbit whose mu is known to 5 %: recording, stepper and estimate.
    Its period is 2 pi, its long axis at 37 degrees, and it begins at the far end of that."""
    far, speed = 1 + eccentricity, np.sqrt((1 - eccentricity) / (1 + eccentricity))
    start = [0.8 * far, 0.6 * far, -0.6 * speed, 0.8 * speed]
    rng = np.random.default_rng(seed)
    times = np.sort(rng.uniform(0, 2 * np.pi * TURNS, 60))
    times[0] = 0.0
    y = cases.solved(cases.attracted(1.0), start, times)[:, 2] + NOISE * rng.normal(size=len(times))
    more = f"[parameters]\nmu = {{ value = 1.0, sd = 0.05 }}\n[recording.noise]\nv = {NOISE}\n"
    file = cases.simulation("(px**2 + py**2)/2 - mu/sqrt(x**2 + y**2)", ("x", "y"), ("px", "py"), {"v": "px"}, more)
    run = cases.recorded(times, y, columns=("v",))
    p = cases.problem(file, [run], 0.02, holdout=0.3)
    stepper, rows, priors = Stepper(p), [r.fitted for r in p.rows], priors_without_effects(p)
    begin, half = np.zeros((1, p.size)), p.state // 2
    begin[0, [0, 1, half, half + 1, p.head]] = [*start, 1.0]
    return run, stepper, weigh_white(p, calibrate(stepper, begin, [()], priors, rows), priors, rows)[0]


@pytest.fixture(scope="module")
def eccentric():
    return binary(0.6, 1)


@pytest.fixture(scope="module")
def grazing():
    return binary(0.8, 3)


def held_out(case, intensity):
    """The rms error of the held-out free run by the noise, and the errors by what is expected of them."""
    run, stepper, estimate = case
    outlook = Outlook(stepper, estimate, 0, np.full(2, intensity))
    late = run.times > outlook.rows.boundary
    errors = outlook.held_out_errors(run.times[late], run.readings[late])
    return np.sqrt(np.mean(errors**2)) / NOISE, np.sqrt(np.nanmean(outlook.held_out(1.0).squares))


def test_an_eccentric_orbit_goes_on(eccentric):
    """The held-out velocities of an eccentric orbit are missed by the noise, and by what is expected of them, as a
    trajectory and about it under next to no force."""
    for intensity in (0.0, 1e-10):
        error, misfit = held_out(eccentric, intensity)
        assert error < 1.4 and 0.7 < misfit < 1.3  # 18 errors tell their rms to a sixth; 0.86 and 0.81 were seen


def test_what_is_shown_is_the_trajectory(eccentric):
    """Readings, phase points and innovations shown are those of SciPy's motion from the fitted start, and no force is
    missing."""
    _, stepper, estimate = eccentric
    outlook = Outlook(stepper, estimate, 0, np.zeros(2))
    n, p = outlook.rows.fitted, stepper.problem
    half, times = p.state // 2, outlook.rows.times
    start = estimate.z[[0, 1, half, half + 1]]
    path = cases.solved(cases.attracted(estimate.z[p.head]), start, times)
    # All three: the integrator's own error over four turns in steps of 0.02, of which 0.0004 of the noise was seen in
    # the readings and 0.0001 in the phase points; innovations are readings by the noise.
    np.testing.assert_allclose(outlook.readings, path[:, 2:3], atol=NOISE / 500)
    np.testing.assert_allclose(outlook.states[:, [0, 1, half, half + 1]], path[:n], atol=NOISE / 500)
    errors = np.nan_to_num(outlook.rows.readings - path[:, 2:3])[:n] / NOISE  # rows between readings have none
    np.testing.assert_allclose(outlook.innovations, errors, atol=1 / 500)
    assert not outlook.missing_force().any() and not outlook.strain().any() and outlook.ok
    assert where_sentence(p, outlook, 1) == "no missing force on y can be followed by itself"


def test_an_orbit_that_sigma_points_lose_is_followed(grazing):
    """Under next to no force sigma points lose an orbit of eccentricity 0.8; about the fitted path the filter does not:
    the held-out run errs as the trajectory does, and the smoothed phase points are SciPy's."""
    run, stepper, estimate = grazing
    outlook, p = Outlook(stepper, estimate, 0, np.full(2, 1e-10)), stepper.problem
    n, noise = outlook.rows.fitted, np.full(1, NOISE)
    spread, read = outlook._start_spread, outlook.rows.readings[:n]
    _, lost = run_filter(p, stepper.courses[0], 0, estimate.z, (), noise, 0 * noise, np.full(2, 1e-10), spread, read)
    assert np.mean(np.asarray(lost.standardised_innovations)[np.asarray(lost.observed)] ** 2) > 30  # 46 was seen
    assert outlook.ok and np.abs(outlook.innovations).max() < 4
    # The filter has the rows twice, as the fit had them; 1.66 and 1.66 were seen, of eighteen errors.
    assert held_out(grazing, 1e-10)[0] == pytest.approx(held_out(grazing, 0.0)[0], rel=0.02)
    four = [0, 1, p.state // 2, p.state // 2 + 1]
    path = cases.solved(cases.attracted(estimate.z[p.head]), estimate.z[four], outlook.rows.times[:n])
    # A tenth of the noise: the filter has the rows twice; 0.0033 was seen.
    np.testing.assert_allclose(outlook.states[:, four], path, atol=NOISE / 10)


def test_about_a_path_a_linear_filter_is_exact():
    """Of a spring everything is linear: about a path that is far off, filter and smoother say what sigma points do."""
    times = np.linspace(0.0, 12.0, 60)
    y = np.cos(times) + NOISE * np.random.default_rng(4).normal(size=len(times))
    y[20:24] = np.nan
    file = cases.simulation("p**2/2 + q**2/2", more=f"[recording.noise]\ny = {NOISE}\n")
    p = cases.problem(file, [cases.recorded(times, y)], 0.02, holdout=0.25)
    stepper, rows, priors = Stepper(p), [r.fitted for r in p.rows], priors_without_effects(p)
    begin = np.zeros((1, p.size))
    begin[0, 0] = 1.0
    estimate = weigh_white(p, calibrate(stepper, begin, [()], priors, rows), priors, rows)[0]
    few, noise = np.full(1, 1e-3), np.full(1, NOISE)
    spread, read = Outlook(stepper, estimate, 0, few)._start_spread, y[: rows[0], None]
    parts, expected = run_filter(p, stepper.courses[0], 0, estimate.z, (), noise, 0 * noise, few, spread, read)
    model, spans, contexts = parts
    known = smooth(model, expected, spans, contexts)
    path = np.random.default_rng(5).normal(size=(len(p.rows[0].times), p.state))
    path[:, [k for k in range(p.state) if k % (p.state // 2)]] = 0.0  # the unseen oscillator rests
    found, slopes = filter_along(stepper, 0, estimate.z, (), path, noise, 0 * noise, few, spread, read)
    n, smoothed = len(path), path_filter.smooth(found, slopes)
    for name in ("filtered_means", "filtered_covariances", "innovation_covariances", "standardised_innovations"):
        # Round-off of sixty rows; 5e-14 was seen.
        np.testing.assert_allclose(getattr(found, name)[:n], getattr(expected, name)[:n], atol=1e-11)
    for name in ("means", "disturbances", "standardised_disturbances", "standardised_residuals"):
        shown, other = getattr(smoothed, name), np.asarray(getattr(known, name))
        # The same there and back; 8e-14 was seen.
        np.testing.assert_allclose(shown[: rows[0] - 1], other[: rows[0] - 1], atol=1e-11)
