"""The Henon-Heiles experiment leaves the keys and figures that it promises, and goes on where it was stopped."""

import json

import jax
import numpy as np
import pytest

import integrators as ig
from experiments import _henon_heiles_case as case
from experiments import _henon_heiles_results as outcome
from experiments import henon_heiles as experiment

TRUTH = np.array([0, 0, 0.5, 0, 0.5, 0, 1, 0, -1 / 3])
# The issue's, and what goes beyond it.
KEYS = {
    "H_true", "H_symplectic", "H_rk2", "tracking_time_symplectic", "tracking_time_rk2",
    "process_noise_ratio_rk2_over_symplectic", "coverage_trained_symplectic", "coverage_predicted_rk2", "seed", "quick",
    "H_order4_step_5_times_larger", "tracking_time_order4_step_5_times_larger",
    "tracking_time_posterior_mean_symplectic", "tracking_time_stepped_as_learnt_symplectic", "beyond",
}  # fmt: skip
FIGURES = ("phases", "hamiltonians", "trajectories", "process_noise", "spreads")


def kept(rng, propagator):
    """What a realisation's file holds, made up around the true potential."""
    worse = 10.0 if propagator == "rk2" else 1.0
    coefficients = TRUTH + 0.001 * worse * rng.normal(size=9)
    noise = 1e-5 * worse * np.exp(rng.normal(size=50))
    found = {
        "process_noise_draws": noise.tolist(), "process_noise_median": float(np.median(noise)),
        "converged": True, "posterior_converged": True,
    }  # fmt: skip
    return found | experiment.judged(
        propagator, coefficients, coefficients, coefficients + 1e-3 * rng.normal(size=(6, 9))
    )


def keep(folder):
    """The files of two realisations, of a quick and of a full run."""
    rng = np.random.default_rng(0)
    for name in experiment.PROPAGATORS:
        for k in range(2):
            found = kept(rng, name)
            for quick, where in ((True, folder / "quick"), (False, folder / "full")):
                where.mkdir(exist_ok=True)
                text = json.dumps(found | {"settings": experiment.settings(name, quick)})
                (where / f"seed3_{k:02d}_{name}.json").write_text(text, encoding="utf-8")


def test_the_keys_and_figures_are_written_from_what_was_kept(tmp_path, monkeypatch, capsys):
    """With every realisation in its file nothing is learnt: metrics, figures and published numbers; full has the keys
    of quick."""
    monkeypatch.setattr(experiment, "QUICK", 2)
    monkeypatch.setattr(experiment, "FULL", 2)
    monkeypatch.delattr(experiment, "learn")
    keep(tmp_path)
    experiment.main(["--quick", "--seed", "3", "--out", str(tmp_path)])
    found = json.loads((tmp_path / "metrics.json").read_text(encoding="utf-8"))
    assert found.keys() >= KEYS and found["realisations"] == 2
    assert set(found["H_rk2"]) == {"median", "lower_quartile", "upper_quartile", "smallest", "largest"}
    # A table line holds the published number beside ours.
    printed = capsys.readouterr().out.splitlines()
    assert any("H_symplectic" in line and "0.1219" in line for line in printed)
    assert sum("against" in line for line in printed) == len(found["beyond"]) > 0 and "what helps: " in printed[-2]
    for name in FIGURES:
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    monkeypatch.setattr(experiment, "_draw", lambda *_: None)
    experiment.main(["--seed", "3", "--out", str(tmp_path)])
    assert json.loads((tmp_path / "metrics.json").read_text(encoding="utf-8")).keys() == found.keys()


def test_a_file_of_other_settings_is_made_anew(tmp_path, monkeypatch):
    """A realisation comes from its file as long as propagator, sampler and horizon are those of the file."""
    calls = []
    monkeypatch.setattr(experiment, "learnt", lambda *given: calls.append(given) or {"H": float(len(calls))})
    run = experiment.Run(tmp_path, 5, quick=True)
    assert [experiment.realisation(run, "rk2", 1)["H"] for _ in range(2)] == [1.0, 1.0]
    monkeypatch.setitem(experiment.SAMPLERS, True, experiment.AdaptiveImportance(draws=400))
    assert [experiment.realisation(run, "rk2", 1)["H"] for _ in range(2)] == [2.0, 2.0]


def test_what_helps_is_told_from_the_numbers():
    """Longer in three realisations of four helps, shorter in three of four hurts, and else there is no difference; two
    times within a twentieth are equal."""

    def runs(**times):
        return [dict(zip(times, row, strict=True)) for row in zip(*times.values(), strict=True)]

    leapfrog = runs(
        tracking_time=[50.0, 60.0, 70.0, 80.0],
        tracking_time_stepped_as_learnt=[10.0, 20.0, 30.0, 90.0],
        tracking_time_posterior_mean=[51.0, 61.0, 69.0, 79.0],
        tracking_time_predictive_median=[50.0, 60.0, 71.0, 81.0],
    )
    order4 = runs(tracking_time=[90.0, 95.0, 99.0, 70.0])
    told = outcome.beyond({"symplectic": leapfrog, "order4_step_5_times_larger": order4})
    assert told["order4_step_5_times_larger"] == {
        "tracking_time": 92.5, "longer_in": 3, "shorter_in": 1, "verdict": outcome.HELPS
    }  # fmt: skip
    assert told["stepped_as_learnt"]["verdict"] == outcome.HURTS
    assert told["posterior_mean"]["verdict"] == told["predictive_median"]["verdict"] == outcome.UNCLEAR


def test_the_truth_is_henon_heiles():
    """The energy of the printed start is 0.122708 (specification E41), and DOP853 keeps it to 1e-10."""
    true = case.truth(np.linspace(0.0, 100.0, 11))
    q1, q2, p1, p2 = true.T
    energies = 0.5 * (p1**2 + p2**2 + q1**2 + q2**2) + q1**2 * q2 - q2**3 / 3
    np.testing.assert_allclose(energies, energies[0], atol=1e-10)
    assert energies[0] == pytest.approx(case.ENERGY, abs=5e-7)


def test_a_model_is_stepped_as_it_was_learnt():
    """`stepped_as_learnt` is the textbook's kick, drift, kick in steps of 0.25, and keeps 200 s of it."""

    def kick(q):
        return -0.125 * np.array([q[0] + 2 * q[0] * q[1], q[1] + q[0] ** 2 - q[1] ** 2])

    q, p = np.split(case.START, 2)
    expected = [case.START]
    for _ in range(800):
        p = p + kick(q)
        q = q + 0.25 * p
        p = p + kick(q)
        expected.append(np.concatenate([q, p]))
    found = case.stepped_as_learnt("symplectic", TRUTH)
    # Round-off, which this regular orbit lets grow by a few powers of ten in 800 steps.
    np.testing.assert_allclose(found.xs, expected, atol=1e-9)
    assert found.ts[-1] == 200.0


def test_predictions_are_near_exact():
    """The true potential stepped by leapfrog in 0.01 tracks the truth for the whole 200 s."""
    times = case.shown_times()
    path = case.predictions(TRUTH[None], times)[0]
    # Leapfrog's phase runs ahead by t dt^2 / 24, 8e-4 rad in 200 s; the orbit stretches that some tenfold.
    np.testing.assert_allclose(path, case.truth(times), atol=1e-2)


def test_order_4_bears_steps_five_times_larger():
    """With the true potential Blanes and Moan's method in steps of 1.25 is nearer the truth after 5 s than leapfrog in
    0.25, and halving its step divides the error by 16."""
    start, times = case.START, np.array([0.0, 5.0])
    potential = case.PolynomialPotential(2, 3, TRUTH)

    def error(integrator, substeps):
        end = ig.integrate(potential, integrator, start, times, substeps).xs[-1]
        return float(np.linalg.norm(end - case.truth(times)[-1]))

    method = ig.BlanesMoan4()
    assert error(method, 4) < 0.2 * error(ig.Leapfrog(), 20)
    # Order 4: 16, and what the next order adds.
    assert error(method, 16) / error(method, 32) == pytest.approx(16.0, rel=0.2)


def test_tracking_ends_where_the_error_is_a_fifth_of_the_amplitude():
    """An error that grows by 0.01 a second passes a fifth of the amplitude 1 at the first time beyond 20 s."""
    times = np.arange(0.0, 50.5, 0.5)
    true = np.stack([np.cos(times), np.sin(times)], axis=1)
    away = true + 0.01 * times[:, None] * np.array([1.0, 0.0])
    assert case.tracking_time(away, true, times, 1.0) == 20.5
    assert case.tracking_time(true, true, times, 1.0) == 50.0
    away[10:] = np.nan
    assert case.tracking_time(away, true, times, 1.0) == 5.0


def test_bands_hold_what_was_drawn_with_them():
    """Truths drawn as the predictions are lie in the band of 95 % for 95 % of the times."""
    rng = np.random.default_rng(0)
    trained = np.arange(2000) < 1000
    scale = np.where(trained, 1.0, 3.0)[:, None]
    paths, true = scale * rng.normal(size=(400, 2000, 1)), scale * rng.normal(size=(2000, 1))
    found = experiment._bands(paths, true, trained)
    # A thousand independent times: 0.7 % standard error; four of them.
    assert found["coverage_trained"] == pytest.approx(0.95, abs=0.03)
    assert found["coverage_predicted"] == pytest.approx(0.95, abs=0.03)
    # 2 x 1.96 standard deviations; the 2.5 % quantile of 400 draws is some 0.02 short on the average of the times.
    assert found["band_width_trained"] == pytest.approx(3.92, abs=0.06)
    assert found["band_width_predicted"] == pytest.approx(3 * 3.92, abs=0.18)


def test_noise_realisations_differ_and_come_back():
    """A realisation hangs on the seed and its number alone; its noise has the printed deviation; time 0 is blank."""
    one, again, other = case.recording(0, 1), case.recording(0, 1), case.recording(1, 1)
    assert np.array_equal(one.readings, again.readings, equal_nan=True)
    noise = np.asarray(one.readings)[1:] - case.truth(np.asarray(one.times))[1:]
    # Eighty draws: a deviation is known to 8 %; four of these.
    assert noise.std() == pytest.approx(case.NOISE, rel=0.32)
    assert np.all(np.isnan(one.readings[0])) and not np.allclose(one.readings[1:], other.readings[1:])


@pytest.mark.slow  # compiles the filter's gradient: a minute
def test_one_realisation_is_learnt_and_sampled():
    """Leapfrog's learnt energy is within 5 % of the truth's, and the posterior holds the truth."""
    found = experiment.learnt("symplectic", case.recording(0, 0), experiment.SAMPLERS[False], jax.random.key(0))
    assert found["converged"] and found["posterior_converged"]
    # The posterior's own deviation of H is about 2.5 % (performance.md, C).
    assert found["H"] == pytest.approx(case.ENERGY, rel=0.05)
    assert found["coverage_trained"] > 0.5
    assert found.keys() >= kept(np.random.default_rng(0), "symplectic").keys()
