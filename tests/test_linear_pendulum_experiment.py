"""The linear pendulum's experiment leaves the keys and figures that it promises, and its baselines are as known."""

import json

import jax
import numpy as np
import pytest

from experiments import _linear_pendulum_results as outcome
from experiments import _pendulum_case as case
from experiments import linear_pendulum as experiment

KEYS = {
    "cells", "cells_counted", "cells_won_over_dmd", "cells_won_over_tdmd", "cells_won_over_dmd_by_map", "published",
    "share_of_cells_won_over_dmd", "largest_log10_bayes_over_tdmd", "mse_bayes_n8_sigma0.01", "mse_tdmd_n40_sigma0.1",
    "forecast_mse_dmd_n40_sigma0.1", "coverage_n8_sigma0.01", "measurement_noise_n40_sigma0.1", "seed", "quick",
}  # fmt: skip
FIGURES = ("ratios", "n8_sigma0.01", "n40_sigma0.1")


def propagator(cell):
    """The true A of one data interval, in closed form."""
    rate, step = case.GRAVITY**0.5, case.READ_UNTIL / cell.n
    cosine, sine = np.cos(rate * step), np.sin(rate * step)
    return np.array([[cosine, sine / rate], [-rate * sine, cosine]])


def kept(cell, rng, shown):
    """What is kept of a data set, made up: draws near the true A, decompositions off by ten times as much."""
    near = propagator(cell) + 1e-3 * rng.normal(size=(20, 2, 2))
    values = {name: propagator(cell) + 1e-2 * rng.normal(size=(2, 2)) for name in ("map", "dmd", "tdmd")}
    found = experiment.judged(cell, near, values) | {
        "process_noise": 1e-6, "measurement_noise": cell.sigma**2, "converged": True, "posterior_converged": True,
        "pareto_k": None,
    }  # fmt: skip
    if shown:
        drawn = np.exp(rng.normal(size=(20, 2)))
        found["shown"] = {"draws": near.tolist(), "variances": drawn.tolist()}
        found["shown"] |= {name: A.tolist() for name, A in values.items()}
    return found


def keep(folder, size):
    """The files of one block of every cell, of a quick and of a full run."""
    rng = np.random.default_rng(0)
    for quick, cells in ((True, experiment.QUICK_CELLS), (False, experiment.FULL_CELLS)):
        where = folder / ("quick" if quick else "full")
        where.mkdir()
        for cell in cells:
            block = {"datasets": [kept(cell, rng, k == 0 and cell in experiment.DETAILED) for k in range(size)]}
            text = json.dumps(block | {"settings": f"{experiment.SETTINGS}, {size} data sets"})
            (where / f"seed3_00_{cell.name}.json").write_text(text, encoding="utf-8")


def test_the_keys_and_figures_are_written_from_what_was_kept(tmp_path, monkeypatch, capsys):
    """With every block in its file nothing is learnt: metrics, maps and figures; a full run has the keys of a quick
    one, and the estimate that was made the nearest to the truth wins every cell."""
    size = 4
    monkeypatch.setattr(experiment, "QUICK", size)
    monkeypatch.setattr(experiment, "FULL", size)
    monkeypatch.setattr(experiment, "BLOCK", {True: size, False: size})
    monkeypatch.delattr(experiment, "learnt")
    keep(tmp_path, size)
    experiment.main(["--quick", "--seed", "3", "--out", str(tmp_path)])
    found = json.loads((tmp_path / "metrics.json").read_text(encoding="utf-8"))
    assert found.keys() >= KEYS
    assert found["cells_won_over_dmd"] == found["cells_won_over_tdmd"] == found["cells_counted"] == 6
    assert found["largest_log10_bayes_over_dmd"] < 0 and found["datasets_per_cell"] == size
    assert "(published: below 0 in all)" in capsys.readouterr().out
    for name in FIGURES:
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    monkeypatch.setattr(experiment, "_draw", lambda *_: None)
    experiment.main(["--seed", "3", "--out", str(tmp_path)])
    full = json.loads((tmp_path / "metrics.json").read_text(encoding="utf-8"))
    assert full.keys() == found.keys() and full["cells_counted"] == 25


def test_blocks_come_back_from_their_files(tmp_path):
    """A second run of the same settings makes nothing anew; one of other settings makes everything."""
    run, cells, made = experiment.Run(tmp_path, 5, quick=True), [case.Cell(8, 0.1), case.Cell(9, 0.1)], []

    def one(cell, k):
        made.append((cell.n, k))
        return {"k": k}

    first = case.each_block(run, cells, 4, 2, "so", one)
    assert made == [(8, 0), (8, 1), (9, 0), (9, 1), (8, 2), (8, 3), (9, 2), (9, 3)]
    assert case.each_block(run, cells, 4, 2, "so", one) == first and len(made) == 8
    case.each_block(run, cells, 4, 2, "otherwise", one)
    assert len(made) == 16


def test_the_truth_is_the_linear_pendulum():
    """The true states are powers of the closed-form propagator (cosines and sines) from (0.1, -0.5), to 8 s."""
    cell = case.Cell(16, 0.1)
    states = case.pushed(propagator(cell), np.array([0.1, -0.5]), 32)
    # Round-off of the matrix exponential.
    np.testing.assert_allclose(case.LINEAR.states(cell.times(case.HORIZON)), states, atol=1e-12)


def test_pushing_forward_is_taking_powers():
    """Many matrices pushed at once give what `numpy.linalg.matrix_power` gives of each."""
    many, start = np.random.default_rng(0).normal(size=(5, 2, 2)), np.array([0.3, -0.2])
    expected = [[np.linalg.matrix_power(A, k) @ start for k in range(7)] for A in many]
    # Round-off of six products.
    np.testing.assert_allclose(case.pushed(many, start, 6), expected, rtol=1e-12)


@pytest.mark.parametrize(("n", "sigma", "expected"), [(8, 0.01, (2.66e-4, 2.52e-4)), (40, 0.1, (7.9e-2, None))])
def test_the_baselines_have_their_known_errors(n, sigma, expected):
    """DMD's and TDMD's mean errors are those of specification 5.3, within four standard errors of a hundred data sets;
    TDMD's at (40, 0.1) has no mean worth the name (0.59, median 0.039), and its median is compared."""
    cell = case.Cell(n, sigma)
    true = case.LINEAR.states(cell.times())
    errors = {"dmd": [], "tdmd": []}
    for k in range(100):
        for name, A in case.decompositions(case.recording(case.LINEAR, cell, 0, k)).items():
            errors[name].append(case.squared_error(case.pushed(A, case.LINEAR.start, n), true))
    for name, known in zip(errors, expected, strict=True):
        if known is not None:
            error = np.std(errors[name], ddof=1) / 10
            # Four standard errors.
            assert outcome.kept_mean(np.array(errors[name])) == pytest.approx(known, abs=4 * error)
            # The errors are no wider than their mean, so that four standard errors are at most 40 %.
            assert error < 0.15 * known
        else:
            # The median of a hundred draws lies between their 36th and 64th in 99.5 % of cases.
            low, high = np.quantile(errors[name], [0.36, 0.64])
            assert low < 0.039 < high


def test_the_largest_error_is_dropped_and_the_ratio_has_its_error():
    """The mean is that of all errors but the largest; the log ratio of two log-normal samples has the standard error
    that the delta method gives."""
    assert outcome.kept_mean(np.array([1.0, 100.0, 3.0, 2.0])) == 2.0
    rng = np.random.default_rng(1)
    ours, theirs = np.exp(0.5 * rng.normal(size=(2, 400)))
    ratio, error = outcome.log_ratio(ours, 10 * theirs)
    expected = np.hypot(ours.std() / ours.mean(), theirs.std() / theirs.mean()) / 20 / np.log(10)
    # Two hundred resamples know a deviation to 5 %; dropping the largest and the means' curvature add as much.
    assert error == pytest.approx(expected, rel=0.25)
    assert ratio == pytest.approx(-1.0, abs=4 * expected)


def test_noise_realisations_differ_and_come_back():
    """A data set hangs on cell, seed and number alone; the noise on all n + 1 readings has the printed deviation."""
    cell = case.Cell(40, 0.1)
    one, again, other = (case.recording(case.LINEAR, cell, seed, 1) for seed in (0, 0, 1))
    assert np.array_equal(one.readings, again.readings) and not np.allclose(one.readings, other.readings)
    noise = np.asarray(one.readings) - case.LINEAR.states(cell.times())
    # 82 draws: a deviation is known to 8 %; four of these.
    assert noise.shape == (41, 2) and noise.std() == pytest.approx(0.1, rel=0.32)


@pytest.mark.slow  # compiles learning and sampling: half a minute
def test_one_data_set_is_learnt_better_than_by_decomposition():
    """Of 40 readings with noise 0.1 the predictive mean is nearer the truth than DMD's motion, which dies out, and the
    measurement noise is found within four of its standard deviations (16 % each)."""
    cell = case.Cell(40, 0.1)
    series = case.recording(case.LINEAR, cell, 0, 0)
    found = experiment.dataset(cell, series, jax.random.key(0), shown=True)
    assert found["converged"] and found["mse_bayes"] < 0.5 * found["mse_dmd"]
    # 82 draws know a deviation to 8 %, so a variance to 16 %; four of these.
    assert found["measurement_noise"] == pytest.approx(0.01, rel=0.64)
    assert np.shape(found["shown"]["draws"]) == (1000, 2, 2)
    assert found.keys() == kept(cell, np.random.default_rng(0), shown=True).keys()
