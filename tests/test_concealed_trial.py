"""The trial is honest: answers are sealed, a diagnosis sees two files, nothing is done twice, scores are right."""

import json
import sys

import numpy as np
import pytest

from experiments import _concealed_run as runs
from experiments import concealed
from experiments._concealed_equivalent import OWNERS, equivalent, same, swallowed
from experiments._concealed_figures import confusion, reliability, strength
from experiments._concealed_results import at_fixed_alarms, brier, calibration, metrics, report, table_of_cases
from experiments._concealed_score import credible_set, forecast_error, nothing, right, row
from experiments._concealed_seal import BrokenSeal, canonical, opened, put, seal, total
from experiments._concealed_workers import each


def effect(word, target, values=None, recordings=()):
    return {"effect": word, "target": target, "values": values or {}, "recordings": list(recordings)}


def answer(*effects, way="open", **more):
    """A pendulum's answer of three forecast rows."""
    return {
        "way": way, "system": "pendulum", "effects": list(effects), "remainder": [], "jitter": 0.0, "kind": "dynamics",
        "parameters": {"m": 1.0, "g": 9.81, "l": 0.5}, "free": [], "initial": {}, "stated_noise": {},
        "noise": {"angle_rad": 0.1}, "columns": ["angle_rad"], "records": [{"number": 1, "after": [1.0, 2.0, 3.0]}],
        "forecast": [[[0.0], [0.0], [0.0]]], "claim": {"detectable": 10.0},
    } | more  # fmt: skip


def finding(word, target, p=0.9, **coefficients):
    told = {n: {"mean": sum(i) / 2, "interval95": list(i)} for n, i in coefficients.items()}
    return {"effect": word, "target": target, "probability": p, "coefficients": told}


def document(*findings, verdict=None, p=0.8, rest=()):
    """A diagnosis with the reported combination's probability and alternatives (effects, unexplained, probability)."""
    others = [{"findings": [effect(*k) for k in keys], "unexplained": u, "probability": q} for keys, u, q in rest]
    return {
        "verdict": verdict or ("mismatch" if findings else "consistent"),
        "probability": p,
        "findings": list(findings),
        "location": {"kind": "dynamics" if findings else "none", "targets": [f["target"] for f in findings],
                     "recordings": [1] if findings else []},
        "alternatives": others,
        "fit": {when: {"holdout_rmse": {"angle_rad": 0.2}} for when in ("before", "after")},
    }  # fmt: skip


def result(doc, after=0.1):
    forecast = {"t": [1.0, 2.0, 3.0], "angle_rad_after": [after] * 3, "angle_rad_before": [0.5] * 3}
    return {"status": "done", "seconds": 10.0, "document": doc, "forecast": forecast}


DAMPED = answer(effect("viscous_damping", "theta", {"c": 0.03}))
NAMED = document(finding("viscous_damping", "theta", c=(0.02, 0.04)),
                 rest=[([("quadratic_drag", "theta")], False, 0.17), ([], False, 0.03)])  # fmt: skip


# Sealing


def test_a_changed_byte_breaks_the_seal(tmp_path):
    """An answer opens as it was sealed; one byte changed, or one hash, and it does not."""
    put(tmp_path / "case_001.json", canonical({"b": 1.0, "a": [0.1]}))
    put(tmp_path / "case_002.json", canonical({"a": 2}))
    sealed = seal(tmp_path, ["case_001", "case_002"], {"seed": 0})
    assert sealed["total"] == total(sealed["cases"]) and len(sealed["total"]) == 64
    assert opened(tmp_path, "case_001") == {"a": [0.1], "b": 1.0}
    seal(tmp_path, ["case_001", "case_002"], {"seed": 0})  # again, unchanged
    content = (tmp_path / "case_002.json").read_bytes()
    (tmp_path / "case_002.json").write_bytes(content.replace(b"2", b"3"))
    with pytest.raises(BrokenSeal):
        opened(tmp_path, "case_002")
    with pytest.raises(BrokenSeal):
        seal(tmp_path, ["case_001", "case_002"], {"seed": 0})
    assert opened(tmp_path, "case_001")
    stored = json.loads((tmp_path / "seals.json").read_text())
    stored["cases"]["case_001"] = "0" * 64
    (tmp_path / "seals.json").write_text(json.dumps(stored))
    with pytest.raises(BrokenSeal):
        opened(tmp_path, "case_001")


def test_canonical_json_is_one_text():
    """The order of keys does not matter, numbers read back exactly, and what is no number is refused."""
    assert canonical({"b": 0.1 + 0.2, "a": 1}) == b'{"a":1,"b":0.30000000000000004}'
    with pytest.raises(ValueError):
        canonical({"a": float("nan")})


# Running

PROGRAM = """
import json, os, pathlib, sys
seen = sorted(os.listdir("."))
count = pathlib.Path(sys.argv[1]); count.write_text(count.read_text() + "x" if count.exists() else "x")
if "{mode}" == "crash": sys.exit("it broke")
if "{mode}" == "late":
    import time; time.sleep(60)
out = pathlib.Path("diagnosis"); out.mkdir()
(out / "diagnosis.json").write_text(json.dumps({{"seen": seen, "arguments": sys.argv[2:]}}))
(out / "forecast.csv").write_text("t,y_after\\n1,2\\n")
"""


@pytest.fixture
def trial(tmp_path, monkeypatch):
    """A public case, and a program in place of the diagnosis that tells what it saw and counts its runs."""
    folder = tmp_path / "public" / "case_001"
    folder.mkdir(parents=True)
    (folder / "simulation.toml").write_text('title = "x"\n')
    rows = "".join(f"1,{k},{y}\n" for k, y in enumerate([1, 2, 3, 4, "", ""]))
    (folder / "recording.csv").write_text("run,t_s,y\n" + rows + "2,0,1\n2,50,1\n")

    def given(mode):
        program = tmp_path / "program.py"
        program.write_text(PROGRAM.format(mode=mode))
        monkeypatch.setattr(runs, "command_line", lambda: [sys.executable, str(program), str(tmp_path / "count")])
        return folder

    return given, tmp_path


def test_the_diagnosis_sees_two_files(trial):
    """The process starts in a fresh folder that holds the two public files, and is asked a forecast a quarter ahead."""
    given, place = trial
    found = runs.diagnosed(given("well"), place / "kept.json", 2)
    assert found["status"] == "done" and found["seconds"] > 0
    assert found["document"]["seen"] == ["recording.csv", "simulation.toml"]
    # The first recording's last reading is at 3, its step 1, its readings four.
    asked = ["--forecast-until", "4.0", "--forecast-step", "0.25", "--jobs", "2"]
    assert found["document"]["arguments"][-6:] == asked
    assert found["forecast"] == {"t": [1.0], "y_after": [2.0]}


def test_what_is_done_is_not_done_again(trial):
    """A kept diagnosis is taken from its file until the public files change or a fresh one is asked for."""
    given, place = trial
    folder, count = given("well"), place / "count"
    for _ in range(2):
        (found,) = runs.every([folder], place / "kept", 1, False, lambda line: None)
    assert found["document"] and count.read_text() == "x"
    runs.every([folder], place / "kept", 1, True, lambda line: None)
    assert count.read_text() == "xx"
    (folder / "simulation.toml").write_text('title = "y"\n')
    runs.every([folder], place / "kept", 1, False, lambda line: None)
    assert count.read_text() == "xxx"
    assert not [p for p in (place / "kept").iterdir() if p.name.startswith(".")]


def test_failures_are_counted(trial, monkeypatch):
    """A crash and a run beyond the time are results like others, and are scored as nothing right."""
    given, place = trial
    found = runs.diagnosed(given("crash"), place / "a.json", 1)
    assert found["status"] == "crashed" and "it broke" in found["told"]
    monkeypatch.setattr(runs, "TIMEOUT", 1.0)
    found = runs.diagnosed(given("late"), place / "b.json", 1)
    assert found["status"] == "late"
    scored = row("case_001", DAMPED, found, None)
    assert not scored["exact"] and not scored["detected"] and not scored["inside"]
    assert metrics([scored])["failed"] == 1


def test_work_comes_back_in_order(capsys):
    """On one core or on two, results come in the order of the arguments, and the end is told."""
    pairs = [(7, 2), (9, 4), (5, 5)]
    assert each("divided", divmod, pairs, 1) == each("divided", divmod, pairs, 2) == [(3, 1), (2, 1), (1, 0)]
    assert "divided: 3 of 3" in capsys.readouterr().err


def test_a_folder_holds_one_trial(tmp_path):
    """Another seed or number of cases in the same folder is refused before anything is drawn."""
    concealed._begun(tmp_path, {"seed": 0})
    concealed._begun(tmp_path, {"seed": 0})
    with pytest.raises(BrokenSeal, match="another trial"):
        concealed._begun(tmp_path, {"seed": 1})
    with pytest.raises(SystemExit) as stop:
        concealed.main(["--cases", "2"])
    assert stop.value.code == 2


# Scoring


def test_a_right_answer_scores():
    """The true name is exact and inside, its interval holds the truth, and errors are in sd of the noise."""
    found = row("case_001", DAMPED, result(NAMED), {"nameable": True, "widths": {"viscous_damping|theta|c": 0.01},
                                                     "holdout": 1.0, "forecast": 0.5})  # fmt: skip
    assert found["exact"] and found["inside"] and found["located"] and found["detected"]
    assert found["size"] == 2 and found["score"] == pytest.approx(0.97) and nothing(NAMED) == 0.03
    (one,) = found["coefficients"]
    assert one["inside"] and one["width"] == pytest.approx(0.02)
    assert found["holdout_after"] == pytest.approx(2.0) and found["forecast_after"] == pytest.approx(1.0)
    summary = metrics([found])["groups"]["all"]
    assert summary["width_over_oracle"] == pytest.approx(2.0)
    assert summary["forecast_over_oracle"] == pytest.approx(2.0) and summary["forecast_over_before"] == pytest.approx(
        0.2
    )


def test_what_can_be_named_is_told_for_all_rows_and_for_the_fitted():
    """A truth that the last rows alone tell counts among what the oracle can name, and not among what it can of those
    rows that are fitted."""
    told = {"nameable": True, "widths": {}, "early": {"nameable": False}}
    late = row("case_001", DAMPED, result(NAMED), told)
    both = row("case_002", DAMPED, result(NAMED), told | {"early": {"nameable": True}})
    groups = metrics([late, both, row("case_003", DAMPED, result(NAMED), None)])["groups"]
    assert (groups["oracle can name"]["cases"], groups["of the fitted rows"]["cases"]) == (2, 1)


def test_a_forecast_counts_as_far_as_it_goes():
    """Times beyond the last that was asked are left out, not held at its value."""
    short = result(NAMED)
    short["forecast"] = {n: v[:2] for n, v in short["forecast"].items()}
    far = DAMPED | {"forecast": [[[0.0], [0.0], [9.0]]]}
    assert row("case_001", far, short, None)["forecast_after"] == pytest.approx(1.0)


def test_a_forecast_is_compared_where_the_truth_is():
    """A right forecast of a swing, eight rows a period, is right between its rows, too, where a straight line would be
    off by up to 8 % of the swing."""
    t = np.arange(24) * np.pi / 4
    later = t[:-1] + np.pi / 8
    answer = {"records": [{"after": list(later)}], "forecast": [np.cos(later)[:, None]], "columns": ["y"],
              "noise": {"y": 1.0}}  # fmt: skip
    assert forecast_error(answer, {"t": list(t), "y_after": list(np.cos(t))}, "after") < 0.01


def test_a_wrong_name_scores_by_its_alternatives():
    """A wrong name is not exact; it is inside where the truth is among the alternatives that make up 95 %."""
    near = document(finding("quadratic_drag", "theta"), p=0.6, rest=[([("viscous_damping", "theta")], False, 0.4)])
    far = document(finding("quadratic_drag", "theta"), p=0.96, rest=[([("viscous_damping", "theta")], False, 0.04)])
    assert credible_set(DAMPED, near) == (True, 2) and credible_set(DAMPED, far) == (False, 1)
    assert not row("a", DAMPED, result(near), None)["exact"]
    assert row("a", DAMPED, result(near), None)["located"]  # the place is right all the same
    elsewhere = document(finding("sensor_bias", "angle_rad"))
    elsewhere["location"]["kind"] = "sensor"
    assert not row("a", DAMPED, result(elsewhere), None)["located"]


def test_silence_on_a_healthy_case_is_right():
    """Nothing left out: consistent is exact, anything else is a false alarm."""
    healthy = answer(way="healthy")
    quiet, loud = (row("a", healthy, result(d), None) for d in (document(p=0.9), NAMED))
    assert quiet["exact"] and not quiet["detected"] and quiet["score"] == pytest.approx(0.1)
    assert loud["detected"] and not loud["exact"]
    found = metrics([quiet, loud])
    assert found["false_alarms"] == 1 and found["healthy"] == 2


def test_what_has_no_word_is_unexplained():
    """A force outside the vocabulary is right as unexplained or unnamed, and wrong under any name."""
    outside = answer(effect("cubic_damping", "theta"))
    unnamed = (("unnamed_force", "theta"),)
    assert right(outside, (), True) and right(outside, unnamed, False)
    assert not right(outside, (), False) and not right(outside, (("quadratic_drag", "theta"),), False)
    assert not right(DAMPED, (), True)
    both = answer(effect("cubic_damping", "theta"), effect("sensor_bias", "angle_rad"))
    assert right(both, (*unnamed, ("sensor_bias", "angle_rad")), False)
    assert not right(both, (*unnamed, ("sensor_gain", "angle_rad")), False)


def test_pairs_need_both_members():
    """A pair is right in any order, and half of it is wrong."""
    pair = answer(effect("viscous_damping", "theta"), effect("sensor_bias", "angle_rad"))
    keys = [("sensor_bias", "angle_rad"), ("viscous_damping", "theta")]
    assert right(pair, keys, False) and not right(pair, keys[:1], False)
    assert not right(pair, [*keys, ("sensor_gain", "angle_rad")], False)


def test_phases_turn():
    """A phase of 3.1 lies in an interval from -3.2 to -3.1: the circle closes."""
    forced = answer(effect("periodic_forcing", "theta", {"a": 1.0, "omega": 2.0, "phi": 3.1}))
    told = document(finding("periodic_forcing", "theta", phi=(-3.25, -3.15), a=(1.1, 1.2)))
    inside = {c["name"]: c["inside"] for c in row("a", forced, result(told), None)["coefficients"]}
    assert inside == {"phi": True, "a": False}


def test_equivalent_names_are_right():
    """Forms that no recording can tell apart count as one; each holds only where its reason does."""
    spring = answer(system="driven_spring", columns=["q_m"])
    bias, force = ("sensor_bias", "q_m"), ("constant_force", "q")
    assert equivalent(spring, bias, force) and equivalent(spring, force, bias)
    assert not equivalent(spring | {"columns": ["q_m", "speed"]}, bias, force)
    assert not equivalent(spring | {"system": "duffing"}, bias, force)
    assert equivalent(spring, ("linear_stiffness", "q"), ("parameter_error", "k"))
    assert same(answer(), [("parameter_error", "l")], [("parameter_error", "g")])
    assert not same(answer(), [("parameter_error", "l")], [("viscous_damping", "theta")])


def test_an_effect_that_calibration_owns_is_rightly_not_found():
    """A stiffness under a flat prior of its parameter leaves nothing to find; under a known one it does."""
    one = answer(effect("linear_stiffness", "q"), system="duffing", free=[["k", 4.0, None]])
    assert swallowed(one, ("linear_stiffness", "q")) and right(one, (), False)
    assert not right(one | {"free": [["k", 4.0, 0.1]]}, (), False) and not right(one | {"free": []}, (), False)
    assert ("duffing", "linear_stiffness", "q") in OWNERS


def test_calibration_is_counted():
    """Bins hold the right numbers; the Brier score of right probabilities is its own expectation."""
    rng = np.random.default_rng(0)
    p = rng.uniform(0.05, 0.99, 4000)
    pairs = list(zip(p, rng.random(4000) < p, strict=True))
    for one in calibration(pairs):
        # Four standard errors of a frequency.
        assert one["right"] / one["number"] == pytest.approx(one["mean"], abs=4 * 0.5 / np.sqrt(one["number"]))
    assert sum(one["number"] for one in calibration(pairs)) == 4000
    found = brier(pairs)
    assert abs(found["score"] - found["expected"]) < 4 * found["sampling_error"]
    sure = brier([(0.99, k % 2 == 0) for k in range(100)])
    assert sure["score"] - sure["expected"] > 10 * sure["sampling_error"]


def test_detection_at_fixed_alarms():
    """The threshold lets at most 2 % of the healthy pass: of fifty one, of forty none."""

    def scored(way, score):
        return {"way": way, "score": score}

    some = [scored("healthy", k / 100) for k in range(50)] + [scored("open", 0.485), scored("open", 0.475)]
    assert at_fixed_alarms(some)["threshold"] == pytest.approx(0.48) and at_fixed_alarms(some)["detected"] == 0.5
    few = [scored("healthy", k / 100) for k in range(40)] + [scored("open", 0.395), scored("open", 0.385)]
    assert at_fixed_alarms(few)["threshold"] == pytest.approx(0.39) and at_fixed_alarms(few)["detected"] == 0.5


def test_tables_and_figures_take_every_kind_of_row(capsys):
    """Right, wrong, healthy and failed cases go through the tables and the three figures."""
    lost = {"status": "crashed", "seconds": 1.0, "document": None, "forecast": None}
    rows = [
        row("case_001", DAMPED, result(NAMED), None),
        row("case_002", answer(way="healthy"), result(document(p=0.9)), None),
        row("case_003", answer(effect("cubic_damping", "theta"), way="noise"), lost, None),
        row("case_004", answer(effect("viscous_damping", "theta"), effect("sensor_bias", "angle_rad"), way="masked"),
            result(document(verdict="unexplained", p=0.7)), None),
    ]  # fmt: skip
    found = metrics(rows)
    table_of_cases(rows)
    report(found)
    told = capsys.readouterr().out
    assert "case_004" in told and "False alarms: 0 of 1 healthy; failed: 1" in told
    for figure in (confusion(rows), reliability(found), strength(rows, 0.5)):
        figure.canvas.draw()
