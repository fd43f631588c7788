"""A missing force that swings ever faster or slower: the line in time and frequency that it follows best."""

from dataclasses import dataclass

import numpy as np
import sympy
from jaxtyping import Float
from scipy.optimize import minimize

from .._expression import symbol

# The most frequencies at the beginning and at the end that are looked at; they are half a cycle of the recording apart
# where they are fewer, as up to 500 rows.
_MOST = 250
# A sweep's phase is somewhere this many cycles off that of its middle frequency; else it is a swing of that one. And it
# has so many cycles at least: with fewer it is any smooth course in time.
_BENT, _CYCLES = 0.5, 4.0


@dataclass(frozen=True)
class Sweep:
    """cos and sin of a phase whose frequency goes evenly from `first` to `last` (rad/time) from `start` on, for `span`;
    with the square of its frequency where it `grows`, as of an unbalance that runs up."""

    first: float
    last: float
    start: float
    span: float
    grows: bool = False

    def terms(self) -> tuple[sympy.Expr, sympy.Expr]:
        """Written out in t."""
        s = symbol("t") - self.start
        rate = (self.last - self.first) / self.span
        phase = self.first * s + float(f"{rate / 2:.7g}") * s**2
        size = ((self.first + rate * s) / max(self.first, self.last)) ** 2 if self.grows else 1
        return size * sympy.cos(phase), size * sympy.sin(phase)

    def along(self, times: Float[np.ndarray, " row"]) -> Float[np.ndarray, "row 2"]:
        s = times - self.start
        rate = (self.last - self.first) / self.span
        size = ((self.first + rate * s) / max(self.first, self.last)) ** 2 if self.grows else np.ones_like(s)
        phase = self.first * s + rate / 2 * s**2
        return size[:, None] * np.stack([np.cos(phase), np.sin(phase)], axis=1)


def swept(
    times: Float[np.ndarray, " row"], push: Float[np.ndarray, " row"], plain: Float[np.ndarray, "row term"]
) -> list[tuple[Sweep, int]]:
    """The sweeps of one size, and that grows, which explain most of a force beside plain terms, and of how many they
    were chosen; none that is a swing of one frequency, or too short."""
    if len(times) < 2 or not push.any():
        return []
    span, gap = float(np.ptp(times)), float(np.median(np.diff(times)))
    highest = np.pi / (2 * gap)
    number = int(min(_MOST, highest * span / np.pi))
    if number < 2:
        return []
    frequencies = np.linspace(2 * np.pi / span, highest, number)
    rest = push - plain @ np.linalg.lstsq(plain, push, rcond=None)[0]
    ends, step = frequencies[[*_strongest(times - times[0], rest, frequencies)]], np.pi / span
    found = [_nearest(times, push, plain, ends, step, grows) for grows in (False, True)]
    return [(one, number**2) for one in found if _is_sweep(one)]


def _is_sweep(one: Sweep) -> bool:
    bent, cycles = abs(one.last - one.first) * one.span / (16 * np.pi), (one.first + one.last) * one.span / (4 * np.pi)
    return min(one.first, one.last) > 0 and bent >= _BENT and cycles >= _CYCLES


def _nearest(
    times: Float[np.ndarray, " row"], push: Float[np.ndarray, " row"], plain: Float[np.ndarray, "row term"],
    begin: Float[np.ndarray, "2"], step: float, grows: bool,
) -> Sweep:  # fmt: skip
    """The best one near two frequencies, to hundredths of a step."""
    start, span = float(times[0]), float(np.ptp(times))

    def left(ends: Float[np.ndarray, "2"]) -> float:
        one = Sweep(float(ends[0]), float(ends[1]), start, span, grows)
        columns = np.concatenate([plain, one.along(times)], axis=1)
        return float(((push - columns @ np.linalg.lstsq(columns, push, rcond=None)[0]) ** 2).sum() / (push @ push))

    simplex = begin + step / 2 * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    found = minimize(left, begin, method="Nelder-Mead", options={"initial_simplex": simplex, "xatol": step / 100})
    return Sweep(float(found.x[0]), float(found.x[1]), start, span, grows)


def _strongest(
    s: Float[np.ndarray, " row"], rest: Float[np.ndarray, " row"], frequencies: Float[np.ndarray, " frequency"]
) -> tuple[int, int]:
    """The line from one frequency to another that a force has most power along."""
    number, waves = len(frequencies), np.exp(-1j * np.outer(frequencies, s))
    power = np.zeros((number, number))
    for k in range(1 - number, number):
        bend = np.sign(k) * (frequencies[abs(k)] - frequencies[0])
        along = np.abs(waves @ (rest * np.exp(-0.5j * bend * s**2 / s[-1])))
        begins = np.arange(max(0, -k), min(number, number - k))
        power[begins, begins + k] = along[begins]
    first, last = np.unravel_index(int(np.argmax(power)), power.shape)
    return int(first), int(last)
