"""Starts are chosen recording by recording: what begins one of them well need not begin the others."""

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis._calibrate import Fits
from symplearn.diagnosis._start import _recombined, without_turns
from symplearn.diagnosis._trajectory import Stepper

TIMES = np.linspace(0.0, 2.0, 9)
GOOD = [np.array([1.0, 0.0]), np.array([-0.4, 0.7])]


def swing(start):
    """The unit oscillator, in closed form."""
    return start[0] * np.cos(TIMES) + start[1] * np.sin(TIMES)


def test_the_first_lane_begins_every_recording_well():
    """Of two lanes, each right for one of two recordings, comes one that is right for both and one wrong for both."""
    file = cases.simulation("p**2/2 + a*q**2/2", more="[parameters]\na = { value = 1.0 }")
    runs = [cases.recorded(TIMES, swing(start), number=k + 1) for k, start in enumerate(GOOD)]
    problem = cases.problem(file, runs, 0.25)
    q, p = np.array([0, 1]) * problem.equations.width
    bad = np.array([0.1, 0.1])
    z = np.zeros((2, problem.size))
    z[:, problem.head] = [1.0, 1.001]
    for lane in range(2):
        for r in range(2):
            z[lane, r * problem.state + np.array([q, p])] = GOOD[r] if r == lane else bad
    rows = [len(TIMES)] * 2
    predictions = Stepper(problem).predict(z, [(), ()], rows)
    fits = Fits([(), ()], z, np.ones((2, 1)), predictions, np.zeros(2), np.ones(2, bool))
    found = _recombined(problem, fits, rows)
    for r in range(2):
        own = r * problem.state + np.array([q, p])
        np.testing.assert_array_equal(found[:, own], [GOOD[r], bad])
    # The calibrated value is that of the lane that begins the first recording.
    np.testing.assert_array_equal(found[:, problem.head], [1.0, 1.001])


WOUND = 0.4 - 4 * np.pi


@pytest.mark.parametrize(
    ("hamiltonian", "observe", "more", "expected"),
    [
        ("pa**2/2 + pb**2/2 - cos(a) - cos(b - a)", {"y": "b"}, "", 0.4),
        ("pa**2/2 + pb**2/2 - cos(a) - cos(b - a)", {"y": "sin(b)"}, "", 0.4),
        ("pa**2/2 + pb**2/2 - cos(a) - cos(b - a)", {"y": "a", "z": "b"}, "", WOUND),
        ("pa**2/2 + pb**2/2 - cos(a) + (b - a)**2", {"y": "sin(b)"}, "", WOUND),
        ("pa**2/2 + pb**2/2 - cos(a) - cos(b - a)", {"y": "sin(b)"}, "[initial]\na = { value = 0.0, sd = 0.1 }", WOUND),
    ],
    ids=["unread", "no angle is read", "read", "a spring", "known"],
)
def test_an_angle_that_nothing_reads_is_not_wound_up(hamiltonian, observe, more, expected):
    """Two whole turns are taken off where they change neither motion nor readings, and nowhere else."""
    file = cases.simulation(hamiltonian, ("a", "b"), ("pa", "pb"), observe, more)
    readings = np.zeros((len(TIMES), len(observe)))
    problem = cases.problem(file, [cases.recorded(TIMES, readings, columns=tuple(observe))], 0.25)
    z = np.zeros(problem.size)
    z[:2] = WOUND, 0.3
    found = without_turns(problem, z)
    assert found[0] == pytest.approx(expected, abs=1e-12)  # round-off of the remainder
    np.testing.assert_array_equal(found[1:], z[1:])
