"""Thin what is sampled far above the motion's own frequencies, without losing what averaging can keep."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

# A recording is left alone below this many rows: there is nothing to gain.
_ENOUGH = 2000
# Rows kept per shortest period of the motion. With the curvature correction below, averaging over 1/20 of a period
# changes its amplitude by 9 (2 pi / 20)^4 / 1920 = 5e-5.
_PER_PERIOD = 20
# Share of the readings' variance that may lie above the highest frequency counted as motion.
_SHARE = 1e-4


@dataclass(frozen=True)
class Thinned:
    """Rows after thinning: times (n,), readings (n, m) and how many readings each one averages (n, m)."""

    times: Float[np.ndarray, " time"]
    readings: Float[np.ndarray, "time channel"]
    counts: Float[np.ndarray, "time channel"]


def highest_frequency(times: Float[np.ndarray, " time"], readings: Float[np.ndarray, "time channel"]) -> float:
    """The frequency below which the motion lies, in 1/time; 0 where nothing stands above the noise.

    Read from the periodogram (Hann window) on an even grid: lines that stand out of the noise of the upper half.
    """
    highest = 0.0
    grid = np.linspace(times[0], times[-1], min(len(times), 1 << 17))
    for column in readings.T:
        seen = ~np.isnan(column)
        if seen.sum() < 8:
            continue
        even = np.interp(grid, times[seen], column[seen])
        power = np.abs(np.fft.rfft((even - even.mean()) * np.hanning(len(grid)))) ** 2
        # The largest of so many exponential bins of pure noise stays below this, but for once in e^5 times.
        highest_noise = (np.log(len(power)) + 5) / np.log(2) * np.median(power[len(power) // 2 :])
        power[power < highest_noise] = 0.0
        above = np.cumsum(power[::-1])[::-1]
        lines = np.nonzero(above > _SHARE * above[0])[0] if above[0] > 0 else np.zeros(1, int)
        highest = max(highest, float(lines[-1]) / (grid[-1] - grid[0]))
    return highest


def thinning_width(times: Float[np.ndarray, " time"], readings: Float[np.ndarray, "time channel"]) -> float:
    """The widest bin, in time, over which the readings may be averaged; 0 where they should be left alone."""
    if len(times) < 2 * _ENOUGH:
        return 0.0
    frequency = highest_frequency(times, readings)
    span = float(times[-1] - times[0])
    width = min(span / _ENOUGH, 1.0 / (_PER_PERIOD * frequency) if frequency > 0 else np.inf)
    return width if width > 2 * span / len(times) else 0.0


def thin(times: Float[np.ndarray, " time"], readings: Float[np.ndarray, "time channel"], width: float) -> Thinned:
    """Average the readings over bins of `width`, corrected for the motion's slope and curvature inside a bin.

    The mean over a bin differs from the value at its mean time by curvature times the variance of the times over 2.
    """
    if width <= 0:
        return Thinned(times, readings, np.where(np.isnan(readings), 0.0, 1.0))
    places = np.unique(np.floor((times - times[0]) / width).astype(int), return_inverse=True)[1]
    size = places.max() + 1
    centre = np.bincount(places, times, size) / np.bincount(places, minlength=size)
    averaged, counts = np.full((size, readings.shape[1]), np.nan), np.zeros((size, readings.shape[1]))
    for j, column in enumerate(readings.T):
        seen = ~np.isnan(column)
        counts[:, j] = np.bincount(places[seen], minlength=size)
        averaged[:, j] = _bin_means(places[seen], times[seen], column[seen], centre, counts[:, j])
    return Thinned(centre, averaged, counts)


def _bin_means(
    places: np.ndarray, times: np.ndarray, values: np.ndarray, centre: np.ndarray, count: np.ndarray
) -> np.ndarray:
    full = count > 0
    n = np.where(full, count, 1.0)
    off = times - centre[places]
    mean = np.bincount(places, values, len(centre)) / n
    lag = np.bincount(places, off, len(centre)) / n
    spread = np.bincount(places, off**2, len(centre)) / n
    out = np.full(len(centre), np.nan)
    if full.sum() < 4:
        out[full] = mean[full]
        return out
    slope = np.gradient(mean[full], centre[full])
    curvature = np.zeros_like(slope)
    before, after = np.diff(centre[full])[:-1], np.diff(centre[full])[1:]
    rise = np.diff(mean[full]) / np.diff(centre[full])
    curvature[1:-1] = 2 * np.diff(rise) / (before + after)
    curvature[0], curvature[-1] = curvature[1], curvature[-2]
    out[full] = mean[full] - slope * lag[full] - 0.5 * curvature * spread[full]
    return out
