"""Which answer a finished search gives."""

from ._build import rows_fitted
from ._document import told_apart
from ._found import Found
from ._posterior import CONSISTENT, Posterior, Weighed, posterior
from ._trajectory import Stepper
from ._weighed import Estimate, coloured_inflation


def judged(stepper: Stepper, found: Found) -> tuple[Posterior, Weighed | None, str]:
    """Probabilities of everything, the reported combination, if any, and the verdict (contract, section 4)."""
    odds = posterior(found.problem, found, 1.0)
    chosen, verdict = _verdict(found, odds)
    inflation = _inflation(stepper, chosen.best if chosen else odds.nothing)
    if inflation > 1:
        odds = posterior(found.problem, found, inflation)
        chosen, verdict = _verdict(found, odds)
    return odds, chosen, verdict


def _inflation(stepper: Stepper, top: Estimate) -> float:
    """How much the evidence of the likeliest answer claims too much."""
    if top.kind != "coloured":
        return max(1.0, top.inflation)
    return coloured_inflation(stepper, top, rows_fitted(stepper.problem.rows))


def _verdict(found: Found, odds: Posterior) -> tuple[Weighed | None, str]:
    if odds.as_it_is >= CONSISTENT:
        return None, "consistent"
    ranked = told_apart(found.problem, odds.named)
    if not ranked or odds.unexplained > ranked[0].probability:
        return None, "unexplained"
    return ranked[0], "mismatch"
