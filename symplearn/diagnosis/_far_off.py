"""Readings that lie far off the likeliest answer, where none were left out.

A motion that a search cannot follow yet has its outliers in other places, or none: a force that is bent towards every
reading passes through them. The answer that is then found may have outliers of its own.
"""

from collections.abc import Sequence

import numpy as np

from .._effects import NOISE
from ._calibrate import residuals, weights
from ._found import doubtful_outliers, speaker
from ._problem import USUAL, Combination
from ._scatter import suspects
from ._score import Start
from ._weighed import standardised
from ._weigher import KEPT, Weigher


def weigh_without_far(weigher: Weigher) -> bool:
    """The best combinations again without the readings that lie far off the very best of them, and whether one with
    these outliers is the likeliest: if so, they stay left out."""
    problem, found, columns = weigher.plain.problem, weigher.found, weigher.outlier_columns
    ranked = [c for c in sorted(found.estimates, key=found.odds, reverse=True) if found.of(c, "white")]
    fit, weight = weigher.as_fitted(ranked[:1]), weights(problem, weigher.rows)
    errors = standardised([x[0] for x in residuals(problem, fit.predictions, weight)], weight, fit.noise[0])
    parts = suspects(np.split(errors, np.cumsum(weigher.rows)[:-1]))
    able, before = np.isin(np.arange(problem.channels), list(columns)), weigher.flagged
    members = tuple(sorted(m for j, m in columns.items() if any(bad[:, j].any() for bad in parts)))[: USUAL - 1]
    if not members:
        return False
    # Those that a known term takes for outliers stay out.
    far = [bad & able | was[: len(bad)] for bad, was in zip(parts, before, strict=True)]
    starts = _starts(weigher, [(), *ranked[:KEPT]], members)
    owed = weigher.owed_for(members, errors, np.concatenate(far), fit.noise[0], np.concatenate(weight))
    weigher.leave_out(far, members, owed)
    weigher.weigh(starts, whole=True)
    best = speaker(found.estimates[max(found.estimates, key=found.odds)])
    if doubtful_outliers(problem, members, best):
        weigher.leave_out(before, (), 0.0)
    return bool(weigher.base)


def _starts(weigher: Weigher, combinations: Sequence[Combination], members: Combination) -> list[Start]:
    """Where combinations were found, with outliers in place of a larger noise of their columns, and beside it."""
    problem, starts = weigher.problem, dict[Combination, Start]()
    far = {problem.candidate(m).place for m in members}
    for combination in combinations:
        white = weigher.found.of(combination, "white")
        ones = [(m, problem.candidate(m)) for m in combination]
        rest = tuple(m for m, one in ones if one.effect is not NOISE or one.place not in far)
        for some in (tuple(sorted({*one, *members})) for one in (rest, combination)):
            if white is not None and len(some) <= weigher.most:
                starts.setdefault(some, Start(some, white.z, 0.0))
    return list(starts.values())
