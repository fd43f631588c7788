"""Value, and value with gradient: Henon-Heiles, 2000 readings, 1 substep, 11 parameters."""

from functools import partial
from typing import Any

import jax

from ._cases import forward_gradient, henon_heiles, learnt_gradient
from ._contest import DYNAMAX, compiled, compiled_by_xla, contest
from ._figures import lines_of
from ._peers import dynamax_score
from ._row import Effort

WORK = "Henon-Heiles, n 2000 x 1 substep"
INTERVAL = 0.05
GOALS = {"value": 1.0, "value and gradient": 4.0}


def measure(effort: Effort) -> dict[str, Any]:
    """Two contests."""
    case = henon_heiles(2000, INTERVAL, 1)
    theirs = dynamax_score(case)
    works: dict[str, dict[str, Any]] = {
        "value": {"symplearn": case.score, "dynamax": theirs},
        "value and gradient": {
            "symplearn": learnt_gradient(case.score),
            "dynamax": jax.value_and_grad(theirs),
            "dynamax, forward": forward_gradient(theirs),
        },
    }
    lines, found = [], {}
    for work, ways in works.items():
        contenders = {name: partial(compiled, way, case.free, case.series.readings) for name, way in ways.items()}
        contenders["symplearn, by XLA"] = partial(compiled_by_xla, ways["symplearn"], case.free, case.series.readings)
        found[work] = contest(f"henon_heiles_long, {work}", contenders, dict.fromkeys(contenders, DYNAMAX), effort)
        lines += lines_of(f"{work}, {WORK}", found[work], {"dynamax": GOALS[work]})
    return {"lines": lines} | found
