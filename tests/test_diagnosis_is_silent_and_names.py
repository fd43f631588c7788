"""Through the verb: silent where nothing is wrong, and the right name where something was concealed."""

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis import Options, diagnose
from symplearn.diagnosis._build import Restriction


def answer(file, *runs, effects=None):
    """The document, from the whole vocabulary or from a few effects, which is faster."""
    return diagnose(file, runs, Options(restriction=Restriction(effects), jobs=2)).document


def only_finding(document):
    (finding,) = document["findings"]
    return finding["effect"], finding["target"], finding["family"]


def covers(finding, name, truth):
    """Whether the posterior of a coefficient holds the truth: within four of its standard deviations."""
    coefficient = finding["coefficients"][name]
    return abs(coefficient["mean"] - truth) < 4 * coefficient["sd"]


def test_a_healthy_oscillator_is_left_in_peace():
    """A Duffing oscillator as simulated, read with uniform noise, is consistent: no finding, after equals before."""
    times = np.linspace(0.0, 12.0, 90)
    x = cases.solved(lambda t, x: [x[1], -x[0] - 0.5 * x[0] ** 3], [1.0, 0.0], times)
    noise = np.random.default_rng(0).uniform(-0.03, 0.03, len(times))
    file = cases.simulation(
        "p**2/2 + k*q**2/2 + b*q**4/4", more="[parameters]\nk = { value = 1.02, sd = 0.05 }\nb = 0.5"
    )
    found = answer(file, cases.recorded(times, x[:, 0] + noise),
                   effects=("viscous_damping", "coulomb_friction", "sensor_bias", "cubic_stiffness"))  # fmt: skip
    assert found["verdict"] == "consistent" and found["findings"] == []
    assert found["probability"] > 0.5 and found["log_bayes_factor"] is None and found["converged"]
    assert found["location"]["kind"] == "none" and found["location"]["targets"] == []
    assert found["fit"]["after"] == found["fit"]["before"]
    assert found["parameters"]["after"] == found["parameters"]["before"]
    # The free run over the held-out quarter is off by the noise, 0.03 / sqrt(3), and not by more than half above it.
    assert found["fit"]["after"]["holdout_rmse"]["y"] < 1.5 * 0.03 / np.sqrt(3)
    k = found["parameters"]["after"]["k"]
    assert abs(k["mean"] - 1.0) < 4 * k["sd"] < 0.1


def test_a_bias_of_the_sensor_is_put_on_the_sensor():
    """A pendulum that moves as simulated and is read off by a constant: the place is the sensor, the number right."""
    times = np.linspace(0.0, 12.0, 90)
    x = cases.solved(lambda t, x: [x[1], -np.sin(x[0])], [1.2, 0.0], times)
    readings = x[:, 0] + 0.1 + 0.02 * np.random.default_rng(0).normal(size=len(times))
    file = cases.simulation("p**2/2 - g*cos(q)", more="[parameters]\ng = 1.0")
    found = answer(file, cases.recorded(times, readings),
                   effects=("viscous_damping", "quadratic_stiffness", "sensor_bias", "constant_force"))  # fmt: skip
    assert found["verdict"] == "mismatch" and found["location"]["kind"] == "sensor"
    assert only_finding(found) == ("sensor_bias", "y", "sensor") and covers(found["findings"][0], "b", 0.1)
    assert found["family_probability"]["sensor"] > 0.99
    # The error of the free run falls from the bias to the noise.
    before, after = (found["fit"][when]["holdout_rmse"]["y"] for when in ("before", "after"))
    assert before > 0.08 and after < 0.03
    total = found["probability"] + found["other"] + sum(row["probability"] for row in found["alternatives"])
    assert total == pytest.approx(1.0, abs=1e-3)


@pytest.mark.slow
def test_damping_of_one_coordinate_is_put_on_that_coordinate():
    """Henon-Heiles with q1 damped and both coordinates read: dissipation, on q1, from the whole vocabulary."""
    times = np.linspace(0.0, 30.0, 200)

    def rates(t, x):
        return [x[2], x[3], -x[0] - 2 * x[0] * x[1] - 0.02 * x[2], -x[1] - x[0] ** 2 + x[1] ** 2]

    x = cases.solved(rates, [0.25, 0.1, 0.1, 0.2], times)
    readings = x[:, :2] + 0.005 * np.random.default_rng(0).normal(size=(200, 2))
    file = cases.simulation(
        "(p1**2 + p2**2)/2 + (q1**2 + q2**2)/2 + lam*(q1**2*q2 - q2**3/3)",
        ["q1", "q2"], ["p1", "p2"], {"a": "q1", "b": "q2"}, more="[parameters]\nlam = 1.0",
    )  # fmt: skip
    found = answer(file, cases.recorded(times, readings))
    assert found["verdict"] == "mismatch" and found["location"]["targets"] == ["q1"]
    assert found["family_probability"]["dissipation"] > 0.99
    assert only_finding(found) == ("viscous_damping", "q1", "dissipation") and covers(found["findings"][0], "c", 0.02)


@pytest.mark.slow
def test_damping_of_a_nonseparable_system_is_dissipation():
    """Tao's example, which no leapfrog can step, damped and released at rest: dissipation, and nothing else."""
    times = np.linspace(0.0, 12.0, 120)

    def rates(t, x):
        velocity = x[1] * (x[0] ** 2 + 1)
        return [velocity, -x[0] * (x[1] ** 2 + 1) - 0.05 * velocity]

    x = cases.solved(rates, [1.0, 0.0], times)
    rng = np.random.default_rng(0)
    readings = x[:, 0] + 0.01 * rng.normal(size=len(times))
    file = cases.simulation("a*(q**2 + 1)*(p**2 + 1)/2", more="[parameters]\na = 1.0")
    found = answer(file, cases.recorded(times, readings))
    assert found["verdict"] == "mismatch" and found["converged"]
    assert found["family_probability"]["dissipation"] > 0.99
    assert found["location"] | {"where": ""} == found["location"] | {"kind": "dynamics", "targets": ["q"], "where": ""}


@pytest.mark.slow
def test_what_has_no_name_gets_none():
    """A strong periodic force, which the vocabulary does not hold, is seen and not given a confident wrong name."""
    times = np.linspace(0.0, 30.0, 240)
    x = cases.solved(lambda t, x: [x[1], -np.sin(x[0]) + 0.1 * np.cos(1.7 * t + 0.4)], [1.0, 0.0], times)
    readings = x[:, 0] + 0.01 * np.random.default_rng(0).normal(size=len(times))
    file = cases.simulation("p**2/2 - g*cos(q)", more="[parameters]\ng = 1.0")
    found = answer(file, cases.recorded(times, readings))
    assert found["verdict"] == "unexplained" and found["findings"] == []
    assert found["log_bayes_factor"] > 20 and found["fit"]["before"]["process_noise_sd"]["p"] > 0
