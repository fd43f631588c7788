"""Textbook oracles in numpy, and small models, shared by the tests of filter, smoother, fit and forecast."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from symplearn._model import Gaussian, LinearObservation, StateSpaceModel
from symplearn._noise import AdditiveGaussian, Dense


class Linear(eqx.Module):
    """x' = A x."""

    A: Any

    def __call__(self, x, interval):
        return self.A @ x


def linear_system(Q=None, P0=None):
    """A stable three-state, two-channel system as plain matrices."""
    rng = np.random.default_rng(1)
    A = rng.normal(size=(3, 3))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    H = rng.normal(size=(2, 3))
    Q = np.array([[0.3, 0.1, 0.0], [0.1, 0.2, 0.0], [0.0, 0.0, 0.4]]) if Q is None else Q
    R = np.array([[0.2, 0.05], [0.05, 0.1]])
    m0 = np.array([1.0, -0.5, 0.3])
    P0 = np.diag([1.0, 0.5, 0.8]) if P0 is None else P0
    return A, H, Q, R, m0, P0


def as_model(A, H, Q, R, m0, P0):
    """The same system as a state-space model."""
    noises = AdditiveGaussian(Dense(Q)), AdditiveGaussian(Dense(R))
    initial = Gaussian(jnp.asarray(m0), jnp.asarray(P0))
    return StateSpaceModel(Linear(jnp.asarray(A)), LinearObservation(jnp.asarray(H)), *noises, initial)


def simulate(A, H, Q, R, m0, P0, n, rng):
    """States, readings and the noises that made them."""
    x = rng.multivariate_normal(m0, P0, method="eigh")
    xi = rng.multivariate_normal(np.zeros(len(m0)), Q, size=n - 1, method="eigh")
    eta = rng.multivariate_normal(np.zeros(len(R)), R, size=n, method="eigh")
    xs = [x]
    for k in range(n - 1):
        xs.append(A @ xs[-1] + xi[k])
    xs = np.array(xs)
    return xs, xs @ H.T + eta, xi, eta


def kalman_log_likelihood(A, H, Q, R, m, P, ys):
    """The textbook Kalman filter, measurement first; a row is cut down to the channels that were read."""
    total = 0.0
    for k, y in enumerate(ys):
        if k > 0:
            m, P = A @ m, A @ P @ A.T + Q
        seen = ~np.isnan(y)
        if seen.any():
            h, r = H[seen], y[seen] - H[seen] @ m
            S = h @ P @ h.T + R[np.ix_(seen, seen)]
            K = P @ h.T @ np.linalg.inv(S)
            total -= 0.5 * (r @ np.linalg.solve(S, r) + np.linalg.slogdet(2 * np.pi * S)[1])
            m, P = m + K @ r, P - K @ S @ K.T
    return total, m, P


def unscented_log_likelihood(f, h, Q, R, m, P, ys, alpha, beta=2.0, kappa=0.0):
    """The textbook unscented filter with explicit weights (Wan and van der Merwe 2000), measurement first."""
    d = len(m)
    lam = alpha**2 * (d + kappa) - d
    wm = np.full(2 * d + 1, 0.5 / (d + lam))
    wc = wm.copy()
    wm[0], wc[0] = lam / (d + lam), lam / (d + lam) + 1 - alpha**2 + beta

    def transform(g, m, P):
        L = np.linalg.cholesky((d + lam) * P)
        X = np.vstack([m, m + L.T, m - L.T])
        Y = np.array([g(x) for x in X])
        mean = wm @ Y
        return mean, (Y - mean).T @ np.diag(wc) @ (Y - mean), (X - m).T @ np.diag(wc) @ (Y - mean)

    total = 0.0
    for k, y in enumerate(ys):
        if k > 0:
            m, P, _ = transform(f, m, P)
            P = P + Q
        mu, S, U = transform(h, m, P)
        S = S + R
        r, K = y - mu, U @ np.linalg.inv(S)
        total -= 0.5 * (r @ np.linalg.solve(S, r) + np.linalg.slogdet(2 * np.pi * S)[1])
        m, P = m + K @ r, P - K @ S @ K.T
    return total


class Conditioned:
    """Every state and noise of a linear model given all readings, from the one joint Gaussian."""

    def __init__(self, A, H, Q, R, m0, P0, ys):
        n, d = len(ys), len(m0)
        powers = [np.linalg.matrix_power(A, k) for k in range(n)]
        zero = np.zeros((d, d))
        F = np.block([[powers[k - j] if j <= k else zero for j in range(n)] for k in range(n)])
        W = np.kron(np.eye(n), Q)
        W[:d, :d] = P0
        seen = ~np.isnan(ys.ravel())
        G = np.kron(np.eye(n), H)[seen]
        noise = np.kron(np.eye(n), R)
        S = G @ F @ W @ F.T @ G.T + noise[np.ix_(seen, seen)]
        mean = np.concatenate([A_k @ m0 for A_k in powers])
        r = np.linalg.solve(S, ys.ravel()[seen] - G @ mean)
        C = F @ W @ F.T @ G.T
        self.means = (mean + C @ r).reshape(n, d)
        self.covariances = _blocks(F @ W @ F.T - C @ np.linalg.solve(S, C.T), n, d)
        B = W @ F.T @ G.T
        self.disturbances = (B @ r).reshape(n, d)[1:]
        self.disturbance_covariances = _blocks(W - B @ np.linalg.solve(S, B.T), n, d)[1:]
        spread = np.diagonal(B @ np.linalg.solve(S, B.T)).reshape(n, d)[1:]
        self.standardised_disturbances = self.disturbances / np.sqrt(np.where(spread > 0, spread, 1))
        # How the score moves with a shift of each state equation: the limit of vanishing process noise.
        score, information = F.T @ G.T @ r, F.T @ G.T @ np.linalg.solve(S, G @ F)
        self.scores = (score / np.sqrt(np.diagonal(information))).reshape(n, d)[1:]
        E = noise[:, seen]
        self.residuals = (E @ r).reshape(n, -1)
        spread = np.diagonal(E @ np.linalg.solve(S, E.T)).reshape(n, -1)
        self.standardised_residuals = self.residuals / np.sqrt(np.where(spread > 0, spread, 1))


def _blocks(matrix, n, d):
    return np.array([matrix[k * d : (k + 1) * d, k * d : (k + 1) * d] for k in range(n)])
