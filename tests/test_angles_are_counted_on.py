"""An angle that was recorded within one turn is counted on over whole turns; one that the simulation keeps within a
turn loses the two readings beside a jump, where noise decides on which side they fall."""

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis import Options, Restriction, diagnose
from symplearn.diagnosis._turns import unwrapped

TIMES = np.linspace(0.0, 10.0, 101)
ROTOR = "p**2/2 - 0.5*cos(q)"


def rotor(observe, energy=ROTOR, more=""):
    return cases.simulation(energy, observe={"a": observe}, more=more)


def turned(readings, file):
    (one,), told = unwrapped(file, [cases.recorded(TIMES, readings, columns=("a",))])
    return one.readings[:, 0], told


@pytest.mark.parametrize(("observe", "turn"), [("q", 2 * np.pi), ("q*180/pi + 5", 360.0), ("-q/pi", 2.0)])
def test_what_was_wrapped_comes_back(observe, turn):
    """In any unit, with gaps: what NumPy takes modulo a turn is what it was, but for whole turns."""
    angle = turn * (0.3 + 0.45 * TIMES)
    angle[40:43] = np.nan
    found, told = turned(angle % turn, rotor(observe))
    assert np.ptp((found - angle)[~np.isnan(angle)]) < 1e-9 * turn  # round-off
    assert np.array_equal(np.isnan(found), np.isnan(angle)) and f"({turn:.6g})" in told[0]


def test_a_sensor_term_of_a_column_of_the_same_name_leaves_an_angle_be():
    """A bias of the column q is no force on the coordinate q."""
    bias = '[[terms]]\neffect = "sensor_bias"\ntarget = "q"\nb = 0.15'
    file = cases.simulation(ROTOR, observe={"q": "q"}, more=bias)
    angle = 2 * np.pi * (0.3 + 0.45 * TIMES)
    found, told = turned(angle % (2 * np.pi), file)
    assert np.ptp(found - angle) < 1e-9 and len(told) == 1


def test_what_is_kept_within_a_turn_loses_what_stands_beside_a_jump():
    """Of a reading that the simulation itself wraps."""
    angle = np.angle(np.exp(1j * 0.45 * 2 * np.pi * TIMES))
    found, (told,) = turned(angle, rotor("atan2(sin(q), cos(q))"))
    jumps = np.flatnonzero(np.abs(np.diff(angle)) > np.pi)
    gone = np.unique(np.concatenate([jumps, jumps + 1]))
    assert np.array_equal(np.flatnonzero(np.isnan(found)), gone)
    assert np.array_equal(np.delete(found, gone), np.delete(angle, gone)) and f"{len(jumps)} times" in told


SILENT = {
    "no jump": (2.5 * np.sin(TIMES), rotor("q")),
    "a rotor that was counted on, read once in a turn and a half": (1.5 * 2 * np.pi * np.arange(101.0), rotor("q")),
    "a wide swing, read four times in a period": (2.9 * np.sin(0.5 * np.pi * np.arange(101) + 0.4), rotor("q")),
    "a length": (2 * np.pi * (0.45 * TIMES % 1.0), rotor("q", "p**2/2 + q**2/2")),
    "a spring winds up": (2 * np.pi * (0.45 * TIMES % 1.0), rotor("q", more="""
[[terms]]
effect = "linear_stiffness"
target = "q"
k = 0.1
""")),
    "an activity of the file goes with the place": (2 * np.pi * (0.45 * TIMES % 1.0), rotor("q", more="""
[[terms]]
effect = "self_excitation"
target = "q"
c = 0.1
a = 1.0
""")),
    "a scale that is not known": (
        2 * np.pi * (0.45 * TIMES % 1.0), rotor("s*q", more="[parameters]\ns = { value = 1.0, sd = 0.1 }")),
    "a force of the file winds up": (2 * np.pi * (0.45 * TIMES % 1.0), rotor("q", more='[forces]\np = "-0.1*q"')),
    "the sine of an angle": (np.sin(7 * TIMES) * np.pi, rotor("pi*sin(q)")),
}  # fmt: skip


@pytest.mark.parametrize("case", SILENT)
def test_what_is_no_angle_stays(case):
    """Nothing is changed and nothing said."""
    readings, file = SILENT[case]
    found, told = turned(readings, file)
    assert told == [] and np.array_equal(found, readings)


def test_a_rotor_read_within_a_turn_is_consistent():
    """A rotor by SciPy, in degrees from 0 to 360: the verdict is that of the same angle counted on, and what was done
    is said."""
    angle = cases.solved(lambda t, x: [x[1], -0.5 * np.sin(x[0])], [0.2, 2.0], TIMES)[:, 0]
    degrees = np.degrees(angle) + np.random.default_rng(3).normal(size=101)
    recording = cases.recorded(TIMES, degrees % 360.0, columns=("a",))
    only = Options(restriction=Restriction(("viscous_damping", "sensor_gain")))
    document = diagnose(rotor("q*180/pi"), [recording], only).document
    assert document["verdict"] == "consistent"
    times = int(angle[-1] / (2 * np.pi))
    assert times > 1 and f"a jumps {times} times by a whole turn (360)" in document["warnings"][0]
