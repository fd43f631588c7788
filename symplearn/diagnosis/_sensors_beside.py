"""Errors of sensors that have a name, beside combinations that leave one without.

An error that remembers itself, or a clock's, follows a drift or a bias as well as it follows anything, and leaves next
to nothing that a score would show: so they are fitted.
"""

from collections.abc import Sequence

from .._effects import BIAS, DELAY, DRIFT, GAIN
from ._problem import Combination
from ._score import Start
from ._weigher import Weigher

# Combinations that these are tried beside.
_FEW = 3


def with_sensors(weigher: Weigher, ranked: Sequence[Combination]) -> list[Start]:
    """The first few of some combinations with one error of a sensor more, in all recordings, from nothing."""
    problem, found, starts = weigher.problem, weigher.found, dict[Combination, Start]()
    ones = [m for m in problem.searched if problem.candidate(m).effect in (BIAS, GAIN, DRIFT, DELAY)]
    ones = [m for m in ones if m == problem.whole(m)]
    for combination in [c for c in ranked if len(c) < weigher.most and found.of(c, "white")][:_FEW]:
        white = found.of(combination, "white")
        assert white is not None  # so they were chosen
        for some in (tuple(sorted({*combination, m})) for m in ones if m not in combination):
            if some not in found.estimates and problem.is_possible(some):
                starts.setdefault(some, Start(some, problem.carried(white.z, combination, some), 0.0))
    return list(starts.values())
