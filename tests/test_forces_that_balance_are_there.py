"""How strong an effect may be is judged by the forces that are there, not by what they leave of each other."""

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis import Options, diagnose
from symplearn.diagnosis._build import Restriction
from symplearn.diagnosis._motion import motion_along
from symplearn.diagnosis._start import priors_without_effects

TIMES = np.linspace(0.0, 40.0, 400)


def forces(more, p, hamiltonian="p**2/2"):
    """The size of the forces on q along a motion of that momentum."""
    q = np.cumsum(p) * (TIMES[1] - TIMES[0])
    problem = cases.problem(cases.simulation(hamiltonian, more=more), [cases.recorded(TIMES, q)], 0.1)
    path = np.stack([q, 0 * q, p, 0 * q], axis=1)
    return motion_along(problem, priors_without_effects(problem).mean, [path]).forces[0]


def test_a_motor_against_its_brake():
    """A steady rotor's torque and friction cancel, and are as strong as each is; where parts add up, the
    sum counts."""
    steady, rest = np.full(400, 1.0), np.zeros(400)
    motor = '[forces]\np = "0.3 - 0.3*p"'
    assert forces(motor, steady) == pytest.approx(np.hypot(0.3, 0.3))
    assert forces(motor, rest) == pytest.approx(0.3)
    assert forces('[forces]\np = "0.2 + 0.1"', steady) == pytest.approx(0.3)
    p = np.cos(TIMES)
    q = np.cumsum(p) * (TIMES[1] - TIMES[0])
    spring, damping = -2.0 * q, -0.5 * p
    apart, together = np.mean(spring**2) + np.mean(damping**2), np.mean((spring + damping) ** 2)
    assert forces('[forces]\np = "-0.5*p"', p, "p**2/2 + q**2") == pytest.approx(np.sqrt(max(apart, together)))


def test_where_no_force_is_known_one_that_would_turn_it_round_counts():
    """What glides, or is held by next to nothing, has no force to compare with: twice the largest momentum over the
    time that is recorded, in whatever unit; a swing's own force is stronger from half a turn on."""
    for size in (1.0, 1e-6):
        slowing = np.linspace(2.0 * size, 0.5 * size, 400)
        assert forces("", slowing) == pytest.approx(2 * 2.0 * size / 40.0)
        assert forces("", slowing, "p**2/2 + 1e-9*q**2/2") == pytest.approx(2 * 2.0 * size / 40.0)
    assert forces("", np.zeros(400)) == 1.0
    swing = np.sqrt(2.0) * np.cos(np.pi / 40.0 * TIMES)
    q = np.cumsum(swing) * (TIMES[1] - TIMES[0])
    stiffness = (np.pi / 40.0) ** 2
    assert forces("", swing, f"p**2/2 + {stiffness}*q**2/2") == pytest.approx(stiffness * np.sqrt(np.mean(q**2)))


@pytest.mark.slow
def test_a_drag_of_a_steady_rotor_is_one_drag():
    """A rotor that starts near its steady speed lacks a tenth of its friction, as the square of the speed: one effect
    does it, and its coefficient is the truth's within three of its standard deviations."""
    rates = lambda t, x: [x[1], 0.3 - 0.3 * x[1] - 0.03 * x[1] * abs(x[1])]  # noqa: E731
    q = cases.solved(rates, [0.0, 0.85], TIMES)[:, 0] + 0.02 * np.random.default_rng(1).normal(size=len(TIMES))
    file = cases.simulation("p**2/2", more='[forces]\np = "0.3 - 0.3*p"')
    some = Restriction(("viscous_damping", "quadratic_drag", "coulomb_friction", "constant_force"))
    (finding,) = diagnose(file, [cases.recorded(TIMES, q)], Options(restriction=some, jobs=2)).document["findings"]
    c = finding["coefficients"]["c"]
    assert finding["effect"] == "quadratic_drag" and abs(c["mean"] - 0.03) < 3 * c["sd"]


@pytest.mark.slow
def test_no_share_is_told_where_there_is_no_force():
    """Of a cart that a drag slows, whose simulation glides for ever, no sentence compares with forces already there."""
    times = np.linspace(0.0, 10.0, 101)
    q = 10.0 * np.log(1 + 0.2 * times) + 0.01 * np.random.default_rng(3).normal(size=len(times))  # v' = -v^2 / 10
    some = Restriction(("quadratic_drag",))
    found = diagnose(cases.simulation("p**2/2"), [cases.recorded(times, q)], Options(restriction=some)).document
    (finding,) = found["findings"]
    # Three of its standard deviations. Seen: 0.1004, with 0.00039.
    assert finding["coefficients"]["c"]["mean"] == pytest.approx(0.1, abs=0.0012)
    assert "already there" not in finding["sentence"]
