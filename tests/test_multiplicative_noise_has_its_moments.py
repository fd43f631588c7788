"""Noise that multiplies has the moments (2.10)-(2.12) for any distribution, and the filter uses them."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from symplearn._distributions import Gamma, MultivariateNormal, Uniform
from symplearn._errors import InputError
from symplearn._filter import unscented_filter
from symplearn._model import Gaussian, StateSpaceModel, intervals_between
from symplearn._noise import Additive, AdditiveGaussian, Dense, Diagonal, Multiplicative, ScaledIdentity
from symplearn._transforms import Moments

COUNT, N = 1_000_000, 12
SPANS = intervals_between(jnp.arange(float(N)))
HISTORY = eqx.filter_jit(unscented_filter)
R = np.array([[0.09, 0.03], [0.03, 0.04]])
SIGMA = np.array([[0.3, 0.1], [0.1, 0.2]])


def gamma_draws(rng):
    return rng.gamma([4.0, 25.0], [0.3, 0.04], size=(COUNT, 2))


def correlated_draws(rng):
    return [1.2, 0.8] + rng.normal(size=(COUNT, 2)) @ np.linalg.cholesky(R).T


def uniform_draws(rng):
    return rng.uniform([0.7, 0.9], [1.3, 1.1], size=(COUNT, 2))


FACTORS = {
    "gamma": (Gamma([4.0, 25.0], [0.3, 0.04]), gamma_draws),
    "correlated": (MultivariateNormal([1.2, 0.8], Dense(R)), correlated_draws),
    "uniform": (Uniform([0.7, 0.9], [1.3, 1.1]), uniform_draws),
}


def gaussian_state(rng):
    """A Gaussian state x and f = A x, with the moments in closed form."""
    A, root = np.array([[0.8, -0.5], [0.4, 0.9]]), np.array([[1.0, 0.0], [0.4, 0.7]])
    mean = np.array([1.5, -0.7])
    x = mean + rng.normal(size=(COUNT, 2)) @ root.T
    return x, x @ A.T, Moments(jnp.asarray(A @ mean), jnp.asarray(A @ root), jnp.asarray(root))


def skewed_state(rng):
    """Gamma-distributed x and f = x, so that nothing is Gaussian."""
    x = rng.gamma([2.0, 5.0], [0.7, 0.2], size=(COUNT, 2))
    root = jnp.diag(jnp.sqrt(jnp.array([2 * 0.7**2, 5 * 0.2**2])))
    return x, x, Moments(jnp.array([1.4, 1.0]), root, root)


@pytest.mark.parametrize(
    ("name", "state"),
    [("gamma", skewed_state), ("gamma", gaussian_state), ("correlated", gaussian_state), ("uniform", skewed_state)],
)
def test_moments_are_those_of_a_million_draws(name, state):
    """Mean, covariance and cross-covariance of f .* w + xi equal NumPy's draws to 1e-2, whatever the distributions."""
    rng = np.random.default_rng(5)
    factor, draws = FACTORS[name]
    x, f, moments = state(rng)
    y = f * draws(rng) + rng.normal(size=(COUNT, 2)) @ np.linalg.cholesky(SIGMA).T
    found = Multiplicative(factor, AdditiveGaussian(Dense(SIGMA))).enter(moments)
    # Standard errors of second moments at 1e6 draws are below 4e-3 here.
    np.testing.assert_allclose(found.mean, y.mean(axis=0), atol=1e-2)
    np.testing.assert_allclose(found.covariance, np.cov(y.T), atol=1e-2)
    cross = (x - x.mean(axis=0)).T @ (y - y.mean(axis=0)) / COUNT
    np.testing.assert_allclose(found.source @ found.factor.T, cross, atol=1e-2)


def test_a_uniform_factor_has_mean_one_and_variance_a_third_of_its_square():
    """v ~ U[1 - a, 1 + a] has mean 1 and covariance (a^2 / 3) I."""
    factor = Uniform(0.9, 1.1, dim=2)
    np.testing.assert_allclose(factor.mean, np.ones(2), rtol=1e-15)
    np.testing.assert_allclose(factor.structure.matrix, 0.1**2 / 3 * np.eye(2), rtol=1e-13)


class Pendulum(eqx.Module):
    """Five leapfrog steps of 0.1 of the pendulum with gravity g."""

    gravity: Any

    def __call__(self, x, interval):
        def leap(_, x):
            p = x[1] - 0.05 * self.gravity * jnp.sin(x[0])
            q = x[0] + 0.1 * p
            return jnp.stack([q, p - 0.05 * self.gravity * jnp.sin(q)])

        return jax.lax.fori_loop(0, 5, leap, x)


class Projected(eqx.Module):
    """The bob's position, sin q and 2 + cos q."""

    def __call__(self, x, context=None):
        return jnp.stack([jnp.sin(x[0]), 2.0 + jnp.cos(x[0])])


def pendulum_step(x):
    q, p = x
    for _ in range(5):
        p = p - 0.05 * np.sin(q)
        q = q + 0.1 * p
        p = p - 0.05 * np.sin(q)
    return np.array([q, p])


def projected(x):
    return np.array([np.sin(x[0]), 2.0 + np.cos(x[0])])


Q = np.array([[0.004, 0.001], [0.001, 0.003]])
WBAR, VBAR = np.array([0.98, 1.03]), np.array([1.0, 0.95])
M0, P0, XI, ETA = np.array([1.2, 0.3]), 0.05 * np.eye(2), 0.01 * SIGMA, np.diag([0.01, 0.02])


def pendulum(process, measurement):
    return StateSpaceModel(
        Pendulum(jnp.asarray(1.0)), Projected(), process, measurement, Gaussian(jnp.asarray(M0), jnp.asarray(P0))
    )


def recorded(seed=6):
    rng = np.random.default_rng(seed)
    x, ys = np.array([1.3, 0.2]), []
    for _ in range(N):
        ys.append(projected(x) * rng.multivariate_normal(VBAR, 0.1 * R) + rng.multivariate_normal([0, 0], ETA))
        x = pendulum_step(x) * rng.multivariate_normal(WBAR, Q) + rng.multivariate_normal([0, 0], XI)
    return np.array(ys)


def unscented(g, m, P):
    """Moments by 2d + 1 points with alpha 1, beta 2, kappa 0: weights 0 and 2 at the centre, 1 / 2d elsewhere."""
    d = len(m)
    L = np.linalg.cholesky(d * P)
    X = np.vstack([m, m + L.T, m - L.T])
    wm = np.array([0.0] + 2 * d * [0.5 / d])
    wc = np.array([2.0] + 2 * d * [0.5 / d])
    Y = np.array([g(x) for x in X])
    mean = wm @ Y
    return mean, (Y - mean).T @ np.diag(wc) @ (Y - mean), (X - m).T @ np.diag(wc) @ (Y - mean)


def textbook(ys, Q, R):
    """Algorithm 2 with (2.10)-(2.12) as they are written."""
    m, P, total = M0, P0, 0.0
    for k, y in enumerate(ys):
        if k > 0:
            E, V, _ = unscented(pendulum_step, m, P)
            m = E * WBAR
            P = V * (Q + np.outer(WBAR, WBAR)) + np.outer(E, E) * Q + XI
        E, V, U = unscented(projected, m, P)
        mu = E * VBAR
        S = V * (R + np.outer(VBAR, VBAR)) + np.outer(E, E) * R + ETA
        U = U * VBAR
        r, K = y - mu, U @ np.linalg.inv(S)
        total -= 0.5 * (r @ np.linalg.solve(S, r) + np.linalg.slogdet(2 * np.pi * S)[1])
        m, P = m + K @ r, P - K @ U.T
    return total, m, P


@pytest.mark.parametrize("dense", [True, False])
def test_the_likelihood_is_the_textbook_filters(dense):
    """On a pendulum with both noises multiplied and added, score and moments are those of Algorithm 2 in NumPy."""
    process_part, reading_part = (Q, 0.1 * R) if dense else (np.diag(np.diag(Q)), np.diag(np.diag(0.1 * R)))
    wrap = Dense if dense else lambda matrix: Diagonal(np.diag(matrix))
    model = pendulum(
        Multiplicative(MultivariateNormal(WBAR, wrap(process_part)), AdditiveGaussian(Dense(XI))),
        Multiplicative(MultivariateNormal(VBAR, wrap(reading_part)), AdditiveGaussian(Dense(ETA))),
    )
    ys = recorded()
    expected, m, P = textbook(ys, process_part, reading_part)
    filtered = HISTORY(model, ys, SPANS)
    # Round-off of twelve steps in two orders of summation.
    assert float(filtered.log_likelihood) == pytest.approx(expected, abs=1e-10)
    np.testing.assert_allclose(filtered.filtered_means[-1], m, atol=1e-11)
    np.testing.assert_allclose(filtered.filtered_covariances[-1], P, atol=1e-11)


@pytest.mark.parametrize("structure", [ScaledIdentity(0.0, 2), Dense(np.zeros((2, 2)))])
def test_factors_of_one_that_do_not_vary_are_no_factors(structure):
    """With Q = 0, E[w] = 1, R = 0, E[v] = 1 the score and every moment are the additive filter's, to round-off."""
    one = MultivariateNormal(jnp.ones(2), structure)
    plain = AdditiveGaussian(Dense(XI)), AdditiveGaussian(Dense(ETA))
    ys = recorded()
    additive = HISTORY(pendulum(*plain), ys, SPANS)
    multiplied = HISTORY(pendulum(*(Multiplicative(one, noise) for noise in plain)), ys, SPANS)
    for ours, theirs in zip(jax.tree.leaves(multiplied), jax.tree.leaves(additive), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-13)


def test_added_noise_enters_by_its_own_mean_and_covariance():
    """Added uniform noise is Gaussian noise of its covariance, with its mean added to the reading."""
    lower, upper = np.array([-0.1, 0.0]), np.array([0.1, 0.4])
    process = AdditiveGaussian(Dense(XI))
    uniform = pendulum(process, Additive(Uniform(lower, upper)))
    gaussian = pendulum(process, AdditiveGaussian(Dense(np.diag((upper - lower) ** 2 / 12))))
    ys = recorded()
    found, expected = HISTORY(uniform, ys + 0.5 * (lower + upper), SPANS), HISTORY(gaussian, ys, SPANS)
    assert float(found.log_likelihood) == pytest.approx(float(expected.log_likelihood), abs=1e-10)


def test_a_factor_of_the_wrong_size_is_refused():
    """One entry for two channels would be stretched over both, and correlate them: it is named instead."""
    moments = Moments(jnp.ones(2), jnp.eye(2), jnp.eye(2))
    for noise in (Multiplicative(Uniform(0.9, 1.1)), Additive(Uniform(-0.1, 0.1))):
        with pytest.raises(InputError, match="needs a distribution of 2 entries here.*give it `dim=2`"):
            noise.enter(moments)
