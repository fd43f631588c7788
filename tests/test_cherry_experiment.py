"""The Cherry experiment leaves the keys and figures that it promises, and goes on where it was stopped."""

import importlib
import json
import math
import sys

import equinox as eqx
import numpy as np
import pytest
from command_line_cases import ROOT

import integrators as ig
from symplearn._hamiltonians import Polynomial
from symplearn._importance import AdaptiveImportance
from symplearn._objectives import MARGINAL_LIKELIHOOD
from symplearn._prior import Laplace, Prior

sys.path.insert(0, str(ROOT))  # experiments are no installed package
case = importlib.import_module("experiments._cherry_case")
experiment = importlib.import_module("experiments.cherry")
KEYS = {
    "e_train_symplectic", "e_test_symplectic", "e_train_rk2", "e_test_rk2", "H_true", "H_symplectic", "H_rk2",
    "horizon_bayes", "horizon_ls", "e_test_order4_step_8_times_larger", "horizon_map_order4_step_40_times_larger",
    "horizon_map_multiplicative_noise", "horizon_expected", "beyond", "published", "seed", "quick",
}  # fmt: skip
FIGURES = ("hamiltonians", "reconstructions", "training", "testing", "spreads")


def coefficients(basis):
    """Those of (5.23), by hand; a Legendre square is (3 z^2 - 1) / 2."""
    terms = Polynomial(2, 3, None, basis).terms
    squares = {"q0^2": 0.5, "q1^2": -1.0, "p0^2": 0.5, "p1^2": -1.0, "q0^2 p1": -0.5, "p0^2 p1": 0.5, "q0 q1 p0": -1.0}
    if basis == case.MONOMIALS:
        return np.array([squares.get(term, 0.0) for term in terms])
    found = {
        "P2(q0)": 1 / 3, "P2(q1)": -2 / 3, "P2(p0)": 1 / 3, "P2(p1)": -2 / 3,
        "P2(q0) P1(p1)": -1 / 3, "P2(p0) P1(p1)": 1 / 3, "P1(q0) P1(q1) P1(p0)": -1.0,
    }  # fmt: skip
    assert found.keys() <= set(terms)
    return np.array([found.get(term, 0.0) for term in terms])


def kept(rng, kind, k):
    """What a realisation's file holds, made up around the truth."""
    said = {
        "process_noise": 1e-6,
        "measurement_noise": 1e-4,
        "converged": True,
        "settings": experiment.settings(kind, k, True),
    }
    if kind in experiment.SINGLE:
        around = coefficients(case.MONOMIALS) + 1e-3 * rng.normal(size=34)
        return experiment.judged(around, case.MONOMIALS) | said | {"draws": []}
    if kind == "several_multiplicative":
        return experiment.judged(coefficients(case.LEGENDRE), case.LEGENDRE) | said
    drawn = coefficients(case.LEGENDRE) + 1e-4 * rng.normal(size=(4, 34))
    parts = {part: experiment.judged(drawn[i], case.LEGENDRE) | said for i, part in enumerate(("ls", "order4", "map"))}
    return (
        parts
        | experiment._predictive(drawn)
        | said
        | {"draws": drawn.tolist(), "posterior_converged": True, "expected": 20.0}
    )


def test_the_keys_and_figures_are_written_from_what_was_kept(tmp_path, monkeypatch, capsys):
    """With every realisation in its file nothing is learnt again: metrics, figures and the published numbers appear."""
    rng = np.random.default_rng(0)
    monkeypatch.setattr(experiment, "QUICK", 2)
    monkeypatch.setattr(experiment, "learnt", None)  # would be called for what is not kept
    (tmp_path / "quick").mkdir()
    for kind in experiment.KINDS:
        for k in range(2):
            path = tmp_path / "quick" / f"seed3_{k:02d}_{kind}.json"
            path.write_text(json.dumps(kept(rng, kind, k)), encoding="utf-8")
    experiment.main(["--quick", "--seed", "3", "--out", str(tmp_path)])
    found = json.loads((tmp_path / "metrics.json").read_text(encoding="utf-8"))
    assert found.keys() >= KEYS and found["realisations"] == 2
    assert set(found["horizon_bayes"]) == {"median", "lower_quartile", "upper_quartile", "smallest", "largest"}
    # A table line holds the published number beside ours.
    assert any("horizon_bayes" in line and "18.22" in line for line in capsys.readouterr().out.splitlines())
    for name in FIGURES:
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_a_file_of_other_settings_is_made_anew(tmp_path, monkeypatch):
    """A realisation that was kept under another prior is not taken for this one's."""
    run = experiment.Run(tmp_path, 0, True)
    monkeypatch.setattr(experiment, "learnt", lambda run, kind, k: {"made": k})
    assert experiment.realisation(run, "rk2", 1)["made"] == 1
    monkeypatch.setattr(experiment, "learnt", None)
    assert experiment.realisation(run, "rk2", 1)["made"] == 1
    monkeypatch.setattr(experiment, "learnt", lambda run, kind, k: {"made": "anew"})
    monkeypatch.setattr(experiment, "PRIOR", Prior({"dynamics": Laplace(0.7)}))
    assert experiment.realisation(run, "rk2", 1)["made"] == "anew"


def test_the_truth_is_cherrys():
    """DOP853 keeps (5.23) to 1e-10 over 24 s, and its value at the printed start is -0.00775 (specification 5.16)."""
    q1, q2, p1, p2 = case.truth(np.linspace(0.0, 24.0, 13)).T
    levels = (q1**2 + p1**2) / 2 - q2**2 - p2**2 + p2 * (p1**2 - q1**2) / 2 - q1 * q2 * p1
    # SciPy's bound of 1e-12 a step on states of about 0.2, over a thousand steps, in the worst case 2e-10.
    np.testing.assert_allclose(levels, case.true_energy(), atol=1e-10)
    # The specification prints three digits.
    assert case.true_energy() == pytest.approx(-0.00775, abs=5e-6)


@pytest.mark.parametrize("basis", [case.MONOMIALS, case.LEGENDRE])
def test_true_coefficients_predict_the_truth(basis):
    """In both bases the true coefficients have the true energy, and predict to the horizon's end."""
    found = experiment.judged(coefficients(basis), basis)
    assert found["H"] == pytest.approx(case.true_energy(), rel=1e-12)
    # The faster oscillator, of frequency 2, has the phase error (2 * 0.01)^2 / 24 * 2 a second of a method of order 2:
    # 3e-4 after 8 s, and 6e-4 after 16 s. Twice that.
    assert found["e_train"] < 6e-4 and found["e_test"] < 1.2e-3 and found["horizon"] == case.HORIZON


def test_the_relative_error_is_the_frobenius_norms_ratio():
    """An estimate that is the truth times 1.3 has e = 0.3 (5.24); one that escaped has the error 10, and never NaN."""
    times = case.fine_times()
    true = case.truth(times)
    found = case.errors(1.3 * true, true, times)
    assert found["e_train"] == pytest.approx(0.3) and found["e_test"] == pytest.approx(0.3) and found["horizon"] == 0.0
    wild = experiment.judged(np.full(34, 1e3), case.MONOMIALS)
    assert wild["e_train"] == wild["e_test"] == case.LARGEST_ERROR
    assert math.isfinite(wild["H"]) and 0 < wild["horizon"] < 1.0


def test_the_horizon_is_of_all_states_so_far():
    """States of norm 1 that are right for 10 s and then off by 1: e(1:k) = sqrt((k - 1001) / k) passes 0.1."""
    times = np.linspace(0.0, 24.0, 2401)
    true = np.stack([np.cos(times), np.sin(times), 0 * times, 0 * times], axis=1)
    wrong = true + np.where(np.arange(2401) >= 1001, 1.0, 0.0)[:, None] * np.array([0.0, 0.0, 1.0, 0.0])
    # (k - 1001) / k >= 0.01 from k = 1012 on (1011.1), which is row 1011.
    assert case.horizon(wrong, true, times) == pytest.approx(10.11)
    assert case.horizon(true, true, times) == 24.0


def test_noise_realisations_have_their_law_and_come_back():
    """One recording has normal noise of 0.01, hung on seed and number alone; several have near, different starts."""
    one, again, other = case.single(0, 1), case.single(0, 1), case.single(1, 1)
    assert np.array_equal(one.readings, again.readings) and not np.allclose(one.readings, other.readings)
    # 84 draws: a deviation is known to 8 %; four of these.
    assert (one.readings - case.truth(case.read_times())).std() == pytest.approx(case.NOISE, rel=0.32)
    recordings = case.several(0, 1)
    assert len(recordings) == 5 and all(series.readings.shape == (21, 4) for series in recordings)
    starts = np.array([series.readings[0] for series in recordings])
    # Deviations of 0.05, and a tenth of a reading: four deviations.
    assert np.all(np.abs(starts - case.START) < 0.25) and np.all(np.ptp(starts, axis=0) > 0.01)
    assert np.array_equal(recordings[2].readings, case.several(0, 1)[2].readings)


def test_factors_of_the_noise_are_within_a_tenth(monkeypatch):
    """Readings over the truth lie in 0.9 to 1.1 and spread as uniform factors do."""
    seen, true_orbit = [], case.truth
    monkeypatch.setattr(case, "truth", lambda *arguments: seen.append(true_orbit(*arguments)) or seen[-1])
    recordings = case.several(4, 0)
    kept_orbits = [x for x in seen if len(x) == 21 and np.max(np.abs(x)) < case.ESCAPED]
    factors = np.array([series.readings / x for series, x in zip(recordings, kept_orbits, strict=True)])
    assert np.all(np.abs(factors - 1) <= 0.1 + 1e-12)
    # 420 draws: the deviation of a uniform law is known to 2 %; four of these.
    assert factors.std() == pytest.approx(0.1 / math.sqrt(3), rel=0.09)


@pytest.mark.slow
def test_side_by_side_is_the_sum():
    """The batch of recordings has the score that the sum over them has."""
    recordings, model = case.several(0, 0)[:2], case.model(ig.RK2.midpoint(), 1, case.LEGENDRE)

    @eqx.filter_jit
    def scores(model, recordings):
        return [objective(model, recordings) for objective in (case.SideBySide(), MARGINAL_LIKELIHOOD)]

    together, apart = map(float, scores(model, recordings))
    # The sums are taken in another order.
    assert together == pytest.approx(apart, rel=1e-10)


@pytest.mark.slow
def test_the_command_learns_from_end_to_end(tmp_path, monkeypatch):
    """One realisation by cheap propagators: the metrics are there, and finite, or `Run.write` would have refused."""
    cheap = (ig.RK2.midpoint(), 1)
    monkeypatch.setattr(experiment, "FULL", 1)
    monkeypatch.setattr(experiment, "SAMPLERS", {False: AdaptiveImportance(draws=64, target=16, batch=128, rounds=4)})
    monkeypatch.setattr(experiment, "SINGLE", dict.fromkeys(experiment.SINGLE, cheap))
    monkeypatch.setattr(experiment, "ORDER4", cheap)
    monkeypatch.setattr(experiment, "SEVERAL", {False: [(ig.RK4(), 1), cheap]})
    experiment.main(["--out", str(tmp_path)])
    found = json.loads((tmp_path / "metrics.json").read_text(encoding="utf-8"))
    assert found.keys() >= KEYS
    # Of one noise realisation; RK2 in steps of 0.4 is coarse, but the published horizon of least squares is 1.5 s.
    assert found["horizon_bayes"]["median"] > 3 * found["horizon_ls"]["median"]
    assert len(list((tmp_path / "full").glob("seed0_00_*.json"))) == len(experiment.KINDS)
