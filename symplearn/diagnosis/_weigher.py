"""Fitting and weighing combinations under every remainder, with outliers taken out where there are some."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from .._effects import OUTLIERS, STOP
from ._along import along, readings
from ._calibrate import Fits, Priors, grow, residuals, weight_of, weights
from ._clock import weigh_known_clock
from ._coloured import Colour
from ._found import Found
from ._jitter import weigh_jitter
from ._magnitude import strength_gain
from ._noisy import PathFit, fit_paths
from ._positional import weigh_positional
from ._problem import USUAL, Combination, Problem
from ._scatter import law_gain, outlier_evidence, outliers, suspects
from ._score import Start
from ._start import windows
from ._static import weigh_static
from ._trajectory import Stepper
from ._weighed import Estimate, standardised, weigh_coloured, weigh_white

# A window grows in these steps, so that a trajectory fit is not caught in a local minimum.
_GROWTH = (0.02, 0.04, 0.08, 0.16, 0.32, 0.64, 1.0)
# Substeps over all rows beyond which the search is narrowed before the whole recording is used, and to how many.
_AFFORDABLE = 12_000
KEPT = 8
# How often paths are fitted anew without the readings that lie far off them.
_CLEARED = 3
# Nats behind the best after most of the rows that no effect catches up in the rest.
_BEHIND = 40.0


class Weigher:
    """Fits and weighs combinations of effects on given recordings, and keeps what it found.

    `base` are the outliers that were taken out beforehand: every combination holds them.
    """

    def __init__(self, stepper: Stepper, found: Found):
        self.plain = self.stepper = stepper
        self.found = found
        self.rows = [r.fitted for r in stepper.problem.rows]
        self.base: Combination = ()
        # Effects in the largest combination that is tried.
        self.most = USUAL
        # Log evidence of the readings that were taken out: by the errors of each white fit, and by those of the path
        # that they were found to lie off.
        self.owed: dict[Combination, float] = {}
        self.owed_along = 0.0
        self.flagged = [np.zeros_like(r.readings, bool) for r in stepper.problem.rows]
        # Errors of sensor and clock that everything was weighed beside.
        self.shared: list[tuple[tuple[Colour, ...], tuple[Colour, ...]]] = []

    @property
    def problem(self) -> Problem:
        return self.stepper.problem

    def is_many(self, size: int) -> bool:
        """Whether so many effects, outliers that are taken out aside, are more than usual."""
        return size + len(self.base) > USUAL

    def moved_to(self, stepper: Stepper, found: Found) -> None:
        """Go on with another stepper of the same recordings."""
        self.plain = self.stepper = stepper
        if any(bad.any() for bad in self.flagged):
            self.stepper = stepper.on(stepper.problem.without(self.flagged))
        self.found, self.shared = found, []

    def take_out_outliers(self, fits: Sequence[PathFit], priors: Priors, spared: frozenset[int] = frozenset()) -> bool:
        """Leave out the readings that lie far off the path that is likeliest without them, but for the columns that are
        `spared`; whether there are any.

        Every path loses its own: one that a strong missing force may bend goes through outliers and shows few.
        """
        problem = self.plain.problem
        columns = self.outlier_columns
        able = (columns.keys() | set(problem.known_outliers)) - spared
        may = np.array([j in able for j in range(problem.channels)])
        lanes = [fit for fit in fits if np.isfinite(fit.log_evidence)]
        for _ in range(_CLEARED):
            far = [self._far(fit, may) for fit in lanes]
            if not any(bad.any() for masks in far for bad in masks):
                return False
            if all(map(_are_left_out, lanes, far)):
                break
            lanes = [replace(fit, left_out=masks, laplace=None) for fit, masks in zip(lanes, far, strict=True)]
            lanes = fit_paths(self.plain, lanes, priors, self.rows, self.path_steps)
        best = max(lanes, key=self._with_outliers)
        assert best.left_out is not None  # so it is asked
        some = np.any([bad.any(0) for bad in best.left_out], axis=0)
        members = tuple(sorted(m for j, m in columns.items() if some[j]))[: USUAL - 1]
        self.leave_out(best.left_out, members, self._path_owed(best, members) if members else 0.0)
        return bool(some.any())

    def _far(self, fit: PathFit, may: np.ndarray) -> tuple[np.ndarray, ...]:
        """Readings far off one path, of the channels that may have outliers."""
        return tuple(bad & may for bad in suspects([self._path_errors(fit, r) for r in range(len(self.rows))]))

    def _with_outliers(self, fit: PathFit) -> float:
        """Log evidence of a path and of what was left out of it."""
        assert fit.left_out is not None  # this is asked after a fit without them
        flagged = np.concatenate(fit.left_out)
        members = tuple(m for m in self.plain.problem.searched if self.plain.problem.candidate(m).effect is OUTLIERS
                        and flagged[:, self.plain.problem.candidate(m).place].any())  # fmt: skip
        return fit.log_evidence + self._path_owed(fit, members)

    def _path_owed(self, fit: PathFit, members: Combination) -> float:
        """Log evidence of what was left out of a path."""
        assert fit.left_out is not None
        errors = np.concatenate([self._path_errors(fit, r) for r in range(len(self.rows))])
        flagged = np.concatenate(fit.left_out)
        # A path that a strong force bends towards every reading leaves less than the noise, which is no smaller for it;
        # where the noise is given, the evidence takes it as it is.
        used = np.isfinite(errors) & ~flagged
        rest = np.sqrt((np.where(used, errors, 0.0) ** 2).sum(0) / np.maximum(used.sum(0), 1))
        less = np.isnan(self.problem.noise) & (rest > 0) & (rest < 1)
        weight = np.concatenate(weights(self.plain.problem, self.rows))
        return self.owed_for(members, errors / np.where(less, rest, 1.0), flagged, fit.noise, weight)

    def owed_for(
        self, members: Combination, errors: np.ndarray, flagged: np.ndarray, noise: np.ndarray, weight: np.ndarray
    ) -> float:
        """Log evidence of the readings that were taken out, as a density in their own unit; one that averages several
        errs by less."""
        value = outlier_evidence(members, self.plain.problem, errors, flagged)
        return value - float((flagged * (np.log(noise) - 0.5 * np.log(np.where(flagged, weight, 1.0)))).sum())

    def _path_errors(self, fit: PathFit, r: int) -> np.ndarray:
        """Readings less those on a path, by their noise; NaN where nothing was read."""
        read = self.plain.problem.rows[r].readings[: self.rows[r]]
        shown = along(self.problem, readings, r, fit.z, (), fit.paths[r])
        weight = weight_of(self.plain.problem.rows[r].counts[: self.rows[r]])
        return np.where(weight > 0, np.sqrt(weight) * (read - shown) / fit.noise, np.nan)

    def weigh(self, starts: Sequence[Start], whole: bool = False) -> None:
        """Fit and weigh combinations; on a long recording most are dropped after its first part.

        With `whole`, all rows are fitted at once: the starts are good already. A score's whole step may lead too far
        for that; what has no place, which a fit could not find from nothing, begins where the score was taken.
        """
        z = np.stack([start.z if not whole or start.still is None or self._is_placed(start) else start.still
                      for start in starts])  # fmt: skip
        candidates = [start.combination for start in starts]
        held = np.array([self._is_held(one) for one in starts])
        growing = self._windows()[-1:] if whole else self._windows()
        cut = len(growing) if whole else self._first_part(growing)
        priors = self.found.priors
        if cut < len(growing) and len(candidates) > KEPT:
            fits = grow(self.stepper, z, candidates, priors, growing[:cut], final=20, held=held)
            values = self._whites(fits, growing[cut - 1])
            ranked = [int(k) for k in np.argsort(-np.where(np.isnan(values), -np.inf, values))]
            # Beside the best some whose time may yet come.
            kept = list(dict.fromkeys([*ranked[:KEPT], *[k for k in ranked if held[k]][:KEPT]]))
            z, candidates, held, growing = fits.z[kept], [candidates[k] for k in kept], held[kept], growing[cut:]
        elif len(growing) > 1 and len(candidates) > KEPT:
            # Who is far behind after most of the rows is not fitted to all of them, unless its time may yet come.
            fits = grow(self.stepper, z, candidates, priors, growing[:-1], final=12, held=held)
            values = self._whites(fits, growing[-2])
            # Of what is done, too: what is not may promise more than there is.
            near = values >= np.nanmax(values) - _BEHIND
            near |= fits.converged & (values >= np.nanmax(values[fits.converged], initial=-np.inf) - _BEHIND)
            kept = [int(k) for k in np.nonzero(held | near)[0]]
            z, candidates, held, growing = fits.z[kept], [candidates[k] for k in kept], held[kept], growing[-1:]
        fits = grow(self.stepper, z, candidates, priors, growing, held=held)
        for b, estimate in enumerate(weigh_white(self.problem, fits, priors, self.rows)):
            self._add(estimate, *self._outliers(fits, b))
        correlated = weigh_coloured(self.problem, fits, priors, self.rows)
        sensors = weigh_positional(self.problem, fits, priors, self.rows)
        sensors += weigh_positional(self.problem, fits, priors, self.rows, moving=True)
        for estimate in correlated + sensors + weigh_jitter(self.problem, fits, priors, self.rows):
            self.add_beside_white(estimate)

    def weigh_static(self, combinations: Sequence[Combination]) -> None:
        """Weigh combinations, fitted before, beside a small force that goes with place."""
        for one in weigh_static(self.stepper, self.as_fitted(combinations), self.found.priors, self.rows):
            self.add_beside_white(one)

    def beside(self, estimate: Estimate, z: Float[np.ndarray, " z"]) -> Estimate:
        """One beside the remainder of another, which is one of the readings alone and keeps its form, about `z`; its
        evidence is without what the step from there promises."""
        p, own, rows = self.problem, [estimate.combination], self.rows
        predictions = self.stepper.predict(z[None], own, rows)
        fits = Fits(own, z[None], estimate.noise[None], predictions, np.zeros(1), np.zeros(1, bool))
        priors, kind = self.found.priors, estimate.kind
        if kind == "coloured":
            (one,) = weigh_coloured(p, fits, priors, rows)
        elif kind == "clock":
            one = weigh_known_clock(p, fits, priors, rows, estimate)
        elif kind == "jitter":
            (one,) = weigh_jitter(p, fits, priors, rows)
        else:
            form = estimate.bends[0].shapes.form if estimate.bends else None
            (one,) = weigh_positional(p, fits, priors, rows, kind == "kinematic", form)
        owed = self._owed_beside(estimate.combination)
        return replace(one, log_evidence=one.log_evidence + owed, outliers=estimate.outliers, converged=True)

    def as_fitted(self, combinations: Sequence[Combination]) -> Fits:
        """Combinations as they were fitted under white noise."""
        whites = [white for c in combinations if (white := self.found.of(c, "white"))]
        z, own = np.stack([one.z for one in whites]), [one.combination for one in whites]
        predictions = self.stepper.predict(z, own, self.rows)
        noise, converged = np.stack([one.noise for one in whites]), np.array([one.converged for one in whites])
        unearned = np.array([one.unearned for one in whites])
        return Fits(own, z, noise, predictions, np.zeros(len(z)), converged, unearned)

    def _whites(self, fits: Fits, rows: list[int]) -> np.ndarray:
        """Log evidences under white noise, by lane, with what unfinished fits promise."""
        fits = replace(fits, converged=np.ones(len(fits.z), bool), unearned=None)
        return np.array([e.log_evidence for e in weigh_white(self.problem, fits, self.found.priors, rows)])

    def _add(self, estimate: Estimate, value: float, told: tuple[tuple[float, float], ...]) -> None:
        self.owed[estimate.combination] = value
        owed = value if estimate.converged else self._owed_beside(estimate.combination)
        self.found.add(replace(estimate, log_evidence=estimate.log_evidence + owed, outliers=told))

    def add_beside_white(self, estimate: Estimate) -> None:
        """Add an estimate under another remainder than white noise."""
        white = self.found.of(estimate.combination, "white")
        owed, told = self._owed_beside(estimate.combination), white.outliers if white else ()
        self.found.add(replace(estimate, log_evidence=estimate.log_evidence + owed, outliers=told))

    def _owed_beside(self, combination: Combination) -> float:
        """What the readings that were taken out owe where errors are not those of the white fit: beside a remainder,
        or where the fit is still on its way. A fit far off would be granted what its own evidence does not lose."""
        own = self.owed.get(combination, 0.0)
        return min(own, self.owed_along) if self.base else own

    def _is_placed(self, start: Start) -> bool:
        """Whether the effect that a score added has a place."""
        assert start.still is not None  # asked of scores only
        ones = [(self.problem.candidate(m).effect, place) for m, place in self.problem.placed(start.combination)]
        return any(one.places and not start.still[place][: one.amplitudes].any() for one, place in ones)

    def _is_held(self, start: Start) -> bool:
        """Whether effects keep their values in early windows, which say nothing of a late jump or a slow beat."""
        ones = [self.problem.candidate(m).effect for m in start.combination]
        return bool(np.any(start.z[self.problem.slots :])) and any(one.places and one is not STOP for one in ones)

    def _outliers(self, fits: Fits, lane: int) -> tuple[float, tuple[tuple[float, float], ...]]:
        """What outliers that were taken out owe, and their share and size by channel."""
        if not self.base:
            return 0.0, ()
        weight = weights(self.plain.problem, self.rows)
        r = residuals(self.plain.problem, fits.predictions, weight)
        errors = standardised([x[lane] for x in r], weight, fits.noise[lane])
        flagged = np.concatenate([bad[:n] for bad, n in zip(self.flagged, self.rows, strict=True)])
        told = [outliers(errors[:, j], flagged[:, j]) for j in range(self.problem.channels)]
        value = self.owed_for(self.base, errors, flagged, fits.noise[lane], np.concatenate(weight))
        return value, tuple((share, size * float(s)) for (share, size), s in zip(told, fits.noise[lane], strict=True))

    @property
    def outlier_columns(self) -> dict[int, int]:
        """The outliers that may be told of each column."""
        problem = self.plain.problem
        return {problem.candidate(m).place: m for m in problem.searched if problem.candidate(m).effect is OUTLIERS}

    def leave_out(self, far: Sequence[np.ndarray], members: Combination, owed_along: float) -> None:
        """Leave out these readings, by recording, and no others; every combination then holds the outliers `members`,
        which owe at most `owed_along` beside errors that are not those of a white fit."""
        self.flagged = [np.zeros_like(r.readings, bool) for r in self.plain.problem.rows]
        for flagged, bad in zip(self.flagged, far, strict=True):
            flagged[: len(bad)] = bad
        some = any(bad.any() for bad in far)
        self.stepper = self.plain.on(self.plain.problem.without(self.flagged)) if some else self.plain
        self.base, self.owed_along = members, owed_along

    def weigh_with_outliers_in(self) -> None:
        """The best combinations again with no reading taken out."""
        if not self.base:
            return
        ranked = sorted(self.found.estimates, key=self.found.best, reverse=True)[:KEPT]
        starts = {}
        for c in dict.fromkeys([self.base, *ranked]):
            white = self.found.of(c, "white")
            less = tuple(m for m in c if m not in self.base)
            if white is not None:
                starts[less] = Start(less, white.z, 0.0)
        clean, base = self.stepper, self.base
        self.stepper, self.base = self.plain, ()
        self.weigh(list(starts.values()), whole=True)
        self.stepper, self.base = clean, base

    def add_paths(self, fits: Sequence[PathFit]) -> None:
        """Of the intensities and spells tried for each combination, the best, owing for the choice."""
        for combination in dict.fromkeys(fit.combination for fit in fits):
            mine = [fit for fit in fits if fit.combination == combination]
            values = np.array([fit.log_evidence + self._granted(fit) - fit.choices for fit in mine])
            if not np.isfinite(values).any():
                continue
            best = mine[int(np.argmax(values))]
            assert best.laplace is not None  # its evidence is finite
            mean = values.max() + np.log(np.mean(np.exp(values - values.max())))
            white = self.found.of(combination, "white")
            self.found.add(
                Estimate(
                    combination,
                    "force" if best.exposures is None else "spell",
                    best.z,
                    best.laplace.covariance,
                    best.noise,
                    float(mean) + self._owed_beside(combination),
                    best.converged,
                    intensity=best.intensity,
                    exposures=best.exposures,
                    paths=best.paths,
                    outliers=white.outliers if white else (),
                )  # fmt: skip
            )

    def _granted(self, fit: PathFit) -> float:
        """What a path gains where noise may have heavier tails, and its effects be of any order of magnitude.

        Nothing of the former while it has not settled: errors after a step that a bound cut short are not those of its
        evidence.
        """
        if fit.laplace is None or fit.errors is None:
            return 0.0
        strength = strength_gain(self.problem, fit.combination, self.found.priors, fit.z, fit.laplace.covariance)
        return strength + (law_gain(self.problem, fit.combination, fit.errors) if fit.converged else 0.0)

    def may_matter(self, fit: PathFit, reach: float) -> bool:
        """Whether a path comes within so many nats of the best of all, should it go on as its last step promises."""
        if fit.laplace is None or not np.isfinite(fit.laplace.log_evidence):
            return False
        settled = replace(fit, converged=True)
        evidence = settled.log_evidence + self._granted(settled) - fit.choices + self._owed_beside(fit.combination)
        top = max(map(self.found.odds, self.found.estimates))
        return evidence + self.found.prices.log(fit.combination) > top - reach

    @property
    def is_long(self) -> bool:
        """Whether the recordings are too long for every combination to see all of them."""
        return self._first_part(self._windows()) < len(_GROWTH)

    @property
    def path_steps(self) -> int:
        return 8 if self.is_long else 16

    def _windows(self) -> list[list[int]]:
        return windows(self.rows, _GROWTH, max(8, 4 * self.problem.state))

    def _first_part(self, growing: list[list[int]]) -> int:
        """How many of the growing windows are affordable for every combination."""
        pieces = int(np.asarray(self.problem.rows[0].spans.pieces)[0])
        return max(1, sum(sum(rows) * pieces <= _AFFORDABLE for rows in growing))


def _are_left_out(fit: PathFit, masks: Sequence[np.ndarray]) -> bool:
    """Whether a path was fitted without exactly these readings."""
    return fit.left_out is not None and all(map(np.array_equal, fit.left_out, masks))
