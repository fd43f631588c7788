"""The scripts of Figures 1.2, 1.3 and 4.1 give what plain formulas give, and leave whole metrics and figures."""

import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from experiments import _command as command
from experiments import logistic_map as logistic
from experiments import objective_surfaces as surfaces
from experiments import sinusoid

ROOT = Path(__file__).parents[1]


def ran(script, folder, *options):
    """The metrics of one quick run."""
    script.main(["--quick", "--out", str(folder), *options])
    return json.loads((folder / "metrics.json").read_text())


@pytest.fixture(scope="module")
def logistic_run(tmp_path_factory):
    """The metrics of the logistic map at seed 3, and the folder they lie in."""
    folder = tmp_path_factory.mktemp("logistic")
    return ran(logistic, folder, "--seed", "3"), folder


def mean_square(theta, y, T):
    """The mean square of multiple shooting of the logistic map with T steps a segment, in a loop."""
    errors = []
    for start in range(0, 200, T):
        x = y[start]
        for k in range(start + 1, min(start + T, 200) + 1):
            x = theta * x * (1 - x)
            errors.append((y[k] - x) ** 2)
    assert len(errors) == 200
    return np.mean(errors)


def unscented_score(theta, y, Sigma, Gamma):
    """Minus the log likelihood (2.4) by a textbook unscented filter of one state, alpha = 1, beta = 2, kappa = 0.

    Then the centre point has weight 0 in the mean and 2 in the variance, the others 1/2.
    """
    m, P, total = 0.5, Gamma, 0.0
    for k, reading in enumerate(y):
        if k > 0:
            centre, up, down = (theta * x * (1 - x) for x in (m, m + math.sqrt(P), m - math.sqrt(P)))
            m = (up + down) / 2
            P = 2 * (centre - m) ** 2 + ((up - m) ** 2 + (down - m) ** 2) / 2 + Sigma
        S = P + Gamma
        total += 0.5 * ((reading - m) ** 2 / S + math.log(2 * math.pi * S))
        m, P = m + P / S * (reading - m), P - P**2 / S
    return total


def test_sinusoid_objectives_are_the_closed_forms(tmp_path):
    """J_sim and J_prop are (1.4) and (1.5), and J_sim(0.95) overtakes J_sim(0.5) at n = 629 as the closed forms do."""
    found = ran(sinusoid, tmp_path)
    t = 0.1 * np.arange(1, 1001)
    running = {w: np.cumsum((np.sin(t) - np.sin(w * t)) ** 2) / np.arange(1, 1001) for w in (0.95, 0.5)}
    above = running[0.95] > running[0.5]
    assert found["crossings"] == (1 + 1 + np.flatnonzero(above[1:] != above[:-1])).tolist() == [629]
    for w, J in running.items():
        one_step = (np.sin(t) - np.sin(t - 0.1 + w * 0.1)) ** 2
        for n in (100, 700, 1000):
            # A thousand phases added up lose some 1e-12 of each.
            assert found["simulation"][str(w)][str(n)] == pytest.approx(J[n - 1], rel=1e-9)
            assert found["propagator"][str(w)][str(n)] == pytest.approx(np.mean(one_step[:n]), rel=1e-8)
    assert (tmp_path / "sinusoid.png").read_bytes()[:4] == b"\x89PNG"


def test_limit_of_the_simulation_objective_has_exceptions(tmp_path):
    """Erratum E1: the long-time limit is 1, but 1/2 at omega = 0 and 2 at omega = -1."""
    for omega, limit in {0.95: 1.0, 0.0: 0.5, -1.0: 2.0}.items():
        # At t = 1000 the beat of 0.05 has an average of at most 1 / (0.05 * 1000).
        assert sinusoid.simulation(omega, 10000, np.array([10000]))[0] == pytest.approx(limit, abs=0.021)


@pytest.mark.parametrize("T", [201, 10, 2])
def test_shooting_is_the_plain_formula(T):
    """Multiple shooting of the logistic map is (4.9) with overlapping segments, in a plain loop."""
    y = logistic.recording(0)
    thetas = np.array([2.0, 2.7, 3.3])  # no chaos, which would magnify round-off
    plain = [mean_square(theta, y, min(T, 200)) for theta in thetas]
    assert np.allclose(logistic.shooting(T, thetas, y), plain, rtol=1e-12)


@pytest.mark.parametrize(("Sigma", "Gamma"), [(1e-12, 1e-12), (1e-10, 1e-16), (0.5, 1e-16), (1e-2, 1e-2)])
def test_logistic_likelihood_is_the_textbook_filter(Sigma, Gamma):
    """The likelihood of the logistic map is that of a textbook unscented filter."""
    y, thetas = logistic.recording(0), np.array([2.0, 3.0, 3.78, 4.0])
    plain = [unscented_score(theta, y, Sigma, Gamma) for theta in thetas]
    # The textbook form subtracts nearly equal variances: a relative 1e-16 * Sigma / Gamma, which has no effect on S.
    assert np.allclose(logistic.likelihood(thetas, Sigma, Gamma, y), plain, rtol=1e-8)


def test_minima_of_the_logistic_map(logistic_run):
    """Least squares of a chaotic map has many minima, T = 5 one, the likelihood one at every ratio of the author."""
    found, _ = logistic_run
    shooting, likelihood = found["multiple_shooting"], found["likelihood"]
    assert shooting["201"]["minima"] > 20 and shooting["5"]["minima"] == shooting["2"]["minima"] == 1
    assert abs(shooting["201"]["global_minimum"] - 3.78) > 0.5
    assert {each["minima"] for each in likelihood.values()} == {1} and len(likelihood) == 5
    at = [each["global_minimum"] for each in (*likelihood.values(), shooting["10"], shooting["5"], shooting["2"])]
    assert np.allclose(at, 3.78)
    sweep = found["towards_least_squares"]
    assert sweep["1"]["minima"] == 1 and sweep["0"]["minima"] > 20


def test_scaling_both_variances_divides_the_quadratic_part_alone():
    """Erratum E29: J(c Sigma, c Gamma) = Q / c + D + (n + 1) / 2 log c, so a ratio does not fix the curve."""
    found = logistic.scaling(logistic.parameters(quick=True), logistic.recording(0))
    at_million = found["1e+06"]
    # Measured 2e-8; the rest is the sigma points' curvature, of the size of Gamma.
    assert at_million["1e-08"]["from_predicted_of_range"] < 1e-6
    assert at_million["1e-12"]["from_normalised_first"] < 1e-3  # 200 log terms of 10 beside 1e7 nats
    assert at_million["1e-08"]["from_normalised_first"] > 0.1 and at_million["1e-08"]["normalised_lowest"] < 0
    assert abs(found["1"]["0.01"]["global_minimum"] - 3.78) > 0.1


def test_the_same_seed_gives_the_same_files(logistic_run, tmp_path):
    """A seed fixes every file byte for byte, and nothing else is left in the folder; another seed has other noise."""
    ran(logistic, tmp_path, "--seed", "3")
    names = ["logistic_limits.png", "logistic_map.png", "metrics.json"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    assert all((tmp_path / name).read_bytes() == (logistic_run[1] / name).read_bytes() for name in names)
    assert np.abs(logistic.recording(3) - logistic.recording(4)).max() > 1e-9


def test_bad_input_is_one_sentence(tmp_path, capsys):
    """A wrong option, a negative seed or a folder that cannot be made: exit code 2 and one line on stderr."""
    (tmp_path / "file").write_text("")
    for options in (["--seed", "-1"], ["--seed", "x"], ["--fast"], ["--out", str(tmp_path / "file")]):
        with pytest.raises(SystemExit) as left:
            sinusoid.main(options)
        said = capsys.readouterr()
        assert left.value.code == 2 and said.out == "" and said.err.count("\n") == 1
        assert said.err.startswith("experiments.sinusoid: ")


def test_a_number_that_is_not_finite_is_never_written(tmp_path):
    """A NaN among the metrics is an error, and what was there before stays."""
    run = command.Run(tmp_path)
    run.write({"x": 1.0})
    before = (tmp_path / "metrics.json").read_text()
    with pytest.raises(ValueError, match="JSON"):
        run.write({"x": float("nan")})
    with pytest.raises(KeyError):
        run.save(_Broken(), "metrics.json")
    assert (tmp_path / "metrics.json").read_text() == before and len(list(tmp_path.iterdir())) == 1


class _Broken(Figure):
    """A figure that fails when half of it is written."""

    def savefig(self, path, **options):
        path.write_text("half")
        raise KeyError


def test_progress_is_told_after_two_seconds(tmp_path, capsys, monkeypatch):
    """Items that take no time say nothing; those of a second each are told after two and then every ten."""
    assert list(command.Run(tmp_path).each("swift", range(100))) == list(range(100))
    assert capsys.readouterr().err == ""
    clock = iter(np.arange(0.0, 100.0, 0.6))
    monkeypatch.setattr(command.time, "monotonic", lambda: next(clock))
    assert list(command.Run(tmp_path).each("slow", range(9))) == list(range(9))
    assert capsys.readouterr().err.splitlines() == ["slow: 4 of 9"]


@pytest.mark.slow
def test_quick_surfaces_have_the_specifications_minima(tmp_path):
    """The whole of Figure 1.3: in the realisation of seed 0 every count of specification 5.2, at all n."""
    for each in ran(surfaces, tmp_path)["objectives"].values():
        for found in each.values():
            assert found["minima"]["first"] == found["minima"]["specification"]
            if "specification" in found["range"]:
                assert round(found["range"]["first"]) == found["range"]["specification"]
    assert (tmp_path / "objective_surfaces.png").read_bytes()[:4] == b"\x89PNG"


def test_the_experiments_are_listed():
    """`python -m experiments` names every experiment that is a command, with what it is about."""
    done = subprocess.run(
        [sys.executable, "-m", "experiments"], cwd=ROOT, capture_output=True, text=True, timeout=60, check=True
    )
    listed = dict(line.split(maxsplit=3)[2:] for line in done.stdout.splitlines()[:-1])
    files = [path.stem for path in (ROOT / "experiments").glob("[!_]*.py")]
    assert sorted(listed) == sorted(f"experiments.{name}" for name in files)
    assert all(about.endswith(".") for about in listed.values())
