"""Mixtures of Student's t densities, fitted to weighted draws: the proposals of adaptive importance sampling.

In NumPy: the number of draws grows from round to round, and compiled code would be compiled anew each time.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import solve_triangular
from scipy.special import gammaln, logsumexp

# A variance below this, in whitened coordinates, is a component that has fallen on one draw.
_LEAST = 1e-8
# No component dies out altogether.
_SMALLEST_SHARE = 0.01


@dataclass(frozen=True)
class StudentMixture:
    """A mixture of multivariate t densities with `dof` degrees of freedom in common.

    `roots` are lower triangular square roots of the scale matrices, which are not the covariances.
    """

    shares: Float[np.ndarray, " component"]
    means: Float[np.ndarray, "component parameter"]
    roots: Float[np.ndarray, "component parameter parameter"]
    dof: float

    def distances(self, z: Float[np.ndarray, "draw parameter"]) -> Float[np.ndarray, "component draw"]:
        """Squared Mahalanobis distances to the components."""
        # For thousands of draws a solve takes several times as long as a product with the small inverse.
        inverses = [solve_triangular(root, np.eye(len(root)), lower=True) for root in self.roots]
        pairs = zip(self.means, inverses, strict=True)
        return np.array([np.sum(((z - mean) @ inverse.T) ** 2, axis=1) for mean, inverse in pairs])

    def joint(self, distances: Float[np.ndarray, "component draw"]) -> Float[np.ndarray, "component draw"]:
        """log of share times density of each component."""
        d, dof = self.means.shape[1], self.dof
        norm = gammaln(0.5 * (dof + d)) - gammaln(0.5 * dof) - 0.5 * d * math.log(dof * math.pi)
        log_dets = np.sum(np.log(np.diagonal(self.roots, axis1=1, axis2=2)), axis=1)
        return (np.log(self.shares) + norm - log_dets)[:, None] - 0.5 * (dof + d) * np.log1p(distances / dof)

    def log_density(self, z: Float[np.ndarray, "draw parameter"]) -> Float[np.ndarray, " draw"]:
        """The log density at each draw."""
        return logsumexp(self.joint(self.distances(z)), axis=0)

    def sample(self, random: np.random.Generator, count: int) -> Float[np.ndarray, "draw parameter"]:
        """`count` independent draws, as many of each component as its share says, to the nearest one."""
        # Stratified: the shares of the components are no source of noise.
        levels = (np.arange(count) + random.uniform()) / count
        which = np.minimum(np.searchsorted(np.cumsum(self.shares), levels), len(self.shares) - 1)
        normal = random.normal(size=(count, self.means.shape[1]))
        stretch = np.sqrt(self.dof / random.chisquare(self.dof, size=(count, 1)))
        return self.means[which] + stretch * np.einsum("nij,nj->ni", self.roots[which], normal)


def refined(
    mixture: StudentMixture,
    z: Float[np.ndarray, "draw parameter"],
    weights: Float[np.ndarray, " draw"],
    iterations: int,
) -> StudentMixture:
    """The mixture after some iterations of expectation-maximisation on draws with weights that add up to one.

    Cappe et al. (2008), Statistics and Computing 18, 447. Each scale matrix is drawn to the common one by twice as many
    pseudo-draws as it has rows, so that a component of few draws does not collapse.
    """
    size = z.shape[1]
    pseudo = 2.0 * size * float(np.sum(weights**2))
    common = pseudo * shrunk(z, weights)
    for _ in range(iterations):
        distances = mixture.distances(z)
        parts = mixture.joint(distances)
        memberships = weights * np.exp(parts - logsumexp(parts, axis=0))
        pulls = memberships * (mixture.dof + size) / (mixture.dof + distances)
        shares = memberships.sum(axis=1)
        means = pulls @ z / np.maximum(pulls.sum(axis=1), 1e-300)[:, None]
        scatters = np.array(
            [(pull[:, None] * (z - mean)).T @ (z - mean) for pull, mean in zip(pulls, means, strict=True)]
        )
        roots = np.linalg.cholesky((scatters + common) / (shares + pseudo)[:, None, None])
        shares = np.maximum(shares, _SMALLEST_SHARE)
        mixture = StudentMixture(shares / shares.sum(), means, roots, mixture.dof)
    return mixture


def scatter(
    z: Float[np.ndarray, "draw parameter"], weights: Float[np.ndarray, " draw"]
) -> Float[np.ndarray, "parameter parameter"]:
    """The covariance of weighted draws, never quite singular."""
    centred = z - weights @ z
    return (weights[:, None] * centred).T @ centred + _LEAST * np.eye(z.shape[1])


def shrunk(
    z: Float[np.ndarray, "draw parameter"], weights: Float[np.ndarray, " draw"]
) -> Float[np.ndarray, "parameter parameter"]:
    """The covariance of weighted draws, drawn towards the identity as far as their number leaves it uncertain.

    Ledoit and Wolf (2004), J. Multivariate Anal. 88, 365, with a known target: of whitened coordinates the covariance
    is near the identity, and a hundred draws do not tell 36^2 entries.
    """
    found, identity = scatter(z, weights), np.eye(z.shape[1])
    lengths, squares = z - weights @ z, float(np.sum(found**2))
    norms = np.sum(lengths**2, axis=1)
    noise = float(weights**2 @ (norms**2 - 2 * np.sum(lengths @ found * lengths, axis=1) + squares))
    share = min(1.0, noise / max(float(np.sum((found - identity) ** 2)), 1e-300))
    return (1 - share) * found + share * identity
