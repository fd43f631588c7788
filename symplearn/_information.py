"""Which numbers a recording can see: the spectrum of the observed information."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ._convergence import labels
from ._errors import InputError
from ._evidence import likelihood_hessian
from ._fit import Estimate
from ._parameters import named_parameters, value_of
from ._prior import AbstractDensity, Laplace, Normal

# A number is unseen where the recording leaves more than this share of its reference variance.
_UNSEEN = 0.5
# The largest entries of a direction that name it.
_NAMED = 0.3
# A decade: the reference width of a positive number, whose free coordinate is its logarithm.
_DECADE = float(np.log(10.0))


class Information(eqx.Module):
    """The observed information of a recording about the learnt numbers, in units of their reference widths.

    The reference width of a number is its prior's standard deviation under `Normal` and `Laplace`, a decade for a
    positive number, one unit of the free coordinate for what is bounded or a matrix, else its own size (1 where it is
    0). `eigenvalues` (direction,), largest first, are of the Hessian of minus the log likelihood at the estimate:
    above 1, the recording says more of that direction than the reference. `directions` (direction, number). `left`
    (number,) is the share of a number's reference variance that the recording leaves, 0 to 1.
    """

    labels: tuple[str, ...] = eqx.field(static=True)
    eigenvalues: Float[np.ndarray, " direction"]
    directions: Float[np.ndarray, "direction number"]
    left: Float[np.ndarray, " number"]

    @property
    def unseen(self) -> tuple[str, ...]:
        """The numbers of which the recording leaves more than half the reference variance."""
        return tuple(name for name, share in zip(self.labels, self.left, strict=True) if share > _UNSEEN)

    @property
    def condition_number(self) -> float:
        """Of the information; inf where it is singular."""
        least = self.eigenvalues[-1]
        return float(self.eigenvalues[0] / least) if least > 0 else float("inf")

    def __str__(self) -> str:
        seen = len(self.labels) - len(self.unseen)
        lines = [
            f"The recording sees {seen} of {len(self.labels)} numbers (condition number {self.condition_number:.3g})."
        ]
        if self.unseen:
            lines.append(f"It CANNOT see {', '.join(self.unseen)}.")
        for value, direction in zip(self.eigenvalues, self.directions, strict=True):
            if value < 1.0:
                lines.append(f"  unseen direction ({value:.2g}): {self._written(direction)}")
        return "\n".join(lines)

    def _written(self, direction: np.ndarray) -> str:
        scaled = direction / np.abs(direction).max()
        parts = [f"{x:+.2f} {name}" for x, name in zip(scaled, self.labels, strict=True) if abs(x) > _NAMED]
        return " ".join(parts)


def information(estimate: Estimate) -> Information:
    """The observed information at an estimate: what the recording alone, without priors, says of each number.

    **Raises:** `InputError` where the likelihood has no Hessian at the estimate.
    """
    hessian = np.asarray(likelihood_hessian(estimate))
    if not np.all(np.isfinite(hessian)):
        raise InputError("The likelihood has no finite Hessian at the estimate; a trajectory nearby escapes.")
    names, widths = _references(estimate)
    scaled = hessian * np.outer(widths, widths)
    eigenvalues, vectors = np.linalg.eigh(scaled)
    # A maximum of the posterior need not be one of the likelihood: what is below 0 says nothing either.
    said = np.maximum(eigenvalues, 0.0)
    left = np.sum(vectors**2 / (1.0 + said), axis=1)
    return Information(tuple(names), eigenvalues[::-1], vectors.T[::-1], left)


def reference_widths(estimate: Estimate) -> np.ndarray:
    """For each free coordinate (parameter,) the width that its prior, or its size, gives it."""
    return _references(estimate)[1]


def _references(estimate: Estimate) -> tuple[list[str], np.ndarray]:
    """A label and a reference width in the free coordinate, for each free coordinate."""
    names: list[str] = []
    widths: list[np.ndarray] = []
    for name, leaf in named_parameters(estimate.model).items():
        free = jnp.asarray(getattr(leaf, "free", leaf))
        whole = np.shape(free) != np.shape(value_of(leaf))
        names += [f"{name} (coordinate {i})" for i in range(free.size)] if whole else labels({name: value_of(leaf)})
        widths.append(np.ravel(_width(leaf, np.asarray(free), estimate.prior.density_of(name))))
    return names, np.concatenate(widths)


def _width(leaf: object, free: np.ndarray, density: AbstractDensity) -> np.ndarray:
    kind = type(leaf).__name__
    if kind == "Positive":
        return np.full(free.shape, _DECADE)
    if kind not in ("Learnt",) and hasattr(leaf, "free"):
        return np.ones(free.shape)
    if isinstance(density, Normal):
        return np.broadcast_to(np.sqrt(np.asarray(density.variance)), free.shape)
    if isinstance(density, Laplace):
        return np.broadcast_to(np.sqrt(2.0) * np.asarray(density.scale), free.shape)
    return np.where(free == 0, 1.0, np.abs(free))
