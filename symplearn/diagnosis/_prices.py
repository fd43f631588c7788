"""The contract's prior of a combination (section 4): the product of its members' prices."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .._effects import ERROR, IMPULSE, OUTLIERS, prices
from ._problem import Combination, Problem

# Prior share of a change in time that begins anew in every one of several recordings.
_ANEW = 1.0 / 30.0
# Prior share of a known value's being wrong in all recordings: parameters are shared (contract, section 2), and what is
# known of one is known of the system.
_SHARED = 0.9
# What has no name is there where no name explains it (contract, section 3): beside some of these, the prior of both is
# this share of their product. Of three laws that were told so in the fourteenth exam by another hand none was right.
_BESIDE_NAMES = 0.2


@dataclass(frozen=True, eq=False)
class Prices:
    """Prior probabilities of effects on targets in recordings, relative to that of nothing left out."""

    problem: Problem

    @cached_property
    def remainder(self) -> float:
        """Of a remainder without a name: one family's share."""
        return 1.0 / len(self._families)

    @cached_property
    def whole(self) -> dict[int, float]:
        """Of every effect and target that is searched, in whichever recordings."""
        found = prices([self.problem.equations.candidates[i] for i in self.problem.searched], self._families)
        return {self.problem.searched[i]: p for i, p in found.items()}

    def log(self, combination: Combination) -> float:
        """Log prior of a combination against nothing left out."""
        ones = [self.problem.candidate(member) for member in combination]
        named = any(one.nameless is None and one.effect is not OUTLIERS for one in ones)
        share = _BESIDE_NAMES if named and any(one.nameless is not None for one in ones) else 1.0
        return float(np.log([*(self._of(member) for member in combination), share]).sum())

    @cached_property
    def _families(self) -> list[str]:
        candidates = [self.problem.equations.candidates[i] for i in self.problem.searched]
        return sorted({c.effect.family for c in candidates} | {"any"})

    def _of(self, member: int) -> float:
        force = self.problem.candidate(member).nameless
        if force is not None:  # those that it was chosen from share their family
            return self._share(member) * self.remainder * float(np.exp(-force.choices))
        return self._share(member) * self.whole[self.problem.whole(member)]

    def _share(self, member: int) -> float:
        """Of an effect and target's prior, half goes to all recordings and the rest to the choices among them.

        Little of it where a change in time would have to begin anew in every recording, as their clocks do; most of it
        of a value that is known of the system.
        """
        variants, one = len(self.problem.variants(member)), self.problem.candidate(member)
        if one.effect is IMPULSE:
            return 1.0 / len(self.problem.rows)
        if variants == 0 or one.effect.amplitudes == 0:  # a noise is one in all recordings
            return 1.0
        every = _SHARED if one.effect is ERROR else 0.5
        if one.effect.family == "time variation" and self._clocks_overlap:
            every = _ANEW
        return every if member == self.problem.whole(member) else (1.0 - every) / variants

    @cached_property
    def _clocks_overlap(self) -> bool:
        """Whether two recordings claim the same time."""
        spans = sorted((float(r.times[0]), float(r.times[-1])) for r in self.problem.rows)
        return any(later[0] < earlier[1] for earlier, later in zip(spans[:-1], spans[1:], strict=True))
