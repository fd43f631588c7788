"""Dynamic modes are PyDMD's, and sparse regressions PySINDy's, on the same readings."""

import estimation_cases as cases
import jax.numpy as jnp
import numpy as np
import pydmd
import pysindy
import pytest
from scipy.integrate import solve_ivp
from sklearn import linear_model

from symplearn._dynamic_modes import dmd, total_dmd
from symplearn._objectives import TimeSeries
from symplearn._reading_slopes import CentralDifference
from symplearn._sparse_regression import PolynomialLibrary, sindy
from symplearn._sparsity import Lasso, SequentialThresholding

# Round-off of well-conditioned least squares: 1e-16 times a condition number below 1e4, and two digits of room.
# Two packages that solve the same problem agree to it; every comparison below that names TOLERANCE is of this kind.
TOLERANCE = 1e-10


def linear_recording(n=60, seed=0):
    """Three channels of a noisy linear motion, all read with errors."""
    A, _, Q, _, m0, P0 = cases.linear_system()
    return cases.simulate(A, np.eye(3), Q, 0.04 * np.eye(3), m0, P0, n, np.random.default_rng(seed))[1]


def series(readings, inputs=None, times=None):
    times = np.arange(float(len(readings))) if times is None else times
    return TimeSeries(jnp.asarray(times), jnp.asarray(readings), None if inputs is None else jnp.asarray(inputs))


def whole_map(modes):
    """PyDMD keeps the map on the leading singular directions; this is the matrix itself."""
    return (modes.modes * modes.eigs @ np.linalg.pinv(modes.modes)).real


@pytest.mark.parametrize("exact", [True, False])
def test_the_dynamic_modes_are_pydmds(exact):
    """A of full rank equals PyDMD's, with exact and with projected modes."""
    readings = linear_recording()
    other = pydmd.DMD(svd_rank=-1, exact=exact).fit(readings.T)
    found = np.asarray(dmd(series(readings)).A)
    np.testing.assert_allclose(found, whole_map(other), atol=TOLERANCE)


def test_truncated_dynamic_modes_are_pydmds():
    """A of rank 2 has PyDMD's two exact modes for eigenvectors, with PyDMD's eigenvalues, and no others."""
    readings = linear_recording()
    other = pydmd.DMD(svd_rank=2, exact=True).fit(readings.T)
    found = np.asarray(dmd(series(readings), rank=2).A)
    np.testing.assert_allclose(found @ other.modes, other.modes * other.eigs, atol=TOLERANCE)
    assert np.linalg.matrix_rank(found, tol=1e-8) == 2


def test_total_dynamic_modes_are_pydmds():
    """A by total least squares equals PyDMD's with as many directions as channels, and differs from plain A."""
    readings = linear_recording()
    other = pydmd.DMD(svd_rank=-1, tlsq_rank=3).fit(readings.T)
    found = np.asarray(total_dmd(series(readings)).A)
    np.testing.assert_allclose(found, whole_map(other), atol=TOLERANCE)
    assert np.abs(found - np.asarray(dmd(series(readings)).A)).max() > 1e-3


def test_dynamic_modes_with_control_are_pydmds():
    """A and B of a driven motion equal those of PyDMD's DMD with control."""
    rng = np.random.default_rng(2)
    A, inputs, xs = cases.linear_system()[0], rng.normal(size=(60, 2)), [np.ones(3)]
    for u in inputs[:-1]:
        xs.append(A @ xs[-1] + np.array([[1.0, 0.5], [-0.4, 0.0], [0.2, 2.0]]) @ u)
    readings = np.array(xs) + 0.1 * rng.normal(size=(60, 3))
    other = pydmd.DMDc(svd_rank=-1).fit(readings.T, inputs[:-1].T)
    found = dmd(series(readings, inputs), control=True)
    np.testing.assert_allclose(found.A, whole_map(other), atol=TOLERANCE)
    np.testing.assert_allclose(found.B, other.B, atol=TOLERANCE)


def oscillator_recording():
    """Van der Pol's oscillator at uneven times, read with small errors."""
    rng = np.random.default_rng(1)
    times = np.cumsum(rng.uniform(0.01, 0.03, size=400))

    def slope(_, x):
        return [x[1], (1 - x[0] ** 2) * x[1] - x[0]]

    # SciPy's own error bounds, seven digits below the noise added here.
    xs = solve_ivp(slope, times[[0, -1]], [2.0, 0.0], t_eval=times, method="DOP853", rtol=1e-10, atol=1e-10).y.T
    return times, xs + 1e-3 * rng.normal(size=xs.shape)


def pysindy_coefficients(optimizer, times, readings, slopes=None):
    """Coefficients (term, state) of PySINDy's whole chain, and the names of its terms."""
    other = pysindy.SINDy(
        optimizer=optimizer,
        feature_library=pysindy.PolynomialLibrary(degree=3),
        differentiation_method=pysindy.FiniteDifference(order=2),
    )
    other.fit(readings, t=times, x_dot=slopes)
    return other.coefficients().T, other.get_feature_names()


@pytest.mark.parametrize("ridge", [0.0, 0.05])
def test_sequential_thresholding_is_pysindys(ridge):
    """Central differences, terms and coefficients, kept and dropped, equal PySINDy's STLSQ at the same ridge."""
    times, readings = oscillator_recording()
    optimizer = pysindy.STLSQ(threshold=0.1, alpha=ridge, unbias=False)
    expected, names = pysindy_coefficients(optimizer, times, readings)
    penalty = SequentialThresholding(0.1, ridge)
    found = sindy(series(readings, times=times), PolynomialLibrary(2, 3), penalty, CentralDifference())
    assert list(found.terms) == names
    assert np.array_equal(np.asarray(found.coefficients) == 0, expected == 0)
    assert 2 < np.count_nonzero(expected) < expected.size
    np.testing.assert_allclose(found.coefficients, expected, atol=TOLERANCE)


@pytest.mark.parametrize("weight", [1.0, 100.0])
def test_the_lasso_is_pysindys(weight):
    """With forward differences the L1 coefficients equal those of scikit-learn's descent, which PySINDy wraps."""
    times, readings = oscillator_recording()
    points, slopes = readings[:-1], np.diff(readings, axis=0) / np.diff(times)[:, None]
    # scikit-learn divides the sum of squares by 2 n; ours is a plain sum.
    descent = linear_model.Lasso(0.5 * weight / len(points), fit_intercept=False, tol=1e-14, max_iter=1_000_000)
    expected, names = pysindy_coefficients(pysindy.WrappedOptimizer(descent, unbias=False), times[:-1], points, slopes)
    found = sindy(series(readings, times=times), PolynomialLibrary(2, 3), Lasso(weight))
    assert found.converged and list(found.terms) == names
    assert 2 < np.count_nonzero(expected) < expected.size
    # scikit-learn stops at a duality gap of 1e-14 of the squared slopes: half the digits of the coefficients.
    np.testing.assert_allclose(found.coefficients, expected, atol=1e-6)
