"""What is expected of held-out rows: their errors about a free run, and how far the unknowns leave that open."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ._problem import Problem
from ._weighed import Estimate

# A pivot of this part of its variance is round-off.
_SPENT = 1e-14


def _lower_root(covariance: np.ndarray) -> np.ndarray:
    """The lower triangular L with L L' = covariance; a column of zeros where nothing is left of a variance."""
    rest, out = covariance.copy(), np.zeros_like(covariance)
    for k, variance in enumerate(np.diag(covariance)):
        if rest[k, k] > _SPENT * variance:
            out[k:, k] = rest[k:, k] / np.sqrt(rest[k, k])
            rest -= np.outer(out[:, k], out[:, k])
    return out


def one_off(
    problem: Problem, e: Estimate, recording: int, inflation: float, start: Float[np.ndarray, "local local"] | None
) -> list[Float[np.ndarray, " z"]]:
    """The unknowns with one after the other of those that are no phase point off by its standard deviation; then, with
    the covariance `start` of everything local, those of the phase point that are left when the others are known."""
    local, state, c = problem.local(recording), problem.state, problem.calibrated
    order = np.r_[state : len(local), :state]
    columns = _lower_root(e.covariance[np.ix_(local[order], local[order])] * inflation)[:, : len(local) - state]
    if start is not None:
        left = _lower_root(start[np.ix_(order, order)] * inflation)[:, len(local) - state :]
        columns = np.concatenate([columns, left], axis=1)
    out, lowest = [], problem.lower_bounds(e.combination)
    for column in columns.T[columns.any(0)]:
        z = e.z.copy()
        z[local[order]] += column
        z[problem.head : problem.slots] = np.clip(z[problem.head : problem.slots], c.lower, c.upper)
        for entry, low in lowest.items():
            z[entry] = max(z[entry], low)
        out.append(z)
    return out


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Readings of held-out rows less the free run, NaN where nothing was read, and the variances expected of them."""

    errors: Float[np.ndarray, "held channel"]
    variances: Float[np.ndarray, "held channel"]

    @property
    def log_density(self) -> float:
        """Sum of the log densities of all readings."""
        terms = -0.5 * (np.log(2 * np.pi * self.variances) + self.errors**2 / self.variances)
        return float(terms[~np.isnan(self.errors)].sum())

    @property
    def squares(self) -> Float[np.ndarray, "held channel"]:
        """Squared errors by what is expected of them."""
        return self.errors**2 / self.variances
