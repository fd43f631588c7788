"""From a recording to a posterior in one call."""

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
from jaxtyping import PRNGKeyArray

from ._errors import InputError
from ._importance import AdaptiveImportance
from ._keys import refuse_key
from ._learn import learn
from ._model import AbstractStateSpaceModel
from ._nuts import NUTS
from ._objectives import MARGINAL_LIKELIHOOD, AbstractObjective
from ._posterior import Posterior
from ._prior import AbstractDensity, Prior
from ._random_walk import RandomWalk
from ._sample import sample
from ._sampler import AbstractSampler, refuse_sampler

# The cheapest first, by effective draws a second on the posterior of Henon-Heiles (specification 5.15); each of the
# later ones stands where the one before gives up.
_IN_TURN = (AdaptiveImportance(), RandomWalk(), NUTS())


def infer(
    model: AbstractStateSpaceModel,
    recordings: Any,
    objective: AbstractObjective = MARGINAL_LIKELIHOOD,
    *,
    prior: Prior | AbstractDensity,
    key: PRNGKeyArray,
    samplers: Sequence[AbstractSampler] = _IN_TURN,
    checkpoint: str | os.PathLike | None = None,
) -> Posterior:
    """The posterior of a model given recordings: `learn`, then `sample`, by one sampler after the other until the draws
    can be trusted.

    The result is the first posterior that converged, or else the one with the largest effective sample size; its text
    then says what is wrong and what to try, and what became of each sampler. `posterior.estimate` is the maximum a
    posteriori, with the record of its starts.

    **Arguments:** as for `learn`; `samplers` - in the order in which they are tried; `checkpoint` - the first part of
    the name of the samplers' files, `.0`, `.1` and so on; the same call goes on from them.

    **Raises:** `InputError` as `learn` and `sample`, or where no sampler is given.
    """
    if not samplers:
        raise InputError("`infer` was given no samplers; leave `samplers` out, or give at least one.")
    for sampler in samplers:
        refuse_sampler(sampler)
    refuse_key(key)
    start_key, draw_key = jax.random.split(key)
    estimate = learn(model, recordings, objective, prior=prior, key=start_key)
    tried: list[Posterior] = []
    for k, sampler in enumerate(samplers):
        path = None if checkpoint is None else Path(f"{os.fspath(checkpoint)}.{k}")
        tried.append(sample(estimate, sampler=sampler, key=jax.random.fold_in(draw_key, k), checkpoint=path))
        if tried[-1].converged or tried[-1].stopped:
            return _remarked(tried[-1], tried)
    return _remarked(max(tried, key=_worth), tried)


def _worth(posterior: Posterior) -> float:
    """The effective sample size; nothing where it is not a number."""
    least = posterior.diagnostics.least_ess
    return least if least > 0 else 0.0


def _remarked(chosen: Posterior, tried: Sequence[Posterior]) -> Posterior:
    """The posterior with a remark on each other sampler that was tried."""
    others = [one for one in tried if one is not chosen]
    remarks = [f"Tried before: {' '.join(one.sampler.split())}: {one.diagnostics}" for one in others]
    if not chosen.estimate.converged:  # type: ignore[union-attr]
        remarks.append("The descent to the most probable model did not converge; the draws do not need it to.")
    return dataclasses.replace(
        chosen, drawn=dataclasses.replace(chosen.drawn, remarks=(*chosen.drawn.remarks, *remarks))
    )
