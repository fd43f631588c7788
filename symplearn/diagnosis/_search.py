"""The search: nothing left out, single effects, pairs, triples; each fitted, and weighed under every remainder."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from .._effects import NOISE, OUTLIERS
from ._calibrate import Priors
from ._effect_priors import motion_along, with_effects, with_unnamed
from ._found import Found
from ._noisy import PathFit, fit_paths
from ._null_paths import beside, null_paths
from ._problem import MOST, Combination, Problem
from ._prospects import Prospects, promising
from ._scan import spacing
from ._score import Start
from ._start import priors_without_effects, with_states
from ._stochastic import free_run
from ._trajectory import LANES, Stepper
from ._unnamed import Proposal
from ._weigher import KEPT, Weigher

# Combinations of one size are carried on to the next size while within this many nats of the best; where a missing
# force leads by no more, what is left out is small.
_REACH = 30.0
# Combinations that are extended, most larger ones that are fitted, and what a larger one must gain to go on.
_BASES, _PAIRS, _WORTH = 4, 32, 2.0
# How many effects are fitted where they are small, and how often the same at other places or in other recordings.
_SMALL, _ALIKE = 24, 4
# Combinations that a missing force is tried beside.
_FORCED = 6
# Combinations that are fitted between two looks at the clock.
_BATCH = 24
# Combinations whose places are moved, how near they are to the best; and those that are weighed again in finer steps.
_MOVED, _NEAR, _AGAIN = 3, 8.0, 24
# Places at which an effect is tried beside the best of the size below, and beside others.
_MANY, _FEW = 160, 60
_ONE_MORE = {1: "one effect", 2: "a second effect", 3: "a third effect"}


class Search:
    """Finds which combinations of effects explain the recordings of a problem, and with what evidence."""

    def __init__(self, stepper: Stepper, seeds: np.ndarray, deadline: float, progress: Callable[[str], None]):
        self.weigher = Weigher(stepper, Found(stepper.problem, priors_without_effects(stepper.problem)))
        self.seeds, self.seed, self.rows = seeds, seeds[0], self.weigher.rows
        self.deadline, self.progress = deadline, progress
        self.prospects = Prospects(self.weigher)

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
        self._begin()
        for size in range(1, MOST - len(self.base) + 1):
            if size > 1 and not self._in_time():
                break
            self.progress(f"looking where {_ONE_MORE[size]} would help")
            if size == 1:
                self._weigh_singles()
            elif starts := self._proposals(size):
                self._weigh_in_batches(starts, self._is_near(size - 1))
            else:
                break
            if size > 1 and not self._gained(size):
                break
        self._move_places()
        self._weigh_subsets()
        self._weigh_clocks()
        self.progress("weighing missing forces beside the best combinations")
        self._weigh_forces()
        self.weigher.weigh_with_outliers_in()
        return self.found

    def _begin(self) -> None:
        """The simulation without effects, under every remainder; and what every effect's prior is, from its motion."""
        bare, w = self.found.priors, self.weigher
        self._follow(bare)
        # From trajectories, too: a path that needs a strong force to follow the recording goes through outliers.
        if w.take_out_outliers(self.null_paths, w.found.priors):
            w.found = Found(self.problem, bare)
            self._follow(bare)
        w.add_paths(self.null_paths)

    def _follow(self, bare: Priors) -> None:
        """Paths and trajectories of the simulation as it is, and the priors of effects that its motion sets."""
        w = self.weigher
        self.progress("following the recording with a missing force")
        paths = null_paths(w.stepper, self.seed, self.rows, bare, w.path_steps)
        self.null_paths = [replace(fit, combination=self.base) for fit in paths]
        best = self._null
        motion = motion_along(self.problem, best.z, best.paths)
        self.typical = motion.forces
        w.found.priors = with_effects(self.problem, with_states(self.problem, bare, best.paths), motion)
        self.progress("weighing the simulation as it is")
        self._weigh_nothing()
        self.null_paths = self._paths_again()

    def _paths_again(self) -> list[PathFit]:
        """Paths under the priors of effects; for each intensity the better of two, from the path it had and from the
        trajectory: a weak force is hard to reach from a path that no force could have."""
        w, white, paths = self.weigher, self.found.of(self.base, "white"), self.null_paths
        again = fit_paths(w.stepper, paths, w.found.priors, self.rows, 3)
        if white is None or not white.converged:
            return again
        begins = [white.z[r * self.problem.state : (r + 1) * self.problem.state] for r in range(len(self.rows))]
        states = [free_run(self.problem, w.stepper.courses[r], white.z, self.base, r, x, 0)[1][: self.rows[r]]
                  for r, x in enumerate(begins)]  # fmt: skip
        starts = [replace(fit, z=white.z, noise=white.noise, paths=states, laplace=None) for fit in paths]
        near = fit_paths(w.stepper, starts, w.found.priors, self.rows, w.path_steps)
        return [max(pair, key=lambda fit: fit.log_evidence) for pair in zip(again, near, strict=True)]

    def _weigh_nothing(self) -> None:
        """The simulation as it is, from many starts: a local optimum here would look like physics left out."""
        half, ways = LANES // 2, [fit.z for fit in self.null_paths if np.isfinite(fit.log_evidence)]
        starts = [*self.seeds[:half], *ways[-half:]]
        self.weigher.weigh([Start(self.base, self._bare(z), 0.0) for z in starts])
        best = self.found.of(self.base, "white")
        if best is not None and np.isfinite(best.log_evidence):
            head = self.problem.head
            spread = np.ptp(np.stack(starts)[:, :head], axis=0) + 1e-300
            self.seed = min(starts, key=lambda z: float((((z - best.z)[:head] / spread) ** 2).sum()))

    @property
    def _null(self) -> PathFit:
        """The best path of the simulation without effects."""
        return max(self.null_paths, key=lambda fit: fit.log_evidence)

    def again(self, stepper: Stepper) -> Found:
        """Fit and weigh the best combinations anew with another stepper of the same recordings."""
        w, before = self.weigher, self.found
        ranked = sorted(before.estimates, key=before.best, reverse=True)[:_AGAIN]
        # What did not converge may promise more than there is; it stays, but nothing falls behind it.
        sound = [e.log_evidence for c in ranked for e in before.estimates[c] if e.converged]
        kept = [c for c in ranked if before.best(c) > max(sound, default=-np.inf) - _REACH]
        w.moved_to(stepper, Found(stepper.problem, before.priors, complete=before.complete))
        mine = [c for c in dict.fromkeys([self.base, *kept]) if self._is_mine(c)]
        w.weigh([Start(c, white.z, 0.0) for c in mine if (white := before.of(c, "white"))], whole=True)
        self._move_places()
        w.add_paths(fit_paths(w.stepper, self.null_paths, w.found.priors, self.rows, 3))
        self._weigh_clocks()
        self._weigh_forces()
        w.weigh_with_outliers_in()
        return self.found

    def with_unnamed(self, stepper: Stepper, listed: Sequence[Proposal]) -> Found:
        """Weigh forces without a name, which the problem of `stepper` has beside everything that was found before."""
        w, before = self.weigher, self.found
        old, new = len(self.problem.equations.candidates), len(stepper.problem.equations.candidates)

        def renumbered(combination: Combination) -> Combination:
            return tuple(m // old * new + m % old for m in combination)

        members = list(range(new - len(listed), new))
        priors = with_unnamed(stepper.problem, before.priors, listed, members, self.typical)
        choices = {m: one.choices for m, one in zip(members, listed, strict=True)}
        kept = {
            renumbered(c): [replace(e, combination=renumbered(c)) for e in es] for c, es in before.estimates.items()
        }
        w.moved_to(stepper, Found(stepper.problem, priors, kept, before.complete, choices))
        w.owed = {renumbered(c): value for c, value in w.owed.items()}
        w.base = renumbered(w.base)
        combination, z = tuple(sorted((*self.base, *members))), self._from_seed()
        for member, place in self.problem.placed(combination):
            if member in members:
                z[place] = listed[members.index(member)].sizes
        w.weigh([Start(combination, z, 0.0)])
        self._add_forces([combination], 1)
        return self.found

    def _move_places(self) -> None:
        """Try the best combinations with their times, thresholds and frequencies moved by steps of the grid, and those
        that did not converge from where they are: damped anew, many get where they were going."""
        ranked = sorted(self.found.estimates, key=self.found.best, reverse=True)
        near = [c for c in ranked if self.found.best(c) > self.found.best(ranked[0]) - _NEAR and self._is_mine(c)]
        starts = []
        for k, c in enumerate(near if self._in_time() else []):
            white = self.found.of(c, "white")
            assert white is not None  # every combination is weighed under white noise first
            starts += [] if white.converged else [Start(c, white.z, 0.0)]
            for member, place in self.problem.placed(c) if k < _MOVED else []:
                if self.problem.candidate(member).effect.places:
                    starts += [Start(c, z, 0.0) for z in self._moved(white.z, member, place.stop - 1)]
        if starts:
            self.progress("moving times, thresholds and frequencies")
            self.weigher.weigh(starts, whole=True)

    def _moved(self, z: np.ndarray, member: int, entry: int) -> list[np.ndarray]:
        one, priors = self.problem.candidate(member), self.found.priors
        low, high = priors.lower[one.values.stop - 1], priors.upper[one.values.stop - 1]
        step = spacing(one, low, high)
        out = []
        for k in (-3, -1, 1, 3):
            if low < z[entry] + k * step < high:
                out.append(z.copy())
                out[-1][entry] += k * step
        return out

    def _is_mine(self, combination: Combination) -> bool:
        """Whether the outliers that were taken out are part of it."""
        return set(self.base) <= set(combination)

    def _size(self, combination: Combination) -> int:
        """Effects beside outliers that are taken out."""
        return len(combination) - len(self.base)

    def _from_seed(self) -> np.ndarray:
        return self._bare(self.seed)

    def _bare(self, z: np.ndarray) -> np.ndarray:
        """The same without effects."""
        return np.where(np.arange(len(z)) < self.problem.slots, z, 0.0)

    def _in_time(self) -> bool:
        if time.monotonic() > self.deadline:
            self.found.complete = False
        return self.found.complete

    def _proposals(self, size: int) -> list[Start]:
        """Where fits of combinations of one size begin: each of the best of the size below with one effect more."""
        best = [c for c in self.found.estimates if self._size(c) == size - 1]
        best = sorted(best, key=self.found.best, reverse=True)
        top = self.found.best(best[0]) if best else -np.inf
        kept: dict[tuple[Combination, int], Start] = {}
        for k, c in enumerate([c for c in best if self.found.best(c) > top - _REACH][:_BASES]):
            white = self.found.of(c, "white")
            assert white is not None  # every combination is weighed under white noise first
            # Thinned frequencies miss an oscillation that stays in tune throughout, so the best one has more of them.
            mine = self.prospects.about(c, _FEW if k else _MANY)
            promised = [replace(start, gain=start.gain + white.log_evidence) for start in mine]
            # As many of each: what a score promises about a poor fit is too much.
            self._keep(promised, kept)
            if not k:
                self._weigh_exchanged(c, size, _PAIRS // _BASES)
        return sorted(kept.values(), key=lambda start: -start.gain)

    def _weigh_exchanged(self, combination: Combination, size: int, number: int) -> None:
        """Combinations of a size that may do as well as the best one, from where a regression about it puts them."""
        starts = [s for s in self.prospects.exchanged(combination, _MANY, size, number) if s.gain > -_REACH]
        if starts:  # from a trajectory that all rows are near to
            self.weigher.weigh(starts, whole=True)

    def _keep(self, listed: Sequence[Start], kept: dict[tuple[Combination, int], Start]) -> None:
        """Add the best of some starts, each combination from two places at most."""
        most = len(kept) + _PAIRS // _BASES
        for start in sorted(listed, key=lambda start: -start.gain):
            tried = sum(combination == start.combination for combination, _ in kept)
            if tried < 2 and len(kept) < most and start.combination not in self.found.estimates:
                kept[start.combination, tried] = start

    def _weigh_singles(self) -> None:
        """Every effect alone, however little time there is for those of the highest scores.

        From where the scores put them if the simulation nearly follows the recording; else from nothing, in a growing
        window. Once one is found that follows it, the others begin where a regression about that one puts them.
        """
        scanned = self.prospects.about(self.base, _MANY)
        if self._is_near(0):
            if small := self._varied(scanned):
                self.weigher.weigh(small, whole=True)
            return
        along = promising(self.prospects.along(self._null, _FEW), _REACH)
        plain = {self._with(c) for c in self.problem.searched if not self.problem.candidate(c).effect.places}
        first = promising(scanned, _REACH) + [s for s in along if s.combination not in plain]
        if first:
            self.progress(f"weighing {len({s.combination for s in first})} likely effects")
            self.weigher.weigh([self._from_nothing(s.combination) if s.combination in plain else s for s in first])
        if (best := self._adequate()) is not None:
            self._weigh_exchanged(best, 1, _SMALL)
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

    def _from_nothing(self, combination: Combination) -> Start:
        return Start(combination, self._from_seed(), 0.0)

    def _weigh_in_batches(self, starts: Sequence[Start], whole: bool = False) -> None:
        """As many as there is time for."""
        if starts:
            self.progress(f"weighing {len({s.combination for s in starts})} combinations")
        for a in range(0, len(starts), _BATCH):
            if self._in_time():
                self.weigher.weigh(starts[a : a + _BATCH], whole=whole)

    def _adequate(self) -> Combination | None:
        """A single effect that follows the recording as no remainder does beside it or instead of it."""
        alone = [c for c in self.found.estimates if self._size(c) == 1]
        best = max(alone, key=self.found.best, default=self.base)
        white = self.found.of(best, "white")
        rest = max(self.found.best(self.base), self._null.log_evidence)
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
        """Whether the best of this size beats the best of smaller ones, so that a larger one may be worth it."""
        smaller = max(self.found.best(c) for c in self.found.estimates if self._size(c) < size)
        mine = [self.found.best(c) for c in self.found.estimates if self._size(c) == size]
        return max(mine, default=-np.inf) > smaller + _WORTH

    def _weigh_subsets(self) -> None:
        """What the best combinations become without each of their members, from where they are: what was weighed
        already may have been caught in a poorer optimum, which would make the member look needed."""
        ranked = sorted(filter(self._is_worth_it, self.found.estimates), key=self.found.best, reverse=True)[:KEPT]
        less = dict.fromkeys(c[:k] + c[k + 1 :] for c in ranked for k in range(len(c)) if c[k] not in self.base)
        some = [c for c in less if c and (c not in self.found.estimates or self._is_behind(c, ranked))]
        if some:
            self.weigher.weigh([Start(c, self._shrunk(c, ranked), 0.0) for c in some[: 2 * KEPT]], whole=True)

    def _is_worth_it(self, combination: Combination) -> bool:
        """Whether no part of a combination does better without the rest."""
        less = [c for c in self.found.estimates if set(c) < set(combination)]
        return bool(combination) and self.found.best(combination) > max(map(self.found.best, less), default=-np.inf)

    def _is_behind(self, combination: Combination, ranked: Sequence[Combination]) -> bool:
        """Whether one member more is worth something."""
        larger = [self.found.best(c) for c in ranked if set(combination) < set(c)]
        return self.found.best(combination) < max(larger)

    def _shrunk(self, combination: Combination, ranked: Sequence[Combination]) -> np.ndarray:
        """Where a combination begins that lacks one member of a fitted one: at that one's values."""
        larger = next(c for c in ranked if set(combination) < set(c))
        white = self.found.of(larger, "white")
        assert white is not None
        z, where = white.z.copy(), dict(self.problem.placed(larger))
        z[self.problem.slots :] = 0.0
        for member, place in self.problem.placed(combination):
            z[place] = white.z[where[member]]
        return z

    def _weigh_clocks(self) -> None:
        """The best combinations again where the clock may wander; none where the very best leaves no remainder."""
        ranked = sorted(self.found.estimates, key=self.found.best, reverse=True)
        top, white = self.found.best(ranked[0]), self.found.of(ranked[0], "white")
        if white is None or white.log_evidence < top:
            self.progress("weighing errors of the clock")
            near = [c for c in ranked if self.found.best(c) > top - _REACH][:KEPT]
            self.weigher.weigh_clocks(list(dict.fromkeys([*near, self.base])))

    def _weigh_forces(self) -> None:
        """Best combinations again, each with a missing force beside it; only the very best where that needs none."""
        named = sorted((c for c in self.found.estimates if self._size(c)), key=self.found.best, reverse=True)
        self._add_forces(named[:1], 2)
        kinds = {e.kind: e.log_evidence for c in named[:1] for e in self.found.estimates[c]}
        if kinds.pop("force", -np.inf) > max(kinds.values(), default=np.inf):
            self._add_forces(named[1 : KEPT // 2 if self.weigher.is_long else _FORCED], 2)

    def _add_forces(self, combinations: Sequence[Combination], every: int) -> None:
        starts = []
        for c in combinations:
            white = self.found.of(c, "white")
            assert white is not None  # every combination is weighed under white noise first
            starts += beside(self._null, self.problem, self.rows, self.typical, c, white.z, every)
        w = self.weigher
        w.add_paths(fit_paths(w.stepper, starts, self.found.priors, self.rows, w.path_steps))
