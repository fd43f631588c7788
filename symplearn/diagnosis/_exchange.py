"""Which effects together would do as well: all subsets of a size, by linear regression about a fitted trajectory.

Two effects may explain only together what a third one nearly explains alone, as dry friction and drag do a damping; one
more at a time never comes there. About a trajectory that is near the recording, what each of them would do is known
without a refit, so all subsets are compared (Furnival and Wilson 1974); frequencies, times and thresholds stay.
"""

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ._calibrate import Fits, Priors, by_the_noise, noise_roots, weights
from ._problem import Combination, Problem
from ._scan import layout, packed
from ._score import Start, Unit, inverse
from ._strength import mixture_gain
from ._trajectory import LANES, Stepper
from ._whitening import Whiten

# Effects that subsets of three and more are formed of, some 2000 of them, and subsets of which every order of magnitude
# is weighed.
_FORMED, _WEIGHED = {3: 24, 4: 16, 5: 14}, 60
# Of a Gram matrix.
_ROUND_OFF = 1e-12


@dataclass(frozen=True, eq=False)
class Response:
    """What one effect's amplitudes do to all readings, by the noise."""

    member: int
    values: Float[np.ndarray, " value"]  # in the fit; of what is not part of it, no amplitude at a place
    columns: Float[np.ndarray, "amplitude reading"]


@dataclass(frozen=True, eq=False)
class Subset:
    """Some effects and what the regression makes of them, in units of their priors' widths."""

    chosen: tuple[int, ...]
    sizes: Float[np.ndarray, " amplitude"]
    spread: Float[np.ndarray, "amplitude amplitude"]
    gain: float


class Regression:
    """The readings' errors and the responses to effects, initial states and calibrated values projected out; by the
    noise, or whitened as a remainder has them."""

    def __init__(
        self, stepper: Stepper, fits: Fits, rows: Sequence[int], priors: Priors, units: dict[int, Unit],
        whiten: Whiten | None = None,
    ):  # fmt: skip
        self.problem, self.priors = stepper.problem, priors
        (self.combination,), (self.z,) = fits.combinations, fits.z
        error, others = by_the_noise(self.problem, fits, rows)
        fitted = _fitted(self.problem, fits, others)
        self.responses = [*fitted, *_further(stepper, fits, rows, units)]
        # Held in every subset: what has no amplitude, and what brings unknowns of its own.
        self.kept = [k for k, one in enumerate(fitted) if not len(one.columns) or self._is_unseen(one.member)]
        numbers = [len(one.columns) for one in self.responses]
        ends = 1 + np.cumsum([0, *numbers])
        self.where = [np.arange(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True)]
        effects = [self.problem.candidate(one.member) for one in self.responses]
        widths = [priors.scales[e.first : e.first + n] for e, n in zip(effects, numbers, strict=True)]
        self.width = np.concatenate([[1.0], *widths])
        sizes = [one.values[:n] for one, n in zip(self.responses, numbers, strict=True)]
        self.error = np.concatenate([[1.0], *sizes])  # the error without any effect, as a sum of columns
        some = np.concatenate([error[None], *(one.columns for one in self.responses)])
        self._project(*((some, others) if whiten is None else (whiten(some), whiten(others))))

    def _is_unseen(self, member: int) -> bool:
        return self.problem.candidate(member).effect.switched

    def _project(self, some: np.ndarray, others: np.ndarray) -> None:
        """The Gram matrix of the error and of all amplitudes, and how the other unknowns follow each of them."""
        p = self.problem
        free = np.nonzero(p.active(self.combination)[: p.slots])[0]
        precision = self.priors.precision_of(p, self.combination)[free]
        off = (self.priors.mean_of(p, self.combination) - self.z)[free]
        moved = others[free]
        cross, square = moved @ some.T, moved @ moved.T + np.diag(precision)
        cross[:, 0] += precision * off
        self.free, self.follow = free, inverse(square) @ cross
        self.gram = some @ some.T - cross.T @ self.follow
        self.gram[0, 0] += float(precision @ off**2)

    def subsets(
        self, size: int, is_known: Callable[[Combination], bool], most: int, among: Callable[[int], bool] | None = None
    ) -> list[Start]:
        """The best combinations of a size that are not known, of some members, by what they gain on the fitted one."""
        return self._best(self._choices(size - len(self.kept), among), is_known, most)

    def with_one_more(self, size: int, is_known: Callable[[Combination], bool], most: int) -> list[Start]:
        """The same of some of the fitted effects with one that is not among them."""
        own = [k for k, one in enumerate(self.responses) if one.member in self.combination and k not in self.kept]
        new = [k for k, one in enumerate(self.responses) if one.member not in self.combination]
        less = itertools.combinations(own, max(0, size - len(self.kept) - 1))
        listed = [(*some, k) for some in less for k in new]
        return self._best(filter(self._is_possible, listed), is_known, most)

    def _best(
        self, choices: Iterable[tuple[int, ...]], is_known: Callable[[Combination], bool], most: int
    ) -> list[Start]:
        own = self._solved([k for k, one in enumerate(self.responses) if one.member in self.combination])
        if own is None:
            return []
        found = [self._solved(c) for c in choices if not is_known(self._members(c))]
        ranked = sorted((one for one in found if one is not None), key=lambda one: -one.gain)[:_WEIGHED]
        ahead = own.gain + self._strength(own)
        starts = [Start(self._members(s.chosen), self._begin(s), s.gain + self._strength(s) - ahead) for s in ranked]
        return sorted(starts, key=lambda start: -start.gain)[:most]

    def _members(self, chosen: Sequence[int]) -> Combination:
        return tuple(sorted(self.responses[k].member for k in {*self.kept, *chosen}))

    def _choices(self, number: int, among: Callable[[int], bool] | None) -> Iterator[tuple[int, ...]]:
        """So many of the effects; where they are three and more, of those that do best with one fewer."""
        some = [k for k, one in enumerate(self.responses) if k not in self.kept
                and (among is None or among(one.member))]  # fmt: skip
        for size in range(3, number + 1):
            fewer = [one for c in itertools.combinations(some, size - 1) if (one := self._solved(c)) is not None]
            ranked = sorted(fewer, key=lambda one: -one.gain)
            some = sorted(list(dict.fromkeys(k for one in ranked for k in one.chosen))[: _FORMED[size]])
        for chosen in itertools.combinations(some, number):
            if self._is_possible(chosen):
                yield chosen

    def _is_possible(self, chosen: tuple[int, ...]) -> bool:
        return self.problem.is_possible([self.responses[k].member for k in {*self.kept, *chosen}])

    def _solved(self, chosen: Sequence[int]) -> Subset | None:
        """The amplitudes of some effects alone; None where one that has a sign would have the other."""
        chosen = tuple(sorted({*self.kept, *chosen}))
        a = np.concatenate([np.zeros(0, int), *(self.where[k] for k in chosen)])
        unit = self.width[a]
        square = self.gram[np.ix_(a, a)] * np.outer(unit, unit)
        spread = inverse(square + np.diag(1.0 + _ROUND_OFF * np.diag(square)))
        push = (self.error @ self.gram[:, a]) * unit
        sizes = spread @ push
        first = np.isin(a, [self.where[k][0] for k in chosen if len(self.where[k])])
        if not np.isfinite(sizes).all() or (sizes < self._lowest(chosen))[first].any():
            return None
        gain = 0.5 * float(push @ sizes) + 0.5 * float(np.linalg.slogdet(spread)[1]) if len(a) else 0.0
        return Subset(chosen, sizes, spread, gain)

    def _strength(self, subset: Subset) -> float:
        """What it gains where its effects may be of any order of magnitude."""
        some = [k for k in subset.chosen if len(self.where[k])]
        if not some:
            return 0.0
        own = np.repeat(np.arange(len(some)), [len(self.where[k]) for k in some])
        return mixture_gain(subset.sizes, subset.spread, own, self._lowest(some))

    def _lowest(self, chosen: Sequence[int]) -> Float[np.ndarray, " amplitude"]:
        """Below which sizes the amplitudes of some effects are not physical."""
        bounds = [self.problem.lowest(self.responses[k].member) / self.width[self.where[k]]
                  for k in chosen if len(self.where[k])]  # fmt: skip
        return np.concatenate([np.zeros(0), *bounds])

    def _begin(self, subset: Subset) -> Float[np.ndarray, " z"]:
        """Where the regression puts all unknowns."""
        combination, z = self._members(subset.chosen), self.z.copy()
        z[self.problem.slots :] = 0.0
        left, places, done = self.error.copy(), dict(self.problem.placed(combination)), 0
        for k in subset.chosen:
            one, number = self.responses[k], len(self.where[k])
            amplitudes = subset.sizes[done : done + number] * self.width[self.where[k]]
            left[self.where[k]] -= amplitudes
            z[places[one.member]] = np.append(amplitudes, one.values[number:])
            done += number
        z[self.free] += self.follow @ left
        return np.clip(z, *self.priors.bounds_of(self.problem, combination))


def _fitted(problem: Problem, fits: Fits, slopes: Float[np.ndarray, "z reading"]) -> list[Response]:
    """Responses to the effects of a fit."""
    found = []
    for member, place in problem.placed(fits.combinations[0]):
        amplitudes = slice(place.start, place.start + problem.candidate(member).effect.amplitudes)
        found.append(Response(member, fits.z[0][place], slopes[amplitudes]))
    return found


def _further(stepper: Stepper, fits: Fits, rows: Sequence[int], units: dict[int, Unit]) -> list[Response]:
    """Responses to effects that are not part of the fit, each at its place and in its own recordings."""
    problem, roots = stepper.problem, noise_roots(weights(stepper.problem, rows), fits)
    unknown = problem.state + problem.calibrated.size
    several: dict[Unit, list[int]] = {}
    for member, unit in units.items():
        several.setdefault(unit, []).append(member)
    lanes, found = list(packed(problem, list(several))), []
    for a in range(0, len(lanes), LANES):
        some = lanes[a : a + LANES]
        laid = [layout(problem, units) for units in some]
        slopes = [stepper.responses(fits.z[0], fits.combinations[0], laid, n, r) for r, n in enumerate(rows)]
        for b, lane in enumerate(some):
            for u, unit in enumerate(lane):
                at = unknown + laid[b][2][u]
                by_run = [(np.nan_to_num(slopes[r][b][at]) * root).reshape(len(at), -1)
                          for r, root in enumerate(roots)]  # fmt: skip
                for member in several[unit]:
                    which = problem.members[member].recordings
                    columns = np.concatenate([x * (r in which) for r, x in enumerate(by_run)], axis=1)
                    columns = problem.turned(member, unit.place, columns)
                    values = np.append(np.zeros(len(at)), [] if unit.place is None else [unit.place])
                    found.append(Response(member, values, columns))
    return found
