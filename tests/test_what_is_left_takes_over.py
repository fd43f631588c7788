"""Of two effects that do nearly the same, either is fitted without the other from where it does what both did."""

from dataclasses import replace

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis._prospects import Prospects
from symplearn.diagnosis._refinement import Refinement
from symplearn.diagnosis._score import Start
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._weighed import Mode

TIMES, NOISE, STIFF = np.linspace(0.0, 100.0, 400), 0.05, 0.3
PATH = cases.solved(lambda t, x: [x[1], -(1 + STIFF) * x[0]], [1.0, 0.0], TIMES)
NAMES = ("linear_stiffness", "cubic_stiffness")


@pytest.fixture(scope="module")
def fitted():
    """A spring stiffer than the simulation's; the stiffness that it lacks, alone and beside a cubic one."""
    readings = PATH[:, 0] + NOISE * np.random.default_rng(0).normal(size=len(TIMES))
    file = cases.simulation("p**2/2 + q**2/2", more=f"[recording.noise]\ny = {NOISE}")
    p = cases.problem(file, [cases.recorded(TIMES, readings)], 0.25)
    w = cases.weigher(p, *PATH.T)
    pair = tuple(next(m for m in p.searched if p.candidate(m).effect.name == name) for name in NAMES)
    z = priors_without_effects(p).mean.copy()
    z[0], z[p.slots] = 1.0, STIFF
    w.weigh([Start(pair[:1], z, 0.0), Start(pair, z, 0.0)], whole=True)
    return w, pair


def test_the_one_that_stays_takes_over(fitted):
    """Beside a cubic stiffness of two of its errors, with the linear one as much less, the linear one alone is as
    likely as if it had been fitted by itself; from where it was, half a turn behind at the end, it does not arrive."""
    w, pair = fitted
    alone, both = w.found.of(pair[:1], "white"), w.found.of(pair, "white")
    linear, cubic = w.problem.slots, w.problem.slots + 1
    spread = both.covariance[cubic]
    z = both.z + (2 * np.sqrt(spread[cubic]) - both.z[cubic]) * spread / spread[cubic]
    slower = alone.z[linear] - z[linear]
    assert slower / (2 * np.sqrt(1 + STIFF)) * TIMES[-1] > np.pi  # in phase, beyond half a turn
    w.found.estimates.clear()
    w.found.estimates[pair] = [replace(both, z=z)]
    Refinement(Prospects(w), lambda message: None).weigh_subsets()
    # A fit ends where it promises a thousandth; a hundredth of a nat changes no probability.
    assert w.found.of(pair[:1], "white").log_evidence == pytest.approx(alone.log_evidence, abs=0.01)


def test_nothing_takes_over_from_what_does_nothing():
    """A simulation with nothing left out that was caught in a poorer optimum is fitted again from where a stiffness
    that is not needed had led; else that would look like what was left out."""
    readings = np.cos(TIMES) + NOISE * np.random.default_rng(0).normal(size=len(TIMES))
    file = cases.simulation("p**2/2 + q**2/2", more=f"[recording.noise]\ny = {NOISE}")
    p = cases.problem(file, [cases.recorded(TIMES, readings)], 0.1)
    w = cases.weigher(p, np.cos(TIMES), -np.sin(TIMES))
    stiffness = (next(m for m in p.searched if p.candidate(m).effect.name == "linear_stiffness"),)
    z = priors_without_effects(p).mean.copy()
    z[0] = 1.0
    w.weigh([Start((), z, 0.0), Start(stiffness, z, 0.0)], whole=True)
    right = w.found.of((), "white")
    poor = right.log_evidence - 500
    w.found.estimates[()] = [replace(right, log_evidence=poor, modes=(Mode(poor, right.z, right.covariance),))]
    Refinement(Prospects(w), lambda message: None).weigh_subsets()
    assert w.found.of((), "white").log_evidence == pytest.approx(right.log_evidence, abs=0.01)
    assert w.found.odds(()) > w.found.odds(stiffness)


def test_it_takes_over_from_the_one_that_loses_least():
    """A mass between springs, caught in a poorer optimum with nothing left out. From the likeliest, a stiffness that
    makes another motion of it, no way leads back: it is fitted again from where a force that is next to nothing is."""
    readings = np.cos(TIMES) + NOISE * np.random.default_rng(0).normal(size=len(TIMES))
    file = cases.simulation(
        "p**2/2 + k*q**2/2",
        more=f"[parameters]\nk = {{ value = 1.0, sd = 0.5 }}\n[recording.noise]\ny = {NOISE}",
    )
    p = cases.problem(file, [cases.recorded(TIMES, readings)], 0.1)
    w = cases.weigher(p, np.cos(TIMES), -np.sin(TIMES))
    cubic, linear = (
        next((m,) for m in p.searched if p.candidate(m).effect.name == name)
        for name in ("cubic_stiffness", "linear_stiffness")
    )
    z = priors_without_effects(p).mean.copy()
    z[0] = 1.0
    w.weigh([Start((), z, 0.0), Start(cubic, z, 0.0), Start(linear, z, 0.0)], whole=True)
    right, other = w.found.of((), "white"), w.found.of(linear, "white")
    away = other.z.copy()
    away[p.head], away[p.slots] = 1.3, -0.3  # the same spring, of which k alone is half a turn ahead at t = 22
    poor, best = right.log_evidence - 500, max(w.found.best(cubic), w.found.best(linear)) + 1.0
    tight = 1e-6 * np.eye(p.size)
    w.found.estimates[()] = [replace(right, log_evidence=poor, modes=(Mode(poor, right.z, right.covariance),))]
    w.found.estimates[linear] = [replace(other, z=away, covariance=tight, log_evidence=best)]
    Refinement(Prospects(w), lambda message: None).weigh_subsets()
    # A fit ends where it promises a thousandth; a hundredth of a nat changes no probability.
    assert w.found.of((), "white").log_evidence == pytest.approx(right.log_evidence, abs=0.01)
