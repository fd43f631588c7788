"""The search: nothing left out, single effects, pairs, triples, and more where these leave more to be told; each
fitted, and weighed under every remainder."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from .._effects import COORDINATE, NOISE, OUTLIERS, PAIR
from ._beginning import STARTS, Beginning
from ._calibrate import Priors
from ._clocks import share_clocks
from ._far_off import weigh_without_far
from ._found import Found
from ._larger import Larger
from ._noisy import fit_paths
from ._null_paths import beside
from ._problem import MOST, USUAL, Combination, Problem
from ._prospects import MANY, Prospects, promising
from ._refinement import Refinement
from ._remainders import Remainders
from ._score import Start
from ._settle import settle
from ._spells import Spells
from ._start import apart_first, priors_without_effects
from ._trajectory import Stepper
from ._weigher import KEPT, Weigher

# Combinations of one size are carried on to the next size while within this many nats of the best; where a missing
# force leads by no more, what is left out is small.
_REACH = 30.0
# What a larger combination must gain to go on.
_WORTH = 2.0
# How many effects are fitted where they are small, and how often the same at other places or in other recordings.
_SMALL, _ALIKE = 24, 4
# Combinations that a missing force is tried beside.
_FORCED = 6
# Combinations that are fitted between two looks at the clock.
_BATCH = 32
# Combinations that are weighed again, in finer steps or by fewer readings.
_AGAIN = 24
# Places at which an effect is tried along a path.
_FEW = 60
_ONE_MORE = {1: "one effect", 2: "a second effect", 3: "a third effect", 4: "a fourth effect", 5: "a fifth effect"}


class Search:
    """Finds which combinations of effects explain the recordings of a problem, and with what evidence."""

    def __init__(
        self, stepper: Stepper, seeds: np.ndarray, deadline: float, progress: Callable[[str], None],
        spared: frozenset[int] = frozenset(), earlier: Found | None = None,
    ):  # fmt: skip
        """`earlier` is what a search of the same recordings found, of which more was used."""
        self.weigher = Weigher(stepper, Found(stepper.problem, priors_without_effects(stepper.problem)))
        self.rows = self.weigher.rows
        self.deadline, self.progress, self.earlier = deadline, progress, earlier
        self.beginning = Beginning(self.weigher, seeds, progress, spared)
        self.prospects = Prospects(self.weigher)
        self.refinement = Refinement(self.prospects, progress)
        self.remainders, self.larger = Remainders(self.weigher, progress), Larger(self.refinement)

    @property
    def found(self) -> Found:
        return self.weigher.found

    @property
    def stepper(self) -> Stepper:
        return self.weigher.stepper

    @property
    def problem(self) -> Problem:
        return self.weigher.problem

    @property
    def base(self) -> Combination:
        return self.weigher.base

    def run(self) -> Found:
        """Search, smallest combinations first."""
        self.beginning.run()
        self.refinement.cross_gaps(0)
        for size in range(1, MOST - len(self.base) + 1):
            if size > 1 and not self.in_time():
                break
            if self.weigher.is_many(size) and not self._is_worth_more(size - 1):
                break
            self.weigher.most = max(USUAL, size + len(self.base))
            self.progress(f"looking where {_ONE_MORE[size]} would help")
            if size == 1:
                self._weigh_singles()
            elif starts := self.larger.starts(size):
                self._weigh_in_batches(starts, self._is_near(size - 1))
            elif not self.weigher.is_many(size):  # of these, exchanges may have found some
                break
            if self.in_time():
                self.refinement.move_stops(size)
                self.refinement.move_modes(size)
                self.refinement.cross_gaps(size)
            if size > 1 and not self.weigher.is_many(size) and not self._gained(size):
                break
        self._take_up()
        self._refine()
        self._weigh_remainders()
        if self.in_time():
            self.refinement.weigh_beside_the_remainder()
        self.progress("weighing missing forces beside the best combinations")
        self._weigh_forces()
        self._weigh_spells()
        self._weigh_with_outliers_in()
        self._weigh_with_outliers_out()
        return self.found

    def along(self, members: Sequence[int]) -> list[Start]:
        """Where each of some effects begins alone, by the force that the simulation misses."""
        return self.prospects.along(self.beginning.best, 1, members)

    def again(self, stepper: Stepper) -> Found:
        """Fit and weigh the best combinations anew with another stepper of the same recordings."""
        w, before = self.weigher, self.found
        kept = before.near(_REACH, _AGAIN)
        best = max(before.estimates, key=before.odds)
        # What each of its members is worth is told against the rest of them, however far behind that is.
        kept += [c for k in range(len(best)) if (c := best[:k] + best[k + 1 :]) in before.estimates]
        w.moved_to(stepper, Found(stepper.problem, before.priors, complete=before.complete))
        w.weigh(self._where(before, [self.base, *kept]), whole=True)
        white = before.of(self.base, "white")
        if white is not None and self.found.white(self.base) < white.log_evidence - _REACH:
            # What goes round once more between two readings looks alike in coarse steps.
            w.weigh([Start(self.base, self.beginning.bare(z), 0.0) for z in self.beginning.seeds[:STARTS]])
        if self.in_time():
            self.refinement.move_places()
        w.add_paths(fit_paths(w.stepper, self.beginning.paths, w.found.priors, self.rows, 3))
        self._weigh_remainders()
        self._weigh_forces()
        self._weigh_spells()
        self._weigh_with_outliers_in()
        return self.found

    def settle(self) -> None:
        """Find the likeliest about their own optima."""
        if self.in_time():
            self.progress("following the likeliest to their own optima")
            share_clocks(self.weigher)
            settle(self.weigher, self._is_mine)

    def goes_on(self, stepper: Stepper, priors: Priors) -> None:
        """Go on with a problem that has more candidates, behind those that this one has."""
        w, before = self.weigher, self.found
        old, new = len(self.problem.equations.candidates), len(stepper.problem.equations.candidates)

        def renumbered(combination: Combination) -> Combination:
            return tuple(m // old * new + m % old for m in combination)

        kept = {
            renumbered(c): [replace(e, combination=renumbered(c)) for e in es] for c, es in before.estimates.items()
        }
        w.moved_to(stepper, Found(stepper.problem, priors, kept, before.complete))
        w.owed = {renumbered(c): value for c, value in w.owed.items()}
        w.base = renumbered(w.base)
        self.beginning.paths = [
            replace(path, combination=renumbered(path.combination)) for path in self.beginning.paths
        ]
        self.prospects, self.remainders = Prospects(w), Remainders(w, self.progress)
        self.refinement = Refinement(self.prospects, self.progress)
        self.larger = Larger(self.refinement)

    def _take_up(self) -> None:
        """Weigh the likeliest of an earlier search, too, from where they were found."""
        if self.earlier is None or not self.in_time():
            return
        starts = self._where(self.earlier, self.earlier.near(_REACH, _AGAIN))
        self.weigher.most = max([self.weigher.most, *(len(start.combination) for start in starts)])
        self.weigher.weigh(starts, whole=True)

    def _where(self, before: Found, combinations: Sequence[Combination]) -> list[Start]:
        """Where combinations were found before, as far as they have the outliers of this search."""
        mine = [c for c in dict.fromkeys(combinations) if self._is_mine(c)]
        return [Start(c, white.z, 0.0) for c in mine if (white := before.of(c, "white"))]

    def _refine(self) -> None:
        """The best once more from elsewhere, with what may do as well, and with what is left without a member."""
        for part in (self.refinement.move_places, self.refinement.weigh_like_the_best, self.refinement.weigh_grown):
            if self.in_time():
                part()
        self.refinement.weigh_subsets()

    def _is_mine(self, combination: Combination) -> bool:
        """Whether the outliers that were taken out are part of it, and no others."""
        return {m for m in combination if self.problem.candidate(m).effect is OUTLIERS} == set(self.base)

    def _size(self, combination: Combination) -> int:
        """Effects beside outliers that are taken out."""
        return len(combination) - len(self.base)

    def in_time(self) -> bool:
        if time.monotonic() > self.deadline:
            self.found.complete = False
        return self.found.complete

    def _weigh_singles(self) -> None:
        """Every effect alone, however little time there is for those of the highest scores.

        From where the scores put them if the simulation nearly follows the recording; else from nothing, in a growing
        window. Once one is found that follows it, the others begin where a regression about that one puts them.
        """
        scanned = self.prospects.about(self.base, MANY)
        if self._is_near(0):
            if small := self._varied(scanned):
                self.weigher.weigh(small, whole=True)
            self._weigh_from_elsewhere()
            return
        along = promising(self.prospects.along(self.beginning.best, _FEW), _REACH)
        plain = {self._with(c) for c in self.problem.searched if not self.problem.candidate(c).effect.places}
        first = promising(scanned, _REACH) + [s for s in along if s.combination not in plain]
        if first:
            self.progress(f"weighing {len({s.combination for s in first})} likely effects")
            self.weigher.weigh([self._from_nothing(s.combination) if s.combination in plain else s for s in first])
        if self._adequate() is not None:  # it may stand for what acts unread, which is not seen from its side
            self._weigh_from_elsewhere()
        if (best := self._adequate()) is not None:
            self.refinement.weigh_exchanged(best, 1, _SMALL)
            return
        taken_out = {self._with(c) for c in self.problem.searched if self.problem.candidate(c).effect is OUTLIERS}
        left = plain - taken_out - set(self.found.estimates)
        self._weigh_in_batches([self._from_nothing(c) for c in sorted(left)])

    def _varied(self, scanned: Sequence[Start]) -> list[Start]:
        """The best starts, not too many of one effect and target, whatever their places and recordings."""
        kept: dict[int, list[Start]] = {}
        ranked = sorted(scanned, key=lambda start: -start.gain)
        for start in ranked:
            (member,) = set(start.combination) - set(self.base)
            alike = kept.setdefault(self.problem.whole(member), [])
            if len(alike) < _ALIKE and sum(map(len, kept.values())) < _SMALL:
                alike.append(start)
        return [start for alike in kept.values() for start in alike]

    def _weigh_from_elsewhere(self) -> None:
        """What acts where nothing is read, from several starts: the simulation as it is hardly tells where that begins,
        and nothing of its side, which is another one for every recording."""
        ones = [self._with(c) for c in self.problem.searched if self._acts_unread(c)]
        seeds = self.beginning.seeds
        apart, _ = apart_first(seeds[:, : self.problem.head], len(seeds))
        self._weigh_in_batches([Start(c, self.beginning.bare(z), 0.0) for z in seeds[apart[:STARTS]] for c in ones])

    def _acts_unread(self, member: int) -> bool:
        """Whether an effect without a place acts on a coordinate of which nothing is read."""
        one = self.problem.candidate(member)
        if one.effect.acts_on not in (COORDINATE, PAIR) or one.effect.places or not one.effect.amplitudes:
            return False
        return any(i in self.beginning.unread for i in one.places)

    def _from_nothing(self, combination: Combination) -> Start:
        return Start(combination, self.beginning.from_seed(), 0.0)

    def _weigh_in_batches(self, starts: Sequence[Start], whole: bool = False) -> None:
        """As many as there is time for."""
        if starts:
            self.progress(f"weighing {len({s.combination for s in starts})} combinations")
        for a in range(0, len(starts), _BATCH):
            if self.in_time():
                self.weigher.weigh(starts[a : a + _BATCH], whole=whole)

    def _adequate(self) -> Combination | None:
        """A single effect that follows the recording as no remainder does beside it or instead of it."""
        alone = [c for c in self.found.estimates if self._size(c) == 1]
        best = max(alone, key=self.found.best, default=self.base)
        white = self.found.of(best, "white")
        rest = max(self.found.best(self.base), self.beginning.best.log_evidence)
        if (
            not alone
            or white is None
            or not white.converged
            or any(self.problem.candidate(m).effect is NOISE for m in best)
        ):
            return None
        is_white = white.log_evidence > self.found.best(best) - _WORTH
        return best if is_white and white.log_evidence > rest + _REACH else None

    def _is_near(self, size: int) -> bool:
        """Whether the best of a size nearly follows the recording, so that one effect more is small, and a fit may
        begin with all rows from where its score puts it."""
        whites = [self.found.of(c, "white") for c in self.found.estimates if self._size(c) == size]
        top = max((e.log_evidence for e in whites if e is not None and e.converged), default=-np.inf)
        return top > self.found.best(self.base) - _REACH

    def _with(self, member: int) -> Combination:
        return tuple(sorted((*self.base, member)))

    def _gained(self, size: int) -> bool:
        """Whether the best of this size beats the best of smaller ones, so that a larger one may be worth it; or by far
        under white noise alone, where an error of the sensor stands for what is missing in both."""
        smaller = [c for c in self.found.estimates if self._size(c) < size]
        mine = [c for c in self.found.estimates if self._size(c) == size]
        return any(
            max(map(value, mine), default=-np.inf) > max(map(value, smaller)) + least
            for value, least in ((self.found.best, _WORTH), (self.found.white, _REACH))
        )

    def _is_worth_more(self, size: int) -> bool:
        """Whether the likeliest has so many effects, and the last of them is worth more than it costs; of more than
        usual, whether that is so among the ones that may have so many."""
        some = [c for c in self.found.estimates if not self.weigher.is_many(size) or self.problem.is_plain(c)]
        mine = [self.found.odds(c) for c in some if self._size(c) == size]
        less = [self.found.odds(c) for c in some if self._size(c) < size]
        return max(mine, default=-np.inf) > max(less, default=-np.inf) + _WORTH

    def _weigh_remainders(self) -> None:
        """Errors of the clock, and forces that go with place, beside the best combinations."""
        self.remainders.weigh_clocks()
        if self.found.odds(self.base) < max(map(self.found.odds, self.found.estimates)) and self.in_time():
            self.remainders.weigh_static()

    def _weigh_forces(self) -> None:
        """Best combinations again, each with a missing force beside it; only the very best where that needs none."""
        named = sorted((c for c in self.found.estimates if self._size(c)), key=self.found.odds, reverse=True)
        self.add_forces(named[:1], 2)
        kinds = {e.kind: e.log_evidence for c in named[:1] for e in self.found.estimates[c]}
        if kinds.pop("force", -np.inf) > max(kinds.values(), default=np.inf):
            self.add_forces(named[1 : KEPT // 2 if self.weigher.is_long else _FORCED], 2)

    def _weigh_spells(self) -> None:
        """Forces that act for a while, where something was left out."""
        best, white = max(self.found.estimates, key=self.found.odds), self.found.of(self.base, "white")
        alone = -np.inf if white is None else white.log_evidence + self.found.prices.log(self.base)
        if self.found.odds(best) > alone + _WORTH and self.in_time():
            self.progress("weighing forces that act for a while")
            spells = Spells(self.prospects, self.beginning.typical)
            spells.weigh(best, _REACH)
            spells.weigh_blows()

    def _weigh_with_outliers_in(self) -> None:
        if self.base:
            self.progress("weighing the best combinations with every reading")
        self.weigher.weigh_with_outliers_in()

    def _weigh_with_outliers_out(self) -> None:
        """Where no readings were left out, as no outliers of the motion then known: those that are of this."""
        if not self.base and self.in_time():
            self.progress("looking for readings far off the likeliest answer")
            if weigh_without_far(self.weigher):
                self.beginning.paths = [replace(path, combination=self.base) for path in self.beginning.paths]

    def add_forces(self, combinations: Sequence[Combination], every: int) -> None:
        starts = []
        for c in combinations:
            white = self.found.of(c, "white")
            assert white is not None  # every combination is weighed under white noise first
            starts += beside(self.beginning.best, self.problem, self.rows, self.beginning.typical, c, white.z, every)
        w = self.weigher
        w.add_paths(fit_paths(w.stepper, starts, self.found.priors, self.rows, w.path_steps))
