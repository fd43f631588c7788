"""Estimates beside a remainder, about their own optimum.

What a remainder leaves of the unknowns is found in one linear step from the trajectory fit under white noise. Where
that is long, as along the valley of a scale beside a free start, the trajectory there is another than the step foresaw:
the step then is one of Gauss and Newton, and others follow it, a share of each that is halved where it does not help
and doubled where it does.
"""

from collections.abc import Callable
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
# Estimates are settled that are within so many nats of the best, so many at most.
_REACH, _MOST = 10.0, 12
# Points that are tried at most; the nats that a settled estimate's further step would bring at most, and those by which
# a step may miss what it foresaw and be as good as right.
_POINTS, _SETTLED, _FORESEEN = 60, 0.02, 1.0
# What errors of a clock that are taken as known may owe for others that were weighed with them, in nats: a share of one
# in six is -1.8, and the rest is for their search, which changes them a little.
_OWED = (-3.0, 0.0)


def settle(weigher: Weigher, is_mine: Callable[[Combination], bool]) -> None:
    """Settle the likeliest estimates, of the combinations that are the weigher's own."""
    found, done = weigher.found, set[tuple[Combination, str]]()
    while len(done) < _MOST:
        least = max(map(found.odds, found.estimates)) - _REACH
        near = [max(found.estimates[c], key=lambda e: e.log_evidence) for c in found.estimates if found.odds(c) > least]
        left = [e for e in near if e.kind in _KINDS and (e.combination, e.kind) not in done and is_mine(e.combination)]
        if not left:
            return
        old = max(left, key=lambda e: found.odds(e.combination))
        done.add((old.combination, old.kind))
        if (new := settled(weigher, old)) is not None:
            found.settle(old, new)


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
    origin, share, owed = _allowed(weigher, old), 1.0, 0.0
    best = weigher.beside(old, origin)
    white = weigher.found.of(old.combination, "white")
    is_known = old.kind == "clock"  # whose errors are those of the old estimate, and not looked for again
    if white is not None and (is_known or not best.log_evidence > old.log_evidence - _FORESEEN):
        first = weigher.beside(old, white.z)
        if not best.log_evidence > first.log_evidence:  # the step led too far
            best, origin, share = first, white.z, 0.5
        if is_known:
            owed = float(np.clip(old.log_evidence - first.log_evidence - first.promised, *_OWED))
    for _ in range(_POINTS):
        if np.isfinite(best.log_evidence) and best.promised < _SETTLED:
            break
        z = origin + share * (_allowed(weigher, best) - origin)
        one = weigher.beside(old, z)
        if one.log_evidence > best.log_evidence:
            best, origin, share = one, z, min(1.0, 2 * share)
        else:
            share /= 2
    if not np.isfinite(best.log_evidence):
        return None
    value = best.log_evidence + owed
    if best.promised < _SETTLED:
        return replace(best, log_evidence=value)
    hoped = min(value + min(best.promised, _FORESEEN), old.log_evidence)
    return replace(best, z=origin, log_evidence=hoped, converged=False)


def _allowed(weigher: Weigher, estimate: Estimate) -> Float[np.ndarray, " z"]:
    return within_bounds(weigher.problem, weigher.found.priors, estimate).z
