"""Everything that was weighed, by combination and kind of remainder."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.optimize import lsq_linear
from scipy.special import logsumexp

from ._calibrate import Priors
from ._prices import Prices
from ._problem import Combination, Problem
from ._weighed import Estimate, Mode

# Two optima whose places differ by more than this many standard deviations are two modes.
_APART = 2.0
# Outliers are larger than this many times the noise.
_FAR = 3.0
# Nats that an estimate which did not converge must be ahead to be reported nevertheless.
UNCONVERGED = 3.0
# Directions of a covariance below this share of its longest are round-off.
_FLATTEST = 1e-12


@dataclass(frozen=True)
class Ahead:
    """How a combination predicts rows that a trajectory fit has not seen: a score in nats, at most zero, whether it
    errs there hardly more than where it was fitted, and whether clearly less than the simulation as it is."""

    score: float
    holds: bool
    is_better: bool


def speaker(estimates: Sequence[Estimate]) -> Estimate:
    """The estimate of the best kind of remainder; one that converged is preferred to one barely ahead that did not."""
    return max(estimates, key=lambda e: e.log_evidence - (0.0 if e.converged else UNCONVERGED))


def doubtful_outliers(problem: Problem, taken_out: Combination, best: Estimate) -> frozenset[int]:
    """Columns of which readings were taken out that the best answer leaves in, or has off by little more than the
    noise."""
    sizes, columns = dict(enumerate(best.outliers)), {m: problem.candidate(m).place for m in taken_out}
    small = {j for j, (_, size) in sizes.items() if size < _FAR * best.noise[j]}
    return frozenset(j for m, j in columns.items() if m not in best.combination or j in small)


def within_bounds(problem: Problem, priors: Priors, estimate: Estimate) -> Estimate:
    """The most probable one of those that signs and bounds allow: a step about a fit may end beyond, where no friction
    is, and no frequency was looked for."""
    lower, upper = priors.bounds_of(problem, estimate.combination)
    for k, low in problem.lower_bounds(estimate.combination).items():
        lower[k] = max(lower[k], low)
    z, spread = estimate.z, estimate.covariance
    if np.all((lower <= z) & (z <= upper)):
        return estimate
    held = np.flatnonzero((np.isfinite(lower) | np.isfinite(upper)) & (np.diagonal(spread) > 0.0))
    # All else follows what is held, so that only these are looked for, in their own widths.
    scales = np.sqrt(np.diagonal(spread)[held])
    values, vectors = np.linalg.eigh(spread[np.ix_(held, held)] / np.outer(scales, scales))
    root = (vectors / np.sqrt(np.maximum(values, _FLATTEST * values[-1]))).T / scales
    found = lsq_linear(root, root @ z[held], (lower[held], upper[held]), method="bvls").x
    follow = spread[:, held] @ (root.T @ (root @ (found - z[held])))
    moved = z + follow
    moved[held] = found
    return replace(estimate, z=moved)


@dataclass
class Found:
    """Estimates by combination, one per kind of remainder; where the places of its effects have several optima, they
    are its modes."""

    problem: Problem
    priors: Priors
    estimates: dict[Combination, list[Estimate]] = field(default_factory=dict)
    complete: bool = True
    ahead: dict[Combination, Ahead] = field(default_factory=dict)  # of the likeliest, beside a clear remainder
    is_fine: bool = True  # whether substeps are as short as the readings ask

    def add(self, estimate: Estimate) -> None:
        """Keep an estimate beside those of the same combination and kind, as a mode where it stands apart; one whose
        trajectory ran away, without a number for its evidence, is as unlikely as can be."""
        if np.isnan(estimate.log_evidence):
            estimate = replace(estimate, log_evidence=-np.inf)
        kinds = self.estimates.setdefault(estimate.combination, [])
        old = self.of(estimate.combination, estimate.kind)
        if old is None:
            kinds.append(replace(estimate, modes=(Mode(estimate.log_evidence, estimate.z, estimate.covariance),)))
            return
        kinds[kinds.index(old)] = self._joined(old, estimate)

    def _joined(self, old: Estimate, new: Estimate) -> Estimate:
        """The better of two estimates, with the modes of both; its evidence is that of all modes together."""
        modes = list(old.modes)
        one = Mode(new.log_evidence, new.z, new.covariance)
        same = [k for k, mode in enumerate(modes) if not self._apart(old.combination, mode, one)]
        if same:
            best = max([one, *(modes[k] for k in same)], key=lambda mode: mode.log_evidence)
            modes = [mode for k, mode in enumerate(modes) if k not in same] + [best]
        elif np.isfinite(one.log_evidence):
            modes.append(one)
        top = max(mode.log_evidence for mode in modes)
        lead = UNCONVERGED * (int(old.converged) - int(new.converged))
        better = new if one.log_evidence >= max(mode.log_evidence for mode in old.modes) + lead else old
        total = float(logsumexp([mode.log_evidence for mode in modes])) if np.isfinite(top) else -np.inf
        return replace(better, log_evidence=total, modes=tuple(modes))

    def settle(self, old: Estimate, new: Estimate) -> None:
        """Put an estimate in the place of one of the same combination and kind whose point is not its own optimum."""
        one = Mode(new.log_evidence, new.z, new.covariance)
        modes = tuple(one if np.array_equal(mode.z, old.z) else mode for mode in old.modes)
        total = float(logsumexp([mode.log_evidence for mode in modes]))
        kinds = self.estimates[old.combination]
        kinds[kinds.index(old)] = replace(new, log_evidence=total, modes=modes)

    def _apart(self, combination: Combination, a: Mode, b: Mode) -> bool:
        """Whether some effect has its place elsewhere."""
        for member, place in self.problem.placed(combination):
            if self.problem.candidate(member).effect.places:
                k = place.stop - 1
                sd = np.sqrt(max(a.covariance[k, k], b.covariance[k, k]))
                if abs(a.z[k] - b.z[k]) > _APART * sd:
                    return True
        return False

    def stand_by(self, other: "Found") -> None:
        """Keep what another search weighed and this one did not, as far as it is less likely than the best here."""
        top = max(map(self.odds, self.estimates))
        for combination, estimates in other.estimates.items():
            if combination not in self.estimates and other.odds(combination) < top:
                self.estimates[combination] = estimates

    def of(self, combination: Combination, kind: str) -> Estimate | None:
        """The estimate of a combination under one kind of remainder, None where there is none."""
        return next((e for e in self.estimates.get(combination, []) if e.kind == kind), None)

    def best(self, combination: Combination) -> float:
        """The largest log evidence of a combination over kinds."""
        return max((e.log_evidence for e in self.estimates[combination]), default=-np.inf)

    def white(self, combination: Combination) -> float:
        """Log evidence of a combination under white noise alone."""
        one = self.of(combination, "white")
        return -np.inf if one is None else one.log_evidence

    @cached_property
    def prices(self) -> Prices:
        """The prior of every combination."""
        return Prices(self.problem)

    def odds(self, combination: Combination) -> float:
        """The same with the combination's prior: what its probability goes with."""
        return self.best(combination) + self.prices.log(combination)

    def near(self, reach: float, most: int) -> list[Combination]:
        """The likeliest, so many at most that are no more nats behind the best; and as many of those with a word for
        everything that are no farther behind the best of these: a law without a word explains what no name explains,
        and is no better extrapolation.

        What did not converge may promise more than there is; it is among them, but nothing falls behind it.
        """
        ranked = sorted(self.estimates, key=self.odds, reverse=True)
        chosen: set[Combination] = set()
        for alike in (ranked, [c for c in ranked if not self.has_law(c)]):
            sound = [e.log_evidence + self.prices.log(c) for c in alike for e in self.estimates[c] if e.converged]
            chosen |= {c for c in alike[:most] if self.odds(c) > max(sound, default=-np.inf) - reach}
        return [c for c in ranked if c in chosen]

    def has_law(self, combination: Combination) -> bool:
        """Whether a combination holds a force without a word."""
        return any(self.problem.candidate(m).nameless is not None for m in combination)

    def told(self, combination: Combination, best: Estimate) -> Estimate:
        """The estimate whose numbers are told: the best one; where a clear remainder is left, the trajectory fit if
        that holds on ahead, as wide as its errors are long-lived."""
        one = self.ahead.get(combination)
        return self._trajectory_fit(combination, best) if one is not None and one.holds else best

    def shown(self, combination: Combination, best: Estimate) -> Estimate:
        """The estimate to run on: the one that is told, as far as its signs and bounds allow. But a clock that may
        wander excuses the phase, which a run goes on from; there the best of the others, of which the evidence of one
        that did not converge says nothing, however large. Where the remainder is clear, an error of the sensor that
        remembers itself is as much of a guess, and the fit that has made the run itself as near as can be runs on."""
        told = self.told(combination, best)
        others = [one for one in self.estimates[combination] if one.kind != told.kind]
        done = [one for one in others if one.converged]
        run_on = speaker(done) if told.kind == "clock" and done else told
        # Whether a fit beside coloured errors is done does not matter where its place is another's.
        first = speaker(others) if told.kind == "clock" and others else told
        if "coloured" in (run_on.kind, first.kind) and combination in self.ahead:
            run_on = self._trajectory_fit(combination, run_on)
        return within_bounds(self.problem, self.priors, run_on)

    def _trajectory_fit(self, combination: Combination, other: Estimate) -> Estimate:
        """The fit under white noise, as wide as its errors are long-lived; another one where that did not converge."""
        white = self.of(combination, "white")
        if white is None or not white.converged:
            return other
        return replace(white, covariance=white.covariance * white.inflation)
