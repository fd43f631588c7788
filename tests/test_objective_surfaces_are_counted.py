"""Local minima on a grid are counted as defined, on the surfaces of Figure 1.3, which are what textbook numpy gives."""

import numpy as np
import pytest
import scipy.linalg
from estimation_cases import kalman_log_likelihood

from experiments import objective_surfaces as surfaces

AT = [(19, 51), (0, 0), (79, 99), (50, 35), (27, 63)]  # the point nearest the truth, two corners, two more


def found_at(values):
    """The indices of the minima."""
    return [tuple(map(int, at)) for at in np.argwhere(surfaces.strict_minima(np.asarray(values, float)))]


def propagator(theta):
    """One step of the pendulum, by scipy."""
    return scipy.linalg.expm(0.1 * np.array([[0.0, theta[0]], [theta[1], 0.0]]))


@pytest.fixture(scope="module")
def by_library():
    """One recording of 20 intervals, and each objective's surface."""
    y = surfaces.readings(0, 20)
    found = surfaces.surfaces(y, surfaces.rectangle().reshape(-1, 2))
    return y, {name: values.reshape(80, 100) for name, values in found.items()}


def samples(values):
    """Five points (theta_1, theta_2) of a surface with its values there."""
    return [(surfaces.rectangle()[at], values[at]) for at in AT]


def test_known_minima_are_found():
    """cos x cos y has a minimum wherever both cosines are of size 1 and opposite sign."""
    x, y = np.linspace(0.5, 13.0, 126), np.linspace(-0.5, 7.0, 76)
    # Inside: x near pi, 2 pi, 3 pi, 4 pi and y near 0, pi, 2 pi; opposite signs at 6 of the 12 pairs.
    found = found_at(np.cos(x)[:, None] * np.cos(y))
    lowest = {(round(x[i] / np.pi), round(y[j] / np.pi)) for i, j in found}
    assert lowest == {(1, 0), (3, 0), (2, 1), (4, 1), (1, 2), (3, 2)} and len(found) == 6


def test_diagonal_neighbours_count():
    """A point that only a diagonal neighbour undercuts is no minimum: a valley aslant the axes has one, not many."""
    values = np.ones((5, 6))
    values[2, 2] = 0.0
    assert found_at(values) == [(2, 2)]
    values[3, 3] = -1.0
    assert found_at(values) == [(3, 3)]


def test_the_border_and_plateaus_do_not_count():
    """A lowest point on the border, or one of two equal ones, is no strict minimum."""
    assert found_at(np.add.outer(np.arange(5), np.arange(5))) == []
    assert found_at([3.0, 1.0, 1.0, 3.0]) == []
    assert found_at([0.0, 1.0, 0.5, 2.0, 1.0]) == [(2,)]


def test_one_dimension_is_counted_the_same():
    """sin has its minima at 3 pi / 2 and every turn later, also on a line."""
    x = np.arange(0.0, 20.0, 0.01)
    # A grid of step 0.01 has its lowest point within half a step.
    assert np.allclose(x[[i for (i,) in found_at(np.sin(x))]], 1.5 * np.pi + 2 * np.pi * np.arange(3), atol=0.005)


def test_simulation_surface_is_the_plain_formula(by_library):
    """The simulation surface is the mean square of (1.2), computed by scipy and numpy."""
    y, ours = by_library
    for theta, value in samples(ours["simulation"]):
        x, errors = surfaces.START, []
        for k in range(1, 21):
            x = propagator(theta) @ x
            errors.append(np.sum((y[k] - x) ** 2))
        assert value == pytest.approx(np.mean(errors), rel=1e-10)  # 20 steps of two matrix exponentials


def test_propagator_surface_is_the_plain_formula(by_library):
    """The propagator surface is the mean square of (1.3)."""
    y, ours = by_library
    for theta, value in samples(ours["propagator"]):
        plain = np.mean(np.sum((y[1:] - y[:-1] @ propagator(theta).T) ** 2, axis=1))
        assert value == pytest.approx(plain, rel=1e-10)


@pytest.mark.parametrize("Sigma", [1e-5, 1e-2])
def test_likelihood_surface_is_the_kalman_filter(by_library, Sigma):
    """The likelihood surface is minus the log density of a textbook Kalman filter."""
    y, ours = by_library
    for theta, value in samples(ours[f"likelihood_{Sigma:g}"]):
        plain, _, _ = kalman_log_likelihood(
            propagator(theta), np.eye(2), Sigma * np.eye(2), 0.01 * np.eye(2), surfaces.START, np.zeros((2, 2)), y
        )
        assert value == pytest.approx(-plain, rel=1e-9, abs=1e-9)  # nats of up to 1e3 that may cancel


def test_counts_are_the_specifications(by_library):
    """At n = 20 the first realisation of seed 0 has the numbers of specification 5.2: 14, 1, 6, 2, 1, 1, range 115."""
    found = {name: surfaces.figures_of(values) for name, values in by_library[1].items()}
    assert [each["minima"] for each in found.values()] == [14, 1, 6, 2, 1, 1]
    assert round(found["likelihood_0.001"]["range"]) == 115


def test_global_minimum_is_located():
    """The lowest point of a surface, the error of its worse parameter, and the range are those of a known bowl."""
    at = surfaces.rectangle()
    values = (at[..., 0] - 1.2) ** 2 + (at[..., 1] + 9.0) ** 2
    found = surfaces.figures_of(values)
    assert found["minima"] == 1 and np.allclose(found["global_minimum"], [1.2, -9.0])
    assert found["global_minimum_error"] == pytest.approx(0.2)
    assert found["range"] == pytest.approx(values.max() - values.min())


def test_second_grid_runs_along_the_valleys():
    """A row of the second grid has one frequency, and a column one ratio of amplitudes."""
    at = surfaces.along_valleys()
    assert np.allclose(np.sqrt(-at[..., 0] * at[..., 1]), surfaces.FREQUENCY[:, None])
    assert np.allclose(np.sqrt(-at[..., 1] / at[..., 0]), surfaces.RATIO[None, :])
