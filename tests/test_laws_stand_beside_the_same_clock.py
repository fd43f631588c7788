"""Laws are compared beside the same errors of sensor and clock, not each beside those that its own search ran into."""

from dataclasses import replace

import numpy as np
import pytest
from test_a_clock_may_wander import late, problem, swing

from symplearn.diagnosis import _clocks
from symplearn.diagnosis._clock import weigh_shared_clock
from symplearn.diagnosis._clocks import share_clocks, weigh_clocks
from symplearn.diagnosis._found import Found
from symplearn.diagnosis._score import Start
from symplearn.diagnosis._settle import settle
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._trajectory import Stepper
from symplearn.diagnosis._weighed import Mode
from symplearn.diagnosis._weigher import Weigher


@pytest.fixture(scope="module")
def weigher():
    """A swing with quadratic drag whose rows are read up to a hundredth of a cycle too early or late: what is true, a
    viscous damping and a drift of the sensor, fitted."""
    p = problem(swing(late(0)))
    priors = replace(priors_without_effects(p), scales=np.full(p.equations.size, 0.3), precision=np.full(p.size, 1e-2))
    wanted = {p.candidate(m).effect.name: m for m in p.searched}
    names = ("quadratic_drag", "viscous_damping", "sensor_drift")
    one = Weigher(Stepper(replace(p, searched=tuple(wanted[name] for name in names))), Found(p, priors))
    z = np.zeros(p.size)
    z[[0, p.head]] = 1.0
    one.weigh([Start((wanted[name],), z, 0.0) for name in names])
    return one, {name: (wanted[name],) for name in names}


@pytest.mark.parametrize("near", [None, 1e3], ids=["far behind", "near"])
def test_what_the_likeliest_was_found_beside_is_tried_beside_all(weigher, near, monkeypatch):
    """A law whose own search was caught, here in no error at all, is weighed beside what another one's
    search found, and searched again from there where it is near; so is a law that was not searched for at all."""
    weigher, laws = weigher
    found, (drag, damping, _) = weigher.found, laws.values()
    weigher.shared = []
    for c in laws.values():
        found.estimates[c] = [one for one in found.estimates[c] if one.kind != "clock"]
    weigh_clocks(weigher, [damping])
    own = found.of(damping, "clock")
    still = replace(own, colours=(replace(own.colours[0], ratio=0.0),), clocks=(replace(own.clocks[0], ratio=0.0),))
    (caught,) = weigh_shared_clock(found.problem, weigher.as_fitted([damping]), found.priors, weigher.rows, still)
    assert caught.log_evidence < own.log_evidence - 10
    caught = replace(caught, modes=(Mode(caught.log_evidence, caught.z, caught.covariance),))
    found.estimates[damping] = [caught if one is own else one for one in found.estimates[damping]]
    if near is not None:
        monkeypatch.setattr(_clocks, "_NEAR", near)
    weigh_clocks(weigher, [drag])
    share_clocks(weigher)
    best, other, third = (found.of(c, "clock") for c in laws.values())
    assert best.log_evidence > own.log_evidence + 10
    if near is None:
        assert other.clocks == third.clocks == best.clocks and other.log_evidence > caught.log_evidence + 1
    else:  # a search from elsewhere ends nearby, not at the same point, by far less than what was lost
        assert other.log_evidence == pytest.approx(own.log_evidence, abs=1.0)


def test_it_is_shared_once(weigher, monkeypatch):
    """What has been tried beside the likeliest's errors is not tried again where nothing likelier was found."""
    weigher, laws = weigher
    weigh_clocks(weigher, list(laws.values()))
    share_clocks(weigher)
    before = {c: weigher.found.of(c, "clock").log_evidence for c in laws.values()}
    tried = []
    monkeypatch.setattr(_clocks, "weigh_shared_clock", lambda *given: tried.append(given) or [])
    share_clocks(weigher)
    assert not tried
    assert {c: weigher.found.of(c, "clock").log_evidence for c in laws.values()} == before


def test_what_a_search_was_caught_in_is_left_where_laws_are_settled(weigher):
    """Of a law whose own search was caught, here in an error of the sensor alone, the settled evidence is as large as
    beside the errors of the clock that another one's search found, be the other one far likelier."""
    weigher, laws = weigher
    found, (drag, damping, _) = weigher.found, laws.values()
    weigh_clocks(weigher, [drag])
    best = found.of(drag, "clock")
    (good,) = weigh_shared_clock(found.problem, weigher.as_fitted([damping]), found.priors, weigher.rows, best)
    still = replace(best, clocks=(replace(best.clocks[0], ratio=0.0),))
    (caught,) = weigh_shared_clock(found.problem, weigher.as_fitted([damping]), found.priors, weigher.rows, still)
    assert caught.log_evidence < good.log_evidence - 10
    lead = best.log_evidence - caught.log_evidence  # near enough to be settled
    caught = replace(caught, log_evidence=caught.log_evidence + max(0.0, lead - 5.0))
    found.estimates = {drag: [e for e in found.estimates[drag] if e.kind in ("white", "clock")],
                       damping: [found.of(damping, "white")]}  # fmt: skip
    found.add(caught)
    settle(weigher, lambda combination: True)
    assert found.of(damping, "clock").clocks == best.clocks
    # It may owe 3.0 nats for what it was weighed with. Seen: 0.39 less.
    assert found.of(damping, "clock").log_evidence > good.log_evidence - 3.0
