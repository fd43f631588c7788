"""Rows read a little early or late, each by chance, are told from a sensor that is noisier than stated, and back."""

from dataclasses import replace

import engine_cases as cases
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from symplearn.diagnosis._calibrate import calibrate
from symplearn.diagnosis._found import Found
from symplearn.diagnosis._jitter import weigh_jitter
from symplearn.diagnosis._scatter import law_gain
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._trajectory import Stepper
from symplearn.diagnosis._weighed import weigh_white

NOISE, TIMES = 0.002, np.linspace(0.0, 40.0, 300)


def readings(jitter, factor=1.0, seed=0):
    """A spring that is read at times off by `jitter` (sd), with `factor` times the stated noise: SciPy's."""
    rng = np.random.default_rng(seed)
    off = np.clip(jitter * rng.normal(size=len(TIMES)), -0.06, 0.06)
    q = cases.solved(lambda t, x: [x[1], -x[0]], [1.0, 0.0], np.append(-1.0, TIMES + off))[1:, 0]
    return q + factor * NOISE * rng.normal(size=len(q))


def weighed(y):
    """Nothing and a wrongly stated noise, under noise alone and under jitter; the priors, too."""
    file = cases.simulation("p**2/2 + q**2/2", more=f"[recording.noise]\ny = {NOISE}")
    p = cases.problem(file, [cases.recorded(TIMES, y)], 0.05)
    priors = replace(priors_without_effects(p), precision=np.full(p.size, 1e-2))
    noise = (next(m for m in p.searched if p.candidate(m).effect.name == "sensor_noise"),)
    begin = np.zeros((2, p.size))
    begin[:, 0], begin[:, 1] = y[0], (y[1] - y[0]) / (TIMES[1] - TIMES[0])
    fits = calibrate(Stepper(p), begin, [(), noise], priors, [len(TIMES)])
    assert fits.converged.all()
    found = Found(p, priors)
    for one in (*weigh_white(p, fits, priors, [len(TIMES)]), *weigh_jitter(p, fits, priors, [len(TIMES)])):
        found.add(one)
    return found, noise


@pytest.fixture(scope="module")
def jittered():
    return weighed(readings(0.004))


def test_jitter_is_told_from_a_noisier_sensor(jittered):
    """Where times are off by twice the noise at the largest rate, jitter is likelier by ten nats than a sensor noisier
    than stated, and its size comes out within a third: the ratios tried lie a factor of two apart."""
    found, noise = jittered
    jitter = found.of((), "jitter")
    assert jitter.log_evidence > found.of(noise, "white").log_evidence + 10
    assert found.of(noise, "jitter") is None
    rate = np.sqrt(np.mean(np.sin(TIMES + 1.0) ** 2))  # begun at -1
    assert np.sqrt(jitter.jitters[0]) * NOISE / rate == pytest.approx(0.004, rel=1 / 3)
    assert jitter.reading_noise == pytest.approx(NOISE * np.sqrt(1 + jitter.jitters[0]))


def test_a_noisier_sensor_is_told_from_jitter():
    """Where a sensor scatters twice as much as stated, that is likelier than jitter by ten nats."""
    found, noise = weighed(readings(0.0, 2.0))
    assert found.of(noise, "white").log_evidence > found.of((), "jitter").log_evidence + 10


def test_times_that_are_kept_leave_no_jitter():
    """No evidence is gained where rows are read when they say."""
    found, _ = weighed(readings(0.0))
    assert found.of((), "jitter").log_evidence < found.of((), "white").log_evidence


def test_the_evidence_is_that_of_scaled_noise(jittered):
    """Of a spring, whose readings are linear in its start, it is the dense Gaussian's whose variance goes with the
    squared rate, but for what the choice of the ratio and of the noise's law owe."""
    found, _ = jittered
    p, one = found.problem, found.of((), "jitter")
    shown = np.stack([np.cos(TIMES), np.sin(TIMES)])
    y = p.rows[0].readings[:, 0]
    path = np.linalg.lstsq(shown.T, y, rcond=None)[0] @ shown
    rate = np.gradient(path, TIMES)
    variance = NOISE**2 * (1 + one.jitters[0] * rate**2 / np.mean(rate**2))
    dense = multivariate_normal(np.zeros(len(y)), 100.0 * shown.T @ shown + np.diag(variance)).logpdf(y)
    law = law_gain(p, (), ((y - path) / np.sqrt(variance))[:, None])
    owed = one.log_evidence - dense - law
    # The mean over twelve ratios is at least a twelfth of the largest. Steps of 0.05 and the start's posterior in the
    # law leave hundredths of a nat.
    assert -np.log(12) - 0.1 < owed < 0.1
