"""The experiment on samplers tells each measure of each sampler on each posterior, and which one to choose."""

import json

import numpy as np
import pytest

from experiments import samplers as experiment


def kept(choice):
    """What a posterior's file holds, made up."""
    trials = {
        name: dict(zip(experiment.TOLD, (400.0, 2.0, 9.0, rate, 3.0, 0.05, trusted), strict=True))
        for name, rate, trusted in (("AdaptiveImportance", 200.0, 1.0), ("NUTS", 2.0, 0.0))
    }
    return {"table": "sampler ESS", "trials": trials, "choice": choice}


def test_measures_are_written_and_drawn(tmp_path, monkeypatch, capsys):
    """One number for each measure, posterior and sampler; a posterior on which none can be trusted has no choice."""
    monkeypatch.setattr(experiment, "compared", lambda run, name: kept(None if name == "cherry" else "NUTS"))
    experiment.main(["--quick", "--seed", "2", "--out", str(tmp_path)])
    found = json.loads((tmp_path / "metrics.json").read_text(encoding="utf-8"))
    for name in experiment.POSTERIORS:
        assert found[f"ess_per_second_{name}_AdaptiveImportance"] == 200.0
        assert found[f"trusted_{name}_NUTS"] == 0.0
    assert found["choice_cherry"] is None and found["choice_henon_heiles"] == "NUTS"
    assert (tmp_path / "samplers.png").stat().st_size > 10_000
    printed = capsys.readouterr().out
    assert "sampler ESS" in printed and "left out: NUTS, MCLMC, DRAM" in printed


@pytest.mark.slow
def test_a_posterior_is_compared(tmp_path):
    """On the linear pendulum's posterior both fast samplers can be trusted, agree, and one of them is chosen."""
    found = experiment.compared(experiment.Run(tmp_path, 0, True), "linear_pendulum")
    assert set(found["trials"]) == {"AdaptiveImportance", "RandomWalk"}
    for told in found["trials"].values():
        assert told["trusted"] == 1.0 and told["off_by"] < 0.2
        assert np.isclose(told["ess_per_second"], told["ess"] / told["seconds"])
    assert found["choice"] in found["trials"]
