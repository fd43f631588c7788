"""The posterior of Cherry's 34 coefficients and two variances to 400 effective draws."""

from typing import Any

import jax

import integrators as ig
import symplearn as sl
from experiments import _cherry_case as case

from ._row import Effort, tell
from ._sampling import measured

GOAL = 5.0
# The first that `infer` tries, with as many draws as 36 directions take: 300 effective ones to learn from, where those
# of half as many left 4 of 5 posteriors unconverged. Of eleven keys all converge, by 16,000 to 120,000 evaluations.
SAMPLER = sl.AdaptiveImportance(draws=4000, target=1200, batch=2000, rounds=60)


def measure(effort: Effort) -> dict[str, Any]:
    """Around the estimate that `learn` finds."""
    tell("sampling_cherry: learning the mode")
    estimate = sl.learn(
        case.model(ig.Tao(ig.as_parameter(20.0)), 8), case.single(0, 0), prior=case.PRIOR, key=jax.random.key(0)
    )
    return measured("posterior of Cherry, 36 parameters,", estimate, SAMPLER, GOAL, effort)
