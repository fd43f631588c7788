"""Of two bodies that a strong spring joins one is recorded: the other is found, and no periodic force in its place."""

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis import Options, diagnose
from symplearn.diagnosis._effect_priors import _looseness, with_effects
from symplearn.diagnosis._found import Found
from symplearn.diagnosis._modes import along_the_modes
from symplearn.diagnosis._motion import motion_along
from symplearn.diagnosis._score import Start
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._trajectory import Stepper
from symplearn.diagnosis._weigher import Weigher

TIMES = np.linspace(0.0, 15.0, 226)
# Stiffness per mass of either body, the second 2.5 times as heavy as the first, and what joins them, scaled as the
# contract has it; seen alone the first seems to have the slower mode's, 4.5.
OWN, OTHER, KAPPA, LOSS = 86.0, 34.4, 78.0 / np.sqrt(2.5), 0.04
SLOW, FAST = np.linalg.eigvalsh([[OWN, -KAPPA], [-KAPPA, OTHER]])
NOISE = 0.01


def carts(x, loss=0.0):
    """Place and speed of the first body (time, 2), by SciPy, from [x, z, v, w]; a drag on the first."""
    rates = [[0, 0, 1, 0], [0, 0, 0, 1], [-OWN, KAPPA, -loss, 0], [KAPPA, -OTHER, 0, 0]]
    return cases.solved(lambda t, y: np.asarray(rates) @ y, x, TIMES)[:, [0, 2]]


def simulation(k="{ value = 4.6, positive = true }"):
    return cases.simulation("p**2/2 + k*q**2/2", more=f"[parameters]\nk = {k}\n[recording.noise]\ny = {NOISE}")


def weigher(k, readings):
    """With priors as the search has them, along the motion that was recorded."""
    p = cases.problem(simulation(k), [cases.recorded(TIMES, readings[:, 0])], 0.02)
    path = np.insert(np.insert(readings, 1, 0.0, axis=1), 3, 0.0, axis=1)
    bare = priors_without_effects(p)
    z = bare.mean.copy()
    priors = with_effects(p, bare, motion_along(p, z, [path]))
    return Weigher(Stepper(p), Found(p, priors))


def hidden(problem):
    (member,) = (m for m in problem.searched if problem.candidate(m).effect.name == "hidden_oscillator")
    return member


def test_what_may_be_joined_does_not_hang_on_where_zero_is():
    """A spring whose stiffness is little known, read from its rest and from five lengths beside it: an unseen
    oscillator may be as strong beside the one as beside the other."""
    swing = np.stack([np.cos(TIMES), -np.sin(TIMES)], axis=1)
    loose = []
    for rest in (0.0, 5.0):
        file = cases.simulation(f"p**2/2 + k*(q - {rest})**2/2", more="[parameters]\nk = { value = 1.0, sd = 3.0 }")
        p = cases.problem(file, [cases.recorded(TIMES, swing[:, 0] + rest)], 0.02)
        path = np.insert(np.insert(swing + [rest, 0.0], 1, 0.0, axis=1), 3, 0.0, axis=1)
        bare = priors_without_effects(p)
        loose.append(_looseness(p, bare, motion_along(p, bare.mean, [path]), 0))
    # A length off by h changes the force by h in both, so that a stiffness off by 3 is three times what is there. The
    # swing is about its mean, which some two swings do not quite have at rest.
    expected = 3.0 * np.std(swing[:, 0]) / np.sqrt(np.mean(swing[:, 0] ** 2))
    # A derivative by differences of a millionth, and the same to round-off. Seen: 1e-10 and 2e-16.
    assert loose[0] == pytest.approx(expected, rel=1e-8) and loose[1] == pytest.approx(loose[0], rel=1e-12)


START = [1.0, 1.4, 0.0, 0.0]


@pytest.fixture(scope="module")
def soft():
    """Fitted with a soft spring, which nothing but the recording knows, and an oscillator that hardly touches it."""
    w = weigher("{ value = 4.6, positive = true }", carts(START))
    p, stiff = w.problem, 6.0
    combination, z = (hidden(p),), np.zeros(p.size)
    strength = (stiff - SLOW) * (FAST - stiff)
    pushes = [(stiff - OWN) * START[0] + KAPPA * START[1], 0.0]  # keep the first body's acceleration and its rate
    z[: p.state] = [START[0], pushes[0], 0.0, pushes[1]]
    z[p.head], z[p.slots : p.slots + 2] = stiff, (strength, np.sqrt(SLOW + FAST - stiff))
    w.weigh([Start(combination, z, 0.0)], whole=True)
    return w, combination


def test_the_same_two_modes_are_the_same_motion(soft):
    """From the soft end, starts with more of the stiffness seen have the two modes of SciPy's bodies, and read what
    these read."""
    w, combination = soft
    p, n = w.problem, len(TIMES)
    starts = along_the_modes(w, combination)
    stiffs = [start.z[p.head] for start in starts]
    assert len(starts) >= 3 and min(stiffs) < 20.0 and max(stiffs) > 80.0
    for start in starts:
        k, (strength, omega) = start.z[p.head], start.z[p.slots : p.slots + 2]
        modes = np.linalg.eigvalsh([[k, -np.sqrt(strength)], [-np.sqrt(strength), omega**2]])
        # Seen: 2e-6, the modes of the fit with the steps of the model.
        assert modes == pytest.approx([SLOW, FAST], rel=1e-5)
    shown = w.stepper.predict(np.stack([start.z for start in starts]), [combination] * len(starts), [n])[0].readings
    assert np.abs(shown[..., 0] - carts(START)[:, 0]).max() < 0.01 * NOISE  # seen: 5e-6


def test_an_unseen_body_may_be_as_strong_as_the_spring_is_loose():
    """Where the stiffness is known, an unseen body may be as strong as every other effect, 0.3 of the forces; where
    nothing is known of it, so that its prior is ten times as wide as its value, sqrt(0.3^2 + 10^2) times as strong as
    they are, on a spring sqrt(1 + 10^2) times as stiff."""
    known, near, open_ = (
        w.found.priors.scales[w.problem.candidate(hidden(w.problem)).first]
        for w in (weigher(k, carts(START)) for k in ("4.6", "{ value = 4.6, sd = 0.01 }", "{ value = 4.6 }"))
    )
    q = carts(START)[:, 0]
    swung = np.std(q) / np.sqrt(np.mean(q**2))  # the swing is about its mean, which is not quite the rest
    for scale, loose in ((near, swung * 0.01 / 4.6), (open_, swung * 10.0)):
        # Seen: 2e-10, the round-off of a difference over a millionth of the stiffness.
        assert scale == pytest.approx(np.hypot(0.3, loose) / 0.3 * np.hypot(1, loose) * known, rel=1e-8)


def test_a_known_spring_is_not_moved():
    """Where the simulation's stiffness is known to a percent, no start has another."""
    w = weigher("{ value = 4.6, sd = 0.05 }", carts(START))
    w.weigh([Start((hidden(w.problem),), w.found.priors.mean, 0.0)], whole=True)
    assert not along_the_modes(w, (hidden(w.problem),))


@pytest.mark.slow
def test_the_second_body_is_found():
    """Through the verb: of a lossy pair the recording of one has a hidden oscillator, certain, with the second body's
    frequency and coupling inside their intervals, a certain loss, and no force of the fast mode's period."""
    readings = carts(START, loss=LOSS)[:, 0] + NOISE * np.random.default_rng(0).normal(size=len(TIMES))
    found = diagnose(simulation(), [cases.recorded(TIMES, readings)], Options(jobs=2)).document
    assert found["family_probability"]["dissipation"] > 0.9 and len(found["findings"]) == 2
    (unseen,) = (one for one in found["findings"] if one["effect"] == "hidden_oscillator")
    assert unseen["probability"] > 0.95
    for name, true in (("omega", np.sqrt(OTHER)), ("kappa", KAPPA)):
        low, high = unseen["coefficients"][name]["interval95"]
        assert low < true < high
