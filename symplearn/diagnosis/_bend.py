"""An error of the sensor that goes with what it reads, as far as it is known."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.polynomial.legendre import legvander

# Polynomials up to this degree.
_DEGREE = 12


def polynomials(expected: Float[np.ndarray, "*row"], low: float, high: float) -> Float[np.ndarray, "*row degree"]:
    """Legendre's, orthonormal over a range; beyond, they stay as at its end."""
    place = np.clip(2 * (expected - low) / max(high - low, 1e-300) - 1, -1.0, 1.0)
    shapes: np.ndarray = legvander(np.nan_to_num(place), _DEGREE) * np.sqrt(2 * np.arange(_DEGREE + 1) + 1)
    return shapes


@dataclass(frozen=True, eq=False)
class Bend:
    """The error of one channel by what it reads from `low` to `high`: the mean of the polynomials' coefficients, and
    the rms over the rows of the sd that is left of it."""

    low: float
    high: float
    coefficients: Float[np.ndarray, " degree"]
    spread: float

    def __call__(self, expected: Float[np.ndarray, "*row"]) -> Float[np.ndarray, "*row"]:
        found: np.ndarray = polynomials(expected, self.low, self.high) @ self.coefficients
        return found


def bent(expected: Float[np.ndarray, "*row channel"], bends: Sequence[Bend]) -> Float[np.ndarray, "*row channel"]:
    """What is read where this is expected; the same where there are no bends."""
    return expected + sum(one(expected[..., j])[..., None] * (np.arange(expected.shape[-1]) == j)
                          for j, one in enumerate(bends))  # fmt: skip
