"""How well the likeliest answers predict ahead: leave-future-out scores, where a clear remainder has no name.

Evidence then rests on a guess of what the remainder is, and Bayes factors of wrong models mislead. Every combination is
fitted to the first part of the rows as a plain trajectory, and run on over the others (Buerkner, Gabry and Vehtari
2020). Errors ahead are of one piece, an amplitude and a phase that drift away, so each free run counts as two readings.
What happens at one time no earlier part can foretell: there a combination counts as it does without it.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from .._effects import AT_ONCE
from ._calibrate import calibrate, residuals, weights
from ._found import Ahead, Found
from ._problem import Combination, Problem
from ._trajectory import Stepper

# Nats by which a remainder stands above white noise, by which an answer may lie behind the best to be looked at, and
# which a score takes off at most: a fit to the first part may fail for reasons of its own.
_CLEAR, _REACH, _WORST = 10.0, 100.0, 10.0
# Combinations that are looked at.
_MOST = 16
# Shares of the rows that are fitted, steps of each fit, and what one channel's free run counts for.
_ORIGINS, _STEPS, _READINGS = (0.4, 0.6, 0.8), 20, 2.0
# Nats by which a combination scores clearly above nothing.
_BETTER = 2.0
# A trajectory fit that errs no more ahead than this many times as much as where it was fitted holds on.
_HOLDS = 3.0
# Share of the fitted rows that what happens at one time has to happen before, to be known from them.
_KNOWN = 0.9


def look_ahead(stepper: Stepper, found: Found, rows: Sequence[int]) -> None:
    """Keep what the likeliest combinations score, where the best leaves a clear remainder; else nothing."""
    ranked = sorted(found.estimates, key=found.odds, reverse=True)
    top = max(e.log_evidence for e in found.estimates[ranked[0]] if e.kind != "spell")
    white = max(e.log_evidence for es in found.estimates.values() for e in es if e.kind == "white")
    if not np.isfinite(top) or top < white + _CLEAR:
        return
    near = [c for c in ranked if found.best(c) > top - _REACH and found.of(c, "white")]
    # Nothing, and the likeliest that does not swing by itself, have to be among them.
    steady = [c for c in ranked if stepper.problem.is_steady(c) and found.of(c, "white")]
    others = [c for c in ((), *steady[:1]) if found.of(c, "white")]
    tried = [*[c for c in near if c not in others][: _MOST - len(others)], *others]
    less = dict.fromkeys(_before_it(stepper.problem, c) for c in tried)
    found.ahead = _scores(stepper, found, [*tried, *(c for c in less if c not in tried and found.of(c, "white"))], rows)


@np.errstate(all="ignore")  # a lane that diverged has no score
def _scores(
    stepper: Stepper, found: Found, combinations: list[Combination], rows: Sequence[int]
) -> dict[Combination, Ahead]:
    begin = np.stack([white.z for c in combinations if (white := found.of(c, "white"))])
    total, holds = np.zeros(len(begin)), np.ones(len(begin), bool)
    for share in _ORIGINS:
        first = [max(1, round(n * share)) for n in rows]
        later = np.array([_is_later(stepper.problem, z, c, first) for z, c in zip(begin, combinations, strict=True)])
        fits = calibrate(stepper, begin, combinations, found.priors, first, _STEPS, held=later)
        (inside, before), (ahead, after) = _squares(stepper, fits.z, combinations, rows, first)
        value = -0.5 * _READINGS * np.log(ahead[:, after]).sum(1)
        known = [_known(stepper.problem, c, combinations) if late else k
                 for k, (c, late) in enumerate(zip(combinations, later, strict=True))]  # fmt: skip
        total += value[known]
        holds &= later | (ahead < _HOLDS**2 * inside)[:, before & after].all(1)
    total = np.where(np.isfinite(total), total, -np.inf)
    if not np.isfinite(total.max()):
        return {}
    bare = total[combinations.index(())] if () in combinations else -np.inf
    better, score = total > bare + _BETTER, np.maximum(total - total.max(), -_WORST)
    return {c: Ahead(float(s), bool(h), bool(b)) for c, s, h, b in zip(combinations, score, holds, better, strict=True)}


def _before_it(problem: Problem, combination: Combination) -> Combination:
    """A combination without what happens at one time."""
    return tuple(m for m in combination if problem.candidate(m).effect not in AT_ONCE)


def _known(problem: Problem, combination: Combination, combinations: list[Combination]) -> int:
    """Which lane stands for one before something happens: without it, or, where that was not fitted, itself."""
    before = _before_it(problem, combination)
    return combinations.index(before if before in combinations else combination)


def _is_later(problem: Problem, z: np.ndarray, combination: Combination, first: Sequence[int]) -> bool:
    """Whether something of a combination happens at one time, and the first rows end before it or soon after."""
    for m, place in problem.placed(combination):
        if problem.candidate(m).effect in AT_ONCE:
            seen = [problem.rows[r].times[round(_KNOWN * (first[r] - 1))] for r in problem.members[m].recordings]
            if z[place.stop - 1] > min(seen):
                return True
    return False


def _squares(
    stepper: Stepper, z: np.ndarray, combinations: Sequence[Combination], rows: Sequence[int], first: Sequence[int]
) -> list[tuple[Float[np.ndarray, "lane channel"], Bool[np.ndarray, " channel"]]]:
    """Mean squares of the errors up to each recording's first rows, and after them; and what is read there at all."""
    weight = weights(stepper.problem, rows)
    parts = residuals(stepper.problem, stepper.predict(z, combinations, rows), weight)
    out = []
    for later in (False, True):
        cut = [slice(n, None) if later else slice(None, n) for n in first]
        square = sum((w[s] * x[:, s] ** 2).sum(1) for x, w, s in zip(parts, weight, cut, strict=True))
        number = sum((w[s] > 0).sum(0) for w, s in zip(weight, cut, strict=True))
        out.append((square / np.maximum(number, 1), number > 0))
    return out
