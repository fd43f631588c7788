"""A sensor that is late shows the motion of the time before, under the inputs of that time."""

import engine_cases as cases
import numpy as np
import pytest
from scipy.linalg import expm

from symplearn._inputs import Inputs
from symplearn._rows import known_inputs
from symplearn.diagnosis._build import augmented_equations
from symplearn.diagnosis._course import courses
from symplearn.diagnosis._forecast import _ahead
from symplearn.diagnosis._stochastic import free_run

GAP, K, C = 0.2, 4.0, 0.1
TIMES = GAP * np.arange(41)
PUSH = np.random.default_rng(5).choice([-1.0, 1.0], len(TIMES))
START = np.array([0.3, -0.2])


def recorded(interpolation, rows=slice(None)):
    """A recording of nothing, pushed one way or the other, anew in every row."""
    inputs = Inputs(TIMES, PUSH[:, None], interpolation)
    return cases.recorded(TIMES[rows], np.zeros((len(TIMES[rows]), 1)), inputs, columns=("y",))


def simulation(tau):
    return cases.simulation(
        f"p**2/2 + {K}*q**2/2", ["q"], ["p"], {"y": "q"},
        f'[forces]\np = "-{C}*p + u"\n[[terms]]\neffect = "sensor_delay"\ntarget = "y"\ntau = {tau}\n',
        'inputs = ["u"]',
    )  # fmt: skip


def moved(x, time, begin, end):
    """A phase point after a time in which the push goes evenly from one value to another: a matrix exponential."""
    rates = np.zeros((4, 4))
    rates[:2] = [[0.0, 1.0, 0.0, 0.0], [-K, -C, 1.0, 0.0]]
    rates[2, 3] = 1.0
    slope = (end - begin) / time if time else 0.0
    return (expm(rates * time) @ [*x, begin, slope])[:2]


def positions(times, interpolation):
    """The position at times after the start, from row to row."""
    after = PUSH if interpolation == "hold" else np.append(PUSH[1:], PUSH[-1])
    points = [START]
    for k in range(len(TIMES) - 1):
        points.append(moved(points[-1], GAP, PUSH[k], after[k]))
    out = []
    for t in times:
        k = min(int(t / GAP + 1e-9), len(TIMES) - 1)
        share = t / GAP - k
        out.append(moved(points[k], share * GAP, PUSH[k], PUSH[k] + share * (after[k] - PUSH[k]))[0])
    return np.array(out)


@pytest.mark.parametrize("interpolation", ["hold", "linear"])
@pytest.mark.parametrize("rows", [0.0, 0.3, 1.0, 2.5, 4.0, 5.5])
def test_a_delay_of_some_rows_is_gone_back_under_the_inputs_of_then(rows, interpolation):
    """A spring that is pushed one way or the other in every row is shown as it was then, even where the delay is longer
    than one that is searched for: the position by matrix exponentials."""
    problem = cases.problem(simulation(rows * GAP), [recorded(interpolation)], 0.05)
    z = np.zeros(problem.size)
    z[[0, problem.state // 2]] = START
    (course,) = courses(problem)
    shown = free_run(problem, course, z, (), 0, z[: problem.state], 0)[0][6:, 0]  # from there on all of it was recorded
    expected = positions(TIMES[6:] - rows * GAP, interpolation)
    # Inputs are known by their means over pieces of a quarter of a row and more, which eight steps back cut anew. Seen:
    # 0.1, 0.2, 0.5, 1.1 and 2.1 % of the swing; under the inputs of its own reading 1, 11, 67, 153 and 237 %.
    assert np.abs(shown - expected).max() < (0.003 + 0.0045 * rows) * np.abs(expected).max()


def test_a_forecast_knows_the_same_of_its_inputs():
    """What a row that is forecast knows of the inputs before it is what a row of a recording does."""
    file, whole, some = simulation(0.1), recorded("hold"), recorded("hold", slice(0, 30))
    problem, longer = (cases.problem(file, [one], 0.05) for one in (some, whole))
    _, times, known = _ahead(problem, some, TIMES[30:], 1)
    np.testing.assert_array_equal(times, TIMES[30:])
    # Round-off of means: differences of integrals.
    np.testing.assert_allclose(known, longer.rows[0].inputs[30:], atol=1e-12)


def test_what_is_known_is_what_was_pushed():
    """Pieces of the time before hold the inputs' means in them, the latest first, and before they are known what they
    begin with; sensors that cannot be late know no more than how the inputs stand."""
    inputs = Inputs(TIMES, PUSH[:, None], "hold")
    known = known_inputs(inputs, TIMES[:9], 20 * GAP)
    np.testing.assert_array_equal(known[:, 0], PUSH[:9])
    np.testing.assert_allclose(known[:, 1], GAP, rtol=1e-15)
    before = np.concatenate([np.full(20, PUSH[0]), PUSH])
    for k, pieces in enumerate(known[:, 2:]):
        # Round-off of differences of integrals.
        np.testing.assert_allclose(pieces, before[k : k + 20][::-1], atol=1e-12)
    assert known_inputs(inputs, TIMES, None).shape == (len(TIMES), 1)
    plain = cases.simulation("p**2/2 + q**2/2", ["q"], ["p"], {"y": "q"}, '[forces]\np = "u"\n', 'inputs = ["u"]')
    assert augmented_equations(plain).delayed
