"""The best combinations weighed once more: with their places moved, beside what may do as well, and with a member more
or less."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from .._effects import HIDDEN, STOP, Memory, Oscillating
from ._clocks import share_clocks, weigh_later_clocks
from ._depths import along_the_depths
from ._driven import as_driven
from ._found import Found, speaker
from ._gaps import across_gaps
from ._magnitude import strength_entries
from ._modes import along_the_modes
from ._problem import Combination, Problem
from ._prospects import MANY, Prospects
from ._scan import ends, spacing
from ._score import Start, inverse
from ._sensors_beside import with_sensors
from ._weighed import Estimate
from ._weigher import KEPT, Weigher

# Combinations whose places are moved, and how near the best one is what is looked at.
_MOVED, _NEAR = 3, 8.0
# How far behind the best of its size one with an unseen oscillator may be to be tried stiffer, and starts of such.
_SOFT, _STIFFER = 100.0, 20
# What an unseen oscillator must promise in place of something else, and frequencies of it that are tried.
_PROMISED, _PLACES = 2.0, 2
# Standard deviations between places of one effect in two fits that stopped at different ones.
_ELSEWHERE = 3.0
# Steps of what fades, as shares of how fast it does.
_FADING = 0.25
# Combinations like the best of a size that are fitted, twice as many of more effects than usual, and how far behind a
# regression may see them.
_ALIKE, _BEHIND = 8, 30.0


class Refinement:
    """Weighs more about the likeliest combinations that a search has found."""

    def __init__(self, prospects: Prospects, progress: Callable[[str], None]):
        self.prospects, self.progress = prospects, progress
        self.weigher: Weigher = prospects.weigher
        # Fits of combinations with a stop whose stops were moved.
        self._stopped_at: dict[Combination, np.ndarray] = {}

    @property
    def found(self) -> Found:
        return self.weigher.found

    @property
    def problem(self) -> Problem:
        return self.weigher.problem

    def move_places(self) -> None:
        """Try the best combinations with their times, thresholds and frequencies moved by steps of the grid, and those
        that did not converge from where they are: damped anew, many get where they were going."""
        ranked = self._likeliest()
        near = [c for c in ranked if self.found.odds(c) > self.found.odds(ranked[0]) - _NEAR]
        starts = []
        for k, c in enumerate(near):
            white = self.found.of(c, "white")
            assert white is not None  # every combination is weighed under white noise first
            starts += [] if white.converged else [Start(c, white.z, 0.0)]
            starts += self._with_stops_moved(c) if k < _MOVED else []
            for member, place in self.problem.placed(c) if k < _MOVED else []:
                effect = self.problem.candidate(member).effect
                if effect.places and effect is not STOP:
                    starts += [Start(c, z, 0.0) for z in self._moved(white.z, member, place.stop - 1)]
        if starts:
            self.progress("moving times, thresholds and frequencies")
            self.weigher.weigh(starts, whole=True)

    def move_modes(self, size: int) -> None:
        """Try the best of a size that have an unseen oscillator with more of the stiffness seen or less, and with a
        periodic force instead; and the other way round."""
        if joined := [start for c in self._near(size)[:_MOVED] for start in self._joined(c)]:
            self.progress("trying what is unseen in place of what swings by itself")
            self.weigher.weigh(joined, whole=True)
        near = self._near(size)
        driven = [start for c in near[:_MOVED] for start in as_driven(self.weigher, c)]
        starts = [start for c in near for start in along_the_modes(self.weigher, c)][:_STIFFER]
        if starts or driven:
            self.progress("moving stiffness between what is seen and what is not")
            self.weigher.weigh([*starts, *driven], whole=True)

    def move_stops(self, size: int) -> None:
        """Try the best of a size that have a stop with it harder and nearer to the edge, or the reverse."""
        if starts := [start for c in self._near(size)[:_MOVED] for start in self._with_stops_moved(c)]:
            self.progress("moving stops")
            self.weigher.weigh(starts, whole=True)

    def cross_gaps(self, size: int) -> None:
        """Try the best of a size from where fits lead that were found gap by gap."""
        some = [self.weigher.base] if size == 0 else self._near(size)[:_MOVED]
        if starts := [start for c in some if (start := across_gaps(self.weigher, c))]:
            self.progress("crossing the gaps once more")
            self.weigher.weigh(starts, whole=True)

    def _near(self, size: int) -> list[Combination]:
        """The best of a size, and those not far behind it."""
        size += len(self.weigher.base)
        ranked = sorted((c for c in self._mine() if len(c) == size), key=self.found.best, reverse=True)
        return [c for c in ranked if self.found.best(c) > self.found.best(ranked[0]) - _SOFT]

    def _joined(self, combination: Combination) -> list[Start]:
        """A combination with an unseen oscillator in place of a member that swings by a clock of its own, where a fit
        without that member promises most: what both would do is linear in a force, and hardly in a coupling, so that
        the force promises more about a motion that is far off, and no exchange takes an oscillator in."""
        out = list[Start]()
        for member in combination:
            rest = tuple(m for m in combination if m != member)
            if (
                not isinstance(self.problem.candidate(member).effect, Oscillating)
                or self.found.of(rest, "white") is None
            ):
                continue
            some = [s for s in self.prospects.about(rest, MANY) if s.combination not in self.found.estimates
                    and s.gain > _PROMISED and self._has_unseen(s.combination)]  # fmt: skip
            out += sorted(some, key=lambda s: -s.gain)[:_PLACES]
        return out

    def _has_unseen(self, combination: Combination) -> bool:
        return any(self.problem.candidate(m).effect is HIDDEN for m in combination)

    def weigh_like_the_best(self) -> None:
        """What may do as well as the likeliest of every size: some fell behind on the way, from where they began."""
        self.progress("weighing what may do as well")
        base = len(self.weigher.base)
        for size in range(1, self.weigher.most - base + 1):
            mine = [c for c in self._mine() if len(c) == size + base]
            best = max(mine, key=self.found.odds, default=None)
            if best is not None and self.found.odds(best) > max(map(self.found.odds, self._mine())) - _NEAR:
                self.weigh_exchanged(best, size, 2 * _ALIKE if self.weigher.is_many(size) else _ALIKE)

    def weigh_exchanged(self, combination: Combination, size: int, number: int) -> None:
        """Combinations of a size that may do as well as the best one, from where a regression about it puts them."""
        starts = [s for s in self.prospects.exchanged(combination, MANY, size, number) if s.gain > -_BEHIND]
        if starts:  # from a trajectory that all rows are near to
            self.weigher.weigh(starts, whole=True)

    def weigh_plain(self, combination: Combination, size: int, number: int) -> None:
        """Of effects without a place, combinations of a size that come nearest to what one with them does."""
        if starts := self.prospects.exchanged(combination, MANY, size, number, plainly=True):
            self.weigher.weigh(starts, whole=True)

    def weigh_beside_the_remainder(self) -> None:
        """What may do as well as the likeliest of every size beside the remainder that the best answer leaves: a search
        under white noise looks for what takes a part of it."""
        if not _is_of_sensors(speaker(self.found.estimates[self._likeliest()[0]])):
            return
        self.progress("weighing what may do as well beside the remainder")
        self._weigh_sensors()
        ranked = self._likeliest()
        top, rest = self.found.odds(ranked[0]), speaker(self.found.estimates[ranked[0]])
        if not _is_of_sensors(rest):
            return
        some: dict[Combination, Start] = {}
        for c in self._bases([c for c in ranked if self.found.odds(c) > top - _BEHIND]):
            least = top - self.found.odds(c) - 2 * _NEAR
            for size in range(len(c), min(len(c) + 1, self.weigher.most) + 1):
                alike = self.prospects.exchanged(c, MANY, size - len(self.weigher.base), _ALIKE, rest)
                some |= {start.combination: start for start in alike if start.gain > least}
        if new := [start for c, start in some.items() if c not in self.found.estimates]:
            self.weigher.weigh(new, whole=True)
        if rest.kind == "clock" and some:
            weigh_later_clocks(self.weigher, list(some))
            share_clocks(self.weigher)

    def _weigh_sensors(self) -> None:
        """Errors of sensors that have a name beside the likeliest; where one of these is ahead, what does as well."""
        before = self._likeliest()
        if starts := with_sensors(self.weigher, before):
            self.weigher.weigh(starts, whole=True)
            if self._likeliest()[0] != before[0]:
                self.weigh_like_the_best()

    def _bases(self, ranked: Sequence[Combination]) -> list[Combination]:
        """The best of every size, and the best without an unseen oscillator, which no exchange takes out."""
        found = []
        for size in range(1, self.weigher.most + 1):
            mine = [c for c in ranked if len(c) == size and c != self.weigher.base]
            seen = [c for c in mine if not self.problem.has_unseen(c)]
            found += [*mine[:1], *seen[:1]]
        return list(dict.fromkeys(found))

    def weigh_grown(self) -> None:
        """Combinations that are less likely than a part of their own, with an effect at another time, threshold or
        frequency than that has it, from the part's fit: they stopped at a poorer optimum."""
        ranked = self._likeliest()
        starts: dict[Combination, Start] = {}
        for part in ranked[:KEPT]:
            grown = [c for c in ranked if len(c) == len(part) + 1 and set(part) < set(c)]
            new = [c for c in grown if c not in starts and self._is_elsewhere(c, part)]
            starts |= {c: Start(c, self._grown(c, part), 0.0) for c in new}
        if starts:
            self.weigher.weigh(list(starts.values())[: 2 * KEPT], whole=True)

    def weigh_subsets(self) -> None:
        """What the best combinations become without each of their members, from where they are, and what becomes of
        those: what was weighed already may have been caught in a poorer optimum, which would make the member look
        needed."""
        tried, base = set[Combination](), self.weigher.base
        for _ in range(self.weigher.most - 1):
            ranked = sorted(filter(self._is_worth_it, self.found.estimates), key=self.found.best, reverse=True)[:KEPT]
            less = dict.fromkeys(c[:k] + c[k + 1 :] for c in ranked for k in range(len(c)) if c[k] not in base)
            some = [c for c in less if c not in tried
                    and (c not in self.found.estimates or self._is_behind(c, ranked))][: 2 * KEPT]  # fmt: skip
            if not some:
                break
            self.weigher.weigh([Start(c, z, 0.0) for c in some for z in self._shrunk(c, ranked)], whole=True)
            tried.update(some)

    def _mine(self) -> list[Combination]:
        """Combinations that the outliers which were taken out are part of."""
        return [c for c in self.found.estimates if set(self.weigher.base) <= set(c)]

    def _likeliest(self) -> list[Combination]:
        """The same, the likeliest first."""
        return sorted(self._mine(), key=self.found.odds, reverse=True)

    def _with_stops_moved(self, combination: Combination) -> list[Start]:
        """A fitted combination with each of its stops harder or softer; nothing once more from the same fit."""
        white = self.found.of(combination, "white")
        assert white is not None  # every combination is weighed under white noise first
        stops = [m for m in combination if self.problem.candidate(m).effect is STOP]
        if not stops or np.array_equal(self._stopped_at.get(combination, ()), white.z):
            return []
        self._stopped_at[combination] = white.z
        moved = [z for m in stops for z in along_the_depths(self.weigher, combination, white.z, m)]
        return [Start(combination, z, 0.0) for z in moved]

    def _moved(self, z: np.ndarray, member: int, entry: int) -> list[np.ndarray]:
        one, priors = self.problem.candidate(member), self.found.priors
        when = priors.when(self.problem, member)
        low, high = ends(priors, one) if when is None else when
        step = _FADING * z[entry] if isinstance(one.effect, Memory) else spacing(one, low, high)
        out = []
        for k in (-3, -1, 1, 3):
            if low < z[entry] + k * step < high:
                out.append(z.copy())
                out[-1][entry] += k * step
        return out

    def _is_worth_it(self, combination: Combination) -> bool:
        """Whether no part of a combination does better without the rest."""
        less = [c for c in self.found.estimates if set(c) < set(combination)]
        return bool(combination) and self.found.best(combination) > max(map(self.found.best, less), default=-np.inf)

    def _is_behind(self, combination: Combination, ranked: Sequence[Combination]) -> bool:
        """Whether one member more is worth something."""
        larger = [self.found.best(c) for c in ranked if set(combination) < set(c)]
        return self.found.best(combination) < max(larger)

    def _is_elsewhere(self, combination: Combination, part: Combination) -> bool:
        """Whether an effect of a part has its place elsewhere there, and does better without the rest."""
        mine, other = self.found.of(combination, "white"), self.found.of(part, "white")
        if mine is None or other is None or mine.log_evidence >= other.log_evidence:
            return False
        where = dict(self.problem.placed(combination))
        for member, place in self.problem.placed(part):
            k = place.stop - 1
            apart = abs(mine.z[where[member].stop - 1] - other.z[k])
            if self.problem.candidate(member).effect.places and apart > _ELSEWHERE * np.sqrt(other.covariance[k, k]):
                return True
        return False

    def _grown(self, combination: Combination, part: Combination) -> np.ndarray:
        """Where a combination begins at a part's values: what is new in it at its own."""
        mine, other = self.found.of(combination, "white"), self.found.of(part, "white")
        assert mine is not None and other is not None
        z = self.problem.carried(other.z, part, combination)
        for member, place in self.problem.placed(combination):
            if member not in part:
                z[place] = mine.z[place]
        return z

    def _shrunk(self, combination: Combination, ranked: Sequence[Combination]) -> list[Float[np.ndarray, " z"]]:
        """Where a combination begins that lacks members of a fitted one: at that one's values, and at those that the
        others take where these do nothing: one of two effects that do nearly the same then does the work of both. Also
        at the latter of the one that loses least, whose member is next to nothing: where a small force decides where a
        motion ends, no other way leads back."""
        larger = next(c for c in ranked if set(combination) < set(c))
        white = self.found.of(larger, "white")
        assert white is not None
        first = self.problem.carried(white.z, larger, combination)
        without = {c: self._without(combination, c) for c in (larger, *self._one_more(combination))}
        nearly = max(without, key=lambda c: without[c][1])
        others = [without[c][0] for c in dict.fromkeys([larger, nearly])]
        return [first, *(z for z in others if np.isfinite(z).all() and not np.array_equal(z, first))]

    def _one_more(self, combination: Combination) -> list[Combination]:
        """What was fitted with one member more."""
        return [c for c in self._mine() if len(c) == len(combination) + 1 and set(combination) < set(c)]

    def _without(self, combination: Combination, larger: Combination) -> tuple[Float[np.ndarray, " z"], float]:
        """The values that a combination takes where what a larger one has beside it does nothing, as far as that is
        linear, and what is left of that one's log evidence."""
        white = self.found.of(larger, "white")
        assert white is not None  # every combination is weighed under white noise first
        gone = [strength_entries(self.problem, larger, member) for member in larger if member not in combination]
        some, spread = np.concatenate(gone), white.covariance
        pull = inverse(spread[np.ix_(some, some)]) @ white.z[some]
        others = np.clip(white.z - spread[:, some] @ pull, *self.found.priors.bounds_of(self.problem, larger))
        left = white.log_evidence - 0.5 * float(white.z[some] @ pull)
        return self.problem.carried(others, larger, combination), left if np.isfinite(left) else -np.inf


def _is_of_sensors(estimate: Estimate) -> bool:
    """Whether what an answer leaves is an error of sensors or of the clock that lasts."""
    return estimate.kind not in ("white", "jitter", "static", "force", "spell")
