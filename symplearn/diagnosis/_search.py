"""The search: nothing left out, single effects, pairs, triples; each fitted, and weighed under every remainder."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from .._effects import HIDDEN, OUTLIERS, Candidate
from ._calibrate import Fits, Priors, estimate_noise, residuals, weights
from ._effect_priors import motion_along, with_effects, with_unnamed
from ._exchange import Regression
from ._found import Found
from ._noisy import PathFit, fit_paths
from ._null_paths import beside, null_paths
from ._problem import MOST, Combination, Problem
from ._scan import grid, noise_starts, on_path, on_trajectory, scan, spacing
from ._score import Start, Unit
from ._start import priors_without_effects, with_states
from ._stochastic import free_run
from ._tangent import sharp_units
from ._trajectory import LANES, Stepper
from ._unnamed import Proposal
from ._weigher import KEPT, Weigher

# Combinations of one size are carried on to the next size while within this many nats of the best; where a missing
# force leads by no more, what is left out is small.
_REACH = 30.0
# Combinations that are extended, most larger ones that are fitted, and what a larger one must gain to go on.
_BASES, _PAIRS, _WORTH = 4, 32, 2.0
# How many effects are fitted where they are small.
_SMALL = 24
# Share of a promise that may be wrong.
_VAGUE = 0.3
# Effects of the highest scores that may take another's part, beside all those without a place.
_EXCHANGED = 24
# Combinations that a missing force is tried beside.
_FORCED = 6
# Combinations that are fitted between two looks at the clock.
_BATCH = 24
# Combinations whose places are moved, how near they are to the best; and those that are weighed again in finer steps.
_MOVED, _NEAR, _AGAIN = 3, 8.0, 24
# Places at which an effect is tried beside the best of the size below, and beside others; fewer where a trajectory
# costs more than one of so many leapfrog substeps; how much more a substep of a nonseparable system costs.
_MANY, _FEW, _LEAST = 160, 60, 10
_CHEAP, _NONSEPARABLE = 600, 5
_ONE_MORE = {1: "one effect", 2: "a second effect", 3: "a third effect"}


class Search:
    """Finds which combinations of effects explain the recordings of a problem, and with what evidence."""

    def __init__(self, stepper: Stepper, seeds: np.ndarray, deadline: float, progress: Callable[[str], None]):
        self.weigher = Weigher(stepper, Found(stepper.problem, priors_without_effects(stepper.problem)))
        self.seeds, self.seed, self.rows = seeds, seeds[0], self.weigher.rows
        self.deadline, self.progress = deadline, progress

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
            starts = self._proposals(size)
            if not starts:
                break
            number = len({start.combination for start in starts})
            self.progress(f"weighing {number} {'single effects' if size == 1 else f'combinations of {size} effects'}")
            near = self._is_near(size - 1)
            # The first single effects are weighed however little time is given.
            for a in range(0, len(starts), _BATCH):
                if (size == 1 and a == 0) or self._in_time():
                    self.weigher.weigh(starts[a : a + _BATCH], whole=near)
            if size > 1 and not self._gained(size):
                break
        self._move_places()
        self._weigh_subsets()
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
        kept = sorted(before.estimates, key=before.best, reverse=True)[:_AGAIN]
        w.moved_to(stepper, Found(stepper.problem, before.priors, complete=before.complete))
        mine = [c for c in dict.fromkeys([self.base, *kept]) if set(self.base) <= set(c)]
        w.weigh([Start(c, white.z, 0.0) for c in mine if (white := before.of(c, "white"))], whole=True)
        w.add_paths(fit_paths(w.stepper, self.null_paths, w.found.priors, self.rows, 3))
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
        """Try the best combinations with their times, thresholds and frequencies moved by steps of the grid."""
        ranked = sorted(self.found.estimates, key=self.found.best, reverse=True)
        top = self.found.best(ranked[0])
        starts = []
        for c in [c for c in ranked if self.found.best(c) > top - _NEAR][:_MOVED] if self._in_time() else []:
            white = self.found.of(c, "white")
            for member, place in self.problem.placed(c):
                if white is not None and self.problem.candidate(member).effect.places:
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
        if size == 1:
            return self._singles()
        best = [c for c in self.found.estimates if self._size(c) == size - 1]
        best = sorted(best, key=self.found.best, reverse=True)
        top = self.found.best(best[0]) if best else -np.inf
        kept: dict[tuple[Combination, int], Start] = {}
        for k, c in enumerate([c for c in best if self.found.best(c) > top - _REACH][:_BASES]):
            white = self.found.of(c, "white")
            assert white is not None  # every combination is weighed under white noise first
            # Thinned frequencies miss an oscillation that stays in tune throughout, so the best one has more of them.
            fits = self._fitted(c, white.z)
            mine = self._scanned(fits, _FEW if k else _MANY)
            promised = [replace(start, gain=start.gain + white.log_evidence) for start in mine]
            # As many of each: what a score promises about a poor fit is too much.
            self._keep(promised, kept)
            if not k and fits is not None:
                self._weigh_exchanged(fits, mine, size)
        return sorted(kept.values(), key=lambda start: -start.gain)

    def _keep(self, listed: Sequence[Start], kept: dict[tuple[Combination, int], Start]) -> None:
        """Add the best of some starts, each combination from two places at most."""
        most = len(kept) + _PAIRS // _BASES
        for start in sorted(listed, key=lambda start: -start.gain):
            tried = sum(combination == start.combination for combination, _ in kept)
            if tried < 2 and len(kept) < most and start.combination not in self.found.estimates:
                kept[start.combination, tried] = start

    def _singles(self) -> list[Start]:
        """Every effect that has no place from zero, in a growing window; the others from where they promise most."""
        if self._is_near(0):
            return self._small_singles()
        problem, zero = self.problem, self._from_seed()
        plain = [c for c in problem.searched if not problem.candidate(c).effect.places]
        starts = [Start(self._with(c), zero, 0.0) for c in plain if problem.candidate(c).effect is not OUTLIERS]
        white = self.found.of(self.base, "white")
        assert white is not None
        found = _promising(self._scanned(self._fitted(self.base, white.z), _MANY))
        best = self._null
        if np.isfinite(best.log_evidence):
            grams = on_path(self.stepper, best, self.rows)
            found += _promising(scan(problem, grams, best.z, self.base, self.found.priors, self._units(_FEW)))
        placed = [s for s in found if self._new(s).effect.places]
        part = [s for s in found if not self._new(s).effect.places
                and not set(s.combination) <= {*problem.searched, *self.base}]  # fmt: skip
        return starts + placed + part

    def _is_near(self, size: int) -> bool:
        """Whether the best of a size nearly follows the recording, so that one effect more is small, and a fit may
        begin with all rows from where its score puts it."""
        whites = [self.found.of(c, "white") for c in self.found.estimates if self._size(c) == size]
        top = max((e.log_evidence for e in whites if e is not None and e.converged), default=-np.inf)
        return top > self.found.best(self.base) - _REACH

    def _small_singles(self) -> list[Start]:
        """The effects of the highest scores, from where those put them."""
        white = self.found.of(self.base, "white")
        assert white is not None
        scanned = self._scanned(self._fitted(self.base, white.z), _MANY)
        found = sorted(scanned, key=lambda start: -start.gain)
        return found[:_SMALL]

    def _with(self, member: int) -> Combination:
        return tuple(sorted((*self.base, member)))

    def _new(self, start: Start) -> Candidate:
        """The effect of a single one's start."""
        (member,) = set(start.combination) - set(self.base)
        return self.problem.candidate(member)

    def _units(self, most: int, sharp: Mapping[int, list[Unit]] | None = None) -> list[Unit]:
        """What is tried: every effect and target at its `sharp` places, or at all, evenly thinned to so many at most."""
        out: list[Unit] = []
        substeps = sum(self.rows) * int(self.problem.rows[0].spans.pieces[0])
        load = substeps * (1 if self.problem.equations.separable else _NONSEPARABLE) / _CHEAP
        most = max(_LEAST, int(most / max(1.0, load)))
        for c in self.problem.searched:
            units = (sharp or {}).get(c) or grid(self.problem, self.found.priors, c)
            out += units[:: max(1, -(-len(units) // most))]
        return out

    def _scanned(self, fits: Fits | None, most: int) -> list[Start]:
        """Starts with one effect more than a fitted combination; none about one that ran away."""
        if fits is None:
            return []
        (combination,), (z,) = fits.combinations, fits.z
        grams = on_trajectory(self.stepper, fits, 0, self.rows)
        wrong = noise_starts(self.problem, fits, self.rows)
        sharp = sharp_units(self.stepper, fits, self.rows, self.found.priors)
        return wrong + scan(self.problem, grams, z, combination, self.found.priors, self._units(most, sharp), sharp)

    def _fitted(self, combination: Combination, z: np.ndarray) -> Fits | None:
        """A combination as it was fitted; None where it ran away."""
        problem, weight = self.problem, weights(self.problem, self.rows)
        predictions = self.stepper.predict(z[None], [combination], self.rows)
        noise = estimate_noise(problem, [combination], residuals(problem, predictions, weight), weight)
        fits = Fits([combination], z[None], noise, predictions, np.zeros(1), np.ones(1, bool))
        return fits if np.isfinite(noise).all() else None

    def _weigh_exchanged(self, fits: Fits, found: Sequence[Start], size: int) -> None:
        """Combinations of one size that may do as well as the best of the size below, whose members they need not
        have: of all effects without a place, and of others where one more of them helps most."""
        problem, (combination,) = self.problem, fits.combinations
        units = {m: Unit(m, None) for m in problem.searched if not problem.candidate(m).effect.places}
        for start in sorted(found, key=lambda start: -start.gain)[:_EXCHANGED]:
            (member,) = set(start.combination) - set(combination)
            place = dict(problem.placed(start.combination))[member].stop - 1
            is_placed = bool(problem.candidate(member).effect.places)
            units.setdefault(member, Unit(problem.whole(member), float(start.z[place]) if is_placed else None))
        some = {m: unit for m, unit in units.items() if problem.candidate(m).effect.amplitudes and m not in combination
                and problem.candidate(m).effect is not HIDDEN}  # fmt: skip
        if some:
            regression = Regression(self.stepper, fits, self.rows, self.found.priors, some)
            known = self.found.estimates.__contains__
            starts = regression.subsets(size + len(self.base), known, _PAIRS // _BASES)
            if starts:  # from a trajectory that all rows are near to
                self.weigher.weigh(starts, whole=True)

    def _gained(self, size: int) -> bool:
        """Whether the best of this size beats the best of smaller ones, so that a larger one may be worth it."""
        smaller = max(self.found.best(c) for c in self.found.estimates if self._size(c) < size)
        mine = [self.found.best(c) for c in self.found.estimates if self._size(c) == size]
        return max(mine, default=-np.inf) > smaller + _WORTH

    def _weigh_subsets(self) -> None:
        """What the best combinations become without each of their members, from where they are: what was weighed
        already may have been caught in a poorer optimum, which would make the member look needed."""
        ranked = sorted((c for c in self.found.estimates if c), key=self.found.best, reverse=True)[:KEPT]
        less = dict.fromkeys(c[:k] + c[k + 1 :] for c in ranked for k in range(len(c)) if c[k] not in self.base)
        some = [c for c in less if c and (c not in self.found.estimates or self._is_behind(c, ranked))]
        if some:
            self.weigher.weigh([Start(c, self._shrunk(c, ranked), 0.0) for c in some[: 2 * KEPT]], whole=True)

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

    def _weigh_forces(self) -> None:
        """Best combinations again, each with a missing force beside it."""
        named = sorted((c for c in self.found.estimates if self._size(c)), key=self.found.best, reverse=True)
        self._add_forces(named[: KEPT // 2 if self.weigher.is_long else _FORCED], 2)

    def _add_forces(self, combinations: Sequence[Combination], every: int) -> None:
        starts = []
        for c in combinations:
            white = self.found.of(c, "white")
            assert white is not None  # every combination is weighed under white noise first
            starts += beside(self._null, self.problem, self.rows, self.typical, c, white.z, every)
        w = self.weigher
        w.add_paths(fit_paths(w.stepper, starts, self.found.priors, self.rows, w.path_steps))


def _promising(scanned: Sequence[Start]) -> list[Start]:
    """Of what was looked at about one motion, what promises nearly as much as the best; the farther off that motion
    is, the less exact are promises."""
    ranked = sorted(scanned, key=lambda start: -start.gain)[:_PAIRS]
    return [s for s in ranked if s.gain > ranked[0].gain - max(_REACH, _VAGUE * ranked[0].gain)]
