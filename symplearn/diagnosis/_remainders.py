"""The best combinations again, beside remainders that are not weighed for all of them."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ._clocks import share_clocks, weigh_clocks
from ._found import Found
from ._problem import Combination
from ._weigher import KEPT, Weigher

# Combinations this many nats behind the best are tried beside a remainder.
_REACH = 30.0
# Of each size, combinations whose clock may wander, however far behind.
_SIMPLE = 2
# Combinations beside a force that goes with place: the best, and of each size however far behind. How many more are
# tried beside it, and beside a clock, where that explains more than this many nats.
_BEST, _STATIC = 24, 8
_LATER, _CLOCKS, _WORTH = 64, 16, 2.0


class Remainders:
    """Errors of the clock, and small forces that go with place, beside the best combinations found so far."""

    def __init__(self, weigher: Weigher, progress: Callable[[str], None]):
        self.weigher, self.progress = weigher, progress

    @property
    def found(self) -> Found:
        return self.weigher.found

    def weigh_clocks(self) -> None:
        """The best combinations again where the clock may wander; none where the very best leaves no remainder."""
        ranked = self._ranked()
        top, white = self.found.best(ranked[0]), self.found.of(ranked[0], "white")
        if white is None or white.log_evidence < top:
            self.progress("weighing errors of the clock")
            near = [c for c in ranked if self.found.best(c) > top - _REACH][:KEPT]
            # What a clock excuses may be all that a larger one has ahead of the best of its size.
            first = list(dict.fromkeys([*near, self.weigher.base, *self._of_each_size(_SIMPLE)]))
            before = {c: self.found.odds(c) for c in ranked}
            weigh_clocks(self.weigher, first)
            weigh_clocks(self.weigher, self._lifted(first, before, "clock")[:_CLOCKS])
            share_clocks(self.weigher)

    def weigh_static(self) -> None:
        """The best combinations again beside a force that goes with place, which any of their forces may stand for; not
        nothing: alone such a force is no remainder. What it explains beside these, it may explain beside others too."""
        self.progress("weighing small forces that go with place")
        ranked = self._ranked()
        top = self.found.odds(ranked[0])
        near = [c for c in ranked if self.found.odds(c) > top - _REACH][:_BEST]
        first = [c for c in dict.fromkeys([*near, self.weigher.base, *self._of_each_size(_STATIC)]) if c]
        self.weigher.weigh_static(first)
        white = {c: self._odds(c, "white") for c in ranked if c}
        if later := self._lifted(first, white, "static")[:_LATER]:
            self.weigher.weigh_static(later)

    def _lifted(
        self, first: Sequence[Combination], before: Mapping[Combination, float], kind: str
    ) -> list[Combination]:
        """Those but the first that would come near the best if a kind of remainder gave them as much as any of these,
        of the odds that they had before."""
        gains = [self._odds(c, kind) - before[c] for c in first if c in before]
        top, most = max(map(self.found.odds, first)), max((g for g in gains if np.isfinite(g)), default=0.0)
        return [c for c in before if c not in first and most > _WORTH and before[c] + most > top - _WORTH]

    def _odds(self, combination: Combination, kind: str) -> float:
        """The same as `Found.odds` under one kind of remainder; NaN where it was not weighed."""
        one = self.found.of(combination, kind)
        return np.nan if one is None else one.log_evidence + self.found.prices.log(combination)

    def _ranked(self) -> list[Combination]:
        return sorted(self.found.estimates, key=self.found.odds, reverse=True)

    def _of_each_size(self, most: int) -> list[Combination]:
        """The best of each size, outliers that are taken out aside."""
        sizes = [len(self.weigher.base) + size for size in range(1, self.weigher.most)]
        return [c for size in sizes for c in [c for c in self._ranked() if len(c) == size][:most]]
