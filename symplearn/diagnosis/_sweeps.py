"""A missing force that swings ever faster or slower: the line in time and frequency that it follows best."""

from dataclasses import dataclass

import numpy as np
import sympy
from jaxtyping import Float
from scipy.optimize import minimize

from .._expression import symbol

# The most frequencies at the beginning and at the end that are looked at; they are half a cycle of the recording apart.
_MOST = 120
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
    times: Float[np.ndarray, " row"],
    push: Float[np.ndarray, " row"],
    plain: Float[np.ndarray, "row term"],
    grows: bool,
) -> tuple[Sweep, int] | None:
    """The sweep that explains most of a force beside plain terms, and of how many it was chosen; None where the best
    one is a swing of one frequency, or too short."""
    if len(times) < 2 or not push.any():
        return None
    span, gap = float(np.ptp(times)), float(np.median(np.diff(times)))
    highest = np.pi / (2 * gap)
    number = int(min(_MOST, highest * span / np.pi))
    if number < 2:
        return None
    frequencies = np.linspace(2 * np.pi / span, highest, number)
    a, b = _strongest(times - times[0], push - plain @ np.linalg.lstsq(plain, push, rcond=None)[0], frequencies)

    def left(ends: Float[np.ndarray, "2"]) -> float:
        columns = np.concatenate(
            [plain, Sweep(float(ends[0]), float(ends[1]), float(times[0]), span, grows).along(times)], axis=1
        )
        return float(((push - columns @ np.linalg.lstsq(columns, push, rcond=None)[0]) ** 2).sum() / (push @ push))

    step = np.pi / span
    simplex = np.array([frequencies[[a, b]] + off for off in ([0.0, 0.0], [step / 2, 0.0], [0.0, step / 2])])
    found = minimize(left, simplex[0], method="Nelder-Mead", options={"initial_simplex": simplex, "xatol": step / 100})
    first, last = map(float, found.x)
    bent, cycles = abs(last - first) * span / (16 * np.pi), (first + last) * span / (4 * np.pi)
    if min(first, last) <= 0 or bent < _BENT or cycles < _CYCLES:
        return None
    return Sweep(first, last, float(times[0]), span, grows), number**2


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
