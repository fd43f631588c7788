"""A sensor that is late shows the motion of the time before, under the inputs of that time."""

from dataclasses import replace

import engine_cases as cases
import numpy as np
import pytest
from posterior_cases import estimate, found, made, place
from scipy.linalg import expm

from symplearn._inputs import Inputs
from symplearn._rows import known_inputs
from symplearn.diagnosis import Options, Restriction, diagnose
from symplearn.diagnosis._build import augmented_equations
from symplearn.diagnosis._course import courses
from symplearn.diagnosis._effect_priors import with_effects
from symplearn.diagnosis._forecast import _ahead
from symplearn.diagnosis._late import left_out
from symplearn.diagnosis._motion import motion_along
from symplearn.diagnosis._search import Search
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._stochastic import free_run
from symplearn.diagnosis._trajectory import Stepper

GAP, K, C = 0.2, 4.0, 0.1
TIMES = GAP * np.arange(41)
PUSH = np.random.default_rng(5).choice([-1.0, 1.0], len(TIMES))
START = np.array([0.3, -0.2])


def recorded(interpolation, rows=slice(None)):
    """A recording of nothing, pushed one way or the other, anew in every row."""
    inputs = Inputs(TIMES, PUSH[:, None], interpolation)
    return cases.recorded(TIMES[rows], np.zeros((len(TIMES[rows]), 1)), inputs, columns=("y",))


def simulation(tau, reading="q"):
    return cases.simulation(
        f"p**2/2 + {K}*q**2/2", ["q"], ["p"], {"y": reading},
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
    return states(times, interpolation)[:, 0]


def states(times, interpolation):
    """Phase points at times after the start, from row to row."""
    after = PUSH if interpolation == "hold" else np.append(PUSH[1:], PUSH[-1])
    points = [START]
    for k in range(len(TIMES) - 1):
        points.append(moved(points[-1], GAP, PUSH[k], after[k]))
    out = []
    for t in times:
        k = min(int(t / GAP + 1e-9), len(TIMES) - 1)
        share = t / GAP - k
        out.append(moved(points[k], share * GAP, PUSH[k], PUSH[k] + share * (after[k] - PUSH[k])))
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
    # 0.2, 0.5, 0.6, 0.5 and 3.6 % of the swing where inputs are linear, 0.3 and 1.5 % of 2.5 and 5.5 rows where they
    # are held; under the inputs of its own reading 1, 11, 67, 153 and 237 %.
    assert np.abs(shown - expected).max() < (0.003 + 0.007 * rows) * np.abs(expected).max()


def test_a_late_accelerometer_shows_the_push_of_then():
    """Where an input is part of a reading, that of a delay ago is shown: in the middle of a piece of that time, where
    it is the push that was held then."""
    rows = 1.25
    reading, tau = f"u - {K}*q - {C}*p", rows * GAP
    file = simulation(tau, reading)
    problem = cases.problem(file, [recorded("hold")], 0.05)
    z = np.zeros(problem.size)
    z[[0, problem.state // 2]] = START
    (course,) = courses(problem)
    shown = free_run(problem, course, z, (), 0, z[: problem.state], 0)[0][6:, 0]
    points = states(TIMES[6:] - tau, "hold")
    expected = PUSH[4:-2] - points @ [K, C]
    # As above, of the place and the speed alone. Seen: 0.04 %; with the push of its own reading 83 %.
    assert np.abs(shown - expected).max() < 0.01 * np.abs(expected).max()


@pytest.mark.parametrize("every", [1, 10])
def test_how_late_a_sensor_may_be_hangs_on_its_own_readings_and_on_the_motion(every):
    """Five of its own readings, or half the shortest period of the motion where that is longer; whatever other sensors
    and recordings are read as finely."""
    times = 0.01 * np.arange(801)
    seen = np.stack([np.cos(2 * np.pi * times / 0.9), np.sin(2 * np.pi * times / 0.9)], axis=1)
    seen[np.arange(801) % (4 * every) > 0, 1] = np.nan
    file = cases.simulation("p**2/2 + 20*q**2", ["q"], ["p"], {"a": "q", "b": "p"})
    short = cases.recorded(times[:50], seen[:50], number=2, columns=("a", "b"))
    problem = cases.problem(file, [cases.recorded(times, seen, columns=("a", "b")), short], 0.01)
    priors = with_effects(problem, priors_without_effects(problem), motion_along(
        problem, np.zeros(problem.size), [np.zeros((n, problem.state)) for n in (801, 50)]))  # fmt: skip
    late = next(c for c in problem.equations.candidates if c.effect.name == "sensor_delay")
    # The shortest period that stands out of a periodogram is a little shorter than the period. Seen: 0.364.
    low, high = {1: (0.3, 0.45), 10: (1.99, 2.01)}[every]
    assert low < priors.upper[late.first] < high


@pytest.mark.slow
@pytest.mark.parametrize("is_driven", [True, False], ids=["driven", "let go"])
def test_what_a_late_sensor_shows_of_the_time_before_is_left_out(is_driven):
    """Nobody knows what pushed a spring before its recording, nor how long a body was held that is let go: the delay
    is told alone, and that its first readings were left out."""
    tau, rng = 0.42, np.random.default_rng(3)
    before = np.append(rng.choice([-1.0, 1.0], 10), PUSH)  # ten rows that are not recorded
    if is_driven:
        points = [START]
        for k in range(len(before) - 1):
            points.append(moved(points[-1], GAP, before[k], before[k]))
        share = 3 - tau / GAP  # from the third row before each reading
        at = [moved(points[k - 3], share * GAP, before[k - 3], before[k - 3])[0] for k in range(10, len(before))]
    else:
        at = [moved([0.5, 0.0], max(t - tau, 0.0), 0.0, 0.0)[0] for t in TIMES]
    inputs = Inputs(TIMES, PUSH[:, None] * is_driven, "hold")
    noisy = np.array(at) + 0.002 * rng.normal(size=len(TIMES))
    second = [] if is_driven else [moved([0.5, 0.0], t, 0.0, 0.0)[1] + 0.002 * rng.normal() for t in TIMES]
    columns = ("y", "v")[: 2 - is_driven]
    file = cases.simulation(
        f"p**2/2 + {K}*q**2/2", ["q"], ["p"], dict(zip(columns, "qp", strict=False)),
        f'[forces]\np = "-{C}*p + u"\n[recording.noise]\n' + "\n".join(f"{c} = 0.002" for c in columns),
        'inputs = ["u"]',
    )  # fmt: skip
    readings = np.stack([noisy, second], axis=1) if second else noisy
    recording = cases.recorded(TIMES, readings, inputs, columns=columns)
    named = ("sensor_delay", "impulse", "constant_force", "regime_change")
    told = diagnose(file, [recording], Options(restriction=Restriction(named))).document
    assert [(f["effect"], f["target"]) for f in told["findings"]] == [("sensor_delay", "y")]
    tau_told = told["findings"][0]["coefficients"]["tau"]
    assert told["probability"] > 0.9 and abs(tau_told["mean"] - tau) < 4 * tau_told["sd"]
    (said,) = [one for one in told["warnings"] if "left out" in one]
    assert said.startswith("the sensor of y is late: its first readings, 3 in all")


def test_what_is_told_of_it_is_what_the_answer_says():
    """Where a delay was the likeliest at first and is none of the answer, the sensor is told to have seemed late."""
    problem = made(1)
    given = cases.recorded(np.arange(10.0), np.ones((10, 2)), columns=("a", "b"))
    used = replace(given, readings=np.where(np.arange(10)[:, None] < [0, 2], np.nan, 1.0))
    delay = place(problem, "sensor_delay", "b")
    late = estimate(problem, (delay,), 20.0)
    late.z[dict(problem.placed((delay,)))[delay]] = 1.5
    for best, how in (((), "seemed to be late"), ((delay,), "is late")):
        estimates = [estimate(problem, (), 100.0 if best == () else 0.0), late]
        (told,) = left_out(problem, found(problem, *estimates), [given], [used])
        assert told.startswith(f"the sensor of b {how}: its first readings, 2 in all")
    assert left_out(problem, found(problem, late), [given], [given]) == []


def test_the_search_without_that_takes_up_what_was_found_before():
    """What an earlier search thought likely is fitted again, from where it was, to the readings that are used now; what
    was far behind it, and what another choice of outliers had, is not."""
    times = np.linspace(0.0, 12.0, 60)
    drag = cases.solved(lambda t, x: [x[1], -x[0] - 0.1 * np.abs(x[1]) * x[1]], [1.0, 0.0], times)[:, 0]
    problem = cases.problem(cases.simulation("p**2/2 + q**2/2"), [cases.recorded(times, drag)], 0.05)
    alone = {problem.candidate(m).effect.name: (m,) for m in problem.searched}
    begun = [estimate(problem, alone[name], gain) for name, gain in (
        ("quadratic_drag", 50.0), ("cubic_stiffness", -50.0), ("sensor_outliers", 50.0))]  # fmt: skip
    begun[0].z[[0, problem.slots]] = 0.9, 0.08
    earlier = found(problem, estimate(problem, (), 0.0), *begun)
    seeds = np.zeros((1, problem.size))
    search = Search(Stepper(problem), seeds, np.inf, lambda message: None, earlier=earlier)
    search.found.priors = replace(
        search.found.priors, scales=np.ones(problem.equations.size), precision=np.full(problem.size, 1e-2)
    )
    search._take_up()
    assert set(search.found.estimates) == {alone["quadratic_drag"]}
    white = search.found.of(alone["quadratic_drag"], "white")
    # The readings are exact, and what is left is the error of the steps: a third in steps half as long. Held to eight
    # times what was seen, 1.2e-6 and 1.2e-7.
    assert white.z[[0, problem.slots]] == pytest.approx([1.0, 0.1], abs=1e-5)


def test_a_forecast_knows_the_same_of_its_inputs():
    """What a row that is forecast knows of the inputs before it is what a row of a recording does."""
    file, whole, some = simulation(0.1), recorded("hold"), recorded("hold", slice(0, 30))
    problem, longer = (cases.problem(file, [one], 0.05) for one in (some, whole))
    _, times, known = _ahead(problem, some, TIMES[30:], 1)
    np.testing.assert_array_equal(times, TIMES[30:])
    # Round-off of means: differences of integrals, about the mean of either recording. Seen: nothing.
    np.testing.assert_allclose(known, longer.rows[0].inputs[30:], atol=1e-12)


def test_what_is_known_is_what_was_pushed():
    """Pieces of the time before hold the inputs' means in them, the latest first, and before they are known what they
    begin with; sensors that cannot be late know no more than how the inputs stand."""
    inputs = Inputs(TIMES, PUSH[:, None], "hold")
    known = known_inputs(inputs, TIMES[:9], 20 * GAP)
    np.testing.assert_array_equal(known[:, 0], PUSH[:9])
    # Twenty pieces of twenty gaps: one rounding of a product and one of a quotient. Seen: nothing.
    np.testing.assert_allclose(known[:, 1], GAP, rtol=1e-15)
    before = np.concatenate([np.full(20, PUSH[0]), PUSH])
    for k, pieces in enumerate(known[:, 2:]):
        # Round-off of differences of integrals up to some seconds. Seen: 2.4e-15.
        np.testing.assert_allclose(pieces, before[k : k + 20][::-1], atol=1e-12)
    assert known_inputs(inputs, TIMES, None).shape == (len(TIMES), 1)
    plain = cases.simulation("p**2/2 + q**2/2", ["q"], ["p"], {"y": "q"}, '[forces]\np = "u"\n', 'inputs = ["u"]')
    assert augmented_equations(plain).delayed
