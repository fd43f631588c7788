"""Slopes of readings: differences, and those of a path smoothed by total variation."""

import abc
from typing import Any

import equinox as eqx
import numpy as np
import scipy.linalg
import scipy.sparse
from jaxtyping import Float

from ._errors import InputError

_GAP = 1e-8  # what the smoothed path's objective may lie above its minimum, as a share of it
_ROUND_OFF = 1e-4  # the same, where round-off leaves no better
_SMOOTHING_STEPS = 100  # about 30 are usual

Rows = tuple[Float[np.ndarray, "row state"], Float[np.ndarray, "row state"]]


class AbstractDerivative(eqx.Module):
    """How slopes are taken from readings."""

    @abc.abstractmethod
    def __call__(self, times: Float[np.ndarray, " time"], readings: Float[np.ndarray, "time state"]) -> Rows:
        """Points of the path, and the slopes there. Rows that a missing reading leaves unknown hold NaN."""


class ForwardDifference(AbstractDerivative):
    """(y_k - y_{k-1}) / dt at y_{k-1}, of first order in dt: what (4.3) and Theorem 4 use."""

    def __call__(self, times: Float[np.ndarray, " time"], readings: Float[np.ndarray, "time state"]) -> Rows:
        return readings[:-1], np.diff(readings, axis=0) / np.diff(times)[:, None]


class CentralDifference(AbstractDerivative):
    """Slopes of the parabola through three neighbouring readings, of second order on any spacing.

    At the ends the parabola is the first or the last one. It needs three rows.
    """

    def __call__(self, times: Float[np.ndarray, " time"], readings: Float[np.ndarray, "time state"]) -> Rows:
        _require_three(times, "CentralDifference")
        return readings, np.gradient(readings, times, axis=0, edge_order=2)


class TotalVariation(AbstractDerivative):
    """Slopes of a smoothed path, for noisy readings: total-variation regularisation. Chartrand (2011).

    The path x of each state minimises integral (x - y)^2 dt / 2 + weight * (total variation of x'). Sampled as a
    polygon at the readings this is a convex problem with a banded matrix (the l1 trend filter of Kim, Koh, Boyd and
    Gorinevsky 2009), solved to a relative duality gap of 1e-8, or to round-off (1e-4 at worst). It gives the slope of
    each edge at the edge's middle. Corners, as of relaxation oscillations, stay; smooth motion becomes a staircase.

    Rows with a missing reading are bridged. `weight` is positive, in reading * time^2; larger is smoother. A hundredth
    to a tenth of (error standard deviation) * (data interval) * (period) is a start.

    **Raises:** `InputError` where fewer than three rows are complete, or the weight is too large for the gap.
    """

    weight: float = eqx.field(static=True, converter=float)

    def __check_init__(self):
        if not self.weight > 0:
            raise InputError(f"`TotalVariation` needs a positive weight, but was given {self.weight}.")

    def __call__(self, times: Float[np.ndarray, " time"], readings: Float[np.ndarray, "time state"]) -> Rows:
        whole = np.isfinite(readings).all(axis=1)
        times, readings = times[whole], readings[whole]
        _require_three(times, "TotalVariation")
        path = np.stack([_smooth_path(times, one, self.weight) for one in readings.T], axis=1)
        return 0.5 * (path[1:] + path[:-1]), np.diff(path, axis=0) / np.diff(times)[:, None]


def _require_three(times: np.ndarray, owner: str) -> None:
    if len(times) < 3:
        raise InputError(f"`{owner}` needs at least three complete rows of readings, but was given {len(times)}.")


def _smooth_path(times: np.ndarray, y: np.ndarray, weight: float) -> np.ndarray:
    """argmin_x 1/2 sum w (x - y)^2 + weight |D x|_1, D the jumps of the polygon's slopes, w the trapezoidal rule.

    A primal-dual interior point method on the dual, min z'Qz / 2 - z'Dy over |z| <= weight with Q = D W^-1 D'; then
    x = y - W^-1 D'z. Time is counted in mean intervals and z in units of the weight, so that slacks keep their digits.
    """
    h = np.diff(times) / np.mean(np.diff(times))
    lam = weight / np.mean(np.diff(times)) ** 2
    w = 0.5 * (np.append(h, 0.0) + np.insert(h, 0, 0.0))
    D = scipy.sparse.diags([1 / h[:-1], -1 / h[:-1] - 1 / h[1:], 1 / h[1:]], [0, 1, 2], shape=(len(y) - 2, len(y)))
    if np.sum(np.abs(D @ y)) <= 10 * np.finfo(float).eps * np.sum(abs(D) @ np.abs(y)):
        return y  # a straight line already
    bands = _bands((D @ scipy.sparse.diags(1 / w) @ D.T) * lam)
    z = np.zeros(len(y) - 2)
    above, below = np.ones_like(z), np.ones_like(z)  # 1 - z and 1 + z
    up, low = (np.full_like(z, np.mean(np.abs(D @ y))) for _ in range(2))  # the multipliers of both
    for _ in range(_SMOOTHING_STEPS):
        x = y - lam * (D.T @ z) / w
        jumps = D @ x
        gap, loss = np.sum(np.abs(jumps) - z * jumps), 0.5 * np.sum(w * (x - y) ** 2) / lam + np.sum(np.abs(jumps))
        noise = np.finfo(float).eps * np.sum(abs(D) @ (np.abs(y) + lam * (abs(D).T @ np.abs(z)) / w))
        if gap <= max(_GAP * loss, noise) and noise <= _ROUND_OFF * loss:
            return x
        barrier = 0.1 * (above @ up + below @ low) / (2 * len(z))
        matrix = bands.copy()
        matrix[-1] += up / above + low / below
        dz = scipy.linalg.solveh_banded(matrix, jumps - barrier / above + barrier / below)
        d_up, d_low = (barrier + up * dz) / above - up, (barrier - low * dz) / below - low
        values, steps = np.concatenate([above, below, up, low]), np.concatenate([-dz, dz, d_up, d_low])
        stretch = min(1.0, 0.99 / max(float(np.max(-steps / values)), 1e-300))
        z, above, below = z + stretch * dz, above - stretch * dz, below + stretch * dz
        up, low = up + stretch * d_up, low + stretch * d_low
    raise InputError(
        f"`TotalVariation` with weight {weight:.3g} did not settle in {_SMOOTHING_STEPS} steps; choose a smaller one."
    )


def _bands(matrix: Any) -> np.ndarray:
    """The upper bands of a symmetric pentadiagonal matrix, as `solveh_banded` takes them."""
    bands = np.zeros((3, matrix.shape[0]))
    for k in range(min(3, matrix.shape[0])):
        bands[2 - k, k:] = matrix.diagonal(k)
    return bands
