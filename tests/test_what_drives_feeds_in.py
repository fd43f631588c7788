"""A self-excitation is named only where more energy is fed in than is lost, at some time in the recordings."""

import engine_cases as cases
import numpy as np
import pytest
from scipy.stats import norm

from symplearn.diagnosis import Options, diagnose
from symplearn.diagnosis._activity import log_fed
from symplearn.diagnosis._build import Restriction
from symplearn.diagnosis._effect_priors import with_effects
from symplearn.diagnosis._motion import motion_along
from symplearn.diagnosis._problem import MOST
from symplearn.diagnosis._start import priors_without_effects

TIMES, RATE = np.linspace(0.0, 62.8, 1257), 0.05
# A swing that dies: its amplitude falls from 1 to a twenty-third.
SWING = np.exp(-RATE * TIMES) * np.cos(TIMES)
SPEED = np.gradient(SWING, TIMES)


def along_the_swing(more=""):
    """A problem, with priors along the swing."""
    p = cases.problem(cases.simulation("p**2/2 + q**2/2", more=more), [cases.recorded(TIMES, SWING)], 0.05)
    z = np.zeros(p.size)
    still = np.zeros_like(TIMES)  # of the unseen oscillator, which there is none of
    motion = motion_along(p, z, [np.stack([SWING, still, SPEED, still], axis=1)])
    return p, with_effects(p, priors_without_effects(p), motion)


@pytest.fixture(scope="module")
def known():
    return along_the_swing()


def combined(p, values):
    """A combination of effects with their amplitudes inside."""
    names = {p.candidate(m).effect.name: m for m in p.searched}
    members = sorted((names[name], name) for name in values)
    c, z = tuple(m for m, _ in members), np.zeros(p.size)
    for (_, place), (_, name) in zip(p.placed(c), members, strict=True):
        z[place][: len(values[name])] = values[name]
    assert len(c) <= MOST
    return c, z


def surplus(values, rows=slice(None)):
    """Mean power over some rows, from each effect's force as the contract has it."""
    c, e = values["self_excitation"]
    force = c * SPEED - e * SWING**2 * SPEED
    force -= values.get("viscous_damping", [0])[0] * SPEED
    force -= values.get("quadratic_drag", [0])[0] * np.abs(SPEED) * SPEED
    force -= values.get("coulomb_friction", [0])[0] * np.sign(SPEED)
    return (force * SPEED)[rows].mean()


CASES = {
    "it drives the small motion": ({"self_excitation": [0.05, 0.5]}, True),
    "it turns below the smallest motion": ({"self_excitation": [0.0001, 0.5]}, False),
    "a friction takes more everywhere": ({"self_excitation": [0.1, 0.1], "coulomb_friction": [0.2]}, False),
    "a drag takes more where it is fast only": ({"self_excitation": [0.1, 0.1], "quadratic_drag": [0.5]}, True),
    "a damping takes all of it": ({"self_excitation": [0.1, 0.1], "viscous_damping": [0.12]}, False),
}


@pytest.mark.parametrize(("values", "drives"), CASES.values(), ids=CASES)
def test_what_loses_more_than_it_feeds_is_impossible(values, drives, known):
    """However well its coefficients are known, and whatever is ahead in the fit; where it feeds in at some time, it
    owes nothing."""
    p, priors = known
    c, z = combined(p, values)
    found = log_fed(p, c, priors.powers, z, np.diag(np.full(p.size, 1e-6) ** 2))
    tenths = [surplus(values, part) for part in np.array_split(np.arange(len(TIMES)), 10)]
    # 1e-6: the log of a probability of one, of a surplus of hundreds of standard deviations.
    assert drives == (max(tenths) > 0) and (found == pytest.approx(0.0, abs=1e-6)) == drives
    assert drives or found < -100


def test_what_is_uncertain_is_weighed_by_its_probability(known):
    """Where the damping's error is as large as what it takes too much: SciPy's normal distribution, in the stretch of
    a swing each where most is fed in."""
    p, priors = known
    c, z = combined(p, {"self_excitation": [0.1, 0.0], "viscous_damping": [0.12]})
    spread = np.zeros((p.size, p.size))
    place = next(place for m, place in p.placed(c) if p.candidate(m).effect.name == "viscous_damping")
    spread[place, place] = 0.02**2
    # Both go with the speed's square, so that one more standard deviation of the damping balances them at any time: to
    # round-off, of which 1e-9 is ample.
    assert log_fed(p, c, priors.powers, z, spread) == pytest.approx(norm.logcdf(-1.0), abs=1e-9)


def test_without_a_self_excitation_nothing_is_owed(known):
    """Dampings alone may only lose."""
    p, priors = known
    c, z = combined(p, {"coulomb_friction": [0.2], "viscous_damping": [0.1]})
    assert log_fed(p, c, priors.powers, z, np.eye(p.size)) == 0.0


KNOWN = {
    "a damping": '[[terms]]\neffect = "viscous_damping"\ntarget = "q"\nc = 0.12\n',
    "a force of the file": '[forces]\np = "-0.12*p"\n',
    "dry friction": '[[terms]]\neffect = "coulomb_friction"\ntarget = "q"\nf = 0.2\n',
}


@pytest.mark.parametrize("more", KNOWN.values(), ids=KNOWN)
def test_what_the_simulation_loses_counts(more):
    """A self-excitation of 0.1 that the simulation's own losses outdo at any time only takes from these, as one in ten
    does; one of 0.5 drives; one that takes out more than it feeds in is no more possible beside them than alone."""
    p, priors = along_the_swing(more)
    for values, owed in (([0.1, 0.0], -np.log(10.0)), ([0.5, 0.0], 0.0)):
        c, z = combined(p, {"self_excitation": values})
        found = log_fed(p, c, priors.powers, z, np.diag(np.full(p.size, 1e-6) ** 2))
        # What is owed is exact but for the log of the probability that a surplus of hundreds of standard deviations is
        # one, which is nothing: 1e-6 is ample.
        assert found == pytest.approx(owed, abs=1e-6)
    c, z = combined(p, {"self_excitation": [0.0001, 0.5]})
    assert log_fed(p, c, priors.powers, z, np.diag(np.full(p.size, 1e-6) ** 2)) < -100


def test_a_damping_that_is_too_strong_is_told_beside_its_rivals():
    """Twice the damping that there is: the finding takes a half of it back, though a self-excitation may be named."""
    times = np.linspace(0.0, 20.0, 334)
    y = cases.solved(lambda t, x: [x[1], -4 * x[0] - 0.05 * x[1]], [1.0, 0.0], times)[:, 0]
    more = KNOWN["a damping"].replace("0.12", "0.10")
    file = cases.simulation("p**2/2 + 2*q**2", more=more)
    recording = cases.recorded(times, y + 0.01 * np.random.default_rng(1).normal(size=334))
    only = Restriction(("viscous_damping", "self_excitation", "coulomb_friction"))
    (found,) = diagnose(file, [recording], Options(restriction=only)).document["findings"]
    low, high = found["coefficients"]["c"]["interval95"]
    assert found["effect"] == "viscous_damping" and low < -0.05 < high


def test_what_takes_back_a_part_of_a_known_loss_is_named():
    """A swing that dies by a damping that is known, less than it would: what feeds in near the middle, without
    outdoing the damping, is told with its coefficients, not as a damping that changes."""
    times = np.linspace(0.0, 40.0, 200)
    push = lambda t, x: [x[1], -4 * x[0] - 0.12 * x[1] + 0.08 * (1 - (x[0] / 0.4) ** 2) * x[1]]  # noqa: E731
    y = cases.solved(push, [1.0, 0.0], times)[:, 0] + 0.01 * np.random.default_rng(4).normal(size=len(times))
    file = cases.simulation(
        "p**2/2 + 2*q**2", more='[parameters]\nc = { value = 0.12, sd = 0.006 }\n[forces]\np = "-c*p"'
    )
    only = Restriction(("viscous_damping", "self_excitation", "parameter_drift"))
    (found,) = diagnose(file, [cases.recorded(times, y)], Options(restriction=only)).document["findings"]
    assert found["effect"] == "self_excitation" and found["probability"] > 0.9
    for name, true in (("c", 0.08), ("a", 0.4)):
        low, high = found["coefficients"][name]["interval95"]
        assert low < true < high


@pytest.mark.slow
def test_a_swing_that_only_decays_is_not_driven():
    """A damping that grows with the square of the position, which no word means, is a friction to the tool and no
    self-excitation, though one that hardly drives would be that very law."""
    times = np.linspace(0.0, 60.0, 400)
    q = cases.solved(lambda t, x: [x[1], -x[0] - (0.004 + 0.1 * x[0] ** 2) * x[1]], [1.0, 0.0], times)[:, 0]
    reading = q + 0.003 * np.random.default_rng(0).normal(size=len(times))
    some = Restriction(("viscous_damping", "quadratic_drag", "coulomb_friction", "self_excitation"))
    found = diagnose(cases.simulation("p**2/2 + k*q**2/2", more="[parameters]\nk = { value = 1.0, sd = 0.01 }"),
                     [cases.recorded(times, reading)], Options(restriction=some, jobs=2)).document  # fmt: skip
    assert found["verdict"] == "mismatch" and found["family_probability"]["dissipation"] > 0.99
    assert found["family_probability"]["activity"] < 0.01
