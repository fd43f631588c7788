"""One hypothesis shown on the recordings: filtered where it was fitted, run freely where it was not."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline

from .._filter import Filtered
from .._smoother import Smoothed
from ._along import What, along, readings
from ._bend import bent
from ._held_out import HeldOut, one_off
from ._lasting import colour_ratio, total_noise
from ._path_filter import Slopes, filter_along, prolonged, smooth
from ._reach import covariance_within_reach
from ._stochastic import free_run, row_roots
from ._trajectory import Stepper
from ._weighed import Estimate


def intensity_of(stepper: Stepper, estimate: Estimate) -> Float[np.ndarray, " d"]:
    """Intensity of the missing force, zero where the remainder is not one."""
    return np.zeros(stepper.problem.equations.dim) if estimate.intensity is None else estimate.intensity


@dataclass(frozen=True, eq=False)
class Outlook:
    """An estimate on one recording. Times, readings and predictions are by row after thinning.

    Where no force disturbs the motion, it is the fitted trajectory; else a filter goes about the most probable path.
    Sigma points, as far apart as the start is uncertain, may lose either: about an eccentric orbit they were seen to
    end some five hundred times too far out.
    """

    stepper: Stepper
    estimate: Estimate
    recording: int
    intensity: Float[np.ndarray, " d"]
    exposures: tuple[np.ndarray, ...] | None = None  # where the missing force does not always act
    near: "Outlook | None" = None  # one that begins close by, within the same reach

    @property
    def rows(self) -> Any:
        return self.stepper.problem.rows[self.recording]

    @cached_property
    def _filtered(self) -> tuple[Filtered, Slopes]:
        """About the estimate's most probable path, or about its trajectory."""
        e, r, n = self.estimate, self.recording, self.rows.fitted
        path = self._trajectory[1][:n] if e.paths is None else e.paths[r]
        return filter_along(
            self.stepper, r, e.z, e.combination, prolonged(self.stepper, r, e.z, e.combination, path), total_noise(e),
            colour_ratio(e), self.intensity, self._start_spread, self._straight[:n], self.exposures,
        )  # fmt: skip

    @cached_property
    def _straight(self) -> Float[np.ndarray, "time channel"]:
        """The readings less the error that goes with what is read, as far as that is known."""
        if not self.estimate.bends:
            return self.rows.readings
        expected = self._run(self._begin, 0)[0]
        return self.rows.readings - np.nan_to_num(bent(expected, self.rows.times, self.estimate.bends) - expected)

    @cached_property
    def _within_reach(self) -> Float[np.ndarray, "local local"]:
        """Posterior covariance of all that the recording depends on, as far as the Gaussian holds for its start."""
        if self.near is not None:
            return self.near._within_reach
        return covariance_within_reach(self.stepper, self.estimate, self.recording)

    @property
    def _start_spread(self) -> Float[np.ndarray, "state state"]:
        return self._within_reach[: self.stepper.problem.state, : self.stepper.problem.state]

    @property
    def _is_free(self) -> bool:
        """Whether no force disturbs the motion."""
        return not self.intensity.any()

    @cached_property
    def _trajectory(self) -> tuple[Float[np.ndarray, "time channel"], Float[np.ndarray, "time state"]]:
        return self._run(self._begin, 0)

    @property
    def _begin(self) -> Float[np.ndarray, " state"]:
        """The phase point at the first row."""
        state = self.stepper.problem.state
        return self.estimate.z[self.recording * state : (self.recording + 1) * state]

    @property
    def ok(self) -> bool:
        """Whether the filter, or the trajectory, went through the fitted rows."""
        states = self._trajectory[1] if self._is_free else self._filtered[0].filtered_means
        return bool(np.isfinite(states[: self.rows.fitted]).all())

    @cached_property
    def smoothed(self) -> Smoothed:
        """State and noises given all fitted rows."""
        return smooth(*self._filtered)

    @cached_property
    def last_state(self) -> Float[np.ndarray, " state"]:
        """The phase point filtered at the last fitted row; the trajectory's own where nothing disturbs it, or where the
        filter failed."""
        last = self.rows.fitted - 1
        if self.ok and not self._is_free:
            return np.asarray(self._filtered[0].filtered_means[last])
        return self._trajectory[1][last]

    @cached_property
    def states(self) -> Float[np.ndarray, "fitted state"]:
        """Phase points over the fitted rows, given all of these."""
        states = self._trajectory[1] if self._is_free else self.smoothed.means
        return np.asarray(states[: self.rows.fitted])

    @cached_property
    def readings(self) -> Float[np.ndarray, "time channel"]:
        """Filtered readings over the fitted rows, then the free run."""
        whole = np.concatenate([self.followed[: self.rows.fitted - 1], self.run])
        return np.where(np.isfinite(whole), whole, np.nan)

    @cached_property
    def run(self) -> Float[np.ndarray, "row channel"]:
        """Readings of the free run, from the last fitted row on."""
        last = self.rows.fitted - 1
        shown = self._trajectory[0][last:] if self._is_free else self._run(self.last_state, last)[0]
        return bent(shown, self.rows.times[last:], self.estimate.bends)

    @cached_property
    def followed(self) -> Float[np.ndarray, "fitted channel"]:
        """Readings of the filtered phase points over the fitted rows."""
        if self._is_free:
            shown = self._trajectory[0][: self.rows.fitted]
        else:
            shown = self.along(readings, np.asarray(self._filtered[0].filtered_means[: self.rows.fitted]))
        return bent(shown, self.rows.times[: self.rows.fitted], self.estimate.bends)

    def along(self, what: What, states: Float[np.ndarray, "row state"]) -> np.ndarray:
        """Something that the augmented simulation has at phase points of the leading rows."""
        e = self.estimate
        return along(self.stepper.problem, what, self.recording, e.z, e.combination, states)

    @cached_property
    def innovations(self) -> Float[np.ndarray, "fitted channel"]:
        """Standardised innovations of the fitted rows, of a trajectory its errors by the noise; 0 where nothing was
        read."""
        if self._is_free:
            errors = (self.rows.readings - self.readings) / self._noise
            return np.where(np.isnan(self.rows.readings), 0.0, errors)[: self.rows.fitted]
        return np.asarray(self._filtered[0].standardised_innovations[: self.rows.fitted])

    def held_out_errors(self, times: np.ndarray, readings: np.ndarray) -> Float[np.ndarray, "row channel"]:
        """Readings minus the free run at original times after the last fitted row; NaN where nothing was read."""
        run = self.readings[self.rows.fitted - 1 :]
        if not np.isfinite(run).all():
            return np.full_like(readings, np.nan)
        path = self.rows.times[self.rows.fitted - 1 :]
        if len(run) > 3:
            return readings - CubicSpline(path, run)(times)
        return readings - np.stack([np.interp(times, path, column) for column in run.T], axis=1)

    def held_out(self, inflation: float) -> HeldOut:
        """How held-out rows lie around the free run, with the spread of the filter and of the unknowns; `inflation`
        multiplies their posterior covariance."""
        first = self.rows.fitted
        return HeldOut((self.rows.readings - self.readings)[first:], self._scatter[first:] + self._unsure(inflation))

    @cached_property
    def _scatter(self) -> Float[np.ndarray, "time channel"]:
        """Variance of every reading when the unknowns are known: of the noise, and of what the filter cannot tell."""
        if self._is_free:
            return self._noise**2
        S = np.asarray(self._filtered[0].innovation_covariances[: len(self.rows.times)])
        return np.diagonal(S, axis1=1, axis2=2) / self._roots() ** 2

    def _unsure(self, inflation: float) -> Float[np.ndarray, "held channel"]:
        """Variance of the held-out free run that unknown parameters leave: each of them off by one standard deviation
        in turn, those before it being known and the start following; and, of a trajectory, what is left of the start.
        What diverges then says nothing."""
        variance, start = np.zeros_like(self.run), self._within_reach if self._is_free else None
        for z in one_off(self.stepper.problem, self.estimate, self.recording, inflation, start):
            other = replace(self, estimate=replace(self.estimate, z=z), near=self)
            variance += np.nan_to_num((other.run - self.run) ** 2, posinf=0.0)
        return variance[1:]

    @property
    def _noise(self) -> Float[np.ndarray, "time channel"]:
        """Standard deviation of the reading error in every row."""
        return total_noise(self.estimate) / self._roots()

    def _roots(self) -> np.ndarray:
        return row_roots(self.stepper.problem, self.recording, len(self.rows.times), colour_ratio(self.estimate))

    def missing_force(self) -> Float[np.ndarray, "fitted coordinate"]:
        """Smoothed missing force on every momentum, in units of dp/dt, by fitted row (the last span's twice)."""
        n = self.rows.fitted
        if self._is_free:
            return np.zeros((n, self.stepper.problem.equations.dim))
        xi = np.asarray(self.smoothed.disturbances[: n - 1, self.stepper.problem.equations.momentum])
        force = xi / np.diff(self.rows.times[:n])[:, None]
        return np.concatenate([force, force[-1:]])

    def strain(self) -> Float[np.ndarray, "fitted coordinate"]:
        """Standardised smoothed disturbances of every momentum."""
        n = self.rows.fitted
        if self._is_free:
            return np.zeros((n, self.stepper.problem.equations.dim))
        series = np.asarray(self.smoothed.standardised_disturbances[: n - 1, self.stepper.problem.equations.momentum])
        return np.concatenate([series, series[-1:]])

    def _run(self, x: np.ndarray, start: int) -> Any:
        p, e = self.stepper.problem, self.estimate
        return free_run(p, self.stepper.courses[self.recording], e.z, e.combination, self.recording, x, start)
