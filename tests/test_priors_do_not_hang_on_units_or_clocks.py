"""What an effect may be beforehand is the same in any unit, in any order of coordinates, and by any clock."""

from dataclasses import replace

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis._effect_priors import _unit, with_effects
from symplearn.diagnosis._motion import Motion, motion_along
from symplearn.diagnosis._scan import grid
from symplearn.diagnosis._start import priors_without_effects

T = np.linspace(0.0, 20.0, 401)
Q = np.stack([1.3 * np.cos(T), 0.4 * np.sin(1.7 * T + 0.3)], axis=1)
V = np.stack([-1.3 * np.sin(T), 0.68 * np.cos(1.7 * T + 0.3)], axis=1)
MOTION = Motion(Q, V, np.array([1.3, 0.8]), np.ones(2), (T,), np.zeros((2, 0)), np.zeros_like(Q))
PAIR = "p1**2/2 + ({unit})**2*p2**2/2 + k*q1**2/2 + 1.5*(q2/({unit}))**2"


def pair(unit=1.0, clocks=(0.0,)):
    """Two swings, the second one's place in a unit of its own, and recordings that begin at given times."""
    file = cases.simulation(PAIR.format(unit=unit), ("q1", "q2"), ("p1", "p2"), {"y1": "q1", "y2": "q2"},
                            "[parameters]\nk = 1.0")  # fmt: skip
    runs = [cases.recorded(T + t, Q * [1.0, unit], number=k + 1) for k, t in enumerate(clocks)]
    return cases.problem(file, runs, 0.05)


def priors_of(problem, unit=1.0):
    bare, still = priors_without_effects(problem), np.zeros_like(T)
    path = np.stack([Q[:, 0], unit * Q[:, 1], still, V[:, 0], V[:, 1] / unit, still], axis=1)
    paths = [path] * len(problem.rows)
    return with_effects(problem, bare, motion_along(problem, bare.mean, paths))


def candidate(problem, effect, *targets):
    return next(c for c in problem.equations.candidates if c.effect.name == effect and c.targets == targets)


def member(problem, effect, recordings):
    return next(
        m for m, one in enumerate(problem.members)
        if problem.candidate(m).effect.name == effect and one.recordings == recordings
    )  # fmt: skip


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_a_gyroscopic_force_of_a_length_and_an_angle_is_as_strong_in_any_unit(unit):
    """F1 = b v2 and F2 = -b v1: where the second place is counted in another unit, b is by as much the other way."""
    one = candidate(pair(), "gyroscopic_coupling", "q1", "q2")
    other = replace(MOTION, q=Q * [1, unit], v=V * [1, unit], forces=MOTION.forces / [1, unit])
    (plain,), (scaled,) = _unit(MOTION, one), _unit(other, one)
    assert scaled == pytest.approx(plain / unit)


def test_a_central_correction_does_not_hang_on_axes():
    """Nor on which coordinate comes first: of a circle that the axes turn about, forces and all."""
    one, turn = candidate(pair(), "central_correction", "q1", "q2"), np.deg2rad(35.0)
    q = np.stack([2.0 * np.cos(T), 0.5 * np.sin(T)], axis=1)
    scales = []
    for axes in (np.eye(2), np.eye(2)[::-1], [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]):
        moved = q @ np.transpose(axes)
        forces = np.sqrt((moved**2).mean(0))  # of an even spring
        scales.append(_unit(replace(MOTION, q=moved, v=moved, forces=forces), one)[0])
    assert scales == pytest.approx([scales[0]] * 3)


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_an_unseen_oscillator_does_not_hang_on_the_unit_of_another_coordinate(unit):
    """How it may begin is told by the coordinate that it hangs on alone."""
    plain, scaled = (priors_of(pair(u), u).starts_of(candidate(pair(u), "hidden_oscillator", "q1")) for u in (1, unit))
    np.testing.assert_allclose(scaled, plain, rtol=1e-6)  # the slope of a force is by a difference


@pytest.mark.parametrize("effect", ["impulse", "regime_change"])
def test_when_something_came_is_told_by_its_own_recording(effect):
    """What is in the first of two recordings came while that was read, whatever the clock of the other says."""
    found = []
    for clock in (0.0, 100.0, 1e4):
        problem = pair(clocks=(5.0, clock))
        priors, m = priors_of(problem), member(pair(clocks=(5.0, clock)), effect, (0,))
        place = dict(problem.placed((m,)))[m].stop - 1
        bounds = [one[place] for one in priors.bounds_of(problem, (m,))]
        found.append([priors.mean_of(problem, (m,))[place], priors.precision_of(problem, (m,))[place], *bounds])
    np.testing.assert_allclose(found, [[15.0, 12 / 20.0**2, 5.0, 25.0]] * 3, rtol=1e-12)


def test_nothing_is_looked_for_between_recordings():
    """Times that are tried lie where something is read, as densely in one recording as in the other."""
    problem = pair(clocks=(0.0, 1e4))
    whole = problem.whole(member(problem, "impulse", (0,)))
    tried = np.sort([unit.place for unit in grid(problem, priors_of(problem), whole)])
    first, second = tried[tried < 5e3], tried[tried > 5e3]
    assert len(first) == len(second) > 10 and 0 < first[0] and first[-1] < 20 and 1e4 < second[0] < second[-1] < 10020
    assert np.ptp(np.diff(first)) < 1e-9 and np.diff(first)[0] == pytest.approx(np.diff(second)[0])


def test_frequencies_are_told_apart_as_one_recording_tells_them():
    """Where clocks lie so far apart that all together resolve more than can be tried, places stay evenly spaced."""
    problem = pair(clocks=(0.0, 1e4))
    whole = problem.whole(member(problem, "periodic_forcing", (0,)))
    tried = np.sort([unit.place for unit in grid(problem, priors_of(problem), whole)])
    assert np.diff(tried).max() < 2 * np.pi / 20 and tried[-1] == pytest.approx(np.pi / (2 * 0.05))
