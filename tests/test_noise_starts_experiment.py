"""The experiment on noise starts counts what it says, and its problems are what their sentences say."""

import json

import jax
import numpy as np
import pytest

from experiments import _noise_zoo as zoo
from experiments import noise_starts as experiment
from symplearn._parameters import resolve


def kept(rng, count):
    """What a data set's file holds, made up: all of `learn` within half a nat of the best, a third of the straight."""
    one_sided = {"lower": None, "upper": 1e-4, "identifiable": False, "values": [1e-6, 1e-4], "drop": [0.0, 2.0]}
    bounded = one_sided | {"lower": 1e-5, "identifiable": True}
    return {
        "offsets": rng.uniform(-6, 6, size=(count, 2)).tolist(),
        "best": 10.0,
        "below": [0.0] * count,
        "straight_below": [0.1 if i % 3 == 0 else 30.0 for i in range(count)],
        "noises": [[1e-5, 1e-2]] * count,
        "best_noises": [1e-5, 1e-2],
        "profiles": {"process": one_sided, "measurement": bounded},
    }


def test_shares_are_counted_and_drawn(tmp_path, monkeypatch, capsys):
    """From made-up results: shares, spreads, one-sided profiles as null, a figure, a table; nothing is learnt."""
    rng = np.random.default_rng(0)
    monkeypatch.setattr(experiment, "measured", lambda run, name, k: kept(rng, 3))
    experiment.main(["--quick", "--seed", "3", "--out", str(tmp_path)])
    found = json.loads((tmp_path / "metrics.json").read_text(encoding="utf-8"))
    for name in zoo.ZOO:
        assert found[f"reached_{name}"] == 1.0 and found[f"starts_{name}"] == 6
        assert found[f"reached_straight_{name}"] == pytest.approx(1 / 3)
        assert found[f"below_straight_{name}"]["largest"] == 30.0
        assert found[f"identifiable_process_{name}"] == 0.0 and found[f"identifiable_measurement_{name}"] == 1.0
        assert found[f"profile_process_{name}"][0] == [None, 1e-4]
    assert (tmp_path / "noise_starts.png").stat().st_size > 10_000
    assert "33%" in capsys.readouterr().out
    # A second run reads what the first one left.
    monkeypatch.setattr(experiment, "measured", lambda run, name, k: pytest.fail("a data set was not kept"))
    experiment.main(["--quick", "--seed", "3", "--out", str(tmp_path)])


@pytest.mark.parametrize("name", zoo.ZOO)
def test_noises_start_where_they_are_told(name):
    """A problem's model starts at the variances that it is given, and its recordings differ by seed and by number."""
    problem = zoo.ZOO[name]
    model = resolve(problem.model(3e-4, 2e-3))
    covariances = (model.process_noise.covariance(None), model.measurement_noise.covariance(None))
    for covariance, variance in zip(covariances, (3e-4, 2e-3), strict=True):
        # A variance may be written as a logarithm: round-off.
        np.testing.assert_allclose(np.asarray(covariance), variance * np.eye(len(covariance)), rtol=1e-12)
    first, again, other, next_seed = (problem.recording(*at) for at in ((0, 0), (0, 0), (0, 1), (1, 0)))
    np.testing.assert_array_equal(first.readings, again.readings)
    for one in (other, next_seed):
        assert not np.array_equal(first.readings, one.readings, equal_nan=True)


def test_shaken_oscillator_has_both_noises():
    """Half the scatter of the shaken oscillator is in its motion: one-step errors have the variance of both noises."""
    rate, h = 2.0, 0.2
    c, s = np.cos(rate * h), np.sin(rate * h)
    step = np.array([[c, s / rate], [-rate * s, c]])
    y = np.concatenate([[zoo.shaken_oscillator(0, k).readings] for k in range(40)])
    errors = y[:, 1:] - y[:, :-1] @ step.T
    # Cov = process + measurement (I + step step'); 8000 errors know a variance to 2 %.
    expected = 1e-3 * np.eye(2) + 4e-4 * (np.eye(2) + step @ step.T)
    np.testing.assert_allclose(np.cov(errors.reshape(-1, 2).T), expected, rtol=0.08, atol=5e-5)


@pytest.mark.slow
def test_a_start_decades_off_ends_at_the_best(tmp_path):
    """Two starts of the linear pendulum's noises, up to six decades off, end within half a nat of the best."""
    jax.config.update("jax_enable_x64", True)
    found = experiment.measured(experiment.Run(tmp_path, 5, True), "linear_pendulum", 0)
    assert max(found["below"]) < experiment.NEAR
    assert found["profiles"]["measurement"]["identifiable"]
