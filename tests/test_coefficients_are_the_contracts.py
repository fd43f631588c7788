"""What a fit holds inside and the contract's coefficients are the same thing said twice."""

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from symplearn._effects import EFFECTS, Oscillating
from symplearn._recording import Recording
from symplearn._simulation_file import parse_simulation
from symplearn.diagnosis._build import Restriction, augmented_equations, build
from symplearn.diagnosis._calibrate import Priors
from symplearn.diagnosis._coefficients import _counted, _summary, coefficients
from symplearn.diagnosis._scatter import outliers
from symplearn.diagnosis._weighed import Estimate

SWING = """
[system]
coordinates = ["q"]
momenta = ["p"]
hamiltonian = "p**2/2 + 2*q**2"
[recording]
time = "t"
[recording.observe]
y = "q"
"""

AMOUNT = st.floats(1e-3, 1e3)
FREQUENCY = st.floats(1e-2, 1e2)
PHASE = st.floats(-math.pi, math.pi, exclude_min=True)
ORIGIN = st.floats(-50.0, 50.0)
OSCILLATING = [e for e in EFFECTS.values() if isinstance(e, Oscillating)]
# Products of frequency and origin reach 5000 radians, whose last digit is 1e-12.
ROUND_OFF = 1e-11


def back(effect, values, origin):
    """The contract's coefficients of the values inside, each of a batch of one."""
    return {name: float(v[0]) for name, v in effect.named(effect.inner(values, origin)[None], origin).items()}


@pytest.mark.parametrize("effect", OSCILLATING, ids=lambda e: e.name)
@given(a=AMOUNT, omega=FREQUENCY, phi=PHASE, origin=ORIGIN)
@example(a=1.0, omega=0.03125, phi=-3.1415926535897927, origin=-8.905430694534019)  # was told as -pi
def test_oscillations_come_back(effect, a, omega, phi, origin):
    """Amplitude, frequency and phase, wherever phases inside count from; the phase lies in (-pi, pi]."""
    found = back(effect, {"a": a, "omega": omega, "phi": phi}, origin)
    assert found["a"] == pytest.approx(a, rel=ROUND_OFF) and found["omega"] == omega
    assert -math.pi < found["phi"] <= math.pi
    assert abs(math.remainder(found["phi"] - phi, 2 * math.pi)) < ROUND_OFF


@given(cosine=st.floats(-5, 5), sine=st.floats(-5, 5), omega=st.floats(-50, 50), origin=ORIGIN, t=st.floats(-50, 50))
def test_any_values_inside_are_the_same_oscillation(cosine, sine, omega, origin, t):
    """A negative frequency too: a cos(omega t + phi) is what the values inside say, with a and omega positive."""
    found = {name: float(v[0]) for name, v in
             EFFECTS["periodic_forcing"].named(np.array([[cosine, sine, omega]]), origin).items()}  # fmt: skip
    assert found["a"] >= 0 and found["omega"] >= 0 and -math.pi < found["phi"] <= math.pi
    inside = cosine * math.cos(omega * (t - origin)) + sine * math.sin(omega * (t - origin))
    if omega != 0:  # a constant has no phase
        assert found["a"] * math.cos(found["omega"] * t + found["phi"]) == pytest.approx(inside, abs=1e-10)


@given(c=AMOUNT, a=AMOUNT, omega=FREQUENCY, kappa=AMOUNT)
def test_self_excitation_and_hidden_oscillators_come_back(c, a, omega, kappa):
    """c and a, omega and kappa."""
    for name, values in (
        ("self_excitation", {"c": c, "a": a}),
        ("hidden_oscillator", {"omega": omega, "kappa": kappa}),
    ):
        assert back(EFFECTS[name], values, 0.0) == pytest.approx(values, rel=ROUND_OFF)


@pytest.mark.parametrize("effect", [e for e in EFFECTS.values() if e.amplitudes], ids=lambda e: e.name)
def test_one_set_of_values_or_many(effect):
    """Values inside may be one vector, as a fit has them, or many, as draws are."""
    values = {name: 0.7 for name in effect.coefficients}
    inside = effect.inner(values, 0.3)
    assert len(inside) == effect.size
    one, many = effect.named(inside, 0.3), effect.named(np.tile(inside, (3, 1)), 0.3)
    for name in effect.coefficients:
        assert float(one[name]) == pytest.approx(0.7) and many[name] == pytest.approx([0.7] * 3)


@pytest.mark.parametrize("middle", [0.5, 3.1, -3.1])
def test_an_interval_of_a_phase_is_about_its_value(middle):
    """Where the phase turns over at pi, value and interval are of the same turn."""
    draws, value = np.random.default_rng(0).normal(middle, 0.2, 4000), math.remainder(middle + 0.1, 2 * math.pi)
    told = _summary(value, np.angle(np.exp(1j * draws)), circular=True)
    assert told["mean"] == value
    # Of 4000 draws quantiles are known to 0.008; held to four times that.
    assert told["interval95"] == pytest.approx([value - 0.1 - 0.392, value - 0.1 + 0.392], abs=0.03)


@pytest.mark.parametrize("start", [0.0, 1e3, 2e4, 1.7e9])
def test_an_oscillation_is_told_at_one_point(start):
    """However far the clock is from zero, where phase and frequency hang together, a, omega and phi are one force's."""
    times = start + np.arange(0.0, 20.0, 0.05)
    file = parse_simulation(SWING, "swing.toml")
    built = augmented_equations(file, start, origin=times[[0, -1]].mean())
    run = Recording(1, "1", ("y",), times, np.cos(2 * (times - start))[:, None], np.arange(len(times)))
    problem = build(file, built, [run], 0.25, 0.05, Restriction())
    member = next(m for m in problem.searched if problem.candidate(m).effect.name == "periodic_forcing")
    place = dict(problem.placed((member,)))[member]
    z, covariance = np.zeros(problem.size), np.zeros((problem.size, problem.size))
    z[place] = 1.0, 0.0, 1.3  # cos(1.3 (t - origin))
    covariance[place, place] = np.diag([0.005, 0.005, 0.005 * np.sqrt(12) / 20]) ** 2
    estimate = Estimate((member,), "white", z, covariance, np.array([0.01]), 0.0, True)
    wide = np.full(built.size, np.inf)
    priors = Priors(np.zeros(problem.size), np.zeros(problem.size), np.zeros(built.size), np.ones(built.size),
                    -wide, wide, np.ones((1, 2)))  # fmt: skip
    told = {name: one["mean"] for name, one in coefficients(problem, priors, estimate, member, 1.0).items()}
    # Where omega t is 2e9 its last digit is 5e-7.
    phase = math.remainder(told["omega"] * built.origin + told["phi"], 2 * math.pi)
    assert abs(phase) < 2e-6 and told["a"] == pytest.approx(1.0)


def test_what_a_few_outliers_say_has_honest_intervals():
    """Of ten outliers among three hundred readings, on average, share and size lie in their intervals as often as these
    claim, and a wrong noise of twelve readings does: over four hundred draws."""
    rng, held, number = np.random.default_rng(4), [], 300
    for _ in range(400):
        is_off = rng.random(number) < 1 / 30
        errors = rng.normal(size=number) * np.where(is_off, np.hypot(1.0, 8.0), 1.0)
        share, size = outliers(errors, np.abs(errors) > 3.5)
        few = rng.normal(size=12)
        told = [*(_counted(name, {"e": share, "sd": size}, 300.0) for name in ("e", "sd")),
                _counted("s", {"s": float(np.sqrt(np.mean(few**2)))}, 12.0)]  # fmt: skip
        ends = [one["interval95"] for one in told]
        held.append([low < true < high for (low, high), true in zip(ends, (1 / 30, 8.0, 1.0), strict=True)])
    # Four standard deviations of a count of four hundred.
    np.testing.assert_allclose(np.mean(held, axis=0), 0.95, atol=0.044)
