"""Where a small force that goes with place explains much beside the best, it is tried beside whatever would then come
near; where it explains nothing, no more is tried than the best."""

from itertools import combinations
from types import SimpleNamespace

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis._found import Found
from symplearn.diagnosis._remainders import Remainders
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._trajectory import Stepper
from symplearn.diagnosis._weighed import Estimate
from symplearn.diagnosis._weigher import Weigher

TIMES = np.linspace(0.0, 10.0, 50)
# Log evidences of pairs under white noise: many like the best, some a little behind, some far behind.
BEST, BEHIND, FAR = [100.0] * 30, [99.0] * 5, [90.0] * 5


@pytest.mark.parametrize(("gain", "expected"), [(30.0, 35), (-1.0, 24)], ids=["a remainder", "none"])
def test_it_is_tried_beside_all_that_it_may_lift(monkeypatch, gain, expected):
    """What is one nat behind the best would be one behind them with it, and is tried; what is ten behind is not. Where
    it explains nothing, the two dozen best are enough."""
    p = cases.problem(cases.simulation("p**2/2 + q**2/2"), [cases.recorded(TIMES, np.cos(TIMES))], 0.05)
    pairs = list(combinations(p.searched, 2))[: len(BEST + BEHIND + FAR)]
    found, tried = Found(p, priors_without_effects(p)), []
    found.prices = SimpleNamespace(log=lambda combination: 0.0)

    def estimate(combination, kind, evidence):
        found.add(Estimate(combination, kind, np.zeros(p.size), np.eye(p.size), np.ones(1), evidence, True))

    def weigh_static(some):
        tried.extend(some)
        for c in some:
            estimate(c, "static", found.of(c, "white").log_evidence + gain)

    for pair, evidence in zip(pairs, BEST + BEHIND + FAR, strict=True):
        estimate(pair, "white", evidence)
    weigher = Weigher(Stepper(p, 1), found)
    monkeypatch.setattr(weigher, "weigh_static", weigh_static)
    Remainders(weigher, lambda said: None).weigh_static()
    assert tried == pairs[:expected]
