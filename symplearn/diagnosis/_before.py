"""What is known of a combination's unknowns before anything is read, and Laplace's integral beside it."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from ._calibrate import Priors
from ._evidence import Laplace, laplace
from ._problem import Combination, Problem


@dataclass(frozen=True, eq=False)
class Before:
    """What is known of the unknowns of a combination before anything is read."""

    problem: Problem
    priors: Priors
    mean: Float[np.ndarray, " z"]
    precision: Float[np.ndarray, " z"]
    active: Bool[np.ndarray, " z"]
    lower: dict[int, float]
    bounds: tuple[Float[np.ndarray, " z"], Float[np.ndarray, " z"]]

    @classmethod
    def of(cls, problem: Problem, combination: Combination, priors: Priors) -> "Before":
        """By the priors, and the bounds of what is physical."""
        mean, precision = priors.mean_of(problem, combination), priors.precision_of(problem, combination)
        active, lower = problem.active(combination), problem.lower_bounds(combination)
        return cls(problem, priors, mean, precision, active, lower, priors.bounds_of(problem, combination))

    def integrate(self, gram: Float[np.ndarray, "column column"], offset: float, z: Float[np.ndarray, " z"]) -> Laplace:
        """Laplace's integral; of nothing where a trajectory ran away."""
        if not np.isfinite(gram).all():
            return Laplace(-np.inf, np.zeros(len(z)), np.zeros((len(z), len(z))), 0.0)
        one = laplace(gram, offset, z, self.mean, self.precision, self.active, self.lower, self.bounds)
        return replace(one, log_evidence=one.log_evidence + self.priors.log_size(self.problem, z))
