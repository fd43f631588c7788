"""The oracle fits what nature moved, ranks rivals rightly, and the table of equivalences holds by computation."""

import numpy as np
import pytest
from concealed_cases import case_of, setting

from experiments import _concealed_hiding, _concealed_rivals
from experiments._concealed_effects import Effect
from experiments._concealed_equivalent import equivalent, swallowed
from experiments._concealed_files import answer, read_setup, recording_file
from experiments._concealed_fit import Free, Given, fit
from experiments._concealed_hiding import clean_readings, form_of, starts, weights
from experiments._concealed_oracle import asked, consulted, early
from experiments._concealed_rivals import candidates, nuisances, ranked, responses


def test_a_fit_of_the_true_form_finds_the_truth():
    """From wrong values, least squares comes back to the coefficient and the calibrated parameter without noise."""
    setup, public = setting("duffing")
    public = public._replace(free=(Free("k", setup.values["k"] * 1.01, None),))
    true = Effect("viscous_damping", "q", {"c": 0.05})
    form = form_of(setup, public, (true,), ((0, "c"),))
    given = Given(clean_readings(setup, (true,)), weights(setup))
    theta = form.begin(starts(setup))
    found = fit(form, given, theta * np.array([1.01, 0.5, 1.0, 1.0]), form.scales(theta))
    assert found.theta == pytest.approx(theta, rel=1e-3, abs=1e-4)
    # What the lanes' order-8 steps differ from DOP853, in sd of the noise of 0.02.
    assert found.rms < 0.01


def test_a_strong_effect_is_named_and_a_weak_one_is_not():
    """A damping of many sd beats nothing by far and every rival; the same three hundred times weaker does neither."""
    setup, public = setting("pendulum", ["angle_rad"], rows=80, noise=0.01)
    size = setup.values["m"] * setup.values["l"] ** 2 * 2 * np.pi / setup.system.period(setup.values)
    told = {}
    for strength in (0.06, 0.0002):
        case = case_of(setup, public, Effect("viscous_damping", "theta", {"c": float(strength * size)}))
        told[strength] = consulted(answer(case), case.noisy)
    strong, weak = told[0.06], told[0.0002]
    assert strong["nameable"] and strong["margins"]["nothing"] > 100
    assert not weak["nameable"] and weak["margins"]["nothing"] < 14
    # Of three quarters of the rows as well, by less.
    assert strong["early"]["nameable"] and not weak["early"]["nameable"]
    assert 100 < strong["early"]["margins"]["nothing"] < strong["margins"]["nothing"]
    # Noise of 80 rows: a rms of 1 with a standard error of 8 %; the forecast is far inside the noise.
    assert strong["rms"] == pytest.approx(1.0, abs=0.25) and strong["forecast"] < 1.0
    assert 0 < strong["widths"]["viscous_damping|theta|c"] < 0.2 * 0.06 * size


def test_what_comes_late_is_named_of_all_rows_alone():
    """A blow in the last quarter of the rows is plain in all of them, and nothing in those before."""
    setup, public = setting("pendulum", ["angle_rad"], rows=80, noise=0.01)
    size, times = setup.values["m"] * setup.values["l"] ** 2, setup.records[0].times
    strength = float(0.3 * size * 2 * np.pi / setup.system.period(setup.values))
    late = Effect("impulse", "theta", {"j": strength, "t_star": float(times[66] + 0.3 * times[1])})
    case = case_of(setup, public, late)
    told = consulted(answer(case), case.noisy)
    assert told["margins"]["nothing"] > 100 and told["early"]["margins"]["nothing"] < 0
    assert told["nameable"] and not told["early"]["nameable"]


def test_a_case_cut_short_is_the_same_case():
    """Its rows are the first ones of every recording, with their true readings, and its inputs go on beyond them."""
    setup, public = setting("driven_spring", ["q_m"], rows=62)
    whole = answer(case := case_of(setup, public, Effect("cubic_stiffness", "q", {"k": 1.0})))
    short, seen = early(whole, case.noisy)
    (record,), (before,) = short["records"], whole["records"]
    assert len(record["times"]) == 47 and record["times"] + record["after"] == before["times"] + before["after"]
    assert np.array_equal(seen[0], case.noisy[0][:47]) and short["clean"] == [whole["clean"][0][:47]]
    theirs, mine = (read_setup(one)[0].records[0] for one in (whole, short))
    assert theirs.inputs is not None and np.array_equal(theirs.inputs.times, mine.inputs.times)
    assert np.array_equal(theirs.inputs.values, mine.inputs.values) and len(mine.times) == 47


def test_a_drag_of_another_power_is_a_rival():
    """A damping that takes little of the amplitude beats nothing by far, and a quadratic drag does as well: it cannot
    be named, though waves of free frequency and an unseen oscillator reproduce more of its response."""
    setup, public = setting("pendulum", ["angle_rad"], rows=80, noise=0.01)
    size = setup.values["m"] * setup.values["l"] ** 2 * 2 * np.pi / setup.system.period(setup.values)
    case = case_of(setup, public, Effect("viscous_damping", "theta", {"c": float(0.015 * size)}))
    told = consulted(answer(case), case.noisy)
    assert told["margins"]["nothing"] > 100
    assert told["margins"]["quadratic_drag|theta for viscous_damping|theta"] < 6 and not told["nameable"]


def test_a_rival_is_judged_in_a_dose_as_small_as_the_truth():
    """Over 25 swings of a Duffing oscillator, a damping that takes under a hundredth of its energy in all has the
    response of its own word, of a quadratic drag and of dry friction: candidates are far stronger to begin with."""
    setup, public = setting("duffing")
    period = setup.system.period(setup.values)
    setup = setup._replace(records=(setup.records[0]._replace(times=np.linspace(0.0, 25 * period, 200)),))
    truth = Effect("viscous_damping", "q", {"c": float(4e-5 * setup.values["m"] * 2 * np.pi / period)})
    rivals = ranked(form_of(setup, public), public, (), truth, candidates(setup, public, ()))
    left = {r.effect.word: r.part for r in rivals}
    assert all(left[word] < 1e-3 for word in ("viscous_damping", "quadratic_drag", "coulomb_friction"))
    assert {r.effect.word for r in rivals[:3]} == {"viscous_damping", "quadratic_drag", "coulomb_friction"}


def test_the_oracle_is_asked_once(tmp_path):
    """Its answer is kept, and asked anew where the answer or the recording is another one."""
    setup, public = setting("driven_spring", ["q_m"], rows=60)
    case = case_of(setup, public)
    public_folder = tmp_path / "public"
    public_folder.mkdir()
    (public_folder / "recording.csv").write_text(recording_file(case))
    document = answer(case)
    first = asked(tmp_path / "kept.json", document, public_folder)
    stamp = (tmp_path / "kept.json").stat().st_mtime_ns
    assert asked(tmp_path / "kept.json", document, public_folder) == first
    assert (tmp_path / "kept.json").stat().st_mtime_ns == stamp
    assert asked(tmp_path / "kept.json", document | {"attempts": 2}, public_folder)["of"] != first["of"]
    assert not first["nameable"] and first["holdout"] == pytest.approx(1.0, abs=0.6)  # 15 rows


SAME = [
    ("driven_spring", ["q_m"], ("sensor_bias", "q_m", {"b": 1.0}), ("constant_force", "q", {"f": 1.0})),
    ("driven_spring", ["q_m"], ("sensor_gain", "q_m", {"g": 1.0}), ("parameter_error", "gain", {"d": 1.0})),
    ("duffing", ["q_m"], ("sensor_gain", "q_m", {"g": 1.0}), ("cubic_stiffness", "q", {"k": 1.0})),
    ("double_well", ["q_mm"], ("parameter_error", "b", {"d": 1.0}), ("cubic_stiffness", "q", {"k": 1.0})),
    ("henon_heiles", ["q1_kpc"], ("sensor_gain", "q1_kpc", {"g": 1.0}), ("parameter_error", "lam", {"d": 1.0})),
    ("orbit", ["x_Mm"], ("sensor_gain", "x_Mm", {"g": 1.0}), ("parameter_error", "mu", {"d": 1.0})),
    ("coupled", ["x1_m"], ("sensor_bias", "x1_m", {"b": 1.0}), ("constant_force", "x2", {"f": 1.0})),
    ("coupled", None, ("sensor_gain", "x1_m", {"g": 1.0}), ("sensor_gain", "x2_m", {"g": 1.0})),
    ("coupled", None, ("coupling_spring", ("x1", "x2"), {"k": 1.0}), ("parameter_error", "kc", {"d": 1.0})),
    ("elastic_pendulum", ["r_m"], ("constant_force", "r", {"f": 1.0}), ("parameter_error", "l", {"d": 1.0})),
    ("pendulum", ["angle_rad"], ("parameter_error", "l", {"d": 1.0}), ("parameter_error", "g", {"d": 1.0})),
]


def left_over(name, columns, effects):
    """Responses to effects that recalibration and free starts leave, and their part of the whole."""
    setup, public = setting(name, columns, rows=80)
    document = {"system": name, "columns": [r.column for r in setup.readings], "initial": {}, "free": [], "effects": []}
    basis, whole = nuisances(setup, public), responses(setup, public, effects)
    left = whole - basis @ (basis.T @ whole)
    return document, left, np.linalg.norm(left, axis=0) / np.linalg.norm(whole, axis=0)


@pytest.mark.parametrize(("name", "columns", "one", "other"), SAME)
def test_equivalences_hold_by_computation(monkeypatch, name, columns, one, other):
    """Both forms move the readings in proportion, once free starts are taken out; and the table says so."""
    for module in (_concealed_hiding, _concealed_rivals):
        monkeypatch.setattr(module, "DOSE", 1e-6)
    effects = [Effect(*one), Effect(*other)]
    document, left, _ = left_over(name, columns, effects)
    assert equivalent(document, *(e.key for e in effects))
    a, b = left.T
    # Square of the sine between them: zero but for the differences' error, 1e-6 of a response that leaves 1/260 over.
    assert 1 - (a @ b) ** 2 / (a @ a) / (b @ b) < 3e-4


@pytest.mark.parametrize(
    ("name", "columns", "effect"),
    [
        ("coupled", ["x1_m"], ("sensor_gain", "x1_m", {"g": 1.0})),
        ("pendulum", ["angle_rad"], ("sensor_delay", "angle_rad", {"tau": 0.1})),
        ("driven_spring", ["speed"], ("constant_force", "q", {"f": 1.0})),
    ],
)
def test_what_calibration_owns_leaves_nothing(monkeypatch, name, columns, effect):
    """An effect that is swallowed leaves less than a thousandth of itself after free starts."""
    monkeypatch.setattr(_concealed_rivals, "DOSE", 1e-6)
    document, _, part = left_over(name, columns, [Effect(*effect)])
    assert swallowed(document, Effect(*effect).key) and part[0] < 1e-3


def test_what_differs_is_not_equivalent(monkeypatch):
    """Two stiffnesses of a pendulum differ by more than rounding, and the table keeps them apart."""
    monkeypatch.setattr(_concealed_rivals, "DOSE", 1e-6)
    effects = [Effect("cubic_stiffness", "theta", {"k": 0.1}), Effect("quadratic_stiffness", "theta", {"k": 0.1})]
    document, left, _ = left_over("pendulum", ["angle_rad"], effects)
    a, b = left.T
    assert 1 - (a @ b) ** 2 / (a @ a) / (b @ b) > 1e-3 and not equivalent(document, *(e.key for e in effects))
