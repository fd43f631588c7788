"""A simulation of which the readings show nothing is neither consistent with them nor repaired by a dead sensor."""

from dataclasses import replace

import engine_cases as cases
import numpy as np
import pytest
from scipy.stats import norm

from symplearn.diagnosis import Options, Restriction, diagnose
from symplearn.diagnosis._calibrate import THINNED
from symplearn.diagnosis._constant import constant_evidence
from symplearn.diagnosis._weighed import Estimate

TIMES = np.linspace(0.0, 20.0, 80)


def noisy(seed=3):
    return np.random.default_rng(seed).normal(size=len(TIMES))


def read(noise=""):
    """Two columns of what is no motion, one with a gap, and their problem."""
    y = np.stack([3.0 + 0.1 * noisy(1), -2.0 + 0.4 * noisy(2)], axis=1)
    y[5:9, 1] = np.nan
    file = cases.simulation("p**2/2 + q**2/2", observe={"a": "q", "b": "p"}, more=noise)
    return y[:60], cases.problem(file, [cases.recorded(TIMES, y)], 0.05, 0.25)


def test_constants_are_weighed_as_gaussians():
    """By SciPy, over the fitted rows: each column about its own mean, with the likeliest noise or the one that is
    given, less half the logarithm of how many readings it has."""
    for given in (None, 0.3):
        y, p = read("" if given is None else f"[recording.noise]\nb = {given}\n")
        expected = 0.0
        for column, sd in zip(y.T, (None, given), strict=True):
            seen = column[~np.isnan(column)]
            expected += norm.logpdf(seen, seen.mean(), sd or seen.std()).sum() - 0.5 * np.log(len(seen))
        assert constant_evidence(p, None) == pytest.approx(expected, rel=1e-12)


def test_a_row_of_averages_counts_as_one_with_less_noise():
    """Rows that average as many readings as tell what four would: SciPy's Gaussians of half the noise."""
    y, p = read("[recording.noise]\na = 0.1\nb = 0.4\n")
    p = replace(p, rows=(replace(p.rows[0], counts=4.0 * THINNED * p.rows[0].counts),))
    expected = 0.0
    for column, sd in zip(y.T, (0.1, 0.4), strict=True):
        seen = column[~np.isnan(column)]
        expected += norm.logpdf(seen, seen.mean(), sd / 2).sum() - 0.5 * np.log(len(seen))
    assert constant_evidence(p, None) == pytest.approx(expected, rel=1e-12)


def test_a_sensor_that_stands_still_is_not_compared():
    """One value throughout tells no noise: nothing is then held against the simulation."""
    file = cases.simulation("p**2/2 + q**2/2", observe={"a": "q", "b": "p"})
    p = cases.problem(file, [cases.recorded(TIMES, np.stack([np.cos(TIMES), np.ones(80)], axis=1))], 0.05, 0.25)
    assert constant_evidence(p, None) == -np.inf


def test_constants_are_ahead_by_no_more_than_they_follow_the_readings():
    """Of a simulation that follows them by three nats less, however much it owes for a start that is little known; of
    one that follows them better, not at all."""
    _, p = read()
    bare = Estimate((), "white", np.zeros(1), np.zeros((1, 1)), np.ones(2), -500.0, True)
    best = constant_evidence(p, None) + 0.5 * (np.log(60) + np.log(56))
    assert constant_evidence(p, replace(bare, log_likelihood=best - 3.0)) == pytest.approx(-497.0, rel=1e-12)
    assert constant_evidence(p, replace(bare, log_likelihood=best + 3.0)) == pytest.approx(-503.0, rel=1e-12)


@pytest.mark.slow
def test_a_piece_of_the_motion_is_no_mismatch():
    """A tenth of a period, in a noise nearly as large as what is seen of it: consistent, though constants do as well,
    which is said."""
    times = np.linspace(0.0, 0.6, 24)
    y = np.cos(times) + 0.1 * np.random.default_rng(5).normal(size=24)
    file = cases.simulation("p**2/2 + q**2/2")
    document = diagnose(
        file, [cases.recorded(times, y)], Options(restriction=Restriction(("viscous_damping",)))
    ).document
    assert document["verdict"] == "consistent" and document["probability"] > 0.5
    assert any("constants and noise tell the readings as well" in one for one in document["warnings"])
    assert "in which the simulated motion is seen" in document["next_measurement"]


def pendulum(start):
    """A pendulum that is said to start somewhere, and the recording of one that starts at 1.2 rad; the noise of the
    sensor is not given."""
    y = cases.solved(lambda t, x: [x[1], -np.sin(x[0])], [1.2, 0.0], TIMES)[:, 0] + 0.01 * noisy()
    file = cases.simulation("p**2/2 - cos(q)", more=f"[initial]\nq = {start}\np = 0.0")
    return file, [cases.recorded(TIMES, y)]


@pytest.mark.slow
def test_a_start_in_another_unit_is_no_agreement():
    """Degrees given as radians, so that the simulation has nothing in common with what was read: the verdict is
    `unexplained`, not a noise as large as the misfit, nor a sensor that shows nothing, and what to check is said."""
    only = Restriction(("sensor_gain", "viscous_damping"))
    document = diagnose(*pendulum(68.75), Options(restriction=only)).document
    assert document["verdict"] == "unexplained" and document["findings"] == []
    assert any("constants and noise tell the readings as well" in one for one in document["warnings"])
    assert document["location"]["where"].endswith("so that nothing is located")


def test_a_start_that_is_right_is_agreement():
    """The same with the start as it was: consistent, without such a warning."""
    document = diagnose(*pendulum(1.2), Options(restriction=Restriction(("sensor_gain", "viscous_damping")))).document
    assert document["verdict"] == "consistent"
    assert not any("constants" in one for one in document["warnings"])


@pytest.mark.slow
def test_a_sensor_the_wrong_way_round_is_found():
    """A scale of -1 is no dead sensor: the gain is -2 to within its interval, and said as an opposite sign."""
    file, (recording,) = pendulum(1.2)
    turned = cases.recorded(TIMES, -recording.readings[:, 0])
    document = diagnose(file, [turned], Options(restriction=Restriction(("sensor_gain",)))).document
    (gain,) = document["findings"]
    low, high = gain["coefficients"]["g"]["interval95"]
    assert low < -2.0 < high and "with the opposite sign" in gain["sentence"]


def test_a_recording_given_twice_is_said_to_be_the_same():
    """Copies count twice, and the answer says which recordings they are."""
    file, (recording,) = pendulum(1.2)
    twice = [recording, replace(recording, number=2)]
    document = diagnose(file, twice, Options(restriction=Restriction(("viscous_damping",)))).document
    assert any("recordings 1 and 2 hold the same numbers" in one for one in document["warnings"])
    single = diagnose(file, [recording], Options(restriction=Restriction(("viscous_damping",)))).document
    assert not any("same numbers" in one for one in single["warnings"])
