"""Where a column or the time is in another unit, turned round, or in another's place, a warning says what to check."""

import itertools
import re
import time
from functools import partial

import engine_cases as cases
import numpy as np
import pytest

from symplearn._inputs import Inputs
from symplearn._progress import Progress
from symplearn.diagnosis import Options, diagnose
from symplearn.diagnosis._build import Restriction
from symplearn.diagnosis._found import Found
from symplearn.diagnosis._other_units import in_other_units
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._trajectory import Stepper

TIMES = np.linspace(0.0, 8.0, 160)
# What the files say is wrong whatever is searched; two effects are a quick search, one of them with a body of its own.
TWO = Restriction(("viscous_damping", "hidden_oscillator"))


def swing(damping=0.05):
    """A pendulum's angle with a little damping, of w^2 = 20, read to 0.008 rad."""
    motion = cases.solved(lambda t, x: [x[1], -20 * np.sin(x[0]) - damping * x[1]], [0.8, 0.0], TIMES)
    return motion[:, 0] + 0.008 * np.random.default_rng(5).normal(size=len(TIMES))


def thrown():
    """A ball thrown without air, read to 0.01 m."""
    t = np.linspace(0.0, 1.2, 80)
    exact = np.stack([3.0 * t, 1.0 + 5.0 * t - 4.905 * t**2], axis=1)
    return t, exact + 0.01 * np.random.default_rng(6).normal(size=exact.shape)


def asked(file, times, readings, columns=None):
    """The warnings of a diagnosis, and what was said on the way."""
    said = []
    options = Options(restriction=TWO, progress=said.append, jobs=2)
    found = diagnose(file, [cases.recorded(times, readings, columns=columns)], options)
    return found.document["warnings"], said


OPEN = cases.simulation("p**2/2 - w*cos(q)", more="[parameters]\nw = { value = 19.8, sd = 0.3 }")
PENDULUM = cases.simulation("p**2/2 - 20*cos(q)")
BALL = cases.simulation("(px**2 + py**2)/2 + 9.81*y", ("x", "y"), ("px", "py"), {"a": "x", "b": "y"})


@pytest.mark.slow
def test_degrees_for_radians_are_told():
    """A pendulum read in degrees, whose simulation has radians, is told to be that, first of all warnings."""
    warnings, _ = asked(PENDULUM, TIMES, np.degrees(swing()))
    assert warnings[0].startswith("with y0 divided by 57.3 (degrees for radians) the simulation misses")


MILLISECONDS = "with t_s divided by 1000 (milliseconds for seconds)"


@pytest.mark.slow
def test_milliseconds_for_seconds_are_told():
    """So are times in milliseconds."""
    warnings, _ = asked(PENDULUM, 1000 * TIMES, swing())
    assert warnings[0].startswith(MILLISECONDS)


@pytest.mark.slow
def test_milliseconds_are_told_where_another_gravity_follows_them():
    """So are they where the simulation follows them with a calibrated value that its prior rules out."""
    times = 0.005 * np.arange(600)
    motion = cases.solved(lambda t, x: [x[1], -21.8 * np.sin(x[0]) - 0.03 * x[1]], [0.8, 0.0], times)[:, 0]
    readings = motion + 0.004 * np.random.default_rng(3).normal(size=len(times))
    known = "[parameters]\nw = { value = 21.6, sd = 0.3 }\n[recording.noise]\ny0 = 0.004"
    file = cases.simulation("p**2/2 - w*cos(q)", observe={"y0": "q"}, more=known)
    options = Options(restriction=Restriction(("viscous_damping",)), jobs=2)
    warnings = diagnose(file, [cases.recorded(1000 * times, readings)], options).document["warnings"]
    assert warnings[0].startswith(MILLISECONDS)


class Stopped(Exception):
    """A person stops the work, having read something."""


@pytest.mark.slow
def test_milliseconds_are_noticed_before_the_search():
    """Before the search, which takes many times as long as with seconds, a notice tells of milliseconds; none tells of
    seconds."""

    def stop(message):
        raise Stopped(message)

    def begins(message):
        if "following the recording" in message:
            raise Stopped("the search begins")

    options = Options(restriction=TWO, progress=begins, notice=stop, jobs=2)
    for unit, said in ((1000, MILLISECONDS), (1, "the search begins")):
        with pytest.raises(Stopped, match=re.escape(said)):
            diagnose(OPEN, [cases.recorded(unit * TIMES, swing())], options)


def test_a_notice_stays_on_stderr(capsys):
    """A notice is a line of its own on stderr, from the first second on."""
    with Progress() as progress:
        progress.notice("stop here")
    assert capsys.readouterr().err == "Notice: stop here\n"


@pytest.mark.slow
@pytest.mark.parametrize("said, change", [
    ("with the sign of b turned round", lambda r: r * [1.0, -1.0]),
    ("with a and b exchanged", lambda r: r[:, ::-1]),
    ("with a and b divided by 1000 (thousandths for units)", lambda r: 1000 * r),
])  # fmt: skip
def test_signs_columns_and_millimetres_are_told(said, change):
    """Heights that count downwards, columns in each other's place, and a ball read in millimetres."""
    times, readings = thrown()
    warnings, _ = asked(BALL, times, change(readings), columns=("a", "b"))
    assert warnings[0].startswith(said)


@pytest.mark.slow
@pytest.mark.parametrize("tilt, said", [
    (0.0, "with the sign of y0, or of what drives it, turned round the simulation misses"),
    (4.0, "with the sign of the input u turned round the simulation misses"),
])  # fmt: skip
def test_an_input_that_pushes_the_other_way_is_told(tilt, said):
    """A pendulum is pushed hard to one side and to the other, and its file has every push the other way; of one that
    hangs straight that is as if it were read the other way."""
    push = 12.0 * np.sign(np.sin(1.3 * TIMES + 0.4))
    x, motion = np.array([0.3, 0.0]), []
    for (a, b), u in zip(itertools.pairwise(TIMES), push, strict=False):
        motion.append(x[0])
        x = cases.solved(partial(pushed, u + tilt), x, np.array([a, b]))[-1]
    read = np.append(motion, x[0]) + 0.008 * np.random.default_rng(8).normal(size=len(TIMES))
    file = cases.simulation(f"p**2/2 - 20*cos(q) - (u + {tilt})*q", recording='inputs = ["u"]')
    recording = cases.recorded(TIMES, read, Inputs(TIMES, -push[:, None], "hold"))
    warnings = diagnose(file, [recording], Options(restriction=TWO, jobs=2)).document["warnings"]
    assert warnings[0].startswith(said)


def pushed(torque, _, x):
    return [x[1], -20 * np.sin(x[0]) + torque]


@pytest.mark.parametrize(("left", "said"), [(np.inf, ["with y0 divided by 57.3"]), (-1.0, [])])
def test_no_unit_is_tried_once_time_has_run_out(left, said):
    """Conversions take as long as a search where starts are hard to find: the time limit holds for them, too."""
    recordings = [cases.recorded(TIMES, np.degrees(swing()))]
    problem = cases.problem(PENDULUM, recordings, 0.05)
    found = Found(problem, priors_without_effects(problem))  # nothing was weighed: nothing follows the recording
    warnings = in_other_units(PENDULUM, recordings, Stepper(problem), found, Options(), time.monotonic() + left)
    assert [one[: len(start)] for one, start in zip(warnings, said, strict=True)] == said


def test_no_unit_is_tried_for_a_column_of_hardly_more_than_noise():
    """Of two readings of a swing one is mostly noise: whatever follows the other misses it, by nothing but that."""
    faint = 0.02 * swing() + 0.03 * np.random.default_rng(7).normal(size=len(TIMES))
    file = cases.simulation("p**2/2 - 20*cos(q)", observe={"y0": "q", "y1": "0.02*q"})
    warnings, said = asked(file, TIMES, np.stack([swing(), faint], axis=1))
    assert not any("unit" in one for one in said) and not any("divided by" in one for one in warnings)


@pytest.mark.slow
def test_no_unit_is_tried_where_nothing_as_strong_as_all_that_is_there_is_missing():
    """Where a strong damping, or nothing, is missing nothing is converted; where a force as strong as those there is,
    which no other unit explains, no warning speaks of units."""
    for readings in (swing(damping=1.0), swing(damping=0.0)):
        warnings, said = asked(PENDULUM, TIMES, readings)
        assert not any("another unit" in one for one in said) and not any("check units" in one for one in warnings)
    bent = cases.solved(lambda t, x: [x[1], -20 * np.sin(x[0]) - 60 * x[0] ** 3], [0.8, 0.0], TIMES)[:, 0]
    warnings, said = asked(PENDULUM, TIMES, bent + 0.008 * np.random.default_rng(7).normal(size=len(TIMES)))
    assert not any("check units" in one for one in warnings)
