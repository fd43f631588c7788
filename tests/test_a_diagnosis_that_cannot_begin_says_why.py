"""Where nothing can be fitted, searched, stepped or read, that is said in one sentence before any work."""

from dataclasses import replace

import engine_cases as cases
import jax
import numpy as np
import pytest

from symplearn import InputError
from symplearn._inputs import Inputs
from symplearn.diagnosis import Options, Restriction, diagnose
from symplearn.diagnosis._diagnose import _times_ahead
from symplearn.diagnosis._usable import check_searched

TIMES = np.linspace(0.0, 20.0, 60)


AS_USUAL = Options()


def refusal(file, recording, options=AS_USUAL):
    """The sentence of the refusal."""
    with pytest.raises(InputError) as said:
        diagnose(file, [recording], options)
    assert "\n" not in str(said.value)
    return str(said.value)


def swing(**more):
    return cases.simulation("p**2/(2*m) + q**2/2", more="[parameters]\nm = 1.0", **more)


def read():
    return cases.recorded(TIMES, np.cos(TIMES))


def test_a_holdout_that_leaves_next_to_nothing_is_refused():
    """Of 60 rows a hold-out of 0.99 leaves two, too few for a start and a mass: how many rows are left and how many
    numbers are unknown is said."""
    file = cases.simulation("p**2/(2*m) + q**2/2", more="[parameters]\nm = { value = 1.0, sd = 0.1 }")
    assert "0.99 leaves 2 rows" in (said := refusal(file, read(), Options(holdout=0.99)))
    assert "3 numbers unknown" in said


@pytest.mark.parametrize(
    ("energy", "more", "what"),
    [
        ("p**2/(2*m) + q**2/2", "m = 0.0", "velocities"),
        ("p**2/2 + m*q**2/2 + sqrt(-1 - q**2)", "m = 1.0", "forces"),
    ],
)
def test_equations_that_give_no_number_anywhere_are_refused(energy, more, what):
    """A division by a mass of zero and a root of what is negative everywhere."""
    file = cases.simulation(energy, more=f"[parameters]\n{more}")
    assert f"the {what} that follow from the Hamiltonian are no numbers" in refusal(file, read())


def test_a_pole_is_no_reason():
    """A force that is singular at one place alone is stepped: a repulsion that grows without bound at zero."""
    y = cases.solved(lambda t, x: [x[1], x[0] ** -3 - x[0]], [1.5, 0.0], TIMES)[:, 0]
    y = y + 0.01 * np.random.default_rng(1).normal(size=len(y))
    file = cases.simulation("p**2/2 + q**2/2 + 1/(2*q**2)")
    document = diagnose(
        file, [cases.recorded(TIMES, y)], Options(restriction=Restriction(("viscous_damping",)))
    ).document
    assert document["verdict"] == "consistent"


def test_a_step_too_fine_to_be_taken_is_refused():
    """Twenty units of time in steps of 1e-9; the finest that is possible is said."""
    file = cases.simulation("p**2/2 + q**2/2", more='[integrator]\nname = "auto"\nstep = 1e-9')
    assert "20,000,000,000 steps" in (said := refusal(file, read()))
    assert "give at least 1e-06" in said


def test_effects_that_can_be_nowhere_are_refused():
    """Of one coordinate none can be coupled to another."""
    said = refusal(swing(), read(), Options(restriction=Restriction(("gyroscopic_coupling",))))
    assert "gyroscopic_coupling" in said


def test_an_expression_alone_may_be_asked_for():
    """No effect with a name is searched then, which is no reason to refuse."""
    p = replace(cases.problem(swing(), [read()], 0.05), searched=())
    check_searched(p, Restriction(("unnamed_force",)))
    with pytest.raises(InputError):
        check_searched(p, Restriction(("contact_stop",)))


@pytest.mark.parametrize(
    ("times", "inputs", "said"),
    [
        (1.0, 1e200, "input `u` is 1e+200"),
        (1e200, 0.0, "the time is"),
        (1e-170, 0.0, "apart, which is too short"),
    ],
)
def test_inputs_and_times_beyond_numbers_are_refused(times, inputs, said):
    """Squares of both are taken; what is too large or too short is told, and no decomposition fails after minutes."""
    driven = cases.simulation("p**2/2 + q**2/2", more='[forces]\np = "u"', recording='inputs = ["u"]')
    values = np.zeros((len(TIMES), 1))
    values[7] = inputs
    assert said in refusal(driven, cases.recorded(TIMES * times, np.cos(TIMES), Inputs(TIMES * times, values)))


def test_a_forecast_past_a_missing_input_is_refused():
    """A row after the last reading that lacks the input is not bridged; one that no forecast reaches may."""
    driven = cases.simulation("p**2/2 + q**2/2", more='[forces]\np = "u"', recording='inputs = ["u"]')
    ahead = np.append(TIMES, [21.0, 23.0])
    inputs = Inputs(ahead, np.zeros((len(ahead), 1)), missing=np.array([22.0]))
    recording = cases.recorded(TIMES, np.cos(TIMES), inputs)
    assert "22: an input is missing" in refusal(driven, recording, Options(forecast_until=23.0))
    assert len(_times_ahead(driven, recording, Options(forecast_until=21.0))) > 0


def test_single_precision_is_refused():
    """In which nothing that is sought can be told; what to set is said."""
    with jax.enable_x64(False):
        assert 'jax.config.update("jax_enable_x64", True)' in refusal(swing(), read())


def test_one_row_is_refused_before_its_forecast():
    """Of one row no spacing is known, and none is made up."""
    said = refusal(swing(), cases.recorded(TIMES[:1], np.ones(1)), Options(forecast_until=30.0))
    assert "only one row is used" in said


@pytest.mark.parametrize("reading", [1e300, -1e101])
def test_a_reading_too_large_to_compute_with_is_refused(reading):
    """Its square is no number; column and reading are told. A recording without readings beside it is none of that."""
    y = np.where(np.arange(60) == 7, reading, np.cos(TIMES))
    none = cases.recorded(TIMES, np.full(60, np.nan), number=2)
    with pytest.raises(InputError, match=r"column `y0`: -?1e\+[13]0[01] is too large"):
        diagnose(swing(), [none, cases.recorded(TIMES, y)])


def test_a_column_of_a_few_readings_tells_no_noise():
    """Three speeds beside two hundred positions, two of them fitted: how many would do is said. With their noise given
    they are used."""
    times = np.linspace(0.0, 20.0, 200)
    y = np.stack([np.cos(times), np.full(200, np.nan)], axis=1)
    y[:, 0] += 0.01 * np.random.default_rng(1).normal(size=200)
    y[[5, 50, 198], 1] = -np.sin(times[[5, 50, 198]])
    observe = {"x": "q", "v": "p"}
    recording = cases.recorded(times, y, columns=("x", "v"))
    said = refusal(cases.simulation("p**2/2 + q**2/2", observe=observe), recording)
    assert "`v`: 2 readings are left for fitting" in said and "give 5" in said
    file = cases.simulation("p**2/2 + q**2/2", observe=observe, more="[recording.noise]\nv = 0.01\n")
    only = Options(restriction=Restriction(("viscous_damping",)))
    assert diagnose(file, [recording], only).document["verdict"] == "consistent"


@pytest.mark.parametrize("rows", [3, 4])
def test_a_few_rows_are_answered(rows):
    """Nothing can be told of so few, and nothing is."""
    times = np.linspace(0.0, 1.5, rows)
    y = np.cos(2 * times) + 0.02 * np.random.default_rng(rows).normal(size=rows)
    some = Options(restriction=Restriction(("viscous_damping", "linear_stiffness")))
    assert diagnose(cases.simulation("p**2/2 + 2*q**2"), [cases.recorded(times, y)], some).document["findings"] == []


def test_a_single_row_is_refused():
    """Beside a recording that is long enough, too: which one it is is said."""
    rows = [cases.recorded(TIMES, np.cos(TIMES)), cases.recorded(TIMES[:1], np.ones(1), number=2)]
    with pytest.raises(InputError, match="run2.csv: only one row is used"):
        diagnose(swing(), rows, AS_USUAL)


def test_a_short_recording_may_stand_beside_a_long_one():
    """Three rows beside two hundred, and inputs in both: they are answered together."""
    long, short = np.linspace(0.0, 20.0, 200), np.linspace(0.0, 1.0, 3)
    rng, only = np.random.default_rng(2), Options(restriction=Restriction(("viscous_damping",)))
    both = [cases.recorded(t, np.cos(t) + 0.01 * rng.normal(size=len(t)), number=k + 1)
            for k, t in enumerate((long, short))]  # fmt: skip
    assert diagnose(cases.simulation("p**2/2 + q**2/2"), both, only).document["verdict"] == "consistent"
