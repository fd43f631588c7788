"""Readings that were taken out as outliers and turn out to be none are put back, and all is searched anew."""

from types import SimpleNamespace

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis import Options, _find, _weigher, diagnose
from symplearn.diagnosis._build import Restriction
from symplearn.diagnosis._found import Found, doubtful_outliers
from symplearn.diagnosis._search import Search
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._trajectory import Stepper
from symplearn.diagnosis._weighed import Estimate

CARTS = """
[parameters]
k1 = 9.9
kc = { value = 5.9, sd = 0.3 }
[initial]
x1 = { value = 0.88, sd = 0.05 }
x2 = { value = -0.75, sd = 0.04 }
p1 = 0.0
p2 = 0.0
"""


def sixth(errors):
    """Every sixth reading of the second column, whatever its error is: what is taken for outliers."""
    found = [np.zeros(e.shape, bool) for e in errors]
    for one in found:
        one[::6, 1] = True
    return found


@pytest.mark.slow
def test_a_wrong_scale_leaves_no_outliers(monkeypatch):
    """Two carts, a sensor that reads a sixth too much and a spring that wears out by three per mille: a sixth of its
    readings, taken for outliers, are put back, and nothing but the two is found."""
    monkeypatch.setattr(_weigher, "suspects", sixth)
    times, rng = np.linspace(0.0, 51.0, 363), np.random.default_rng(3)

    def rates(t, x):
        pull = 5.9 * (x[0] - x[1])
        return [x[2] / 1.6, x[3] / 1.2, -9.9 * (1 - 6e-5 * t) * x[0] - pull, -15.4 * x[1] + pull]

    x = cases.solved(rates, [0.88, -0.75, 0.0, 0.0], times)
    readings = x[:, :2] * [1.0, 1.176] + rng.normal(size=(363, 2)) * [0.0057, 0.0164]
    file = cases.simulation(
        "p1**2/3.2 + p2**2/2.4 + k1*x1**2/2 + 15.4*x2**2/2 + kc*(x1 - x2)**2/2",
        ["x1", "x2"], ["p1", "p2"], {"a": "x1", "b": "x2"}, more=CARTS,
    )  # fmt: skip
    said: list[str] = []
    some = Restriction(("sensor_gain", "sensor_outliers", "parameter_drift", "viscous_damping"))
    found = diagnose(file, [cases.recorded(times, readings, columns=("a", "b"))],
                     Options(restriction=some, jobs=2, progress=said.append)).document  # fmt: skip
    assert "leaving readings in that are no outliers" in said
    assert {(f["effect"], f["target"]) for f in found["findings"]} == {("sensor_gain", "b"), ("parameter_drift", "k1")}


@pytest.mark.parametrize(
    ("said", "size", "doubtful"),
    [("sensor_outliers", 2.0, {0}), ("sensor_outliers", 4.0, set()), ("viscous_damping", 4.0, {0})],
    ids=["no larger than the noise", "larger", "left in by the best answer"],
)
def test_outliers_are_far_off(said, size, doubtful):
    """Those below three times the noise are none, nor are those that the best answer does without."""
    times = np.linspace(0.0, 10.0, 50)
    p = cases.problem(cases.simulation("p**2/2 + q**2/2"), [cases.recorded(times, np.cos(times))], 0.05)
    names = {p.candidate(m).effect.name: m for m in p.searched}
    best = Estimate((names[said],), "white", np.zeros(p.size), np.eye(p.size), np.array([0.5]), 0.0, True,
                    outliers=((0.1, 0.5 * size),))  # fmt: skip
    assert doubtful_outliers(p, (names["sensor_outliers"],), best) == doubtful


@pytest.mark.parametrize(
    ("ahead_of_white", "without", "answer"),
    [(50.0, 130.0, "without"), (50.0, 80.0, "with"), (2.0, 130.0, "with")],
    ids=["likelier without them", "likelier with them", "no clear remainder"],
)
def test_outliers_beside_a_clear_remainder_are_tried_without(monkeypatch, ahead_of_white, without, answer):
    """They may be a part of it: the likelier of both searches is the answer, and what the other one weighed stands by.
    Without a remainder one search is enough.

    An electronic Duffing oscillator had outliers in the place of an offset, which an error of the clock took with it.
    """
    times = np.linspace(0.0, 10.0, 50)
    p = cases.problem(cases.simulation("p**2/2 + q**2/2"), [cases.recorded(times, np.cos(times))], 0.05)
    outliers = next(m for m in p.searched if p.candidate(m).effect.name == "sensor_outliers")

    def estimate(kind, evidence):
        return Estimate((outliers,), kind, np.zeros(p.size), np.eye(p.size), np.array([0.5]), evidence, True,
                        outliers=((0.1, 5.0),))  # fmt: skip

    class Searching(Search):
        """Finds these outliers beside an error of the clock, or, where they are left in, something else."""

        def __init__(self, stepper, seeds, deadline, progress, spared, earlier=None):
            found = Found(p, priors_without_effects(p))
            base = () if spared else (outliers,)
            self.weigher = SimpleNamespace(stepper=stepper, problem=p, found=found, base=base)
            kinds = [estimate("white", 100.0 - ahead_of_white), estimate("clock", 100.0)]
            found.estimates = {(): [estimate("white", without)]} if spared else {(outliers,): kinds}
            found.prices = SimpleNamespace(log=lambda combination: 0.0)

        def run(self):
            return self.weigher.found

    monkeypatch.setattr(_find, "Search", Searching)
    found = _find._run(Stepper(p, 1), np.zeros((1, p.size)), 0.0, Options(progress=lambda said: None))
    assert found.base == ((outliers,) if answer == "with" else ())
    assert max(found.found.estimates, key=found.found.odds) == found.base
    assert set(found.found.estimates) == ({(outliers,)} if ahead_of_white < 10.0 else {(outliers,), ()})
