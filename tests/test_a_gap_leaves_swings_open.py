"""Behind a gap of many swings a fit begins at every swing that the rows before leave open, not at the nearest."""

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis import Options, Restriction, diagnose
from symplearn.diagnosis._calibrate import calibrate
from symplearn.diagnosis._gaps import across_gaps
from symplearn.diagnosis._score import Start
from symplearn.diagnosis._weighed import weigh_white

FREE = "[parameters]\nw2 = { value = 4.0, sd = 0.01 }\n"


def gapped(seed, *ends):
    """Times at random in stretches of ten."""
    rng = np.random.default_rng(seed)
    return np.sort(np.concatenate([rng.uniform(end - 10.0, end, 40) for end in ends])), rng


@pytest.mark.slow
def test_a_weak_damping_is_found_across_gaps():
    """A pendulum, read for ten units of time, again after ninety swings and again after nearly two hundred: by SciPy
    with a damping of 0.002. It is told within its interval, and the held-out rows are missed by the noise."""
    times, rng = gapped(1, 10.0, 310.0, 910.0)
    q = cases.solved(lambda t, x: [x[1], -4 * np.sin(x[0]) - 0.002 * x[1]], [1.5, 0.0], times)[:, 0]
    recording = cases.recorded(times, q + 0.02 * rng.normal(size=len(q)), columns=("a",))
    file = cases.simulation("p**2/2 - w2*cos(q)", observe={"a": "q"}, more=FREE)
    document = diagnose(file, [recording], Options(restriction=Restriction(("viscous_damping",)))).document
    (found,) = document["findings"]
    low, high = found["coefficients"]["c"]["interval95"]
    assert low < 0.002 < high and document["fit"]["after"]["holdout_rmse"]["a"] < 1.5 * 0.02


@pytest.fixture(scope="module", params=[(10.0, 400.0), (10.0, 20.0)], ids=["a gap", "no gap"])
def caught(request):
    """An oscillator that is fitted to its first stretch and as many swings on as that leaves it caught."""
    times, rng = gapped(5, *request.param)
    y = np.cos(2.0 * times) + 0.05 * rng.normal(size=len(times))
    p = cases.problem(cases.simulation("p**2/2 + w2*q**2/2", more=FREE.replace("0.01", "1.0")),
                      [cases.recorded(times, y)], 0.05)  # fmt: skip
    phase = 2.0 * p.rows[0].times
    weigher = cases.weigher(p, np.cos(phase), -2.0 * np.sin(phase))
    z = np.zeros((1, p.size))
    z[0, 0], z[0, p.head] = 1.0, (2.0 - 3 * 2 * np.pi / 390.0) ** 2  # three swings too few
    fits = calibrate(weigher.stepper, z, [()], weigher.found.priors, weigher.rows)
    weigher.found.add(weigh_white(p, fits, weigher.found.priors, weigher.rows)[0])
    return request.param, weigher


def test_it_begins_where_the_readings_go_on(caught):
    """Of an oscillator caught three swings off it comes within a hundredth of a swing; without a gap nothing is
    tried."""
    (_, last), weigher = caught
    start = across_gaps(weigher, ())
    if last < 100:
        assert start is None
        return
    p = weigher.problem
    wrong = weigher.found.of((), "white").z[p.head]
    assert isinstance(start, Start) and abs(np.sqrt(wrong) - 2.0) * last > np.pi
    assert abs(np.sqrt(start.z[p.head]) - 2.0) * last < 0.02 * np.pi
