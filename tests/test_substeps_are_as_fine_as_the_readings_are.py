"""Substeps are halved until the readings can no longer tell the stepped motion from the true one."""

import numpy as np
import pytest
from engine_cases import recorded, simulation, solved

from symplearn.diagnosis._build import Restriction, augmented_equations, build, first_substep, refined
from symplearn.diagnosis._calibrate import weights
from symplearn.diagnosis._course import courses
from symplearn.diagnosis._stochastic import free_run

_START = (1.2, 0.0)
# Of a chi-square below 0.1 between two halvings, a third more in size is left (and a tenth more by higher orders).
_LEFT = 0.1 * (4 / 3) ** 2 * 1.1


def _forced(force):
    return f'[forces]\np = "{force}"'


def _laid_out(file, recordings):
    """What lays the problem out with a longest substep, its equations compiled once."""
    built = augmented_equations(file)
    return lambda longest: build(file, built, recordings, 0.0, longest, Restriction())


def _before_and_after(hamiltonian, more, times, readings, noise):
    """The problem in its first substeps and in those that are fine enough, with the motion from `_START`; and whether
    they are said to be."""
    file = simulation(hamiltonian, more=more)
    recordings = [recorded(times, readings, columns=("y",))]
    rebuild, substep = _laid_out(file, recordings), first_substep(file, recordings)
    first = rebuild(substep)
    z = np.zeros(first.size)
    z[0], z[first.state // 2] = _START
    fine, _, is_fine = refined(rebuild, first, z, np.array([noise]), substep)
    return first, fine, z, is_fine


def _chi_square(laid_out, z, truth, noise) -> float:
    shown = free_run(laid_out, courses(laid_out)[0], z, (), 0, z[: laid_out.state], 0)[0]
    return float((weights(laid_out, [len(shown)])[0] * ((shown - truth) / noise) ** 2).sum())


@pytest.mark.parametrize("rows_a_period", [6, 25, 100])
def test_a_damped_pendulum_is_stepped_as_exactly_as_it_is_read(rows_a_period):
    """However close a damped pendulum's rows lie, stepped readings differ from DOP853's by nothing that can be seen."""
    times = np.arange(0.0, 40.0, 2 * np.pi / rows_a_period)
    truth = solved(lambda t, s: [s[1], -np.sin(s[0]) - 0.5 * s[1]], _START, times)[:, :1]
    # A term of the vocabulary, which is split in to order two.
    damped = '[[terms]]\neffect = "viscous_damping"\ntarget = "q"\nc = 0.5\n'
    first, fine, z, is_fine = _before_and_after("p**2/2 - cos(q)", damped, times, truth, 1e-4)
    assert is_fine and _chi_square(fine, z, truth, 1e-4) < _LEFT
    assert _chi_square(first, z, truth, 1e-4) > 10 * _LEFT  # what is to be seen without a halving


def test_substeps_in_which_a_known_damping_diverges_are_halved():
    """An overdamped coil that its first substeps throw out to infinity is stepped as exactly as it is read, too."""
    times = np.arange(0.0, 100.0, 0.25)
    truth = solved(lambda t, s: [s[1], -30 * s[1] - 40 * s[0] + 40 * np.sin(0.7 * t)], _START, times)[:, :1]
    first, fine, z, is_fine = _before_and_after(
        "p**2/2 + 20*q**2", _forced("-30*p + 40*sin(0.7*t)"), times, truth, 0.05
    )
    assert is_fine and _chi_square(fine, z, truth, 0.05) < _LEFT
    with np.errstate(invalid="ignore", over="ignore"):
        assert not np.isfinite(_chi_square(first, z, truth, 0.05))


def test_a_motion_that_leaves_every_bound_is_halved_in_vain_and_left_alone():
    """x'' = x**3 leaves for infinity within two units of time, whatever the substeps: they stay as they were, and
    are said to be too long."""
    times = np.arange(0.0, 10.0, 0.1)
    first, fine, _, is_fine = _before_and_after("p**2/2", _forced("q**3"), times, np.cos(times)[:, None], 1e-4)
    assert fine is first and not is_fine


def test_a_motion_that_no_halving_settles_is_left_alone():
    """A top that the start throws through its singularity goes elsewhere in substeps of every length: they stay as they
    were, for sixty times the work would tell nothing, and are said to be too long."""
    times = np.arange(0.0, 4.0, 0.02)
    energy = "pth**2/2 + (pph - cos(th))**2/(2*sin(th)**2) + 3*cos(th)"
    file = simulation(energy, ("th", "ph"), ("pth", "pph"), {"y": "sin(th)*cos(ph)"})
    recordings = [recorded(times, np.cos(times)[:, None], columns=("y",))]
    rebuild, substep = _laid_out(file, recordings), first_substep(file, recordings)
    first = rebuild(substep)
    z = np.zeros(first.size)
    z[[0, 1, first.state // 2, first.state // 2 + 1]] = -0.09, -1.9, -150.0, -4.4
    fine, length, is_fine = refined(rebuild, first, z, np.array([0.01]), substep)
    assert fine is first and length == substep and not is_fine
