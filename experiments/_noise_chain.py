"""A short chain begun at the lesser mode of the noises: what a thousand samples show that have not converged.

Adaptive Metropolis (Haario, Saksman and Tamminen 2001) with a second, shorter try after a rejection, in A and the two
variances themselves: DRAM's settings, of the dissertation's length. The second try is not corrected for the first, as
what is looked at is how long the chain takes to leave, not where it ends.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from symplearn._fit import Estimate
from symplearn._posterior import LogPosterior, log_posterior_of

LENGTH = 1000
# Adaptation after so many samples and every so many; the share of the step that the second try has.
_BEFORE, _EVERY, _SECOND = 200, 50, 0.1
# The first steps of both variances: that of process noise relative to the measurement noise's, which has 2 n readings.
_PROCESS = 2e-3


class Chain(NamedTuple):
    """The variances (sample, 2) that a chain went through, process noise first."""

    variances: Float[np.ndarray, "sample 2"]

    @property
    def left_after(self) -> int:
        """After how many samples the process noise was first the larger one; all of them if never."""
        over = self.variances[:, 0] > self.variances[:, 1]
        return int(np.argmax(over)) if over.any() else len(over)

    @property
    def share_of_process_noise(self) -> float:
        """The share of samples in which the process noise was the larger one."""
        return float(np.mean(self.variances[:, 0] > self.variances[:, 1]))


def chain_from(top: Estimate, curvature: Float[np.ndarray, "4 4"], readings: int, random: Any) -> Chain:
    """A chain from the local maximum `top`; `curvature` is that of A there, `readings` how many rows were read."""
    density = log_posterior_of(top)
    at = np.concatenate([np.ravel(v) for v in top.values().values()]).astype(float)
    measurement = at[5]
    scales = np.array([_PROCESS * measurement, measurement / np.sqrt(readings)])
    covariance = np.zeros((6, 6))
    covariance[:4, :4], covariance[4:, 4:] = np.linalg.inv(curvature), np.diag(scales**2)
    root, height, samples = _root(covariance), _height(density, at), [at]
    for k in range(1, LENGTH):
        for share in (1.0, _SECOND):
            tried = at + share * root @ random.normal(size=6)
            there = _height(density, tried)
            if np.log(random.uniform()) < there - height:
                at, height = tried, there
                break
        samples.append(at)
        if k >= _BEFORE and k % _EVERY == 0:
            root = _root(np.cov(np.array(samples).T))
    return Chain(np.array(samples)[:, 4:])


def _root(covariance: np.ndarray) -> np.ndarray:
    """Of the steps: 2.4^2 / 6 times the covariance."""
    return 2.4 / 6**0.5 * np.linalg.cholesky(covariance + 1e-12 * np.eye(6))


def _height(density: LogPosterior, at: np.ndarray) -> float:
    if np.any(at[4:] <= 0):
        return -np.inf
    return float(_evaluated(density, jnp.asarray(np.append(at[:4], np.log(at[4:])))))


@eqx.filter_jit
def _evaluated(density: LogPosterior, free: Float[Array, " 6"]) -> Float[Array, ""]:
    return density(free)
