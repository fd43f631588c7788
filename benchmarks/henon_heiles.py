"""Value and gradient of one chain: Henon-Heiles, 20 readings, 20 substeps, 11 parameters."""

from functools import partial
from typing import Any

import jax

from ._cases import forward_gradient, henon_heiles, learnt_gradient
from ._contest import DYNAMAX, compiled, compiled_by_xla, contest
from ._figures import lines_of
from ._peers import dynamax_score
from ._row import Effort

WORK = "value and gradient, Henon-Heiles, n 20 x 20 substeps, 11 parameters"
GOAL = 5.0


def measure(effort: Effort) -> dict[str, Any]:
    """dynamax in forward and reverse mode, for it may have the better one, and with our propagator, which leaves only
    the filters to differ; and symplearn without machine code."""
    case = henon_heiles(20, 5.0, 20)
    theirs = dynamax_score(case)
    ways = {
        "symplearn": learnt_gradient(case.score),
        "dynamax": jax.value_and_grad(theirs),
        "dynamax, forward": forward_gradient(theirs),
        "dynamax, our propagator": jax.value_and_grad(dynamax_score(case, case.propagated)),
    }
    at = case.free, case.series.readings
    contenders = {name: partial(compiled, way, *at) for name, way in ways.items()}
    contenders["symplearn, by XLA"] = partial(compiled_by_xla, ways["symplearn"], *at)
    found = contest("henon_heiles", contenders, dict.fromkeys(contenders, DYNAMAX), effort)
    return {"lines": lines_of(WORK, found, {"dynamax": GOAL}), "gradient": found}
