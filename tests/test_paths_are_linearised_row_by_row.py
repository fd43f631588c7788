"""A path is linearised row by row, by the program that steps trajectories; a filter is smoothed with these slopes."""

import engine_cases as cases
import numpy as np
import pytest

from symplearn._smoother import smooth
from symplearn.diagnosis import _path_filter as path_filter
from symplearn.diagnosis._path import linearise
from symplearn.diagnosis._path_filter import filter_along
from symplearn.diagnosis._problem import SLOTS
from symplearn.diagnosis._stochastic import free_run, run_filter
from symplearn.diagnosis._trajectory import Stepper

G, DRAG, PUSH, RATE = 9.81, 0.3, 0.5, 2.0
FILE = """
[parameters]
g = { value = 9.81, sd = 0.1 }
"""
N = 12
MISSING = 5


@pytest.fixture(scope="module")
def stepper():
    """A pendulum of which the sine of the angle is read, with one reading missing."""
    times = np.cumsum(np.random.default_rng(1).uniform(0.1, 0.3, N))
    readings = np.sin(cases.solved(lambda t, x: [x[1], -G * np.sin(x[0])], [1.0, 0.2], times)[:, 0])
    readings[MISSING] = np.nan
    file = cases.simulation("p**2/2 - g*cos(q)", observe={"y": "sin(q)"}, more=FILE)
    return Stepper(cases.problem(file, [cases.recorded(times, readings)], 0.005))


def flown(x, g, drag, push, begin, end, origin):
    """Where a damped and driven pendulum is, by SciPy."""
    rates = lambda t, x: [x[1], -g * np.sin(x[0]) - drag * x[1] + push * np.cos(RATE * (t - origin))]  # noqa: E731
    return cases.solved(rates, x, np.array([begin, end]), 1e-12)[-1]


def place(problem, effect):
    return next(i for i, c in enumerate(problem.equations.candidates) if c.effect.name == effect)


def test_every_row_begins_at_its_own_point_of_the_path(stepper):
    """Defects and slopes in the phase point, a calibrated parameter, a drag and a force's amplitude are differences of
    SciPy's flow from each point of a path that no trajectory goes along."""
    p = stepper.problem
    combination = tuple(sorted(place(p, effect) for effect in ("viscous_damping", "periodic_forcing")))
    z = np.zeros(p.size)
    z[p.head] = G
    for member, entries in p.placed(combination):
        drags = p.candidate(member).effect.name == "viscous_damping"
        z[entries] = [DRAG] if drags else [PUSH, 0.0, RATE]  # cosine, sine, frequency
    order = [p.candidate(m).effect.name for m in combination]
    first = {p.candidate(m).effect.name: entries.start - p.slots for m, entries in p.placed(combination)}
    assert set(order) == {"viscous_damping", "periodic_forcing"}
    path = np.random.default_rng(2).normal(size=(N, p.state))
    path[:, [1, 3]] = 0.0  # no unseen oscillator
    hots, values = p.onehot(combination, 0)[None], z[None, p.head :]
    found = linearise(stepper, 0, path[None], values, hots, [np.arange(4)], p.rows[0].readings)
    times, origin, seen = p.rows[0].times, p.equations.origin, [0, 2]

    def arrives(k, x, g=G, drag=DRAG, push=PUSH):
        return flown(x, g, drag, push, times[k], times[k + 1], origin)

    h = 1e-4
    for k in range(N - 1):
        x = path[k, seen]
        sloped = [(arrives(k, x + h * e) - arrives(k, x - h * e)) / (2 * h) for e in np.eye(2)]
        theta = {
            0: (arrives(k, x, g=G + h) - arrives(k, x, g=G - h)) / (2 * h),
            1 + first["viscous_damping"]: (arrives(k, x, drag=DRAG + h) - arrives(k, x, drag=DRAG - h)) / (2 * h),
            1 + first["periodic_forcing"]: (arrives(k, x, push=PUSH + h) - arrives(k, x, push=PUSH - h)) / (2 * h),
        }
        # Differences err by h squared, 1e-8; the splitting of the drag by the step squared, seen as 6e-6.
        near = {"rtol": 0.0, "atol": 2e-5}
        np.testing.assert_allclose(found.defect[0, k, seen], arrives(k, x) - path[k + 1, seen], **near)
        np.testing.assert_allclose(np.asarray(found.A)[0, k][np.ix_(seen, seen)], np.array(sloped).T, **near)
        for column, slope in theta.items():
            np.testing.assert_allclose(found.T[0, k, seen, column], slope, **near)
    assert not np.asarray(found.A)[0, -1].any() and not np.asarray(found.defect)[0, -1].any()


def test_readings_are_linearised_at_the_path(stepper):
    """Residual and slope are those of the sine at each point, and nothing where nothing was read."""
    p = stepper.problem
    path = np.random.default_rng(3).normal(size=(N, p.state))
    values, hots = np.append(G, np.zeros(SLOTS))[None], p.onehot((), 0)[None]
    found = linearise(stepper, 0, path[None], values, hots, [np.zeros(0, int)], p.rows[0].readings)
    read = ~np.isnan(p.rows[0].readings[:, 0])
    residual = np.where(read, p.rows[0].readings[:, 0] - np.sin(path[:, 0]), 0.0)
    np.testing.assert_allclose(found.residual[0, :, 0], residual, atol=1e-14)  # round-off
    np.testing.assert_allclose(found.H[0, :, 0, 0], np.where(read, np.cos(path[:, 0]), 0.0), atol=1e-14)  # round-off
    assert read.sum() == N - 1 and not np.asarray(found.H)[0, :, 0, 1:].any()


def test_what_is_not_covered_is_still(stepper):
    """Rows after those that are given neither move nor read, and the others do not know of them."""
    p = stepper.problem
    path = np.random.default_rng(4).normal(size=(1, N, p.state))
    values, hots = np.append(G, np.zeros(SLOTS))[None], p.onehot((), 0)[None]
    whole, part = (
        linearise(stepper, 0, path, values, hots, [np.zeros(0, int)], p.rows[0].readings[:n]) for n in (N, N - 4)
    )
    for long, short in zip(whole, part, strict=True):
        np.testing.assert_array_equal(np.asarray(long)[:, : N - 5], np.asarray(short)[:, : N - 5])
        assert not np.asarray(short)[:, N - 4 :].any()


def test_smoothing_with_slopes_is_the_unscented_smoother_where_the_spread_is_small(stepper):
    """At a noise of 1e-4 the slopes along a trajectory are those over the filter's spread: means, forces and strains of
    both smoothers agree to the spread, relative to the largest."""
    p, course = stepper.problem, stepper.courses[0]
    z = np.zeros(p.size)
    z[[0, 2]], z[p.head] = [1.0, 0.2], G
    noise, spread = np.full(1, 1e-4), 1e-8 * np.diag([1.0, 0.0, 1.0, 0.0])
    read = p.rows[0].readings + noise * np.random.default_rng(7).normal(size=(N, 1))
    readings = np.where(np.arange(N)[:, None] % 3 == 1, np.nan, read)
    parts, filtered = run_filter(p, course, 0, z, (), noise, 0 * noise, np.full(1, 1e-6), spread, readings)
    assert bool(filtered.ok)
    model, spans, contexts = parts
    path, few = free_run(p, course, z, (), 0, z[: p.state], 0)[1], np.full(1, 1e-6)
    expected = smooth(model, filtered, spans, contexts)
    found = path_filter.smooth(*filter_along(stepper, 0, z, (), path, noise, 0 * noise, few, spread, readings))
    for name in ("means", "disturbances", "standardised_disturbances", "residuals", "standardised_residuals"):
        ours, theirs = (np.asarray(getattr(one, name)) for one in (found, expected))
        assert np.abs(theirs).max() > 0
        # The curvature over some spreads, which is how far the readings lead from the trajectory: 4e-4 was seen.
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-3 * np.abs(theirs).max(), err_msg=name)
