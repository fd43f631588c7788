"""Combinations weighed beside errors of the clock, all of them beside the likeliest.

Each search for such errors may be caught in an optimum of its own; two laws would then be compared by their luck. So
what the likeliest was found beside is tried beside everything that was fitted, and what comes near is searched again
from there.
"""

from collections.abc import Sequence

import numpy as np

from ._clock import weigh_clock, weigh_shared_clock
from ._found import Found
from ._problem import Combination
from ._weighed import Estimate
from ._weigher import Weigher

# How often errors are shared at most, from a likelier estimate each time; how many nats a combination that is searched
# again may lie behind the best, and how many it must have gained.
_ROUNDS, _NEAR, _GAINED = 2, 6.0, 1.0
# Nats behind the best beside errors that are another's, from which on a combination's own are not searched for: they
# have given up to 17 more. How many are searched at once at most.
_FAR, _MOST = 25.0, 6


def weigh_clocks(weigher: Weigher, combinations: Sequence[Combination]) -> None:
    """Weigh combinations, fitted before, where the clock may run ahead and behind beside a coloured error."""
    _search(weigher, combinations, _likeliest(weigher.found))


def weigh_later_clocks(weigher: Weigher, combinations: Sequence[Combination]) -> None:
    """The same after others were searched for such errors: all beside the likeliest one's, and a few that come near
    there searched themselves."""
    like, found = _likeliest(weigher.found), weigher.found
    if like is not None:
        _weigh_beside(weigher, combinations, like)
        odds = {c: _evidence(found, c) + found.prices.log(c) for c in combinations}
        least = max(map(found.odds, found.estimates)) - _FAR
        combinations = sorted((c for c in combinations if odds[c] > least), key=lambda c: -odds[c])[:_MOST]
    _search(weigher, combinations, like)


def share_clocks(weigher: Weigher) -> None:
    """Weigh everything beside the errors of sensor and clock of the likeliest estimate of this kind, where these are
    new; what gains and is near the best is searched again from there."""
    found, base = weigher.found, set(weigher.base)
    for _ in range(_ROUNDS):
        fresh = [one for one in _leaders(found) if (one.colours, one.clocks) not in weigher.shared]
        for like in fresh:
            weigher.shared.append((like.colours, like.clocks))
            others = [c for c in found.estimates if base <= set(c) and c != like.combination]  # of the same readings
            before = {c: _evidence(found, c) for c in others}
            _weigh_beside(weigher, others, like)
            least = max(map(found.odds, found.estimates)) - _NEAR
            near = [c for c in others if _evidence(found, c) > before[c] + _GAINED and found.odds(c) > least]
            _search(weigher, sorted(near, key=found.odds, reverse=True)[:_MOST], like)
        if not fresh:
            return


def _leaders(found: Found) -> list[Estimate]:
    """The likeliest estimate of this kind, and the likeliest with a word for everything."""
    every = [one for estimates in found.estimates.values() for one in estimates if one.kind == "clock"]
    worded = [one for one in every if not found.has_law(one.combination)]
    return list(dict.fromkeys(max(some, key=lambda one: one.log_evidence) for some in (every, worded) if some))


def _likeliest(found: Found) -> Estimate | None:
    return next(iter(_leaders(found)), None)


def _evidence(found: Found, combination: Combination) -> float:
    one = found.of(combination, "clock")
    return -np.inf if one is None else one.log_evidence


def _search(weigher: Weigher, combinations: Sequence[Combination], like: Estimate | None) -> None:
    found = weigher.found
    own = [c for c in combinations if found.of(c, "coloured")]
    colours = [one.colours for c in own if (one := found.of(c, "coloured"))]
    if own:
        for one in weigh_clock(weigher.problem, weigher.as_fitted(own), found.priors, weigher.rows, colours, like):
            weigher.add_beside_white(one)


def _weigh_beside(weigher: Weigher, combinations: Sequence[Combination], like: Estimate) -> None:
    """Weigh combinations beside the errors that an estimate has."""
    found = weigher.found
    fitted = [c for c in combinations if (white := found.of(c, "white")) and np.isfinite(white.log_evidence)]
    if own := [c for c in fitted if found.of(c, "coloured")]:
        for one in weigh_shared_clock(weigher.problem, weigher.as_fitted(own), found.priors, weigher.rows, like):
            weigher.add_beside_white(one)
