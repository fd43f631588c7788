"""Value and gradient of 64 chains at once: Henon-Heiles, 20 readings, 20 substeps, 11 parameters."""

from functools import partial
from typing import Any

import jax
import numpy as np

from ._cases import henon_heiles, learnt_gradient
from ._contest import DYNAMAX, compiled, compiled_by_xla, contest
from ._figures import lines_of
from ._peers import dynamax_score
from ._row import Effort

WORK = "the same, 64 chains at once"
CHAINS = 64
GOAL = 8.0


def measure(effort: Effort) -> dict[str, Any]:
    """Chains beside each other, a thousandth apart."""
    case = henon_heiles(20, 5.0, 20)
    chains = case.free + 1e-3 * np.random.default_rng(0).normal(size=(CHAINS, case.free.size))
    ways = {
        "symplearn": learnt_gradient(case.score),
        "dynamax": jax.value_and_grad(dynamax_score(case)),
    }
    at = chains, case.series.readings
    contenders = {name: partial(compiled, jax.vmap(way, (0, None)), *at) for name, way in ways.items()}
    contenders["symplearn, by XLA"] = partial(compiled_by_xla, jax.vmap(ways["symplearn"], (0, None)), *at)
    found = contest("henon_heiles_chains", contenders, dict.fromkeys(contenders, DYNAMAX), effort)
    return {"lines": lines_of(WORK, found, {"dynamax": GOAL}), "gradient": found}
