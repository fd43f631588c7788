"""The rigs move and are read as their sentences say, and the experiment counts what it says."""

import json
from dataclasses import replace

import numpy as np
import pytest

from experiments import rigs as experiment
from experiments._rigs_nature import RIGS, motion, recorded
from symplearn import read_recordings, read_simulation


def drawn(name):
    rng = np.random.default_rng([0, 0, *name.encode()])
    rig = RIGS[name](rng)
    return rig, recorded(rig, rng)


def test_a_cart_that_is_only_damped_is_the_textbooks():
    """Without all but its viscous damping the cart's motion is the closed form of a damped spring."""
    rig, _ = drawn("cart")
    c, k, x = 0.3, rig.parameters["k"], rig.start[0]
    values = dict.fromkeys(rig.values, 0.0) | {"viscous": c}
    turn = np.sqrt(k - c**2 / 4)
    t = rig.times
    expected = x * np.exp(-c * t / 2) * (np.cos(turn * t) + c / (2 * turn) * np.sin(turn * t))
    moved = motion(rig, values, rig.parameters, rig.start, t)[:, 0]
    # DOP853 is asked for 1e-10 of the state in every step, and what it errs by adds up over hundreds. Seen: 1.7e-10.
    np.testing.assert_allclose(moved, expected, rtol=0, atol=2e-9 * x)


@pytest.mark.parametrize("name", RIGS)
def test_what_is_read_is_the_motion_and_what_is_given_is_a_simulation(name, tmp_path):
    """Readings lie within a tenth of their spread of what the unspoilt sensor shows; the two files are read, with the
    columns and rows that there are."""
    rig, readings = drawn(name)
    states = motion(rig, rig.values, rig.parameters, rig.start, rig.times)
    missed = readings - rig.shown(states, rig.times, rig.values, rig.parameters)
    # Noise is 0.3 to 1.2 % of an amplitude that shrinks, and what spoils a reading as much. Seen: 0.022.
    assert np.all(np.sqrt(np.mean(missed**2, axis=0)) < 0.1 * readings.std(0))
    experiment._write(rig, readings, tmp_path)
    simulation = read_simulation(tmp_path / "simulation.toml")
    (recording,) = read_recordings(simulation, [tmp_path / "recording.csv"])
    assert list(recording.columns) == list(rig.observe)
    # Nine digits are written, so that half of the last is 5e-9 of a number that begins with 1. Seen: 4.7e-9.
    np.testing.assert_allclose(recording.readings, readings, rtol=1e-8)


def test_what_does_not_act_is_counted(tmp_path, monkeypatch, capsys):
    """From a made-up answer: the error over the true form's, and what is told at 0.9 and does not act, of those at a
    place alone; a second run diagnoses nothing."""
    rig, _ = drawn("cart")
    told = [("viscous_damping", "x", 1.0), ("impulse", "x", 0.95), ("periodic_forcing", "x", 0.5)]
    answer = {
        "verdict": "mismatch", "probability": 0.9, "seconds": 3.0,
        "findings": [{"effect": e, "target": t, "probability": p} for e, t, p in told],
        "fit": {"after": {"holdout_rmse": {"x_m": 2.0}}},
    }  # fmt: skip
    monkeypatch.setattr(experiment, "RIGS", {"cart": lambda rng: replace(rig, times=rig.times[:60])})
    monkeypatch.setattr(experiment, "_diagnosed", lambda folder: answer)
    monkeypatch.setattr(experiment, "held_out", lambda rig, readings, fitted: np.array([1.0]))
    experiment.main(["--quick", "--out", str(tmp_path)])
    found = json.loads((tmp_path / "metrics.json").read_text(encoding="utf-8"))
    assert found["within"] == 0.0 and found["not_there"] == 1
    assert found["median_over_the_true_form"] == pytest.approx(2.0)
    assert "impulse x 0.95" in capsys.readouterr().out
    monkeypatch.setattr(experiment, "_diagnosed", lambda folder: pytest.fail("a case was not kept"))
    experiment.main(["--quick", "--out", str(tmp_path)])
