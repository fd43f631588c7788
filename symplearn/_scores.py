"""How good a forecast was: scores against the truth or against readings that came later."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.special import ndtr, ndtri

from ._errors import InputError
from ._forecast import Forecast
from ._normal import log_density
from ._predict import PosteriorForecast


@dataclasses.dataclass(frozen=True)
class ForecastScores:
    """Scores of a forecast, each (channel,) and a mean over the times at which there is a reading.

    - `rmse`: root mean squared error of the mean forecast, (2.19); `map_rmse`: that of the most probable model's path
      without noise, (2.20).
    - `log_density`: of the reading, in nats, under the normal density of the forecast's mean and variance: exact where
      the forecast is normal, and for others the proper score of Dawid and Sebastiani (1999).
    - `crps`: the continuous ranked probability score, in units of the channel; lower is better. Of draws it is the
      fair estimate of Ferro (2014), whose expectation does not depend on how many there are.
    - `coverage`: the share of readings inside the middle `level` of the forecast, time by time.
    - `energy_error`, of phase points: mean of |H(x) - H(x_0)| / |H(x_0)| over draws and times, as (5.29);
      `map_energy_error` that of the most probable model's path. None where no energy was given.
    - `count`: how many readings were scored; `diverged`: how many draws were left out at the end.
    """

    rmse: Float[np.ndarray, " channel"]
    map_rmse: Float[np.ndarray, " channel"]
    log_density: Float[np.ndarray, " channel"]
    crps: Float[np.ndarray, " channel"]
    coverage: Float[np.ndarray, " channel"]
    level: float
    count: int
    diverged: int = 0
    energy_error: float | None = None
    map_energy_error: float | None = None

    def __str__(self) -> str:
        energy = "" if self.energy_error is None else f", energy error {100 * self.energy_error:.3g} %"
        gone = "" if not self.diverged else f", {self.diverged} draws DIVERGED and were left out"
        return (
            f"Scores of {self.count} readings: RMSE {self.rmse}, CRPS {self.crps}, log density {self.log_density} "
            f"nats, {100 * self.coverage} % inside the middle {100 * self.level:g} %{energy}{gone}"
        )


def score_forecast(
    forecast: PosteriorForecast | Forecast,
    truth: Any,
    *,
    level: float = 0.9,
    energy: Callable[[Any], Any] | None = None,
    start: Any = None,
) -> ForecastScores:
    """Score a forecast against what came.

    The noiseless truth is for a forecast without measurement noise, readings for one with it; a `Forecast` always has
    it in its `sds`.

    **Arguments:** `truth` - (time, channel) at the forecast's times, NaN where nothing was read, or a recording whose
    times are among the forecast's; `level` - of the interval whose coverage is told; `energy` - the true energy, a
    function of a state (state,); `start` (state,) - the true state from which the energy error counts.

    **Raises:** `InputError` where shapes or times do not fit, nothing was read, the level is not between 0 and 1, only
    one of `energy` and `start` is given, or a forecast has no spread to judge.
    """
    if not 0 < level < 1:
        raise InputError(f"A `level` is between 0 and 1, but {level} was given.")
    if (energy is None) != (start is None):
        raise InputError("The energy error needs both `energy` and the true state it counts from, `start`.")
    rows, y = _rows(forecast, truth)
    seen = ~np.isnan(y)
    if not seen.any(axis=0).all():
        raise InputError("A channel of the truth was never read at the forecast's times: there is nothing to score.")
    if isinstance(forecast, Forecast):
        mean, map_path, log_density, crps, inside = _of_normal(forecast, rows, y, level)
    else:
        mean, map_path, log_density, crps, inside = _of_draws(forecast, rows, y, level)

    def averaged(one: np.ndarray) -> np.ndarray:
        return np.where(seen, one, 0.0).sum(axis=0) / seen.sum(axis=0)

    drift, map_drift = (None, None) if energy is None else _energy_errors(forecast, energy, start)
    gone = 0 if isinstance(forecast, Forecast) else int(forecast.diverged[-1])
    return ForecastScores(
        np.sqrt(averaged((mean - y) ** 2)),
        np.sqrt(averaged((map_path - y) ** 2)),
        averaged(log_density),
        averaged(crps),
        averaged(inside),
        level=level,
        count=int(seen.sum()),
        diverged=gone,
        energy_error=drift,
        map_energy_error=map_drift,
    )


def _rows(forecast: Any, truth: Any) -> tuple[np.ndarray, np.ndarray]:
    """Which of the forecast's times are scored, and what was read there."""
    times = np.asarray(forecast.times)
    channels = (forecast.path if isinstance(forecast, Forecast) else forecast.map_path).shape[1]
    y = np.asarray(truth.readings if hasattr(truth, "readings") else truth, dtype=float)
    at = np.asarray(truth.times, dtype=float) if hasattr(truth, "readings") else times
    rows = np.abs(times[:, None] - at).argmin(axis=0)
    # Times that are the same but for round-off.
    if y.shape != (len(at), channels) or not np.allclose(times[rows], at, rtol=1e-9, atol=1e-9 * np.ptp(times)):
        raise InputError(
            f"The forecast is of {channels} channels at {len(times)} times from {times[0]:g} to {times[-1]:g}, but the "
            f"truth has the shape {y.shape}; give its values at those times, or a recording of some of them."
        )
    return rows, y


def _of_normal(forecast: Forecast, rows: np.ndarray, y: np.ndarray, level: float) -> Any:
    mean, sd = np.asarray(forecast.means)[rows], np.asarray(forecast.sds)[rows]
    _refuse_no_spread(sd)
    inside = np.abs(y - mean) <= ndtri(0.5 + 0.5 * level) * sd
    return mean, np.asarray(forecast.path)[rows], log_density(y - mean, sd), normal_crps(mean, sd, y), inside


def _of_draws(forecast: PosteriorForecast, rows: np.ndarray, y: np.ndarray, level: float) -> Any:
    draws = np.where(np.asarray(forecast.alive)[:, rows, None], np.asarray(forecast.readings)[:, rows], np.nan)
    count = np.sum(~np.isnan(draws), axis=0)
    if count.min() < 2:
        raise InputError("At some time fewer than two draws are left, which have no spread: forecast less far.")
    mean, sd = np.nanmean(draws, axis=0), np.nanstd(draws, axis=0, ddof=1)
    _refuse_no_spread(sd)
    low, high = np.nanquantile(draws, [0.5 - 0.5 * level, 0.5 + 0.5 * level], axis=0)
    inside = (low <= y) & (y <= high)
    return mean, np.asarray(forecast.map_path)[rows], log_density(y - mean, sd), fair_crps(draws, y), inside


def _refuse_no_spread(sd: np.ndarray) -> None:
    if not np.all(sd > 0):
        raise InputError(
            "The forecast has no spread at some time, so that it has no density: draw noise, or leave out that time."
        )


def fair_crps(
    draws: Float[np.ndarray, "draw time channel"], y: Float[np.ndarray, "time channel"]
) -> Float[np.ndarray, "time channel"]:
    """mean |x_i - y| - sum |x_i - x_j| / 2 m (m - 1), over m draws that are not NaN. Ferro (2014), Q. J. R. Meteorol.
    Soc. 140, 1917."""
    ordered = np.sort(draws, axis=0)  # NaN comes last
    there = ~np.isnan(ordered)
    m = there.sum(axis=0)
    # The sum over pairs is one over ranks: x_(i) is the larger of i - 1 pairs, and the smaller of m - i.
    rank = np.arange(1, len(draws) + 1).reshape(-1, 1, 1)
    pairs = np.sum(np.where(there, (2 * rank - m - 1) * ordered, 0.0), axis=0)
    return np.nansum(np.abs(draws - y), axis=0) / m - pairs / (m * (m - 1))


def normal_crps(mean: Any, sd: Any, y: Any) -> np.ndarray:
    """sd (w (2 Phi(w) - 1) + 2 phi(w) - 1 / sqrt(pi)), w = (y - mean) / sd. Gneiting and Raftery (2007), eq. 21."""
    w = (np.asarray(y) - mean) / sd
    return sd * (w * (2 * ndtr(w) - 1) + 2 * np.exp(log_density(w)) - 1 / math.sqrt(math.pi))


def _energy_errors(forecast: Any, energy: Callable[[Any], Any], start: Any) -> tuple[float, float]:
    """Of all draws, and of the most probable model's path."""
    begin = float(energy(jnp.asarray(start, dtype=float)))
    if not math.isfinite(begin) or begin == 0.0:
        raise InputError(f"The energy at `start` is {begin:g}: an error relative to it means nothing.")
    if isinstance(forecast, Forecast):
        error = float(np.mean(np.abs(_energies(energy, forecast.state_path) - begin))) / abs(begin)
        return error, error
    drift = np.abs(_energies(energy, forecast.states) - begin) / abs(begin)
    path = np.abs(_energies(energy, forecast.map_states) - begin) / abs(begin)
    return float(np.mean(drift[np.asarray(forecast.alive)])), float(np.mean(path))


def _energies(energy: Callable[[Any], Any], states: Any) -> np.ndarray:
    flat = jnp.asarray(states).reshape(-1, states.shape[-1])
    return np.asarray(jax.vmap(energy)(flat)).reshape(states.shape[:-1])
