"""What an effect may be beforehand is the same in any unit, in any order of coordinates, and by any clock."""

from dataclasses import replace

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis._course import courses
from symplearn.diagnosis._effect_priors import _range, _unit, with_effects
from symplearn.diagnosis._motion import Motion, motion_along
from symplearn.diagnosis._scan import grid
from symplearn.diagnosis._score import Unit, placed
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._stochastic import free_run

T = np.linspace(0.0, 20.0, 401)
Q = np.stack([1.3 * np.cos(T), 0.4 * np.sin(1.7 * T + 0.3)], axis=1)
V = np.stack([-1.3 * np.sin(T), 0.68 * np.cos(1.7 * T + 0.3)], axis=1)
MOTION = Motion(
    Q, V, np.array([1.3, 0.8]), np.ones(2), (T,), np.zeros((2, 0)), np.zeros_like(Q), momenta=np.array([1.3, 0.68])
)
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


@pytest.mark.parametrize("effect", ["sensor_drift", "parameter_drift"])
def test_how_fast_something_drifts_is_told_by_a_recording_alone(effect):
    """A drift may be as fast as one that shows in a recording, however long after it the next one begins."""
    scales = []
    for clock in (0.0, 500.0, 1e5):
        problem = pair(clocks=(0.0, clock))
        one = next(c for c in problem.equations.candidates if c.effect.name == effect)
        scales.append(priors_of(problem).scales[one.first])
    assert scales == pytest.approx([scales[0]] * 3)


@pytest.mark.parametrize("effect", ["sensor_drift", "parameter_drift"])
def test_a_drift_counts_from_the_first_row_of_each_recording(effect):
    """Two recordings alike but for their clocks show the same drift, from nothing at their first rows."""
    problem, z = pair(clocks=(3.0, 1e4)), None
    target = {"sensor_drift": "y1", "parameter_drift": "k"}[effect]
    m = next(m for m in problem.searched if problem.candidate(m).key == (effect, (target,)))
    z, runs = np.zeros(problem.size), []
    z[dict(problem.placed((m,)))[m]] = 0.02
    x = np.array([1.3, 0.4, 0.0, 0.0, 0.2, 0.0])
    for combination in ((m,), ()):
        runs.append([free_run(problem, course, z * bool(combination), combination, r, x, 0)[0][:, 0]
                     for r, course in enumerate(courses(problem))])  # fmt: skip
    (first, second), (still, _) = runs
    # Round-off of times of 1e4 in a drift over twenty.
    np.testing.assert_allclose(second, first, atol=1e-9)
    rates = lambda t, x: [x[1], -(1 + 0.02 * t) * x[0]]  # noqa: E731
    drifted = still + 0.02 * T if effect == "sensor_drift" else cases.solved(rates, [1.3, 0.0], T)[:, 0]
    # A method of order four in steps of a 126th of the period.
    np.testing.assert_allclose(first, drifted, atol=1e-5)
    assert np.abs(drifted - still).max() > 0.1


def test_a_blow_may_be_what_set_a_body_in_motion():
    """However soon it comes to rest again: half of its largest momentum is within the prior of a blow."""
    decay = np.exp(-T)
    motion = replace(MOTION, forces=MOTION.forces / 30, momenta=np.array([2.0, 0.5]),
                     q=Q * decay[:, None], v=V * decay[:, None])  # fmt: skip
    problem = pair()
    priors = with_effects(problem, priors_without_effects(problem), motion)
    blow = candidate(problem, "impulse", "q1")
    assert priors.scales[blow.first] == pytest.approx(1.0)
    (push,) = _unit(motion, blow)
    assert 0.3 * push < 0.1


@pytest.mark.parametrize("clock", [0.0, 500.0, 1e5])
def test_a_phase_counts_from_what_the_force_is_in(clock):
    """What a force in the second recording does is scanned by the phase that all have and fitted by its own: the same
    force, by the contract's names, and SciPy's motion under it, however far its clock begins from the other's."""
    problem, omega = pair(clocks=(0.0, clock)), 2.3
    m = next(m for m, one in enumerate(problem.members)
             if one.candidate.key == ("periodic_forcing", ("q1",)) and one.recordings == (1,))  # fmt: skip
    effect, whole, z = problem.candidate(m).effect, problem.whole(m), np.zeros(problem.size)
    sizes = np.array([0.3, -0.2])
    z = placed(problem, z, (), (m,), m, sizes, Unit(whole, omega))
    assert problem.origin(m) == pytest.approx(clock + 10.0) and problem.origin(whole) == problem.equations.origin
    by_all = effect.named(np.append(sizes, omega), problem.equations.origin)
    by_own = effect.named(z[dict(problem.placed((m,)))[m]], problem.origin(m))
    assert by_own["a"] == pytest.approx(by_all["a"])
    # Round-off of a phase of 2.3e5.
    assert np.cos(by_own["phi"] - by_all["phi"]) == pytest.approx(1.0, abs=1e-9)
    force = lambda t: by_all["a"] * np.cos(omega * t + by_all["phi"])  # noqa: E731
    rates = lambda t, x: [x[2], x[3], -x[0] + force(t), -3.0 * x[1]]  # noqa: E731
    expected = cases.solved(rates, np.zeros(4), T + clock)[:, 0]
    shown, _ = free_run(problem, courses(problem)[1], z, (m,), 1, np.zeros(problem.state), 0)
    # A method of order four in steps of a 126th of the period. Seen: 3e-6.
    np.testing.assert_allclose(shown[:, 0], expected, atol=1e-4)
    assert np.abs(expected).max() > 0.1


def test_frequencies_are_told_apart_as_one_recording_tells_them():
    """Where clocks lie so far apart that all together resolve more than can be tried, places stay evenly spaced."""
    problem = pair(clocks=(0.0, 1e4))
    whole = problem.whole(member(problem, "periodic_forcing", (0,)))
    tried = np.sort([unit.place for unit in grid(problem, priors_of(problem), whole)])
    assert np.diff(tried).max() < 2 * np.pi / 20 and tried[-1] == pytest.approx(np.pi / (2 * 0.05))


@pytest.mark.parametrize(("omega", "least"), [(1.0, 10.0), (16.0, 16.0), (19.5, 18.0)])
def test_a_frequency_that_is_read_is_tried(omega, least):
    """Oscillations are tried up to half the Nyquist frequency, here 10.5, and up to what stands out of the readings,
    but for the last tenth below the Nyquist frequency itself."""
    times = 0.15 * np.arange(200)
    file = cases.simulation("p**2/2 + q**2/2")
    problem = cases.problem(file, [cases.recorded(times, np.cos(omega * times))], 0.05)
    motion = motion_along(problem, np.zeros(problem.size), [np.ones((200, problem.state))])
    assert least < motion.frequencies[1] <= 0.9 * np.pi / 0.15 + 1e-9
    assert omega > 10 or motion.frequencies[1] == pytest.approx(np.pi / 0.3)


def test_a_force_may_be_as_strong_as_what_moves_a_body_so_fast():
    """A force of high frequency moves a body as little as its square is large: its prior reaches the middle of the
    orders of magnitude in between; that of a constant force does not hang on frequencies."""
    problem, scales = pair(), {}
    for highest in (30.0, 0.0):
        priors = with_effects(problem, priors_without_effects(problem), replace(MOTION, highest=highest))
        scales[highest] = {c.key: priors.scales[c.first] for c in problem.equations.candidates}
    fast, slow = (scales[h][("periodic_forcing", ("q1",))] for h in (30.0, 0.0))
    assert fast / (0.3 * MOTION.forces[0]) == pytest.approx(33.0 / MOTION.own_frequency(0)) and fast >= slow
    steady, same = (scales[h][("constant_force", ("q1",))] for h in (30.0, 0.0))
    assert steady == same == pytest.approx(0.3 * MOTION.forces[0])


def test_a_stop_may_lie_where_a_body_comes_to_rest():
    """A floor that a ball lies on in four rows of five is above most of where it is read."""
    q = Q.copy()
    q[80:, 0] = -0.01
    q[:80, 0] = np.abs(q[:80, 0])
    floor = next(c for c in pair().equations.candidates if c.key[0] == "contact_stop" and c.side == "lower")
    low, high = _range(replace(MOTION, q=q), floor)
    assert low == pytest.approx(-0.01) and high > 0.1


def test_what_is_held_out_says_nothing_beforehand():
    """How late a sensor may be and how fast an oscillation are told by the rows that are fitted, alone."""
    times = 0.05 * np.arange(400)
    slow = np.cos(1.5 * times)
    fast = np.where(np.arange(400) < 300, slow, np.cos(50.0 * times))
    file, found = cases.simulation("p**2/2 + q**2/2"), []
    for readings in (slow, fast):
        problem = cases.problem(file, [cases.recorded(times, readings)], 0.05, holdout=0.25)
        motion = motion_along(problem, np.zeros(problem.size), [np.ones((300, problem.state))])
        found.append([problem.latest, motion.highest])
    assert found[0] == found[1] and found[0][0] > 5 * 0.05
