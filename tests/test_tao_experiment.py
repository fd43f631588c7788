"""The experiments with neural Hamiltonians leave whole metrics, go on where they were stopped, and judge as defined."""

import importlib
import json
import sys

import equinox as eqx
import jax
import numpy as np
import pytest
from command_line_cases import ROOT

from symplearn._errors import InputError
from symplearn._hamiltonian_objectives import MiniBatch
from symplearn._objectives import TimeSeries

sys.path.insert(0, str(ROOT))  # experiments are no installed package
tao = importlib.import_module("experiments.tao")
found = importlib.import_module("experiments._tao_results")
pendulum = importlib.import_module("experiments.double_pendulum")
judged = importlib.import_module("experiments._double_pendulum_results")
study = importlib.import_module("experiments._ensemble")

CELLS = ((0.0, 300), (0.1, 300))
TINY = tao.Settings(CELLS, CELLS, (), repeats=2, width=2, epochs=20, depth=2)


@pytest.mark.slow
def test_tiny_run_leaves_the_keys_and_goes_on(tmp_path):
    """A run without time trains nothing and says what is missing; the same command then writes every key."""
    tao.main(["--out", str(tmp_path), "--minutes", "1e-9"], TINY)
    early = json.loads((tmp_path / "metrics.json").read_text())
    assert early["missing"] == [[0.0, 300], [0.1, 300]] and early["cells"] == 0
    tao.main(["--out", str(tmp_path)], TINY)
    numbers = json.loads((tmp_path / "metrics.json").read_text())
    for way in ("posterior", "l1"):
        for name in ("mse_median", "mse_minimum", "hamiltonian_mse_median", "hamiltonian_mse_minimum"):
            # (5.26) and (5.27), n along the rows and a along the columns.
            table = np.array(numbers[f"{name}_{way}"], dtype=float)
            assert table.shape == (8, 11)
            assert np.isfinite(table[0, 0]) and np.isfinite(table[0, 10]) and np.isfinite(table).sum() == 2
        assert np.array(numbers[f"mse_minimum_{way}"][0])[0] <= np.array(numbers[f"mse_median_{way}"][0])[0]
    won = sum(numbers["mse_median_posterior"][0][i] < numbers["mse_median_l1"][0][i] for i in (0, 10))
    assert numbers["cells_won_median"] == won and numbers["cells"] == 2 and numbers["missing"] == []
    least = [numbers[f"hamiltonian_mse_of_minimum_mse_{way}"][0] for way in ("l1", "posterior")]
    gains = [least[0][i] / least[1][i] for i in (0, 10)]
    assert numbers["best_gain_hamiltonian_mse"] == pytest.approx(max(gains))
    assert len(numbers["beyond_mean_of_copies"]) == 2
    assert set(numbers["beyond_mean_of_copies_gain_hamiltonian_mse"]) == {"median", "low", "high"}
    for name in ("maps.png", "runs_median.png", "runs_least.png"):
        if name == "maps.png" or (tmp_path / name).exists():
            assert (tmp_path / name).read_bytes()[:4] == b"\x89PNG"
    # What is done is only read: no time is no hindrance, and the numbers are the same.
    tao.main(["--out", str(tmp_path), "--minutes", "1e-9"], TINY)
    assert json.loads((tmp_path / "metrics.json").read_text()) == numbers


def test_all_n_at_once_score_as_each_does():
    """On a GPU rows of all n are one program: filled up with intervals of no length, a recording scores the same."""
    rows = [tao.Row(0.05, n, 0) for n in (300, 400)]
    settings = TINY._replace(cells=tuple((row.a, row.n) for row in rows), beyond=(), repeats=1)
    together = tao.ensemble(settings, {tao.POSTERIOR: rows}, 0)
    times, readings = together.recordings.times, together.recordings.readings
    assert np.isnan(readings[0, 300:]).all() and not np.diff(times[0, 299:]).any()
    first = tao.ensemble(settings, {tao.POSTERIOR: rows[:1]}, 0)
    # SciPy's own error bound: it is asked for a longer solution, and steps otherwise.
    assert np.allclose(readings[0, :300], first.recordings.readings[0], atol=1e-9)
    first = first._replace(recordings=TimeSeries(times[:1, :300], readings[:1, :300]))

    @eqx.filter_jit
    def scores(each):
        objective = each.training.objective
        return eqx.filter_vmap(lambda model, series: objective(model, series))(each.models, each.recordings)

    # The same 300 increments, and zeros.
    assert scores(together)[0] == pytest.approx(float(scores(first)[0]), rel=1e-12)


def test_a_table_of_known_errors_is_counted():
    """Of errors by hand: cells won, the best gain by the models of least MSE, both columns beyond, and the verdicts."""

    def outcome(mse, off):
        return found.Outcome(np.array(mse), np.array(off), np.zeros((2, 4, 2)))

    outcomes = {
        (tao.POSTERIOR, (0.1, 300)): outcome([1.0, 3.0, 2.0], [0.5, 9.0, 1.0]),
        (tao.L1, (0.1, 300)): outcome([5.0, 0.5, 4.0], [1.0, 8.0, 2.0]),
        (tao.POSTERIOR, (0.0, 400)): outcome([3.0, 3.0, 3.0], [3.0, 3.0, 3.0]),
        (tao.L1, (0.0, 400)): outcome([2.0, 2.0, 4.0], [6.0, 1.0, 1.0]),
        (tao.MEAN, (0.1, 300)): outcome([0.5, 1.5, 1.0], [0.25, 3.0, 0.5]),
        (tao.L1, (0.01, 300)): outcome([6.0, 6.0, 6.0], [4.0, 4.0, 4.0]),
    }
    cells = [(0.1, 300), (0.0, 400), (0.0, 500)]
    numbers = found.metrics(outcomes, cells)
    assert (numbers["cells"], numbers["missing"]) == (2, [[0.0, 500]])
    # Medians 2 below 4 and 3 above 2; least errors 1 above 0.5 and 3 above 2.
    assert (numbers["cells_won_median"], numbers["cells_won_minimum"]) == (1, 0)
    # The Hamiltonian errors where the MSE is least: 8 against 0.5, and 6 against 3.
    assert numbers["best_gain_hamiltonian_mse"] == 16.0
    assert numbers["gain_hamiltonian_mse"].median == 9.0
    together = numbers["beyond_mean_of_copies_gain_hamiltonian_mse"]
    assert together.median == 2.0 and together.verdict == "it helps"
    # Medians: L1 at 1 % has 6 and 4, the posterior at 10 % has 2 and 1.
    assert numbers["beyond_noise_ten_times"] == [{"n": 300, "gain_mse": 3.0, "gain_hamiltonian_mse": 4.0}]
    assert numbers["beyond_noise_ten_times_won"] == 1
    assert numbers["mse_median_l1"][0][1] is None  # L1 alone has no place in the maps
    assert study.Spread.of([0.5, 0.6]).verdict == "it hurts"
    assert study.Spread.of([0.5, 2.0]).verdict == "it makes no clear difference"


def test_truth_has_the_period():
    """The truth keeps H = 5 and has the period 3.26106."""
    truth = tao.orbit(1001)
    assert np.allclose(tao.energy(truth), 5.0, atol=1e-8)  # DOP853 at 1e-11 over three periods
    # Readings every 0.01: the period by where q rises through 0 for the first time at p < 0, linearly interpolated.
    q = truth[:, 0]
    crossings = [k - 1 + q[k - 1] / (q[k - 1] - q[k]) for k in range(2, 1001) if q[k - 1] > 0 >= q[k]]
    assert 0.01 * np.diff(crossings) == pytest.approx(3.26106, abs=1e-4)


def test_double_pendulum_truth_keeps_its_energy():
    """The equations by the mass matrix keep the Hamiltonian (5.28), which starts at -20.41 from q1 = 1."""
    for start, energy in (((1.0, 0.0, 0.0, 0.0), -20.41), ((2.0, 0.0, 0.0, 0.0), -1.6453)):
        H = judged.energy(pendulum.orbit(start, 501))
        assert H[0] == pytest.approx(energy, abs=5e-3)
        assert np.abs(H - H[0]).max() < 1e-8  # DOP853 at 1e-12 over 5 s


def test_a_batch_holds_a_piece():
    """A batch of fewer data intervals than a piece has is refused: its score was a division by zero."""
    with pytest.raises(InputError, match="batch of 4 data intervals holds no piece of 5"):
        pendulum.InPieces(5, MiniBatch(4, jax.random.key(0)))


def test_double_pendulum_is_judged_as_defined():
    """Mean and maximum of |H - H_0| and the time to half a radian are those of plain loops."""
    truth = pendulum.orbit((1.0, 0.0, 0.0, 0.0), 200)
    xs = np.stack([truth, truth])
    xs[1, 120:, 1] += 0.6
    numbers = judged.judge(xs, truth)
    assert numbers["time_to_half_radian"].median == pytest.approx(0.5 * (2.0 + 1.2))
    H = judged.energy(truth)
    off = [np.mean(np.abs(judged.energy(each) - H[0])) for each in xs]
    assert numbers["mean_hamiltonian_error"].median == pytest.approx(np.median(off))
    highest = [np.max(np.abs(judged.energy(each) - H[0])) for each in xs]
    assert numbers["maximum_hamiltonian_error"].median == pytest.approx(np.median(highest))


def test_spread_is_calibrated_where_the_noise_is_what_it_says():
    """Draws about the truth cover 90 % of angles drawn alike; white one-step errors of the learnt variance say so."""
    truth = pendulum.orbit((1.0, 0.0, 0.0, 0.0), 200)
    draw = np.random.default_rng(0)
    sd = 0.1 * np.linspace(0.1, 1.0, 100)[:, None]
    angles = truth[:, :2].copy()
    angles[:100] += sd * draw.standard_normal((100, 2))
    draws = truth[:100, :2] + sd * draw.standard_normal((1, 400, 100, 2))
    observed = np.concatenate([angles, truth[:, 2:]], axis=1)
    variances = np.array([[1.0, 4.0, 9.0, 16.0]])
    errors = np.sqrt(variances) * draw.standard_normal((1, 2000, 4))
    spread = judged.calibrate(judged.Drawn(draws, 3.0 * draws, errors, variances), truth[None], observed)
    # 200 angles: 90 % within four standard errors of 0.021.
    assert spread["coverage_90"].median == pytest.approx(0.9, abs=0.085)
    # 8000 errors: a root mean square of 1 within four standard errors of 0.008, a correlation of 0 within 0.045.
    assert spread["one_step_error_over_process_noise"].median == pytest.approx(1.0, abs=0.032)
    assert spread["one_step_error_correlation"].median == pytest.approx(0.0, abs=0.045)
    coherent = judged.Drawn(draws, draws, 5.0 * np.ones((1, 2000, 4)), np.ones((1, 4)))
    spread = judged.calibrate(coherent, truth[None], observed)
    assert spread["one_step_error_over_process_noise"].median == pytest.approx(5.0)
    assert spread["one_step_error_correlation"].median == pytest.approx(1.0, abs=1e-3)  # 1999 pairs of 2000 squares


@pytest.mark.slow
def test_tiny_double_pendulum_leaves_the_keys(tmp_path):
    """A tiny run writes errors of all ways and the calibration, each with its spread, for both motions."""
    pendulum.main(["--out", str(tmp_path)], pendulum.Settings(60, 2, 2, 20, 10))
    numbers = json.loads((tmp_path / "metrics.json").read_text())
    for motion in ("regular", "chaotic"):
        names = [
            f"{name}_{way}_{motion}"
            for name in ("mean_hamiltonian_error", "maximum_hamiltonian_error", "time_to_half_radian")
            for way in pendulum.WAYS
        ]
        names += [f"{name}_{motion}" for name in ("coverage_90", "error_over_spread", "rank_correlation")]
        for name in names:
            assert numbers[name]["low"] <= numbers[name]["median"] <= numbers[name]["high"]
    assert numbers["missing"] == []
    for name in ("double_pendulum.png", "double_pendulum_phase.png"):
        assert (tmp_path / name).read_bytes()[:4] == b"\x89PNG"


def test_stopped_by_ctrl_c_it_says_how_to_go_on(tmp_path, capsys, monkeypatch):
    """Ctrl-C in a training: exit code 130 and one line; the jobs that wait do not begin."""
    begun = []

    def job():
        begun.append(1)
        raise KeyboardInterrupt

    def interrupted(settings, run, deadline):
        study.side_by_side([job] * 9, deadline)

    monkeypatch.setattr(tao, "study", interrupted)
    with pytest.raises(SystemExit) as left:
        tao.main(["--out", str(tmp_path)], TINY)
    assert left.value.code == 130
    assert capsys.readouterr().err == "experiments.tao: stopped; the same command goes on from here\n"
    assert len(begun) < 9


def test_bad_minutes_is_one_sentence(tmp_path, capsys):
    """A time that is no positive number: exit code 2 and one line on stderr."""
    for given in ("0", "x", "nan"):
        with pytest.raises(SystemExit) as left:
            tao.main(["--out", str(tmp_path), "--minutes", given], TINY)
        said = capsys.readouterr()
        assert left.value.code == 2 and said.err.count("\n") == 1 and said.err.startswith("experiments.tao: ")
