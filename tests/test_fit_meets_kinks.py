"""A fit under a Laplace prior ends at the kinks, where some coefficients are exactly zero."""

import jax.numpy as jnp
import numpy as np

from symplearn._fit import fit
from symplearn._model import FullState, LinearDynamics, StateSpaceModel
from symplearn._noise import AdditiveGaussian, ScaledIdentity
from symplearn._objectives import TimeSeries
from symplearn._prior import Laplace, Prior
from symplearn._trajectory_objectives import PropagatorLeastSquares

VARIANCE, SCALE = 0.04, 0.05


def autoregression(seed=0, n=60):
    """x' = A x + w, read without error; half of A is zero."""
    rng = np.random.default_rng(seed)
    A, xs = np.array([[0.8, 0.0, 0.0], [0.0, 0.5, -0.6], [0.0, 0.0, 0.7]]), [np.ones(3)]
    for _ in range(n):
        xs.append(A @ xs[-1] + np.sqrt(VARIANCE) * rng.normal(size=3))
    return np.array(xs)


def test_a_fit_is_the_lasso():
    """The coefficients satisfy the Karush-Kuhn-Tucker conditions of the lasso, and some of them are exactly zero."""
    xs = autoregression()
    noises = AdditiveGaussian(ScaledIdentity(VARIANCE, 3)), AdditiveGaussian(ScaledIdentity(1e-6, 3))
    model = StateSpaceModel(LinearDynamics(0.3 * jnp.ones((3, 3))), FullState(), *noises)
    prior = Prior({"dynamics": Laplace(SCALE)})
    estimate = fit(model, TimeSeries(np.arange(len(xs), dtype=float), xs), PropagatorLeastSquares(), prior=prior)
    A = np.asarray(estimate.model.dynamics.A)
    # The normal equations by NumPy: the slope of the squares is the subgradient of |A| / SCALE, sign for sign.
    slope = (xs[1:] - xs[:-1] @ A.T).T @ xs[:-1] / VARIANCE
    zero = A == 0
    assert estimate.converged and 2 <= zero.sum() <= 6
    assert np.all(np.abs(slope[zero]) <= 1 / SCALE)
    # The descent ends where 1e-5 nats are promised: a slope of 0.1 against a curvature of some thousand.
    np.testing.assert_allclose(slope[~zero], np.sign(A[~zero]) / SCALE, atol=0.2)
