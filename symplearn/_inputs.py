"""Inputs between their rows: held, linear or band-limited."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy.fft

from ._errors import InputError

EVENNESS = 0.02  # of a spacing: how far a time may lie off the even grid (rounding in the file)
_FINE = 8  # points of the fine grid to a row
_STENCIL = np.arange(-3, 5)  # its points around a time that the local polynomial goes through
_CHUNK = 200_000  # times evaluated at once


@dataclass(frozen=True, eq=False)
class Inputs:
    """Known inputs of one recording at all its rows, and what they are in between.

    **Arguments:**

    - `times`: `(n,)`, strictly increasing.
    - `values`: `(n, n_inputs)`.
    - `interpolation`: `hold` (the value of the latest row), `linear`, or `bandlimited` (evenly sampled; no
        frequencies above half the sampling rate).
    - `name`: of the recording, for sentences.
    - `missing`: times of rows that lack an input and are left out.

    **Raises** `InputError` if times are not even where `bandlimited` needs them so.
    """

    times: np.ndarray
    values: np.ndarray
    interpolation: str = "hold"
    name: str = "the recording"
    missing: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if self.interpolation == "bandlimited":
            self._check_even()

    def at(self, times: np.ndarray) -> np.ndarray:
        """The inputs at `times` `(k,)`, as `(k, n_inputs)`.

        **Raises** `InputError` where a time is more than half a spacing outside the rows.
        """
        times = np.asarray(times, dtype=float)
        self._check_range(times)
        if self.interpolation == "hold":
            return self.values[self._rows(times)]
        if self.interpolation == "linear":
            return np.stack([np.interp(times, self.times, v) for v in self.values.T], axis=1)
        return self._bandlimited(times)

    def mean_over(self, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
        """The mean of the inputs over each interval from `begin` to `end` `(k,)`, as `(k, n_inputs)`.

        Exact for `hold` and `linear`; the value in the middle for `bandlimited` and for an empty interval.

        **Raises** `InputError` where a time is more than half a spacing outside the rows.
        """
        begin, end = np.asarray(begin, dtype=float), np.asarray(end, dtype=float)
        self._check_range(begin)
        self._check_range(end)
        middle = self.at(0.5 * (begin + end))
        if self.interpolation == "bandlimited":
            return middle
        length = (end - begin)[:, None]
        whole = self._rows(begin) != self._rows(end) if self.interpolation == "hold" else end > begin
        # Around the mean: the difference of two long integrals then loses fewer digits.
        mean = self._centred[1]
        area = self._integral(end) - self._integral(begin)
        return np.where(whole[:, None], mean + area / np.where(length > 0, length, 1.0), middle)

    @cached_property
    def spacing(self) -> float:
        """The median distance of rows; infinite for a single row."""
        return float(np.median(np.diff(self.times))) if len(self.times) > 1 else np.inf

    def _check_range(self, times: np.ndarray) -> None:
        first, last, slack = self.times[0], self.times[-1], 0.5 * self.spacing
        wrong = times[(times < first - slack) | (times > last + slack)]
        if wrong.size:
            needed = wrong.max() if wrong.max() > last else wrong.min()
            raise InputError(
                f"{self.name}: inputs are needed at {needed:.10g}, but the rows give them from {first:.10g} "
                f"to {last:.10g}; add rows with inputs and empty observed cells"
            )

    def _check_even(self) -> None:
        if len(self.times) < 3:
            return
        even = np.linspace(self.times[0], self.times[-1], len(self.times))
        off = np.abs(self.times - even)
        worst = int(np.argmax(off))
        if off[worst] > EVENNESS * (even[1] - even[0]):
            raise InputError(
                f"{self.name}: inputs are to be bandlimited, but the rows are not evenly spaced near t = "
                f'{self.times[worst]:.10g}; give evenly spaced rows or interpolation = "linear"'
            )

    def _rows(self, times: np.ndarray) -> np.ndarray:
        """The latest row at or before each time; a time short of a row by rounding is the row's own."""
        rounding = 4 * np.spacing(np.max(np.abs(self.times)))
        rounding += 1e-9 * self.spacing if np.isfinite(self.spacing) else 0.0
        found = np.searchsorted(self.times, times + rounding, side="right") - 1
        return np.clip(found, 0, len(self.times) - 1)

    @cached_property
    def _centred(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Values around their mean, the mean, the slopes after each row and the integral up to each row."""
        mean = self.values.mean(axis=0)
        values = self.values - mean
        steps = np.diff(self.times)[:, None]
        rise = np.diff(values, axis=0) if self.interpolation == "linear" else np.zeros_like(values[1:])
        slopes = np.concatenate([rise / steps, np.zeros_like(values[:1])])
        pieces = (values[:-1] + 0.5 * rise) * steps
        return values, mean, slopes, np.concatenate([np.zeros_like(values[:1]), np.cumsum(pieces, axis=0)])

    def _integral(self, times: np.ndarray) -> np.ndarray:
        """The integral of the centred inputs from the first row to each time."""
        values, _, slopes, integral = self._centred
        rows = self._rows(times)
        after = (times - self.times[rows])[:, None]
        return integral[rows] + values[rows] * after + 0.5 * slopes[rows] * np.maximum(after, 0.0) ** 2

    @cached_property
    def _fine_grid(self) -> np.ndarray:
        """The inputs without their ramp on the fine grid, `(stencil + (n - 1) * fine, n_inputs)`.

        The ramp through the first and last row is taken off and the rest continued as an odd function, so
        that it is periodic with a continuous slope: trigonometric interpolation adds no frequency, and its
        error near the ends falls fast with the distance from them.
        """
        n = len(self.times)
        rest = self.values - self._ramp(np.arange(n, dtype=float))
        periodic = np.concatenate([rest, -rest[-2:0:-1]])
        spectrum = scipy.fft.rfft(periodic, axis=0)
        fine = scipy.fft.irfft(spectrum * _FINE, n=len(periodic) * _FINE, axis=0, overwrite_x=True)
        left, right = -_STENCIL[0], _STENCIL[-1]
        return np.concatenate([fine[-left:], fine[: (n - 1) * _FINE + right + 1]])

    def _ramp(self, rows: np.ndarray) -> np.ndarray:
        first, last = self.values[0], self.values[-1]
        return first + (last - first) * (rows / (len(self.times) - 1))[:, None]

    def _bandlimited(self, times: np.ndarray) -> np.ndarray:
        n = len(self.times)
        if n < 3:
            return np.stack([np.interp(times, self.times, v) for v in self.values.T], axis=1)
        rows = (times - self.times[0]) * ((n - 1) / (self.times[-1] - self.times[0]))
        rows = np.clip(rows, 0.0, n - 1.0)
        parts = [self._local(rows[i : i + _CHUNK]) for i in range(0, len(rows), _CHUNK)]
        return np.concatenate([np.zeros((0, self.values.shape[1])), *parts])

    def _local(self, rows: np.ndarray) -> np.ndarray:
        """The polynomial through the eight points of the fine grid around each time (Lagrange)."""
        below = np.floor(rows * _FINE).astype(int)
        offset = rows * _FINE - below
        result = self._ramp(rows)
        for j, point in enumerate(_STENCIL):
            others = np.delete(_STENCIL, j)
            weight = np.prod([(offset - o) / (point - o) for o in others], axis=0)
            result += weight[:, None] * self._fine_grid[below + j]
        return result
