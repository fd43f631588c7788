"""Starts are chosen recording by recording: what begins one of them well need not begin the others."""

import engine_cases as cases
import numpy as np

from symplearn.diagnosis._calibrate import Fits
from symplearn.diagnosis._start import _recombined
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
