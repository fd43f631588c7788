"""A short importance sampling run that tells chains where to start and how far to step."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from ._blocks import Course
from ._importance import AdaptiveImportance, softened, weighted_sample
from ._sampler import LogDensity, generator
from ._student_mixture import shrunk
from ._whitening import Whitening

SCOUT = AdaptiveImportance(target=500, rounds=20)


class Scouting(NamedTuple):
    """Coordinates whitened by the density's covariance, a start (chain, parameter) in them for each chain, and the
    evaluations it took."""

    whitening: Whitening
    z: Array
    evaluations: int


def scouted(
    options: AdaptiveImportance, density: LogDensity, start: Whitening, chains: int, key: PRNGKeyArray
) -> Scouting:
    """Starts for chains, independent and a little too far apart where importance sampling works badly."""
    random = generator(key)
    sample = weighted_sample(options, density, start, random, Course("sample: scouting"))
    weights = softened(sample.log_weights, least=5.0 * (sample.z.shape[1] + 1))
    root = np.linalg.cholesky(shrunk(sample.z, weights))
    mean = weights @ sample.z
    whitening = Whitening(
        start.free(jnp.asarray(mean)), start.root @ jnp.asarray(root), start.repaired, start.statement
    )
    finite = np.where(np.isfinite(sample.log_density), weights, 0.0)
    picked = sample.z[random.choice(len(weights), size=chains, p=finite / finite.sum())]
    return Scouting(whitening, jnp.asarray(np.linalg.solve(root, (picked - mean).T).T), sample.evaluations)
