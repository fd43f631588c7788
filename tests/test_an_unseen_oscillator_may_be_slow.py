"""An unseen oscillator is looked for down to half a cycle in the recording, a periodic force down to one."""

import numpy as np
import pytest
from finding_cases import candidate

from symplearn.diagnosis._effect_priors import _range
from symplearn.diagnosis._motion import Motion
from symplearn.diagnosis._scan import _places

SPAN, GAP = 12.0, 0.1
T = np.arange(0.0, SPAN + GAP / 2, GAP)
MOTION = Motion(np.sin(T)[:, None], np.cos(T)[:, None], np.ones(1), np.ones(1), (T,))


@pytest.mark.parametrize(("name", "cycles"), [("hidden_oscillator", 0.5), ("periodic_forcing", 1.0)])
def test_the_slowest_is_tried_and_the_rest_as_densely(name, cycles):
    """From so many cycles in the recording to half the Nyquist frequency, no further apart than the span resolves, two
    pi over it, and not much denser."""
    low, high = _range(MOTION, candidate(name))
    assert (low, high) == pytest.approx((2 * np.pi * cycles / SPAN, np.pi / (2 * GAP)))
    tried = _places(candidate(name), low, high)
    assert (tried[0], tried[-1]) == pytest.approx((low, high))
    assert 0.4 * np.pi / SPAN < np.diff(tried).max() < 2 * np.pi / SPAN
