"""Draws of a posterior, or of any density, by the sampler of your choice."""

import dataclasses
import os
from pathlib import Path
from typing import Any

import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from ._blocks import Course
from ._checkpoint import Checkpoint, seal_of
from ._errors import InputError
from ._fit import Estimate
from ._funnel import Straightened, bent_back, funnel_of
from ._importance import AdaptiveImportance
from ._keys import refuse_key
from ._parameters import flatten
from ._posterior import Posterior, log_posterior_of, posterior_of
from ._sampler import AbstractBlockSampler, AbstractSampler, Drawn, LogDensity, refuse_sampler
from ._small_arrays import on_one_thread
from ._whitening import Whitening, standard, whiten


@on_one_thread
def sample(
    estimate: Estimate,
    *,
    sampler: AbstractSampler | None = None,
    key: PRNGKeyArray,
    checkpoint: str | os.PathLike | None = None,
) -> Posterior:
    """Draw from the posterior around an estimate. Dissertation (2.13) to (2.18), Algorithm 3 corrected.

    The estimate need not have converged, nor its Hessian be positive definite: the sampler's scale is measured where
    the Hessian is of no use. Where the process noise learns, the posterior is a funnel along it; samplers then walk in
    coordinates in which that is straight. Whether the draws can be trusted is in the result: `posterior.converged`.

    Samplers run in blocks of some seconds. Beyond two seconds progress is told on stderr, every ten. Ctrl-C ends the
    run after its block: the draws so far come back as a posterior that is `stopped` and says so; where there are none
    yet, as in warm-up, the interrupt is raised.

    **Arguments:** `sampler` - `AdaptiveImportance()`, `RandomWalk()`, `NUTS()`, `MCLMC()` or `DRAM()`; `TemperedSMC()`
    for several modes; `Pathfinder()` or `VariationalInference()` for a first look; `key` - of `jax.random.key`;
    `checkpoint` - a file that is written every minute and at the end, also one by Ctrl-C or an exception, whole or not
    at all. Where it exists, sampling goes on from it and ends at the same draws, to the last bit, as without the stop;
    a scouting run that was stopped is done again.

    **Raises:** `InputError` where `sampler` is none or `key` no key, the estimate's log posterior is not finite, the
    checkpoint is damaged or of another computation, or the sampler has no blocks to keep.
    """
    sampler = AdaptiveImportance() if sampler is None else sampler
    refuse_sampler(sampler)
    refuse_key(key)
    density, centre = log_posterior_of(estimate), flatten(estimate.model)[0]
    known_by = (density, centre)
    funnel = None if sampler.by_place else funnel_of(estimate, density)
    if funnel is None:
        drawn = _drawn(density, whiten(density, centre), sampler, key, checkpoint, known_by)
    else:
        straight = Straightened(density, funnel)
        start = standard(straight, len(funnel.axes))
        drawn = bent_back(_drawn(straight, start, sampler, key, checkpoint, known_by), funnel)
    return posterior_of(estimate, drawn, str(sampler))


@on_one_thread
def sample_density(
    log_density: LogDensity,
    start: Any,
    *,
    sampler: AbstractSampler | None = None,
    key: PRNGKeyArray,
    checkpoint: str | os.PathLike | None = None,
) -> Posterior:
    """Draw from a density of your own; the draws are `posterior.values["x"]`, (chain, draw, parameter).

    **Arguments:** `log_density` - a function of a vector (parameter,) to nats, which JAX can differentiate; it need not
    be normalised; `start` (parameter,) - near its mode; the others as in `sample`. A checkpoint knows a density by its
    arrays and by its shape around the start: of two that agree in both it cannot tell one from the other.

    **Raises:** `InputError` where the start is no vector, the log density is not finite there, or as `sample` for a
    checkpoint.
    """
    start = jnp.asarray(start, dtype=float)
    if start.ndim != 1 or start.size == 0:
        raise InputError(f"`sample_density` needs a vector to start from, but was given the shape {start.shape}.")
    sampler = AdaptiveImportance() if sampler is None else sampler
    refuse_sampler(sampler)
    refuse_key(key)
    around = whiten(log_density, start)
    return posterior_of(
        None, _drawn(log_density, around, sampler, key, checkpoint, (log_density, around)), str(sampler)
    )


def _drawn(
    density: LogDensity, start: Whitening, sampler: AbstractSampler, key: PRNGKeyArray, checkpoint: Any, known_by: Any
) -> Drawn:
    if isinstance(sampler, AbstractBlockSampler):
        seal = seal_of((known_by, key), str(sampler))
        file = None if checkpoint is None else Checkpoint(Path(checkpoint), seal)
        drawn = sampler.draw_in(Course("sample", file, catches=True), density, start, key)
    elif checkpoint is not None:
        raise InputError(f"`{type(sampler).__name__}` draws all at once and keeps no checkpoint; leave it out.")
    else:
        drawn = sampler.draw(density, start, key)
    remarks = (*drawn.remarks, start.statement) if start.statement else drawn.remarks
    return dataclasses.replace(drawn, remarks=remarks)
