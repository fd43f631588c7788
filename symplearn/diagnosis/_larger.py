"""Where fits of larger combinations begin: each of the best of a size with one effect more."""

from collections.abc import Sequence
from dataclasses import replace

from ._found import Found
from ._problem import Combination, Problem
from ._prospects import MANY
from ._refinement import Refinement
from ._score import Start

# Combinations that are extended, how near the best they are, and how near where all of them have an effect at a place.
_BASES, _REACH, _FAR = 4, 30.0, 100.0
# Starts of each of them, exchanges about the best, and places of an effect beside others than the best.
_EACH, _FEW = 8, 60


class Larger:
    """Proposes combinations of one effect more than the best that a search has found, and weighs exchanges."""

    def __init__(self, refinement: Refinement):
        self.refinement = refinement

    @property
    def found(self) -> Found:
        return self.refinement.found

    @property
    def problem(self) -> Problem:
        return self.refinement.problem

    def starts(self, size: int) -> list[Start]:
        """Where fits of combinations of one size begin, outliers that are taken out aside; the likeliest first."""
        best = self._best_of(size - 1)
        if not best:
            return []
        near = [c for c in best if self.found.best(c) > self.found.best(best[0]) - _REACH][:_BASES]
        # What an error of the sensor hides, an effect less, shows where there is none; and no exchange takes out what
        # is unseen.
        plain = sorted(best, key=self.found.white, reverse=True)[:1]
        seen = [c for c in best if self._may_follow(c, best[0]) and not self.problem.has_unseen(c)][:1]
        bare: list[Combination] = []
        if all(any(map(self._has_place, c)) for c in near):
            # A place suits itself to what several others do together, each of which does little alone. No way may lead
            # there one by one, so what these do together is weighed, too; and the best without any place is extended.
            self._weigh_plain(best, size)
            bare = [c for c in best if self._may_follow(c, best[0]) and self.problem.is_plain(c)][:1]
        kept: dict[tuple[Combination, int], Start] = {}
        for k, c in enumerate(dict.fromkeys([*near, *plain, *seen, *bare])):
            # As many of each: what a score promises about a poor fit is too much.
            self._keep(self._promised(c, size, first=k == 0), kept)
            if k == 0 or c in seen:
                self.refinement.weigh_exchanged(c, size, _EACH)
        return sorted(kept.values(), key=lambda start: -start.gain)

    def _best_of(self, size: int) -> list[Combination]:
        mine = [c for c in self.found.estimates if len(c) - len(self.refinement.weigher.base) == size]
        return sorted(mine, key=self.found.best, reverse=True)

    def _may_follow(self, combination: Combination, best: Combination) -> bool:
        """Whether one is near enough where what is ahead has an effect that may stand for several."""
        return self.found.best(combination) > self.found.best(best) - _FAR

    def _promised(self, combination: Combination, size: int, first: bool) -> list[Start]:
        """Starts of one effect more, with the log evidence that they promise; of more effects than usual those that
        promise more than what is new costs."""
        # Thinned frequencies miss an oscillation that stays in tune throughout, so the best one has more of them.
        mine = self.refinement.prospects.about(combination, MANY if first else _FEW)
        if self.refinement.weigher.is_many(size):
            prior = self.found.prices.log
            mine = [s for s in mine if s.gain > prior(combination) - prior(s.combination)]
        white = self.found.white(combination)
        return [replace(start, gain=start.gain + white) for start in mine]

    def _weigh_plain(self, best: Sequence[Combination], size: int) -> None:
        """What effects without a place do together, from what follows the readings best."""
        if seen := [c for c in best if not self.problem.has_unseen(c)]:
            self.refinement.weigh_plain(max(seen, key=self.found.white), size, _EACH)

    def _has_place(self, member: int) -> bool:
        return bool(self.problem.candidate(member).effect.places)

    def _keep(self, listed: Sequence[Start], kept: dict[tuple[Combination, int], Start]) -> None:
        """Add the best of some starts, each combination from two places at most."""
        most = len(kept) + _EACH
        for start in sorted(listed, key=lambda start: -start.gain):
            tried = sum(combination == start.combination for combination, _ in kept)
            if tried < 2 and len(kept) < most and start.combination not in self.found.estimates:
                kept[start.combination, tried] = start
