"""A dense covariance of the noise is learnt from readings of a linear system, all its entries at once."""

import equinox as eqx
import estimation_cases as cases
import jax.numpy as jnp
import numpy as np
import pytest

from symplearn._fit import fit
from symplearn._model import FullState, Gaussian, LinearDynamics, StateSpaceModel
from symplearn._noise import AdditiveGaussian, Dense, ScaledIdentity
from symplearn._objectives import MARGINAL_LIKELIHOOD, TimeSeries
from symplearn._parameters import Frozen, PositiveDefinite
from symplearn._prior import Flat

A = np.array([[0.8, 0.3], [-0.4, 0.7]])
SIGMA = np.array([[0.5, -0.3], [-0.3, 0.4]])
N = 101
NAME = "process_noise.structure.covariance"


def model(r):
    """The linear system, read with a noise of variance r in each channel, before its process noise is known."""
    dynamics, start = LinearDynamics(Frozen(jnp.asarray(A))), Gaussian(jnp.zeros(2), jnp.eye(2))
    noises = AdditiveGaussian(Dense(PositiveDefinite(np.eye(2)))), AdditiveGaussian(ScaledIdentity(r, dim=2))
    return StateSpaceModel(dynamics, FullState(), *noises, start)


def recorded(r, seed):
    system = A, np.eye(2), SIGMA, r * np.eye(2), np.zeros(2), np.eye(2)
    ys = cases.simulate(*system, N, np.random.default_rng(seed))[1]
    return ys, TimeSeries(jnp.arange(float(N)), jnp.asarray(ys))


def learn(r, series):
    estimate = fit(model(r), series, prior=Flat())
    assert estimate.converged
    return np.asarray(estimate.values()[NAME])


def most_probable(sum_of_squares):
    """The matrix of n = 100 residuals that has the highest density in free coordinates under a flat prior.

    n log det L + |L^-1 C|^2 / 2 - sum k_i log L_ii, with C C' the sum of squares and k = (3, 2) the powers of the
    Jacobian, is least at L = C diag(n - k)^-1/2.
    """
    C = np.linalg.cholesky(sum_of_squares)
    return C @ np.diag(1 / (N - 1 - np.array([3.0, 2.0]))) @ C.T


@pytest.mark.slow
def test_of_exact_readings_the_map_is_the_residuals_covariance():
    """Where the state is read exactly, the MAP is the residuals' covariance, with the Jacobian's small correction."""
    ys, series = recorded(0.0, 0)
    residuals = ys[1:] - ys[:-1] @ A.T
    # The fit stops within 1e-5 nats of the best, with 100 nats of curvature: 4e-4 standard deviations.
    np.testing.assert_allclose(learn(0.0, series), most_probable(residuals.T @ residuals), rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_the_truth_lies_within_its_standard_errors():
    """Over 12 noisy recordings the estimates scatter about the true matrix as the Wishart distribution says."""
    found = np.array([learn(0.01, recorded(0.01, seed)[1]) for seed in range(1, 13)])
    assert np.linalg.eigvalsh(found).min() > 0
    truth = most_probable((N - 1) * SIGMA)
    # Var S_ij = (S_ii S_jj + S_ij^2) / n, for exact readings; reading noise of 2 % of the state's adds to each step.
    spread = np.sqrt((np.outer(np.diag(SIGMA), np.diag(SIGMA)) + SIGMA**2) / (N - 1))
    index = np.tril_indices(2)
    deviations = ((found - truth) / spread)[:, *index]
    # Means of 12: three standard errors of each; the sum of 36 squares is chi-square, roughly: 36 +- 4 sd of 8.5.
    assert np.abs(deviations.mean(axis=0)).max() < 3 / np.sqrt(12)
    assert 10.0 < np.sum(deviations**2) < 75.0
    # And the sign and size of the correlation were learnt, from a start that has none.
    assert found[:, 0, 1].max() < -0.1


def test_the_wrong_matrix_is_less_likely():
    """A diagonal noise of the same variances, which the structure would be without its covariance, scores worse."""
    given = model(0.01)

    @eqx.filter_jit
    def score(S, series):
        return MARGINAL_LIKELIHOOD(eqx.tree_at(lambda m: m.process_noise.structure, given, Dense(S)), series)

    ys, series = recorded(0.01, 20)
    for S in (SIGMA, np.diag(np.diag(SIGMA))):
        expected = cases.kalman_log_likelihood(A, np.eye(2), S, 0.01 * np.eye(2), np.zeros(2), np.eye(2), ys)[0]
        assert float(score(jnp.asarray(S), series)) == pytest.approx(-expected, rel=1e-12)
    assert score(jnp.asarray(SIGMA), series) < score(jnp.diag(jnp.diag(SIGMA)), series) - 10.0
