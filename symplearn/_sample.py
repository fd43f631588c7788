"""Draws of a posterior, or of any density, by the sampler of your choice."""

import dataclasses
from typing import Any

import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from ._errors import InputError
from ._fit import Estimate
from ._importance import AdaptiveImportance
from ._parameters import flatten
from ._posterior import Posterior, log_posterior_of, posterior_of
from ._sampler import AbstractSampler, Drawn, LogDensity
from ._whitening import whiten


def sample(estimate: Estimate, *, sampler: AbstractSampler | None = None, key: PRNGKeyArray) -> Posterior:
    """Draw from the posterior around an estimate. Dissertation (2.13) to (2.18), Algorithm 3 corrected.

    The estimate need not have converged, nor its Hessian be positive definite: the sampler's scale is measured where
    the Hessian is of no use. Whether the draws can be trusted is in the result: `posterior.converged`.

    **Arguments:** `sampler` - `AdaptiveImportance()`, `RandomWalk()`, `NUTS()` or `DRAM()`; `key` - of
    `jax.random.key`.

    **Raises:** `InputError` where the estimate's log posterior is not finite.
    """
    sampler = AdaptiveImportance() if sampler is None else sampler
    return posterior_of(
        estimate, _drawn(log_posterior_of(estimate), flatten(estimate.model)[0], sampler, key), str(sampler)
    )


def sample_density(
    log_density: LogDensity, start: Any, *, sampler: AbstractSampler | None = None, key: PRNGKeyArray
) -> Posterior:
    """Draw from a density of your own; the draws are `posterior.values["x"]`, (chain, draw, parameter).

    **Arguments:** `log_density` - a function of a vector (parameter,) to nats, which JAX can differentiate; it need not
    be normalised; `start` (parameter,) - near its mode; the others as in `sample`.

    **Raises:** `InputError` where the start is no vector, or the log density is not finite there.
    """
    start = jnp.asarray(start, dtype=float)
    if start.ndim != 1 or start.size == 0:
        raise InputError(f"`sample_density` needs a vector to start from, but was given the shape {start.shape}.")
    sampler = AdaptiveImportance() if sampler is None else sampler
    return posterior_of(None, _drawn(log_density, start, sampler, key), str(sampler))


def _drawn(density: LogDensity, centre: Any, sampler: AbstractSampler, key: PRNGKeyArray) -> Drawn:
    start = whiten(density, centre)
    drawn = sampler.draw(density, start, key)
    remarks = (*drawn.remarks, start.statement) if start.statement else drawn.remarks
    return dataclasses.replace(drawn, remarks=remarks)
