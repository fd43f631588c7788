"""A bias or a drift of a sensor may be as large as an error of its scale: a share of what is read, however steady."""

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis._effect_priors import with_effects
from symplearn.diagnosis._found import Found
from symplearn.diagnosis._motion import motion_along
from symplearn.diagnosis._score import Start
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._trajectory import Stepper
from symplearn.diagnosis._weigher import Weigher

TIMES = np.linspace(0.0, 40.0, 300)
A, B, NOISE, BIAS = 1.0, 1.0, 0.003, 0.3
# A swing of a tenth about one of two wells, which lies one away from the zero between them.
PATH = cases.solved(lambda t, x: [x[1], A * x[0] - B * x[0] ** 3], [1.1, 0.0], TIMES)


def weigher(shift):
    """Of that swing, read that much too high; the depth of the wells is free, so that where they lie says little."""
    readings = PATH[:, 0] + shift + NOISE * np.random.default_rng(0).normal(size=len(TIMES))
    known = f"[parameters]\na = {{ value = {A} }}\nb = {{ value = {B}, sd = 0.02 }}\n[recording.noise]\ny = {NOISE}"
    file = cases.simulation("p**2/2 - a*q**2/2 + b*q**4/4", more=known)
    p = cases.problem(file, [cases.recorded(TIMES, readings)], 0.1)
    bare, still = priors_without_effects(p), np.zeros_like(TIMES)
    path = np.stack([PATH[:, 0], still, PATH[:, 1], still], axis=1)
    return Weigher(Stepper(p), Found(p, with_effects(p, bare, motion_along(p, bare.mean, [path]))))


def member(problem, name):
    (found,) = (m for m in problem.searched if problem.candidate(m).effect.name == name)
    return found


def test_faults_of_a_sensor_are_as_strong_as_each_other():
    """Under the priors' widths a bias, a drift and a scale make the same rms error: 0.3 of the reading's own rms."""
    w = weigher(0.0)
    errors = {"sensor_bias": np.ones_like(TIMES), "sensor_drift": TIMES, "sensor_gain": PATH[:, 0]}
    for name, error in errors.items():
        width = w.found.priors.scales[w.problem.candidate(member(w.problem, name)).first]
        # The prior takes a drift's rms as an integral over the time; a sum over 300 rows is that to one in 300, 0.0033.
        assert width * np.sqrt(np.mean(error**2)) == pytest.approx(0.3 * np.sqrt(np.mean(PATH[:, 0] ** 2)), rel=0.005)


def test_a_bias_beyond_the_swing_is_found_as_large_as_it_is():
    """A bias three times the swing's amplitude is within two of its errors; nothing holds it to what the swing is."""
    w = weigher(BIAS)
    combination = (member(w.problem, "sensor_bias"),)
    z = w.found.priors.mean.copy()
    z[: w.problem.state] = PATH[0, 0], 0.0, PATH[0, 1], 0.0
    z[w.problem.slots] = BIAS
    w.weigh([Start(combination, z, 0.0)], whole=True)
    white = w.found.of(combination, "white")
    sd = float(np.sqrt(white.covariance[w.problem.slots, w.problem.slots]))
    assert white.converged and abs(white.z[w.problem.slots] - BIAS) < 2 * sd
    assert sd < 0.05
