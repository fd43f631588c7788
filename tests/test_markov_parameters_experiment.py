"""The experiment of section 3.2.2.1 draws the systems it says, starts from readings alone, and leaves its metrics."""

import json

import numpy as np
import pytest
from scipy.stats import halfnorm

from experiments import _markov_parameters_case as case
from experiments import _markov_parameters_estimates as estimates
from experiments import _markov_parameters_results as outcome
from experiments import markov_parameters as experiment


def test_systems_and_recordings_are_as_described():
    """From rest, x' = x + B u and y = H x + D u; readings without noise are those of a textbook loop, the exact Markov
    parameters its answer to an impulse, and the entries have the variances of the text."""
    one = case.case(0, "small", 0.0, 1, 100)
    assert one.readings.shape == (117, 2) and one.B.shape == (5, 3)
    x, readings = np.zeros(5), []
    for u in one.inputs:
        readings.append(one.H @ x + one.D @ u)
        x = x + one.B @ u
    # Round-off of 117 sums.
    np.testing.assert_allclose(one.readings, readings, atol=1e-12)
    exact = [one.D] + [one.H @ np.linalg.matrix_power(np.eye(5), k) @ one.B for k in range(17)]
    np.testing.assert_array_equal(one.exact, exact)
    many = [case.case(0, "large", 1.0, k, 90) for k in range(20)]
    # 1600 draws of H, 1000 of B: variances are known to 3.5 and 4.5 %; four of these.
    assert np.var([m.H for m in many]) == pytest.approx(1 / 8, rel=0.15)
    assert np.var([m.B for m in many]) == pytest.approx(1 / 10, rel=0.18)


def test_noise_is_added_to_both():
    """What a loop without noise leaves of the readings grows as a random walk read by H, with measurement noise."""
    differences = []
    for k in range(40):
        loud, quiet = case.case(2, "small", 0.5, k, 400), None
        x = np.concatenate([np.zeros((1, 5)), np.cumsum(loud.inputs @ loud.B.T, axis=0)[:-1]])
        quiet = x @ loud.H.T + loud.inputs @ loud.D.T
        steps = np.diff(loud.readings - quiet, axis=0)
        differences.append(np.var(steps, axis=0) / (0.25 * (np.sum(loud.H**2, axis=1) + 2.0)))
    # Of one step: s^2 (H H' + 2 I). A variance of 416 neighbouring steps is known to some 8 %, of 80 means to 1 %.
    assert np.mean(differences) == pytest.approx(1.0, abs=0.04)


def test_a_shorter_recording_is_the_beginning_of_a_longer_one():
    """K equations need K + 17 rows, and `first` gives those of the case that was drawn shorter."""
    longer, shorter = case.case(1, "large", 0.5, 2, 300), case.case(1, "large", 0.5, 2, 120)
    assert len(shorter.readings) == 137
    np.testing.assert_array_equal(longer.first(120).inputs, shorter.inputs)
    # Sums of other lengths may be ordered otherwise: round-off.
    np.testing.assert_allclose(longer.first(120).readings, shorter.readings, atol=1e-12)


def test_without_noise_every_estimate_but_ls_is_exact():
    """The autoregression and the floor give exact Markov parameters; LS does not, as A = I forgets nothing."""
    one = case.case(0, "small", 0.0, 0, 300)
    assert case.spectral_error(estimates.autoregression(one)[0], one.exact) < 1e-8
    assert case.spectral_error(case.floor(one), one.exact) < 1e-10
    assert case.spectral_error(estimates.ls(one), one.exact) > 0.1


def test_the_error_is_the_largest_singular_value():
    """Of all blocks side by side: the root of the largest eigenvalue of E E'."""
    rng = np.random.default_rng(0)
    wrong = rng.normal(size=(18, 2, 3))
    row = np.hstack(list(wrong))
    expected = np.sqrt(np.linalg.eigvalsh(row @ row.T)[-1])
    # Round-off.
    assert case.spectral_error(wrong, np.zeros_like(wrong)) == pytest.approx(expected, rel=1e-12)


def test_the_baselines_are_those_of_the_specification():
    """Small systems, noise 0.25, K = 2000: the floor's error is 0.13, LS's and GLS's some 30 times that, GLS's less."""
    cases = [case.case(0, "small", 0.25, k, 2000) for k in range(10)]
    ls, gls, floor = (
        np.mean([case.spectral_error(estimate(one), one.exact) for one in cases])
        for estimate in (estimates.ls, estimates.gls, case.floor)
    )
    # Ten repeats by another program; one floor scatters by a fifth, and one of LS by its own size.
    assert floor == pytest.approx(0.13, rel=0.25)
    assert gls < ls
    assert ls == pytest.approx(5.6, rel=0.7) and gls == pytest.approx(4.4, rel=0.7)


def test_starts_are_made_of_the_readings_alone():
    """A start is a model of the right size whose Markov parameters are near the autoregression's; the prior is
    half-N(0, 1) over the noises' standard deviations, as printed."""
    one = case.case(0, "small", 0.5, 0, 500)
    blocks, variance = estimates.autoregression(one)
    model = estimates.starting_model(blocks, variance, one)
    log_q, log_r = (
        float(noise.structure.variance.log_variance.free) for noise in (model.process_noise, model.measurement_noise)
    )
    expected = halfnorm.logpdf(np.exp([0.5 * log_q, 0.5 * log_r])).sum()
    # Round-off of two terms.
    assert float(estimates.PRIOR.log_density(model)) == pytest.approx(float(expected), rel=1e-12)
    A, B, H = (np.asarray(m) for m in (model.dynamics.A, model.dynamics.B, model.observation.matrix))
    assert A.shape == (5, 5)
    # ERA of order 5 leaves out what the noisy parameters have beyond it.
    assert np.abs(H @ B - blocks[1]).max() < 0.2 * np.abs(blocks[1]).max()
    at_first = H @ np.asarray(model.initial.mean.free)
    seen = one.readings[17] - np.asarray(model.observation.feedthrough) @ one.inputs[17]
    # A pseudo-inverse of an H whose singular values differ by some decades.
    np.testing.assert_allclose(at_first, seen, atol=1e-8)


def test_of_the_large_systems_only_some_are_fitted():
    """All small cases, and of the large ones the first few at the least noise and the fewer equations."""
    cases = list(range(10))
    assert experiment.mapped("small", 1.0, 2000, cases) == cases
    assert len(experiment.mapped("large", 0.25, 190, cases)) == experiment.LARGE_MAP
    assert not experiment.mapped("large", 1.0, 190, cases) and not experiment.mapped("large", 0.25, 2000, cases)


def made_up(counts, repeats):
    rng = np.random.default_rng(0)
    sizes = {"ls": 5.0, "gls": 4.0, "map": 0.2, "autoregression": 0.3, "floor": 0.1}
    found = {
        method: {str(count): (size * np.exp(0.1 * rng.normal(size=repeats))).tolist() for count in counts}
        for method, size in sizes.items()
    }
    return found | {"settled": {str(count): [True] * repeats for count in counts}, "won_by": {}}


def test_the_keys_and_the_figure_are_written_from_what_was_kept(tmp_path, monkeypatch, capsys):
    """With every group in its file nothing is estimated: a spread for each size, noise, K and method, and a figure."""
    calls = []

    def group(seed, size, noise, repeats, counts):
        calls.append((size, noise, list(repeats)))
        found = made_up(counts, len(repeats))
        return found | {"map": {}, "settled": {}} if size == "large" and noise > 0.25 else found

    monkeypatch.setattr(experiment, "group", group)
    experiment.main(["--quick", "--out", str(tmp_path)])
    assert calls == [("small", noise, [0, 1, 2]) for noise in (0.25, 0.5, 1.0)]
    found = json.loads((tmp_path / "metrics.json").read_text(encoding="utf-8"))
    one = found["error_small_noise_0.5_K_500_map"]
    assert one["repeats"] == 3 and one["smallest"] <= one["median"] <= one["largest"] and {"mean", "std"} <= one.keys()
    assert found["map_lowest_small_noise_1"] == {"154": 1.0, "500": 1.0, "1000": 1.0}
    printed = capsys.readouterr().out
    assert "ls 6.6, gls 5.3" in printed and "quick" in printed
    assert (tmp_path / "errors_small.png").read_bytes().startswith(b"\x89PNG")
    drawn = []
    monkeypatch.setattr(experiment, "errors_against_equations", lambda found, size: drawn.append(size))
    monkeypatch.setattr(experiment.Run, "save", lambda *_: None)
    experiment.main(["--quick", "--out", str(tmp_path)])
    assert len(calls) == 3  # the second run had all in its files
    experiment.main(["--out", str(tmp_path)])
    assert len(calls) == 3 + 3 * 5 + 3
    full = json.loads((tmp_path / "metrics.json").read_text(encoding="utf-8"))
    assert full["error_small_noise_1_K_2000_ls"]["repeats"] == 50
    assert outcome.name_of("large", 1.0, 2000, "gls") in full and outcome.name_of("large", 1.0, 2000, "map") not in full
    assert "not run" in capsys.readouterr().out and drawn == ["small", "small", "large"]


@pytest.mark.slow  # compiles the gradient of a filter with 63 numbers: a minute
def test_the_maximum_beats_least_squares():
    """From 300 equations the MAP's mean error is a fraction of those of LS and of GLS with the true weights."""
    found = experiment.group(0, "small", 0.25, range(4), (154, 300))
    assert np.mean(found["map"]["300"]) < 0.5 * min(np.mean(found["gls"]["300"]), np.mean(found["ls"]["300"]))
    assert len(found["won_by"]["154"]) == 4 and max(found["won_by"]["300"]) <= 2
