"""Where a small force that goes with place, or a clock that wanders, explains much beside the best, it is tried beside
whatever would then come near; where it explains nothing, no more is tried than the best."""

from itertools import combinations
from types import SimpleNamespace

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis import _remainders
from symplearn.diagnosis._found import Found
from symplearn.diagnosis._remainders import Remainders
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._trajectory import Stepper
from symplearn.diagnosis._weighed import Estimate
from symplearn.diagnosis._weigher import Weigher

TIMES = np.linspace(0.0, 10.0, 50)
# Log evidences of pairs under white noise: many like the best, some a little behind, some far behind.
BEST, BEHIND, FAR = [100.0] * 30, [99.0] * 5, [90.0] * 5


def tried(monkeypatch, evidences, kind, gain):
    """Pairs of effects of given log evidences under an error of the sensor; and those that a kind of remainder is tried
    beside, which gives each of them so many nats more."""
    p = cases.problem(cases.simulation("p**2/2 + q**2/2"), [cases.recorded(TIMES, np.cos(TIMES))], 0.05)
    pairs = list(combinations(p.searched, 2))[: len(evidences)]
    found, some = Found(p, priors_without_effects(p)), []
    found.prices = SimpleNamespace(log=lambda combination: 0.0)

    def estimate(combination, kind, evidence):
        found.add(Estimate(combination, kind, np.zeros(p.size), np.eye(p.size), np.ones(1), evidence, True))

    def weigh(listed):
        some.extend(listed)
        for c in (c for c in listed if c):
            estimate(c, kind, found.of(c, "white").log_evidence + gain)

    estimate((), "white", -1000.0)
    estimate((), "coloured", -1000.0)
    for pair, evidence in zip(pairs, evidences, strict=True):
        estimate(pair, "white", evidence)
        estimate(pair, "coloured", evidence + 0.1)
    weigher = Weigher(Stepper(p, 1), found)
    monkeypatch.setattr(weigher, "weigh_static", weigh)
    monkeypatch.setattr(_remainders, "weigh_clocks", lambda _, listed: weigh(listed))
    monkeypatch.setattr(_remainders, "share_clocks", lambda _: None)
    remainders = Remainders(weigher, lambda said: None)
    remainders.weigh_static() if kind == "static" else remainders.weigh_clocks()
    return pairs, [c for c in some if c]


@pytest.mark.parametrize(("gain", "expected"), [(30.0, 35), (-1.0, 24)], ids=["a remainder", "none"])
def test_a_force_is_tried_beside_all_that_it_may_lift(monkeypatch, gain, expected):
    """What is one nat behind the best would be one behind them with it, and is tried; what is ten behind is not. Where
    it explains nothing, the two dozen best are enough."""
    pairs, some = tried(monkeypatch, BEST + BEHIND + FAR, "static", gain)
    assert some == pairs[:expected]


@pytest.mark.parametrize(("gain", "expected"), [(30.0, 14), (-1.0, 8)], ids=["a remainder", "none"])
def test_a_clock_is_tried_beside_all_that_it_may_lift(monkeypatch, gain, expected):
    """Of fourteen that are alike or nearly so the eight best are tried first, and the others where those gain."""
    pairs, some = tried(monkeypatch, [100.0] * 9 + BEHIND + FAR, "clock", gain)
    assert some == pairs[:expected]
