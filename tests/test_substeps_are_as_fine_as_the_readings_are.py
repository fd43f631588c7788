"""Substeps are halved until the readings can no longer tell the stepped motion from the true one."""

import numpy as np
import pytest
from engine_cases import recorded, simulation, solved

from symplearn.diagnosis._build import Restriction, augmented_equations, build, first_substep, refined
from symplearn.diagnosis._calibrate import weights
from symplearn.diagnosis._course import courses
from symplearn.diagnosis._stochastic import free_run

_START = (1.2, 0.0)
_DAMPING = 0.5
# Of a chi-square below 0.1 between two halvings, a third more in size is left (and a tenth more by higher orders).
_LEFT = 0.1 * (4 / 3) ** 2 * 1.1


def _chi_square(problem, z, noise, truth) -> float:
    shown = free_run(problem, courses(problem)[0], z, (), 0, z[: problem.state], 0)[0]
    return float((weights(problem, [len(shown)])[0] * ((shown - truth) / noise) ** 2).sum())


@pytest.mark.parametrize("rows_a_period", [6, 25, 100])
def test_a_damped_pendulum_is_stepped_as_exactly_as_it_is_read(rows_a_period):
    """However close a damped pendulum's rows lie, stepped readings differ from DOP853's by nothing that can be seen."""
    times = np.arange(0.0, 40.0, 2 * np.pi / rows_a_period)
    truth = solved(lambda t, s: [s[1], -np.sin(s[0]) - _DAMPING * s[1]], _START, times)[:, :1]
    noise = np.array([1e-4])
    file = simulation("p**2/2 - cos(q)", more=f'[forces]\np = "-{_DAMPING}*p"')
    readings = [recorded(times, truth, columns=("y",))]
    equations, substep = augmented_equations(file), first_substep(file, readings)

    def rebuild(longest):
        return build(file, equations, readings, 0.0, longest, Restriction())

    first = rebuild(substep)
    z = np.zeros(first.size)
    z[0], z[first.state // 2] = _START
    fine, _ = refined(rebuild, first, z, noise, substep)
    assert _chi_square(fine, z, noise, truth) < _LEFT
    assert _chi_square(first, z, noise, truth) > 10 * _LEFT  # what is to be seen without a halving
