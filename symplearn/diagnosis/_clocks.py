"""Combinations weighed beside errors of the clock, all of them beside the likeliest.

Each search for such errors may be caught in an optimum of its own; two laws would then be compared by their luck. So
what the likeliest was found beside is tried beside everything that was fitted, and what comes near is searched again
from there.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ._clock import weigh_clock, weigh_shared_clock
from ._found import Found
from ._problem import Combination
from ._weighed import Estimate

if TYPE_CHECKING:
    from ._weigher import Weigher

# How often errors are shared at most, from a likelier estimate each time; how many combinations are searched again, how
# many nats these may lie behind the best, and how many they must have gained.
_ROUNDS, _MOST, _NEAR, _GAINED = 2, 6, 6.0, 1.0


def weigh_clocks(weigher: "Weigher", combinations: Sequence[Combination]) -> None:
    """Weigh combinations, fitted before, where the clock may run ahead and behind beside a coloured error."""
    _search(weigher, combinations, _likeliest(weigher.found))


def share_clocks(weigher: "Weigher") -> None:
    """Weigh everything beside the errors of sensor and clock of the likeliest estimate of this kind, where these are
    new."""
    for _ in range(_ROUNDS):
        like = _likeliest(weigher.found)
        if like is None or (like.colours, like.clocks) == weigher.shared:
            return
        _search(weigher, _beside(weigher, like), like)
        weigher.shared = like.colours, like.clocks


def _likeliest(found: Found) -> Estimate | None:
    every = (one for estimates in found.estimates.values() for one in estimates if one.kind == "clock")
    return max(every, key=lambda one: one.log_evidence, default=None)


def _search(weigher: "Weigher", combinations: Sequence[Combination], like: Estimate | None) -> None:
    found = weigher.found
    own = [c for c in combinations if found.of(c, "coloured")]
    colours = [one.colours for c in own if (one := found.of(c, "coloured"))]
    if own:
        for one in weigh_clock(weigher.problem, weigher.as_fitted(own), found.priors, weigher.rows, colours, like):
            weigher.add_beside_white(one)


def _beside(weigher: "Weigher", like: Estimate) -> list[Combination]:
    """Weigh everything that was fitted to the same readings beside the errors that an estimate has; of what does better
    than beside its own, what is near the best."""
    found, base = weigher.found, set(weigher.base)
    fitted = [c for c in found.estimates if (white := found.of(c, "white")) and np.isfinite(white.log_evidence)]
    others = [c for c in fitted if base <= set(c) and c != like.combination and found.of(c, "coloured")]
    if not others:
        return []
    own = {c: one.log_evidence if (one := found.of(c, "clock")) else -np.inf for c in others}
    for one in weigh_shared_clock(weigher.problem, weigher.as_fitted(others), found.priors, weigher.rows, like):
        weigher.add_beside_white(one)
    top = max(map(found.odds, found.estimates))
    better = [c for c in others if (one := found.of(c, "clock")) and one.log_evidence > own[c] + _GAINED]
    return sorted((c for c in better if found.odds(c) > top - _NEAR), key=found.odds, reverse=True)[:_MOST]
