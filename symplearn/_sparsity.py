"""What keeps the coefficients of a regression few: the lasso, and sequential thresholding."""

import abc

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ._counts import refuse_count
from ._errors import InputError

_OPTIMAL = 1e-10  # what the lasso's optimality conditions may miss, as a share of the largest possible slope

Solution = tuple[Float[np.ndarray, " term"], bool, int]


class AbstractPenalty(eqx.Module):
    """How coefficients are kept few."""

    @abc.abstractmethod
    def __call__(self, features: Float[np.ndarray, "row term"], slopes: Float[np.ndarray, " row"]) -> Solution:
        """The coefficients of one state's equation, whether they are final, and the steps taken."""


class Lasso(AbstractPenalty):
    """The L1 penalty: the theta that minimises, exactly as (4.3),

    sum_k ||(y_k - y_{k-1})/dt - Xi(y_{k-1}) theta||^2 + weight |theta|_1

    (with another derivative, its points and slopes). By Theorem 4, corrected, a Laplace prior of density
    exp(-rate |theta|) on a model with unit process noise is weight = 2 rate / dt^2.

    Sweeps of coordinate descent, each followed by the exact minimum on the signs it found, end where the optimality
    conditions hold to 1e-10 of the largest possible slope. Coordinate descent alone crawls if features are alike.
    A weight near 0 on features that are almost dependent may end unconverged. **Arguments:** `weight` - at least 0;
    `max_sweeps`.
    """

    weight: float = eqx.field(static=True, converter=float)
    max_sweeps: int = eqx.field(static=True, default=1000)

    def __check_init__(self):
        refuse_count("Lasso", "max_sweeps", self.max_sweeps)
        if not self.weight >= 0:
            raise InputError(f"`Lasso` needs a weight of at least 0, but was given {self.weight}.")

    def __call__(self, features: Float[np.ndarray, "row term"], slopes: Float[np.ndarray, " row"]) -> Solution:
        # Columns of length 1, the weight divided likewise: the same problem, better conditioned.
        lengths = _lengths(features)
        X, lam = features / lengths, self.weight / lengths
        G, c = X.T @ X, X.T @ slopes
        theta = np.zeros(len(c))
        for sweep in range(1, self.max_sweeps + 1):
            theta = _finish_signs(G, c, lam, _sweep(G, c, lam, theta))
            pull = 2 * X.T @ (slopes - X @ theta)
            missed = np.where(theta != 0, np.abs(pull - lam * np.sign(theta)), np.maximum(np.abs(pull) - lam, 0.0))
            if np.max(missed) <= _OPTIMAL * 2 * np.linalg.norm(slopes):
                return theta / lengths, True, sweep
        return theta / lengths, False, self.max_sweeps


def _lengths(features: np.ndarray) -> np.ndarray:
    """The columns' Euclidean lengths, 1 for a column of zeros."""
    lengths = np.linalg.norm(features, axis=0)
    return np.where(lengths > 0, lengths, 1.0)


def _sweep(G: np.ndarray, c: np.ndarray, lam: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Each coordinate in turn at its minimum: a soft threshold."""
    theta = theta.copy()
    for i in np.flatnonzero(np.diagonal(G)):
        rest = c[i] - G[i] @ theta + G[i, i] * theta[i]
        theta[i] = np.sign(rest) * max(abs(rest) - 0.5 * lam[i], 0.0) / G[i, i]
    return theta


def _finish_signs(G: np.ndarray, c: np.ndarray, lam: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Straight towards the minimum for the present signs; a coefficient that reaches zero on the way leaves."""
    theta = theta.copy()
    while (kept := np.flatnonzero(theta)).size:
        here, block = theta[kept], G[np.ix_(kept, kept)]
        slope = c[kept] - 0.5 * lam[kept] * np.sign(here) - block @ here
        step = np.linalg.lstsq(block, slope, rcond=1e-12)[0]
        # Features that depend on each other: what they cannot fit only shortens theta, until a sign changes.
        rest = slope - block @ step
        if np.max(np.abs(rest)) > max(1e-6 * np.min(lam[kept]), 1e-13 * np.linalg.norm(c)):
            step = rest
        reach = np.divide(-here, step, where=here * step < 0, out=np.full_like(here, np.inf))
        first, bend = int(np.argmin(reach)), step @ block @ step
        stretch = min(reach[first], step @ slope / bend if bend > 0 else np.inf)
        if not (np.isfinite(stretch) and stretch > 0):
            break  # round-off alone
        theta[kept] = here + stretch * step
        if stretch < reach[first]:
            break
        theta[kept[first]] = 0.0
    return theta


class SequentialThresholding(AbstractPenalty):
    """Least squares again and again without the coefficients below a threshold. Brunton, Proctor and Kutz (2016).

    Each fit minimises ||x' - Xi theta||^2 + ridge |theta|^2 on the terms left, the last one included.

    **Arguments:** `threshold` - in the units of the coefficients, at least 0; `ridge` - at least 0; `max_steps`.

    **Raises:** `InputError` where the data do not determine the coefficients and `ridge` is 0.
    """

    threshold: float = eqx.field(static=True, converter=float)
    ridge: float = eqx.field(static=True, converter=float, default=0.0)
    max_steps: int = eqx.field(static=True, default=20)

    def __check_init__(self):
        refuse_count("SequentialThresholding", "max_steps", self.max_steps)
        if not (self.threshold >= 0 and self.ridge >= 0):
            given = f"{self.threshold} and {self.ridge}"
            raise InputError(f"`SequentialThresholding` needs a threshold and a ridge of at least 0, but got {given}.")

    def __call__(self, features: Float[np.ndarray, "row term"], slopes: Float[np.ndarray, " row"]) -> Solution:
        terms = features.shape[1]
        rank = np.linalg.matrix_rank(features / _lengths(features))
        if self.ridge == 0 and rank < terms:
            raise InputError(
                f"The library has {terms} terms, but the data tell only {rank} of them apart; give more readings, "
                "fewer terms, or a `ridge` above 0."
            )
        kept = np.ones(terms, dtype=bool)
        theta = self._fit(features, slopes, kept)
        for step in range(1, self.max_steps + 1):
            still = kept & (np.abs(theta) >= self.threshold)
            if np.array_equal(still, kept):
                return theta, True, step
            kept, theta = still, self._fit(features, slopes, still)
        return theta, False, self.max_steps

    def _fit(self, features: np.ndarray, slopes: np.ndarray, kept: np.ndarray) -> np.ndarray:
        # Dividing by the columns' lengths does not move the minimum.
        X, theta = features[:, kept], np.zeros(features.shape[1])
        lengths = _lengths(X)
        stacked = np.vstack([X, np.sqrt(self.ridge) * np.eye(X.shape[1])]) / lengths
        theta[kept] = np.linalg.lstsq(stacked, np.append(slopes, np.zeros(X.shape[1])), rcond=None)[0] / lengths
        return theta
