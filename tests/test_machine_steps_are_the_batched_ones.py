"""A diagnosis steps by machine code what XLA would step many at once: the same readings, phase points and slopes."""

import engine_cases as cases
import numpy as np
import pytest

from symplearn._inputs import Inputs
from symplearn.diagnosis import _native_rows, _stochastic
from symplearn.diagnosis._batched_steps import BatchedSteps
from symplearn.diagnosis._lanes import Lanes
from symplearn.diagnosis._native_steps import NativeSteps
from symplearn.diagnosis._path_filter import prolonged
from symplearn.diagnosis._problem import SLOTS
from symplearn.diagnosis._stochastic import free_run
from symplearn.diagnosis._trajectory import Stepper

TIMES = np.sort(np.random.default_rng(0).uniform(0.0, 3.0, 18))
MORE = """
[parameters]
m = 1.3
a = { value = 0.7, sd = 0.1 }

[forces]
p = "-0.2*p*abs(p) + 0.3*u"

[[terms]]
effect = "impulse"
target = "y"
j = 0.2
t_star = 1.1
"""
HAMILTONIANS = {
    "separable": "p**2/(2*m) + r**2/2 + a*cosh(x) + x*y**2/4 + y**2",
    "not separable": "p**2/(2*m)*(1 + y**2/4) + r**2/(2 + cos(x)) + a*x**2 + y**2",
}


@pytest.fixture(scope="module", params=HAMILTONIANS)
def steppers(request):
    """The same two recordings, driven, by machine code and by XLA; one column shows a momentum."""
    file = cases.simulation(
        HAMILTONIANS[request.param], ["x", "y"], ["p", "r"], {"X": "x + y**2/9", "V": "r"}, MORE,
        'inputs = ["u"]\ninterpolation = "linear"',
    )  # fmt: skip
    problem = cases.problem(file, [made(TIMES, 1), made(TIMES[:11], 2)], 0.07)
    native = Stepper(problem)
    assert isinstance(native.steps, NativeSteps)
    return native, Stepper(problem, 1, BatchedSteps(native.courses, native.threads))


def made(times, number):
    """A recording of nothing, driven by a sine."""
    inputs = Inputs(times, np.sin(2 * times)[:, None], "linear")
    return cases.recorded(times, np.zeros((len(times), 2)), inputs, number, ("X", "V"))


def unknowns(problem, rng):
    """Starts, calibrated values and slots away from nothing."""
    z = 0.3 * rng.normal(size=problem.size)
    z[problem.head : problem.slots] = 0.7 + 0.05 * rng.normal(size=problem.slots - problem.head)
    z[problem.slots :] = rng.uniform(0.03, 0.1, size=problem.size - problem.slots)
    return z


def compared(found, expected):
    """How far two arrays are apart, of the largest entry."""
    return np.abs(found - expected).max() / np.abs(expected).max()


def test_every_effect_is_stepped_alike(steppers):
    """Readings and slopes of every effect on every target, alone and with others, are those of XLA."""
    native, batched = steppers
    problem, rng = native.problem, np.random.default_rng(1)
    combinations = [(), *((member,) for member in problem.searched)]
    combinations += [tuple(sorted(map(int, rng.choice(problem.searched, 3, replace=False)))) for _ in range(4)]
    zs, rows = (
        np.stack([unknowns(problem, rng) for _ in combinations]),
        [len(problem.rows[0].times), 9],
    )  # of the second not all
    one, other = native.predict(zs, combinations, rows), batched.predict(zs, combinations, rows)
    for mine, theirs in zip(one, other, strict=True):
        whole = np.isfinite(theirs.readings).all((1, 2))  # one runs into the singularity of its central force
        np.testing.assert_array_equal(np.isfinite(mine.readings).all((1, 2)), whole)
        assert whole.sum() >= len(whole) - 1
        # Round-off of a hundred substeps of a motion that is not chaotic.
        assert compared(mine.readings[whole], theirs.readings[whole]) < 1e-10
        assert compared(mine.slopes[whole], theirs.slopes[whole]) < 1e-10
        slots = mine.slopes[1 : 1 + len(problem.searched), -SLOTS:]  # of single effects
        # Wrong noise and outliers move no motion; a stop may not be reached.
        assert (np.abs(slots).max((1, 2, 3)) > 0).mean() > 0.8


def test_rows_may_begin_anew(steppers):
    """On a path the points that arrive from the row before, and all slopes, are those of XLA, too."""
    native, batched = steppers
    problem, rng = native.problem, np.random.default_rng(2)
    paths = 0.5 * rng.normal(size=(3, 9, problem.state))
    local = np.stack([unknowns(problem, rng)[problem.local(1)] for _ in range(3)])
    hots = np.stack([problem.onehot(c, 1) for c in [(), problem.searched[:2], problem.searched[-3:]]])
    along = [np.arange(problem.state), np.arange(3, 14), np.array([0])]
    runs = [Lanes(1, local, hots, along, 9, paths)]
    (mine,), (theirs,) = native.steps(problem, runs), batched.steps(problem, runs)
    # Round-off of the substeps of one row.
    assert compared(mine.shown, theirs.shown) < 1e-10
    for one, other, places in zip(mine.slopes, theirs.slopes, along, strict=True):
        assert one.shape == (len(places), 9, problem.channels + problem.state)
        assert compared(one, other) < 1e-10


def test_a_free_run_is_the_same_from_any_row(steppers, monkeypatch):
    """A run that begins in the middle gives the same readings and phase points without machine code."""
    native, _ = steppers
    problem, z = native.problem, unknowns(native.problem, np.random.default_rng(3))
    given = problem, native.courses[0], z, problem.searched[3:5], 0, z[: problem.state], 4
    mine = free_run(*given)
    monkeypatch.setattr(_stochastic, "native_rows", lambda *some: None)
    for one, other in zip(mine, free_run(*given), strict=True):
        assert one.shape == other.shape and len(one) == len(problem.rows[0].times) - 4
        # Round-off of a hundred substeps.
        assert compared(one, other) < 1e-10


def test_a_path_is_prolonged_without_machine_code(steppers, monkeypatch):
    """Held-out rows, to which a path runs on, are reached where the code cannot be written, too."""
    native, _ = steppers
    problem, z = native.problem, unknowns(native.problem, np.random.default_rng(3))
    path = np.tile(z[: problem.state], (5, 1))
    mine = prolonged(native, 0, z, (), path)
    monkeypatch.setattr(_stochastic, "native_rows", lambda *some: None)
    other = prolonged(native, 0, z, (), path)
    assert other.shape == (len(problem.rows[0].times), problem.state)
    np.testing.assert_allclose(other, mine, rtol=1e-10, atol=1e-12)  # round-off of a hundred substeps


def test_the_answer_does_not_depend_on_the_threads(steppers):
    """Two threads give the digits of one."""
    native, _ = steppers
    problem = native.problem
    zs = np.stack([unknowns(problem, np.random.default_rng(4))] * 5)
    combinations = [(member,) for member in problem.searched[:5]]
    two = Stepper(problem, 2).predict(zs, combinations, [9, 9])
    for one, other in zip(native.predict(zs, combinations, [9, 9]), two, strict=True):
        np.testing.assert_array_equal(one.slopes, other.slopes)


def test_without_machine_code_xla_steps(steppers, monkeypatch):
    """Where the code cannot be written, or the work is a graphics card's, a stepper is XLA's."""
    problem = steppers[0].problem
    monkeypatch.setattr(_native_rows.jax, "default_backend", lambda: "gpu")
    _native_rows.native_rows.cache_clear()
    assert isinstance(Stepper(problem).steps, BatchedSteps)
    monkeypatch.undo()
    _native_rows.native_rows.cache_clear()
    monkeypatch.setattr(_native_rows, "_traced", _refused)
    assert isinstance(Stepper(problem).steps, BatchedSteps)
    _native_rows.native_rows.cache_clear()


def _refused(*given):
    raise _native_rows.Unsupported("anything")
