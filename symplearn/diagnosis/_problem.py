"""What is asked: recordings, the augmented simulation, what is calibrated and its priors.

The unknowns of one combination of effects are one vector z = [x_0 of every recording, calibrated values, slots].
A slot holds the coefficient of one effect of the combination; which effect is data, so that nothing is compiled anew.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

import integrators as ig

from .._augmented import Equations
from .._rows import Rows

SLOTS = 3  # effects in the largest combination

Combination = tuple[int, ...]  # places in `Equations.candidates`, in increasing order


@dataclass(frozen=True)
class Calibrated:
    """The values that are calibrated with every combination: parameters first, then coefficients of known terms.

    `place` (f,) is where each stands in the parameter or coefficient vector; `parameters` is how many are parameters.
    """

    names: tuple[str, ...]
    place: Int[np.ndarray, " f"]
    parameters: int
    mean: Float[np.ndarray, " f"]
    sd: Float[np.ndarray, " f"]  # inf where the prior is flat
    lower: Float[np.ndarray, " f"]
    upper: Float[np.ndarray, " f"]
    recordings: Float[np.ndarray, "recording f"]  # 1 where it acts, 0 where a term is not in the recording

    @property
    def size(self) -> int:
        return len(self.names)


@dataclass(frozen=True)
class InitialPrior:
    """Prior of the phase point at the first row: sd 0 where it is known, inf where nothing is."""

    mean: Float[np.ndarray, " state"]
    sd: Float[np.ndarray, " state"]


@dataclass(frozen=True, eq=False)
class Problem:
    """A simulation and its recordings, ready to be fitted with any combination of effects."""

    equations: Equations
    integrator: ig.AbstractIntegrator
    rows: tuple[Rows, ...]
    parameters: Float[np.ndarray, " parameter"]  # known ones, and starting values of the calibrated
    terms: Float[np.ndarray, "recording candidate"]  # coefficients already in the simulation
    calibrated: Calibrated
    initial: InitialPrior
    noise: Float[np.ndarray, " channel"]  # sd of one original reading, nan where it is estimated
    searched: tuple[int, ...]  # candidates that may be reported
    units: dict[str, str]

    @property
    def state(self) -> int:
        """Dimension of the phase space."""
        return 2 * self.equations.dim

    @property
    def channels(self) -> int:
        return len(self.equations.columns)

    @property
    def head(self) -> int:
        """Where the calibrated values start in z."""
        return self.state * len(self.rows)

    @property
    def size(self) -> int:
        """Length of z."""
        return self.head + self.calibrated.size + SLOTS

    def local(self, recording: int) -> Int[np.ndarray, " local"]:
        """Which entries of z one recording depends on."""
        own = np.arange(recording * self.state, (recording + 1) * self.state)
        return np.concatenate([own, np.arange(self.head, self.size)])

    def onehot(self, combination: Sequence[int]) -> Float[np.ndarray, "slot candidate"]:
        """Which coefficient each slot is."""
        matrix = np.zeros((SLOTS, len(self.equations.candidates)))
        for slot, candidate in enumerate(combination):
            matrix[slot, candidate] = 1.0
        return matrix

    def active(self, combination: Sequence[int]) -> Bool[np.ndarray, " z"]:
        """Which entries of z are free under a combination."""
        free = np.ones(self.size, bool)
        free[: self.head] = np.tile(self.initial.sd > 0, len(self.rows))
        free[self.head + self.calibrated.size + len(combination) :] = False
        return free

    def coefficients(self, recording: int, z: Float[np.ndarray, " z"], combination: Sequence[int]) -> np.ndarray:
        """The coefficient vector that one recording is stepped with."""
        c = self.calibrated
        values = self.terms[recording].copy()
        for j in range(c.parameters, c.size):
            values[c.place[j]] += c.recordings[recording, j] * z[self.head + j]
        for slot, candidate in enumerate(combination):
            values[candidate] += z[self.head + c.size + slot]
        return values

    def parameter_values(self, z: Float[np.ndarray, " z"]) -> Float[np.ndarray, " parameter"]:
        """The parameter vector with its calibrated entries filled in."""
        c, values = self.calibrated, self.parameters.copy()
        values[c.place[: c.parameters]] = z[self.head : self.head + c.parameters]
        return values

    def lower_bounds(self, combination: Sequence[int]) -> dict[int, float]:
        """Entries of z that are physical above a bound only: a drag adds up to at least nothing with its known term."""
        first = self.head + self.calibrated.size
        signed = [(s, c) for s, c in enumerate(combination) if self.equations.candidates[c].effect.positive]
        return {first + slot: -float(self.terms[:, c].min()) for slot, c in signed}
