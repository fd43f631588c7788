"""A stop that throws a motion back between one reading and the next shows where the motion turns, and hardly how hard
it is: that is said with it. Of a stop that is read several times inside, and of one never reached, nothing is."""

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis._hard_stops import hardly_entered
from symplearn.diagnosis._outlook import Outlook
from symplearn.diagnosis._trajectory import Stepper
from symplearn.diagnosis._weighed import Estimate

TIMES = np.arange(0.0, 15.0, 0.05)


def said(stiffness, side="upper", place=0.6, every=1):
    """What is said of a stop in a spring of period pi, which runs into it at speed and is in it for half the period of
    that: pi / sqrt(4 + k); one row in so many holds a reading."""
    y = np.where(np.arange(len(TIMES)) % every == 0, np.cos(TIMES), np.nan)
    p = cases.problem(cases.simulation("p**2/2 + 2*q**2"), [cases.recorded(TIMES, y)], 0.005)
    (member,) = [m for m in p.searched if p.candidate(m).effect.name == "contact_stop" and p.candidate(m).side == side]
    z = np.zeros(p.size)
    z[:3:2] = (-0.5, -1.6) if side == "lower" else (0.5, 1.6)
    z[p.slots : p.slots + 2] = stiffness, place
    estimate = Estimate((member,), "white", z, 1e-4 * np.eye(p.size), np.ones(1), 0.0, True)
    return hardly_entered([Outlook(Stepper(p), estimate, 0, np.zeros(1))])


@pytest.mark.parametrize(("side", "place"), [("upper", 0.6), ("lower", -0.6)])
def test_less_than_two_readings_inside_are_said(side, place):
    """Contacts of 0.044 time units with readings every 0.05, which turn the motion as a wall would that lies half the
    contact's duration beyond the stop at the speed of the impact."""
    (warning,) = said(5000.0, side, place)
    speed = np.sqrt(1.6**2 + 4 * (0.5**2 - 0.6**2))
    wall = float(warning.split("up to ")[1].split(";")[0])
    assert f"{side} contact stop on q" in warning
    # The deepest of the readings is short of where the motion turns, and four digits are told: 0.0011 was seen.
    assert wall == pytest.approx(np.sign(place) * (0.6 + speed * 0.5 * np.pi / np.sqrt(5004.0)), abs=0.003)


def test_a_stop_that_is_read_inside_is_not_doubted():
    """Contacts of 0.31 time units, six readings each; and a stop outside the motion, which no reading is in."""
    assert said(100.0) == []
    assert said(5000.0, place=2.0) == []


def test_rows_without_a_reading_show_nothing_inside():
    """The same contacts of six rows, of which one in six was read."""
    (warning,) = said(100.0, every=6)
    assert "upper contact stop" in warning
