"""Estimates beside a remainder, about their own optimum.

What a remainder leaves of the unknowns is found in one linear step from the trajectory fit under white noise. Where
that is long, as along the valley of a scale beside a free start, the trajectory there is another than the step foresaw:
the step then is one of Gauss and Newton, and others follow it, a share of each that is halved where it does not help
and doubled where it does.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ._found import within_bounds
from ._problem import Combination
from ._weighed import Estimate
from ._weigher import Weigher

# Remainders of the readings alone. A missing force is fitted as a path, to its end; what a small force that goes with
# place takes over from the parameters a trajectory without it, about which it would be settled, knows nothing of.
_KINDS = ("coloured", "clock", "positional", "kinematic", "jitter")
# Estimates are settled that are within so many nats of the best, so many at most; of those with a law apart.
_REACH, _MOST = 10.0, 12
# Of how many others the errors of sensor and clock are tried.
_ERRORS = 3
# Points that are tried at most, and the least share of a step; the nats that a settled estimate's further step would
# bring at most, and those by which a step may miss what it foresaw and be as good as right.
_POINTS, _SMALLEST, _SETTLED, _FORESEEN = 60, 1e-3, 0.02, 1.0
# What errors of a clock that are taken as known may owe for others that were weighed with them, in nats: a share of one
# in six is -1.8, and the rest is for their search, which changes them a little.
_OWED = (-3.0, 0.0)


def settle(weigher: Weigher, is_mine: Callable[[Combination], bool]) -> None:
    """Settle the likeliest estimates, of the combinations that are the weigher's own; then those whose clock errs
    beside each other's errors of it, since a search for these may be caught, and laws would be compared by its luck."""
    found, done = weigher.found, set[tuple[Combination, str]]()
    while True:
        full = [law for law in (False, True) if sum(found.has_law(c) is law for c, _ in done) >= _MOST]
        near = [max(found.estimates[c], key=lambda e: e.log_evidence) for c in found.near(_REACH, _MOST)]
        left = [e for e in near if e.kind in _KINDS and (e.combination, e.kind) not in done and is_mine(e.combination)]
        left = [e for e in left if found.has_law(e.combination) not in full]
        if not left:
            break
        old = max(left, key=lambda e: found.odds(e.combination))
        done.add((old.combination, old.kind))
        if (new := settled(weigher, old)) is not None:
            found.settle(old, new)
    clocks = [found.of(c, kind) for c, kind in done if kind == "clock"]
    _share_clocks(weigher, [one for one in clocks if one is not None and one.owed is not None])


def _share_clocks(weigher: Weigher, estimates: Sequence[Estimate]) -> None:
    """Settle estimates once more beside the errors of sensor and clock of the likeliest others; what is likelier takes
    their place."""
    ranked = sorted(estimates, key=lambda e: -e.log_evidence)
    errors = list(dict.fromkeys((one.colours, one.clocks) for one in ranked))[:_ERRORS]
    for old in ranked:
        own = old.colours, old.clocks
        other = [settled(weigher, replace(old, colours=colours, clocks=clocks))
                 for colours, clocks in errors if (colours, clocks) != own]  # fmt: skip
        best = max([old, *filter(None, other)], key=lambda e: e.log_evidence)
        if best is not old:
            weigher.found.settle(old, best)


def settled(weigher: Weigher, old: Estimate) -> Estimate | None:
    """An estimate about its own optimum; where another form of the same error is likelier there, that one's. None where
    the evidence is no number at any point."""
    best = _followed(weigher, old)
    while best is not None and best.converged and best.bends and best.kind != "clock":
        other = weigher.beside(replace(best, bends=()), best.z)
        if other.bends[0].shapes.form is best.bends[0].shapes.form:
            break
        new = _followed(weigher, other)
        if new is None or not new.log_evidence > best.log_evidence:
            break
        best = new
    return best


def _followed(weigher: Weigher, old: Estimate) -> Estimate | None:
    """An estimate about the best point that steps lead to, with the evidence there; where they come to no end, with a
    nat of what a further one promises, and no more than before. None where the evidence is no number at any point."""
    origin, share, owed = _allowed(weigher, old), 1.0, old.owed
    best = weigher.beside(old, origin)
    white = weigher.found.of(old.combination, "white")
    is_known = old.kind == "clock"  # whose errors are those of the old estimate, and not looked for again
    if white is not None and (is_known or not best.log_evidence > old.log_evidence - _FORESEEN):
        first = weigher.beside(old, white.z)
        if not best.log_evidence > first.log_evidence:  # the step led too far
            best, origin, share = first, white.z, 0.5
        if is_known and owed is None:
            owed = float(np.clip(old.log_evidence - first.log_evidence - first.promised, *_OWED))
    for _ in range(_POINTS):
        if share < _SMALLEST or (np.isfinite(best.log_evidence) and best.promised < _SETTLED):
            break
        z = origin + share * (_allowed(weigher, best) - origin)
        one = weigher.beside(old, z)
        if one.log_evidence > best.log_evidence:
            best, origin, share = one, z, min(1.0, 2 * share)
        else:
            share /= 2
    if not np.isfinite(best.log_evidence):
        return None
    value = best.log_evidence + (owed or 0.0)
    if best.promised < _SETTLED:
        return replace(best, log_evidence=value, owed=owed)
    hoped = min(value + min(best.promised, _FORESEEN), old.log_evidence)
    return replace(best, z=origin, log_evidence=hoped, converged=False, owed=owed)


def _allowed(weigher: Weigher, estimate: Estimate) -> Float[np.ndarray, " z"]:
    return within_bounds(weigher.problem, weigher.found.priors, estimate).z
