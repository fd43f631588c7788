"""A column of which nothing is read in the first rows does not keep a fit from its way."""

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis._calibrate import calibrate
from symplearn.diagnosis._start import first_fits, priors_without_effects, ranked
from symplearn.diagnosis._trajectory import Stepper

TIMES = np.linspace(0.0, 12.0, 121)
LATE = 70


@pytest.fixture(scope="module")
def stepper():
    """A pendulum's angle and momentum by SciPy, the momentum read from a row on that no first window reaches."""
    path = cases.solved(lambda t, x: [x[1], -4 * np.sin(x[0])], [0.9, 0.3], TIMES)
    readings = path + 0.01 * np.random.default_rng(5).normal(size=path.shape)
    readings[:LATE, 1] = np.nan
    file = cases.simulation("p**2/2 - 4*cos(q)", observe={"y": "q", "z": "p"})
    return Stepper(cases.problem(file, [cases.recorded(TIMES, readings, columns=("y", "z"))], 0.05))


def test_rows_before_it_begins_are_fitted_by_the_others(stepper):
    """The fit of these rows arrives: its errors are those of the sensor, and so is the noise that it finds."""
    priors = priors_without_effects(stepper.problem)
    z = np.zeros(stepper.problem.size)
    z[[0, stepper.problem.state // 2]] = 0.7, 0.0
    fits = calibrate(stepper, z[None], [()], priors, [LATE - 10])
    # Of sixty readings the noise is known to a tenth; held to three and a half times that. Seen: 0.0081.
    assert fits.noise[0, 0] == pytest.approx(0.01, rel=0.35) and np.isfinite(fits.noise).all()


def test_starts_are_told_apart_by_the_others(stepper):
    """Of two starts the one that follows what is read comes first, and both have a likelihood."""
    z = np.zeros((2, stepper.problem.size))
    z[:, [0, stepper.problem.state // 2]] = [[-0.5, 1.0], [0.9, 0.3]]
    rows = [LATE - 10]
    ((order, misfit),) = ranked(stepper.problem, stepper.predict(z, [(), ()], rows), rows)
    assert list(order) == [1, 0] and np.isfinite(misfit).all()


def test_the_start_is_found(stepper):
    """From nothing, through windows that hold none of the late column."""
    fits = first_fits(stepper, priors_without_effects(stepper.problem), [len(TIMES)])
    # Of the sixteen rows of the last window place and speed are known to 0.003 and, over 1.5 units of time, to twice or
    # three times as much; held to 0.02. Seen: 0.0044 and 0.0078.
    np.testing.assert_allclose(fits.z[0, [0, stepper.problem.state // 2]], [0.9, 0.3], atol=0.02)
    # And the noise to a fifth, 1 / sqrt(2 x 14); held to less than twice that. Seen: 0.0070.
    assert fits.noise[0, 0] == pytest.approx(0.01, rel=0.35)
