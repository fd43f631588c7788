"""The search: nothing left out, single effects, pairs, triples; each fitted, and weighed under every remainder."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np

from ._calibrate import Priors, grow
from ._noisy import PathFit, fit_paths
from ._problem import SLOTS, Combination
from ._start import priors_without_effects, scales, typical_forces, windows, with_states
from ._stochastic import run_filter
from ._trajectory import Stepper
from ._weighed import Estimate, weigh_coloured, weigh_white

# A window grows in these steps, so that a trajectory fit is not caught in a local minimum.
_GROWTH = (0.02, 0.04, 0.08, 0.16, 0.32, 0.64, 1.0)
# Intensities of the missing force that are tried, as shares of the forces already there.
_SHARES = np.geomspace(3e-5, 0.3, 8)
# Combinations of one size are carried on to the next size while within this many nats of the best.
_REACH = 30.0
_KEPT = 8
# Substeps over all rows beyond which the search is narrowed before the whole recording is used.
_AFFORDABLE = 12_000


@dataclass
class Found:
    """Everything that was weighed: estimates by combination, one per kind of remainder."""

    priors: Priors
    estimates: dict[Combination, list[Estimate]] = field(default_factory=dict)
    complete: bool = True

    def add(self, estimate: Estimate) -> None:
        """Keep the better of two estimates of the same combination and kind."""
        kinds = self.estimates.setdefault(estimate.combination, [])
        same = [e for e in kinds if e.kind == estimate.kind]
        if not same:
            kinds.append(estimate)
        elif estimate.log_evidence > same[0].log_evidence:
            kinds[kinds.index(same[0])] = estimate

    def of(self, combination: Combination, kind: str) -> Estimate | None:
        """The estimate of a combination under one kind of remainder, None where there is none."""
        return next((e for e in self.estimates.get(combination, []) if e.kind == kind), None)

    def best(self, combination: Combination) -> float:
        """The largest log evidence of a combination over kinds."""
        return max((e.log_evidence for e in self.estimates[combination]), default=-np.inf)


class Search:
    """Finds which combinations of effects explain the recordings of a problem, and with what evidence."""

    def __init__(self, stepper: Stepper, seeds: np.ndarray, deadline: float, progress: Callable[[str], None]):
        self.problem, self.stepper, self.seeds, self.seed = stepper.problem, stepper, seeds, seeds[0]
        self.rows = [r.fitted for r in self.problem.rows]
        self.deadline, self.progress = deadline, progress

    def run(self) -> Found:
        """Search, smallest combinations first."""
        bare = priors_without_effects(self.problem)
        self.found = Found(bare)
        self.progress("following the recording with a missing force")
        self.null_paths = self._null_paths(bare)
        best = max(self.null_paths, key=lambda fit: fit.log_evidence)
        self.typical = typical_forces(self.problem, best.z, best.paths)
        wide = with_states(self.problem, bare, best.paths)
        self.found.priors = replace(wide, scales=scales(self.problem, best.z, best.paths))
        self._add_paths(fit_paths(self.stepper, self.null_paths, self.found.priors, self.rows, 3))
        for size in range(1, SLOTS + 1):
            candidates = self._proposals(size)
            # The simulation as it is and single effects are weighed however little time is given.
            if not candidates or (size > 1 and not self._in_time()):
                break
            single = f"the simulation as it is and {len(candidates) - 1} single effects"
            self.progress(f"weighing {single if size == 1 else f'{len(candidates)} combinations of {size} effects'}")
            self._weigh(candidates)
            self._exchange(size)
            if size > 1 and self._long and not self._gained(size):
                break
        self._weigh_subsets()
        self.progress("weighing missing forces beside the best combinations")
        self._weigh_forces()
        return self.found

    def _in_time(self) -> bool:
        if time.monotonic() > self.deadline:
            self.found.complete = False
        return self.found.complete

    def _windows(self) -> list[list[int]]:
        return windows(self.rows, _GROWTH, max(8, 4 * self.problem.state))

    def _null_paths(self, priors: Priors) -> list[PathFit]:
        """The simulation without effects under missing forces of several intensities."""
        problem = self.problem
        guess = self._rough_noise()
        first = [self._filtered_path(r, self.seed, guess) for r in range(len(self.rows))]
        self.typical = typical_forces(problem, self.seed, first)
        starts = [PathFit((), self._intensity(share), self.seed, guess, first) for share in _SHARES]
        return fit_paths(self.stepper, starts, priors, self.rows, self._path_steps)

    def _intensity(self, share: float) -> np.ndarray:
        """Squared force times the time over which it would be felt: a tenth of the shortest recording's length."""
        length = min(r.times[n - 1] - r.times[0] for r, n in zip(self.problem.rows, self.rows, strict=True))
        return (share * np.maximum(self.typical, 1e-300)) ** 2 * length / 10

    def _rough_noise(self) -> np.ndarray:
        """Reading noise from third differences, which a smooth motion hardly has."""
        out = []
        for j, known in enumerate(self.problem.noise):
            columns = [r.readings[:n, j] for r, n in zip(self.problem.rows, self.rows, strict=True)]
            joined = np.concatenate([np.diff(column, 3) ** 2 / 20 for column in columns])
            spread = np.nanstd(np.concatenate(columns))
            rough = np.sqrt(np.nanmedian(joined) / 0.455) if np.isfinite(joined).any() else spread
            count = max(1.0, float(np.median(self.problem.rows[0].counts[:, j])))
            out.append(known if np.isfinite(known) else max(rough, 1e-6 * spread) * np.sqrt(count))
        return np.array(out)

    def _filtered_path(self, r: int, z: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """A path near the readings: filtered with a strong missing force, from a wide initial state."""
        problem, course = self.problem, self.stepper.courses[r]
        x = z[r * problem.state : (r + 1) * problem.state]
        spread = np.diag(np.maximum(0.05 * np.abs(x), 1e-3 * np.abs(x).max() + 1e-12) ** 2)
        spread[problem.initial.sd == 0] = 0.0
        force = typical_forces(problem, z, [np.tile(x, (1, 1))] * len(self.rows))
        span = float(np.median(np.diff(problem.rows[r].times)))
        intensity = np.maximum(force, np.abs(force).max() * 1e-3) ** 2 * span * 10
        _, filtered = run_filter(problem, course, r, z, (), noise, 0 * noise, intensity, spread, self.rows[r])
        means = np.array(filtered.filtered_means[: self.rows[r]])
        means[0] = x
        return means if bool(filtered.ok) else np.tile(x, (self.rows[r], 1))

    def _proposals(self, size: int) -> list[Combination]:
        """Combinations of one size: every single effect, then what extends the best of the size below."""
        searched = self.problem.searched
        if size == 1:
            return [(), *((c,) for c in searched)]
        if size == 2 and len(searched) <= 12:
            return list(combinations(searched, 2))
        known = [c for c in self.found.estimates if len(c) == size - 1 and c]
        top = max((self.found.best(c) for c in known), default=-np.inf)
        ranked = sorted(known, key=self.found.best, reverse=True)
        kept = [c for c in ranked if self.found.best(c) > top - _REACH][:_KEPT] or ranked[:_KEPT]
        if size == 2:
            kept = ranked[:_KEPT]
        more = {tuple(sorted((*c, one))) for c in kept for one in searched if one not in c}
        return sorted(more)

    def _exchange(self, size: int) -> None:
        """Exchange single members of the best combinations of one size, so that no rival is missed."""
        if size == 1 or self._long or not self._in_time():
            return
        mine = sorted((c for c in self.found.estimates if len(c) == size), key=self.found.best, reverse=True)
        swapped = {
            tuple(sorted((*c[:k], *c[k + 1 :], one)))
            for c in mine[: _KEPT // 2]
            for k in range(size)
            for one in self.problem.searched
            if one not in c
        }
        missing = sorted(swapped - set(self.found.estimates))
        if missing:
            self.progress(f"exchanging members: {len(missing)} more combinations of {size} effects")
            self._weigh(missing)

    def _gained(self, size: int) -> bool:
        """Whether the best of this size beats the best of smaller ones, so that a larger one may be worth it."""
        smaller = max(self.found.best(c) for c in self.found.estimates if len(c) < size)
        return max(self.found.best(c) for c in self.found.estimates if len(c) == size) > smaller

    def _weigh(self, candidates: Sequence[Combination]) -> None:
        """Fit and weigh combinations; on a long recording most are dropped after its first part."""
        start = np.tile(self.seed, (len(candidates), 1))
        start[:, self.problem.head + self.problem.calibrated.size :] = 0.0
        growing = self._windows()
        cut = self._first_part(growing)
        if cut < len(growing) and len(candidates) > _KEPT:
            fits = grow(self.stepper, start, candidates, self.found.priors, growing[:cut], final=20)
            values = [e.log_evidence for e in weigh_white(self.problem, fits, self.found.priors, growing[cut - 1])]
            order = [int(k) for k in np.argsort(values)[::-1]]
            kept = sorted(order[:_KEPT], key=lambda k: -values[k]) + [k for k in order[_KEPT:] if not candidates[k]]
            start, candidates, growing = fits.z[kept], [candidates[k] for k in kept], growing[cut:]
        fits = grow(self.stepper, start, candidates, self.found.priors, growing)
        for estimate in weigh_white(self.problem, fits, self.found.priors, self.rows):
            self.found.add(estimate)
        for estimate in weigh_coloured(self.problem, fits, self.found.priors, self.rows):
            self.found.add(estimate)

    @property
    def _long(self) -> bool:
        """Whether the recordings are too long for every combination to see all of them."""
        return self._first_part(self._windows()) < len(_GROWTH)

    @property
    def _path_steps(self) -> int:
        return 8 if self._long else 16

    def _first_part(self, growing: list[list[int]]) -> int:
        """How many of the growing windows are affordable for every combination."""
        pieces = self.problem.rows[0].spans.inputs.shape[1]
        return max(1, sum(sum(rows) * pieces <= _AFFORDABLE for rows in growing))

    def _weigh_subsets(self) -> None:
        """What the best combinations become without each of their members, where that was not weighed yet."""
        ranked = sorted((c for c in self.found.estimates if c), key=self.found.best, reverse=True)[:_KEPT]
        less = dict.fromkeys(c[:k] + c[k + 1 :] for c in ranked for k in range(len(c)))
        missing = [c for c in less if c and c not in self.found.estimates]
        if missing:
            self._weigh(missing[:_KEPT])

    def _weigh_forces(self) -> None:
        """Best combinations again, each with a missing force beside it."""
        named = [c for c in self.found.estimates if c]
        contenders = sorted(named, key=self.found.best, reverse=True)[: _KEPT // 2 if self._long else _KEPT]
        null = max(self.null_paths, key=lambda fit: fit.log_evidence)
        starts = []
        for c in contenders:
            white = self.found.of(c, "white")
            assert white is not None  # every combination is weighed under white noise first
            for share in _SHARES[: -1 : 2 if self._long else 1]:
                starts.append(PathFit(c, self._intensity(share), white.z, null.noise, null.paths))
        self._add_paths(fit_paths(self.stepper, starts, self.found.priors, self.rows, self._path_steps))

    def _add_paths(self, fits: Sequence[PathFit]) -> None:
        """Of the intensities tried for each combination, the best, owing for the choice."""
        for combination in dict.fromkeys(fit.combination for fit in fits):
            mine = [fit for fit in fits if fit.combination == combination]
            values = np.array([fit.log_evidence for fit in mine])
            if not np.isfinite(values).any():
                continue
            best = mine[int(np.argmax(values))]
            assert best.laplace is not None  # its evidence is finite
            mean = values.max() + np.log(np.mean(np.exp(values - values.max())))
            self.found.add(
                Estimate(
                    combination,
                    "force",
                    best.z,
                    best.laplace.covariance,
                    best.noise,
                    float(mean),
                    best.converged,
                    intensity=best.intensity,
                    paths=best.paths,
                )  # fmt: skip
            )
