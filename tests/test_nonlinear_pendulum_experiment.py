"""The nonlinear pendulum's experiment leaves what it promises, and its hills are those of the density it says."""

import json

import jax
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.special import ellipk
from scipy.stats import halfnorm

from experiments import _noise_landscape as noise
from experiments import _nonlinear_pendulum_results as outcome
from experiments import _pendulum_case as case
from experiments import nonlinear_pendulum as experiment

KEYS = {
    f"{name}_{cell.name}"
    for cell in experiment.CELLS
    for name in (
        "mse_bayes", "mse_map", "mse_dominant", "mse_process_mode", "mse_measurement_mode", "mse_dmd", "mse_tdmd",
        "tdmd_over_dominant", "tdmd_over_dominant_of_means", "share_with_two_modes_of_draws", "two_hills",
        "two_modes_process_and_measurement", "mass_of_measurement_mode_prior_of_variances", "published_start_ends",
    )
} | {"published", "datasets_per_cell", "seed", "quick"}  # fmt: skip
FIGURES = ("noises", "trajectories", "spreads")
SIZE = 3


def bumps(*peaks, at=None):
    """A log density, on the grid or `at` process noises along the first peak's measurement noise: the sum of bumps
    (process, measurement, height), all logarithms."""
    process, measurement = np.meshgrid(noise.GRID, noise.GRID, indexing="ij") if at is None else (at, peaks[0][1])
    return np.logaddexp.reduce([h - 2 * ((process - x) ** 2 + (measurement - y) ** 2) for x, y, h in peaks], axis=0)


def kept(cell, rng, first):
    """What is kept of a data set, made up: matrices that turn as the pendulum does, and two hills."""
    rate, step = 1.9, case.READ_UNTIL / cell.n
    turn = np.array(
        [[np.cos(rate * step), np.sin(rate * step) / rate], [-rate * np.sin(rate * step), np.cos(rate * step)]]
    )
    names = ("map", "dominant", "dmd", "tdmd", *outcome.MODES)
    values = {name: turn + 0.01 * rng.normal(size=(2, 2)) for name in names}
    draws, drawn = turn + 0.01 * rng.normal(size=(20, 2, 2)), np.exp(rng.normal(size=(20, 2)))
    hill = {"below": 0.0, "rises": 1.0, "log10_variances": [-1.0, -2.0], "mass": {"prior_of_variances": 0.5}}
    found = {
        "modes_of_draws": 1, "share_of_dominant_mode": 1.0, "share_more_measurement_than_process_noise": 0.1,
        "process_noise": 0.1, "measurement_noise": 0.01, "converged": True, "posterior_converged": True,
        "hills": {"joint_variances": 2, "marginal_variances": 1}, "published_start": "highest",
        "process_mode": hill, "measurement_mode": hill | {"below": 9.0, "left_after": 500, "chain_share": 0.5},
    }  # fmt: skip
    if first:
        found["shown"] = {"draws": draws.tolist(), "variances": drawn.tolist()}
        found["shown"] |= {name: values[name].tolist() for name in ("map", "dmd", "tdmd")}
    return found | experiment.judged(cell, draws, values)


def test_the_keys_and_figures_are_written_from_what_was_kept(tmp_path, monkeypatch, capsys):
    """With every block in its file nothing is learnt: metrics, figures, and the published ratio beside ours."""
    monkeypatch.setattr(experiment, "QUICK", SIZE)
    monkeypatch.setattr(experiment, "FULL", SIZE)
    monkeypatch.setattr(experiment, "BLOCK", {True: SIZE, False: SIZE})
    monkeypatch.delattr(experiment, "learnt")
    one, shape = bumps((-1, -2, 0.0)), 2 * noise.GRID.shape
    land = noise.Landscape(one, one, np.zeros((*shape, 2, 2)), np.zeros((*shape, 4, 4)))
    monkeypatch.setattr(noise, "landscape", lambda *_: land)
    rng = np.random.default_rng(0)
    for quick, where in ((True, tmp_path / "quick"), (False, tmp_path / "full")):
        where.mkdir()
        for cell in experiment.CELLS:
            block = {"datasets": [kept(cell, rng, k == 0) for k in range(SIZE)]}
            text = json.dumps(block | {"settings": f"{experiment.settings(quick)}, {SIZE} data sets"})
            (where / f"seed3_00_{cell.name}.json").write_text(text, encoding="utf-8")
    experiment.main(["--quick", "--seed", "3", "--out", str(tmp_path)])
    found = json.loads((tmp_path / "metrics.json").read_text(encoding="utf-8"))
    assert found.keys() >= KEYS and found["datasets_per_cell"] == SIZE
    assert found["two_hills_n24_sigma1"]["joint_variances"] == {"share": 1.0, "of": SIZE}
    assert found["two_hills_n24_sigma1"]["marginal_variances"] == {"share": 0.0, "of": SIZE}
    assert found["measurement_mode_below_process_mode_n26_sigma0.1"]["median"] == 9.0
    assert "(published: 1.3)" in capsys.readouterr().out
    for name in FIGURES:
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    monkeypatch.setattr(experiment, "_draw", lambda *_: None)
    experiment.main(["--seed", "3", "--out", str(tmp_path)])
    assert json.loads((tmp_path / "metrics.json").read_text(encoding="utf-8")).keys() == found.keys()


def test_the_truth_is_the_nonlinear_pendulum():
    """The true motion keeps its energy, and comes back after the period 4 K(sin(2.5 / 2)) / sqrt(g) (3.4 s)."""
    q, p = case.NONLINEAR.states(np.linspace(0.0, 8.0, 50)).T
    # SciPy's bound of 1e-12 a step, over some hundred steps, and the interpolant between them.
    np.testing.assert_allclose(0.5 * p**2 - 9.81 * np.cos(q), -9.81 * np.cos(2.5), atol=1e-9)
    period = 4 * ellipk(np.sin(1.25) ** 2) / 9.81**0.5  # SciPy's argument is the modulus squared
    # The interpolant between DOP853's steps is of order 7.
    np.testing.assert_allclose(case.NONLINEAR.states(np.array([period]))[0], [2.5, 0.0], atol=1e-7)


@pytest.mark.parametrize(("n", "expected"), [(24, (0.214, 0.315)), (26, (0.211, 0.306))])
def test_the_baselines_have_their_known_errors(n, expected):
    """DMD's and TDMD's mean errors at noise 0.1 are those of specification 5.4, within four standard errors of sixty
    data sets."""
    cell = case.Cell(n, 0.1)
    true, errors = case.NONLINEAR.states(cell.times()), {"dmd": [], "tdmd": []}
    for k in range(60):
        for name, A in case.decompositions(case.recording(case.NONLINEAR, cell, 0, k)).items():
            errors[name].append(case.squared_error(case.pushed(A, case.NONLINEAR.start, n), true))
    for name, known in zip(errors, expected, strict=True):
        error = np.std(errors[name], ddof=1) / 60**0.5
        # Four standard errors, at most a fifth of the number, by the next line.
        assert outcome.kept_mean(np.array(errors[name])) == pytest.approx(known, abs=4 * error)
        assert error < 0.05 * known


def test_hills_are_told_from_their_saddles():
    """Two bumps are two hills, the lower one as prominent as it rises above the lowest point between them; they share
    the grid out. One that rises by less than a quarter of a nat is no hill."""
    peaks = (-1.0, -2.0, 0.0), (-4.0, -2.0, -1.0)
    high, low = noise.hills(bumps(*peaks))
    assert high.variances == pytest.approx((-1.0, -2.0)) and low.variances == pytest.approx((-4.0, -2.0))
    saddle = bumps(*peaks, at=np.linspace(-4.0, -1.0, 3001)).min()
    # The spline's error at the saddle, where the slope turns within two points of the grid.
    assert high.prominence == np.inf and low.prominence == pytest.approx(-1.0 - saddle, abs=0.15)
    assert high.of_process_noise and not low.of_process_noise
    assert np.all(high.cells ^ low.cells)
    close = (-1.0, -2.0, 0.0), (-2.4, -2.0, -0.8)
    line = bumps(*close, at=np.linspace(-2.4, -1.0, 1001))
    assert 0 < line[0] - line.min() < noise.PROMINENT  # two maxima, by too little
    assert len(noise.hills(bumps(*close))) == 1


def test_a_plateau_at_the_edge_is_a_hill():
    """A density that rises towards no process noise, as one over variances can, has a hill at the grid's edge."""
    process = np.broadcast_to(noise.GRID[:, None], 2 * noise.GRID.shape)
    values = np.where(process < -3, -5.0 - 0.5 * (process + 6.0), bumps((-1.0, -2.0, 0.0)).clip(min=-8.0))
    found = noise.hills(values - 0.1 * (noise.GRID + 2.0) ** 2)
    assert len(found) == 2 and found[1].variances[0] == noise.GRID[0]


def test_densities_change_coordinates_and_priors():
    """Where the readings say nothing, the density over the standard deviations under their prior is SciPy's half-normal
    of each, and that over the variances is SciPy's half-normal of these; masses of all cells are one."""
    v = 10**noise.GRID
    over_variances = np.add.outer(halfnorm.logpdf(v), halfnorm.logpdf(v))
    over_sds = np.add.outer(halfnorm.logpdf(np.sqrt(v)), halfnorm.logpdf(np.sqrt(v)))
    found = noise.densities(over_variances, 0.0)
    assert np.ptp(found["prior_of_sds_over_sds"] - over_sds) < 1e-12
    # dv / d log v = v, dv / ds = 2 s
    logs = np.add.outer(np.log(v), np.log(v))
    assert np.ptp(found["log_variances"] - over_variances - logs) < 1e-12
    assert np.ptp(found["sds"] - over_variances - 0.5 * logs) < 1e-12
    every = noise.finer(over_variances) < np.inf
    assert all(mass == pytest.approx(1.0) for mass in noise.masses(over_variances, every).values())


def log_likelihood(A, process, measurement, readings, known):
    """The textbook Kalman filter, measurement first, from a known state."""
    m, P, total = known, np.zeros((2, 2)), 0.0
    for k, y in enumerate(readings):
        if k:
            m, P = A @ m, A @ P @ A.T + process * np.eye(2)
        S = P + measurement * np.eye(2)
        total -= 0.5 * ((y - m) @ np.linalg.solve(S, y - m) + np.log(np.linalg.det(2 * np.pi * S)))
        gain = np.linalg.solve(S, P).T
        m, P = m + gain @ (y - m), P - gain @ P
    return total


def best(readings, process, A):
    """The largest log posterior over the variances at one process noise, by SciPy over A and the measurement noise."""

    def score(x):
        v = np.exp(x[4])
        prior = 0.1 * np.abs(x[:4]).sum() + 0.5 * (v**2 + process**2)
        return prior - log_likelihood(x[:4].reshape(2, 2), process, v, readings, case.NONLINEAR.start)

    starts = [np.append(A.ravel(), log_variance) for log_variance in (-5.0, -1.7)]
    return max(-minimize(score, start, method="BFGS").fun for start in starts)


def test_the_density_over_the_variances_has_two_maxima_at_low_noise():
    """By a textbook filter and SciPy's optimiser: from no process noise up, the best log posterior over the variances
    first falls by a nat and more, and then rises to the dominant mode; over log variances it only rises."""
    cell = case.Cell(26, 0.1)
    series = case.recording(case.NONLINEAR, cell, 0, 0)
    A = case.decompositions(series)["dmd"]
    process = np.array([1e-6, 1e-4, 6e-3, 0.12])
    heights = np.array([best(np.asarray(series.readings), v, A) for v in process])
    assert heights[0] > heights[1] > heights[2] + 1.0 and heights[3] > heights[0] + 3.0
    # With the Jacobian of the process noise's logarithm; that of the other one, which hardly changes, left out.
    assert np.all(np.diff(heights + np.log(process)) > 0)


@pytest.mark.slow  # compiles descents, learning, sampling and modes: two minutes
def test_one_data_set_is_laid_out():
    """The landscape's heights are those of the textbook filter at their A; both modes are found at low noise, the
    process noise's is the higher one, and the kept keys are the ones that the metrics read."""
    cell = case.Cell(26, 0.1)
    series = case.recording(case.NONLINEAR, cell, 0, 0)
    land = noise.landscape(series, case.NONLINEAR.start, case.decompositions(series)["dmd"])
    for i, j in ((4, 20), (20, 12), (16, 18)):
        v, w = 10 ** noise.GRID[i], 10 ** noise.GRID[j]
        told = log_likelihood(land.A[i, j], v, w, np.asarray(series.readings), case.NONLINEAR.start)
        priors = halfnorm.logpdf(v) + halfnorm.logpdf(w) - 0.1 * np.abs(land.A[i, j]).sum() - 4 * np.log(20.0)
        # The square-root filter and the textbook's round differently.
        assert land.height[i, j] == pytest.approx(told + priors, abs=1e-6)
    found = experiment.dataset(cell, series, jax.random.key(0), 0, quick=True)
    assert found["hills"]["joint_variances"] == 2 and found["hills"]["joint_log_variances"] == 1
    assert found["process_mode"]["below"] == 0.0 and found["measurement_mode"]["below"] > 3.0
    assert found.keys() == kept(cell, np.random.default_rng(0), first=True).keys()
