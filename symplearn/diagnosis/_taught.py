"""What a recording's held-out rows say besides: the phase point at its last row, known from all of them.

Where no force is missing the phase point at the end follows from the start and the parameters, so that rows that were
held out tell of it only together with these: a start alone cannot make up for a frequency that is slightly wrong. So
all are updated together, by Gauss-Newton with the fit's posterior as the prior. And a run goes on with what belongs to
its end: an orbit that was followed under one attraction and goes on under another is another orbit. What is told of the
answer stays as it was fitted.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from .._triangular import semidefinite_cholesky
from ._bend import bent
from ._lasting import colour_ratio, total_noise
from ._reach import covariance_within_reach
from ._stochastic import row_roots
from ._trajectory import Stepper
from ._weighed import Estimate

# Held-out readings have tails of Student's t of so many degrees of freedom: some may be outliers.
_FREEDOM = 5.0
# Steps, and how often one is halved.
_STEPS = 8
# Steps end where they move the unknowns by less than this many standard deviations.
_SETTLED = 1e-3


def root_of(stepper: Stepper, e: Estimate, inflation: float) -> Float[np.ndarray, "local local"]:
    """Root of the posterior covariance of all that the first recording depends on, as far as it is Gaussian."""
    return np.asarray(semidefinite_cholesky(jnp.asarray(covariance_within_reach(stepper, e, 0, inflation))))


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of all readings of the first recording by their noise, and their slopes in what it depends on."""

    scale: Float[np.ndarray, "time channel"]  # one over the noise; 0 where nothing was read
    left: Float[np.ndarray, "time channel"]
    slopes: Float[np.ndarray, "local time channel"]

    @classmethod
    def of(cls, stepper: Stepper, e: Estimate, own: Float[np.ndarray, " local"]) -> "Errors":
        problem, rows = stepper.problem, stepper.problem.rows[0]
        z, length = e.z.copy(), len(rows.times)
        z[problem.local(0)] = own
        found = stepper.predict(z[None], [e.combination], [length] + [1] * (len(problem.rows) - 1))[0]
        scale = np.where(np.isnan(rows.readings), 0.0, row_roots(problem, 0, length, colour_ratio(e)) / total_noise(e))
        expected = bent(found.readings[0], rows.times, e.bends)
        return cls(scale, (np.nan_to_num(rows.readings) - expected) * scale, -found.slopes[0] * scale)

    def among(self, some: Bool[np.ndarray, "time channel"]) -> tuple[np.ndarray, np.ndarray]:
        """Errors of some readings, and their slopes."""
        return self.left[some], self.slopes[:, some]


@dataclass(frozen=True, eq=False)
class Taught:
    """Mean and root of the covariance of the same, given the held-out rows as well, and what errs there."""

    mean: Float[np.ndarray, " local"]
    root: Float[np.ndarray, "local local"]
    errors: Errors

    def log_weights(
        self,
        units: Float[np.ndarray, "draw local"],
        readings: Float[np.ndarray, "draw time channel"],
        given: np.ndarray,
    ) -> Float[np.ndarray, " draw"]:
        """Log density of draws against that of the Gaussian they are from, by their own `readings` of `given`."""
        scale = self.errors.scale
        left = (np.nan_to_num(given) - readings) * scale
        linear = self.errors.left + np.einsum("dl,ltc->dtc", units @ self.root.T, self.errors.slopes)
        with np.errstate(over="ignore", invalid="ignore"):
            logs = -0.5 * (_lost(left) - _lost(linear))
        return np.where(np.isfinite(logs), logs, -np.inf)


def _lost(errors: Float[np.ndarray, "draw time channel"]) -> Float[np.ndarray, " draw"]:
    """Minus twice the log likelihood of errors with the tails of Student's t, of which small ones are Gaussian's."""
    far = 1 + (_FREEDOM + 1) * np.log((_FREEDOM + errors**2) / (_FREEDOM + 1))
    return np.where(np.abs(errors) < 1, errors**2, far).sum((1, 2))


def taught(stepper: Stepper, e: Estimate, root: Float[np.ndarray, "local local"]) -> Taught:
    """What all rows of the first recording say, the fit's posterior of covariance root root' being given."""
    rows, begin, unit = stepper.problem.rows[0], e.z[stepper.problem.local(0)], np.zeros(len(root))
    found = Errors.of(stepper, e, begin)
    new = (found.scale > 0) & (np.arange(len(rows.times)) >= rows.fitted)[:, None]
    for _ in range(_STEPS):
        left, slopes = found.among(new)
        trust = np.minimum(1.0, (_FREEDOM + 1) / (_FREEDOM + left**2))
        along, cost = slopes.T @ root, float(trust @ left**2 + unit @ unit)
        precision = np.eye(len(unit)) + along.T @ (trust[:, None] * along)
        step = -np.linalg.solve(precision, along.T @ (trust * left) + unit)
        for share in 0.5 ** np.arange(_STEPS):
            moved = unit + share * step
            tried = Errors.of(stepper, e, begin + root @ moved)
            if float(trust @ tried.among(new)[0] ** 2 + moved @ moved) <= cost:
                break
        else:
            break
        unit, found = moved, tried
        if np.abs(share * step).max() < _SETTLED:
            break
    return Taught(begin + root @ unit, root @ np.linalg.cholesky(np.linalg.inv(precision)), found)
