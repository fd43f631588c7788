"""How large a motion begins is of unknown order of magnitude: no gain of a sensor earns anything by its start."""

from dataclasses import replace

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis._found import Found
from symplearn.diagnosis._score import Start
from symplearn.diagnosis._start import priors_without_effects, with_states
from symplearn.diagnosis._trajectory import Stepper
from symplearn.diagnosis._weigher import Weigher

TIMES = np.linspace(0.0, 12.0, 60)
Q = np.stack([0.7 * np.cos(TIMES + 0.4), np.zeros(60), -0.7 * np.sin(TIMES + 0.4), np.zeros(60)], axis=1)
GAIN = '[recording.noise]\ny = 0.01\n[[terms]]\neffect = "sensor_gain"\ntarget = "y"\ng = {}'


def weighed(gain, recordings=1):
    """Log evidence of a spring that a sensor of known gain shows, under the priors of one of gain one."""
    noise = 0.01 * np.random.default_rng(0).normal(size=60)
    runs = [cases.recorded(TIMES, Q[:, 0] + noise, number=k + 1) for k in range(recordings)]
    p = cases.problem(cases.simulation("p**2/2 + q**2/2", more=GAIN.format(gain)), runs, 0.1)
    priors = with_states(p, priors_without_effects(p), [Q] * recordings)
    w, z = Weigher(Stepper(p), Found(p, priors)), np.zeros(p.size)
    for r in range(recordings):
        z[r * p.state : (r + 1) * p.state] = Q[0] / (1 + gain)
    w.weigh([Start((), z, 0.0)], whole=True)
    return w.found.of((), "white").log_evidence


@pytest.mark.parametrize("recordings", [1, 2])
@pytest.mark.parametrize("gain", [-0.5, 1.0])
def test_a_motion_twice_as_large_is_as_likely(gain, recordings):
    """A linear spring shows the same by half the gain at twice the start, and neither is the likelier."""
    one, other = weighed(0.0, recordings), weighed(gain, recordings)
    # The very wide prior of a start, ten sizes of the motion, tells some hundredths of a nat. Seen: 0.030 a recording;
    # where a start's density is flat 1.38 a recording.
    assert other == pytest.approx(one, abs=0.05 * recordings)


def test_what_rests_at_first_is_as_likely_as_any():
    """A motion that begins at next to nothing is not infinitely likely; nothing hangs on a start that is known."""
    p = cases.problem(cases.simulation("p**2/2 + q**2/2"), [cases.recorded(TIMES, Q[:, 0])], 0.1)
    priors, z = with_states(p, priors_without_effects(p), [Q]), np.zeros(p.size)
    z[: p.state] = 1e-9 * Q[0]
    assert 0 < priors.log_size(p, z) < 8 and priors.log_size(p, z) == pytest.approx(priors.log_size(p, 0 * z))
    z[: p.state] = Q[0]
    larger = np.concatenate([3 * z[: p.state], z[p.state :]])
    # Two directions, and next to nothing of what counts as rest.
    assert priors.log_size(p, z) - priors.log_size(p, larger) == pytest.approx(2 * np.log(3), abs=0.01)
    known = replace(priors, sizes=np.full(p.state, np.inf))
    assert known.log_size(p, z) == known.log_size(p, larger) == 0.0
