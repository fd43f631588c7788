"""The per cent of the forces that a sentence gives are a ratio of root mean squares, or are not given."""

import re

import numpy as np
import pytest
from finding_cases import VALUES, candidate, said, values

from symplearn.diagnosis._effect_priors import _unit
from symplearn.diagnosis._motion import Motion

# Theta swings unevenly for ten periods, under forces of a root mean square of 1.7; the forcing has whole periods too.
T = np.linspace(0.0, 20 * np.pi, 4000, endpoint=False)
Q = 0.8 * np.sin(T) + 0.3 * np.cos(2 * T) + 0.1
V = 0.8 * np.cos(T) - 0.6 * np.sin(2 * T)
PUSH = 1.7
MOTION = Motion(Q[:, None], V[:, None], np.array([PUSH]), np.ones(1), (T,))
c, f, k, a, omega, phi = (VALUES[name] for name in ("c", "f", "k", "a", "omega", "phi"))
FORCES = {
    "viscous_damping": -c * V,
    "quadratic_drag": -c * np.abs(V) * V,
    "coulomb_friction": -f * np.sign(V),
    "constant_force": f + 0 * T,
    "linear_stiffness": -k * Q,
    "quadratic_stiffness": -k * Q**2,
    "cubic_stiffness": -k * Q**3,
    "periodic_forcing": a * np.cos(omega * T + phi),
}


def strength(name):
    """An effect's amplitudes over those that its prior takes to be as strong as the forces already there."""
    one = candidate(name)
    inside = one.effect.inner(values(name), 0.0)[: one.effect.amplitudes]
    return float(np.linalg.norm(inside / np.array(_unit(MOTION, one))))


@pytest.mark.parametrize("name", FORCES)
def test_the_share_is_the_ratio_of_root_mean_squares(name):
    """The per cent said are those of the force along the motion, written out by hand, over the forces there."""
    share = re.search(r"about (\S+) % of the forces already there", said(name, strength=strength(name)))
    # Two digits are said: half a unit in the second is at most a twentieth.
    assert float(share[1]) == pytest.approx(100 * np.sqrt(np.mean(FORCES[name] ** 2)) / PUSH, rel=0.05)


def test_a_periodic_force_is_said_by_its_root_mean_square():
    """A cosine whose amplitude is the root mean square of the forces there has 1 / sqrt(2) = 71 % of it."""
    assert "about 71 % of the forces already there" in said("periodic_forcing", strength=1.0)


@pytest.mark.parametrize(
    ("name", "side"),
    [
        ("contact_stop", "upper"),
        ("contact_stop", "lower"),
        ("impulse", None),
        ("hidden_oscillator", None),
        ("self_excitation", None),
    ],
)
def test_what_has_no_ratio_says_none(name, side):
    """Where the prior measures an effect otherwise than by its force, its sentence is as if no strength were known."""
    assert said(name, side, strength=0.3) == said(name, side)
    assert "forces already there" not in said(name, side)


@pytest.mark.parametrize("strength", [None, float("nan"), float("inf")])
def test_an_unknown_strength_is_not_said(strength):
    """What is not known or not finite makes no sentence."""
    assert "forces already there" not in said("viscous_damping", strength=strength)
