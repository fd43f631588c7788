"""Trajectory fits: a form of the motion with free parameters, coefficients and starts, fitted to readings by SciPy."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from ._concealed_effects import Effect, Modes
from ._concealed_lanes import STEPS, run, step
from ._concealed_sensors import Recorded, Setup, delay, faulty


class Free(NamedTuple):
    """A free parameter: its name, prior mean (the starting guess), and prior sd (None: flat)."""

    name: str
    mean: float
    sd: float | None


class Given(NamedTuple):
    """What the fits see: by recording the readings (row, column), NaN where missing, and each column's weight."""

    readings: tuple[np.ndarray, ...]
    sd: np.ndarray


@dataclass(frozen=True)
class Form:
    """A form of the truth: free parameters, effects with their free coefficients, and free starts."""

    setup: Setup
    free: tuple[Free, ...]
    effects: tuple[Effect, ...] = ()
    open: tuple[tuple[int, str], ...] = ()  # (effect, coefficient) that are fitted
    initial: tuple[tuple[int, float, float], ...] = ()  # (state, mean, sd): prior of each recording's first state

    @cached_property
    def sizes(self) -> tuple[int, ...]:
        """Number of states of each recording."""
        return tuple(2 * self.setup.system.dof + self.setup.world(r, self.effects).extra for r in self.setup.records)

    @property
    def length(self) -> int:
        """Number of fitted numbers."""
        return len(self.free) + len(self.open) + sum(self.sizes)

    def begin(self, starts: Sequence[np.ndarray]) -> np.ndarray:
        """The vector with the true values: parameters and coefficients as they are, and given starts."""
        values = [self.setup.values[f.name] for f in self.free]
        coefficients = [self.effects[k].values[name] for k, name in self.open]
        padded = [
            np.concatenate([s[:n], np.zeros(max(0, n - len(s)))]) for s, n in zip(starts, self.sizes, strict=True)
        ]
        return np.concatenate([values, coefficients, *padded])

    def scales(self, theta: np.ndarray) -> np.ndarray:
        """Size of each number, for steps of differences."""
        found = np.abs(theta)
        place = len(self.free) + len(self.open)
        for n in self.sizes:
            found[place : place + n] = np.concatenate([self.extent, np.ones(n)])[:n]
            place += n
        return np.where(found > 0, found, 1.0)

    @cached_property
    def extent(self) -> np.ndarray:
        """The largest coordinates and momenta of the published simulation."""
        record = self.setup.records[0]
        states = run(self.setup.world(record, ()), record.start[:, None], record.times, self.longest(()))
        return np.max(np.abs(states[:, :, 0]), axis=0)

    def parted(self, theta: np.ndarray) -> tuple[Any, tuple[Effect, ...], list[np.ndarray]]:
        """Parameters, effects and starts of lanes, theta of shape (number, lane)."""
        m = len(self.free)
        values = dict(self.setup.values) | {f.name: theta[i] for i, f in enumerate(self.free)}
        effects = list(self.effects)
        for i, (k, name) in enumerate(self.open, m):
            effects[k] = effects[k].with_values(**{name: theta[i]})
        ends = np.cumsum([m + len(self.open), *self.sizes])
        return values, tuple(effects), [theta[a:b] for a, b in zip(ends[:-1], ends[1:], strict=True)]

    def readings(self, theta: np.ndarray, beyond: bool = False) -> list[np.ndarray]:
        """Expected readings of each recording, shape (row, column, lane); `beyond` also over the forecast."""
        values, effects, starts = self.parted(theta)
        return [
            self._of(record, values, effects, start, beyond)
            for record, start in zip(self.setup.records, starts, strict=True)
        ]

    def _of(self, record: Recorded, values: Any, effects: Any, start: np.ndarray, beyond: bool) -> np.ndarray:
        times = np.concatenate([record.times, record.forecast]) if beyond else record.times
        world, d = self.setup.world(record, effects, values), self.setup.system.dof
        states = run(world, start, times, self.longest(effects))
        columns = []
        for reading in self.setup.readings:
            x = np.moveaxis(states, 1, 0)  # (state, row, lane)
            late = delay(world.effects, reading.column)
            if np.any(late != 0):
                with np.errstate(all="ignore"):
                    x = step(times[:, None], x, -late, world, Modes(float(times[0])))
            h = reading.see(x[:d], x[d : 2 * d], values)
            columns.append(faulty(world.effects, reading.column, h, (times - world.origin)[:, None]))
        return np.stack([np.broadcast_to(c, states.shape[::2]) for c in columns], axis=1)

    def longest(self, effects: Sequence[Effect]) -> float:
        """Largest step."""
        own = self.setup.system.period(self.setup.values) / self.setup.system.quick
        fastest = max([float(np.max(np.abs(e.values["omega"]))) for e in effects if "omega" in e.values], default=0.0)
        # A fit may try any frequency; beyond four times the fastest motion no effect here lies.
        return min(own, max(2 * np.pi / max(fastest, 1e-9), own / 4)) / STEPS

    def strain(self, theta: np.ndarray) -> np.ndarray:
        """Rows of the priors, shape (row, lane)."""
        rows = [(theta[i] - f.mean) / f.sd for i, f in enumerate(self.free) if f.sd is not None]
        place = len(self.free) + len(self.open)
        for n in self.sizes:
            rows += [(theta[place + i] - mean) / sd for i, mean, sd in self.initial]
            place += n
        return np.array(rows).reshape(len(rows), theta.shape[1])

    def residuals(self, theta: np.ndarray, given: Given) -> np.ndarray:
        """(readings - expected) / sd and the priors' rows, shape (row, lane)."""
        rows = []
        for found, seen in zip(self.readings(theta), given.readings, strict=True):
            there = np.isfinite(seen)
            rows.append(((found - seen[:, :, None]) / given.sd[None, :, None])[there])
        return np.concatenate([*rows, self.strain(theta)])

    def differences(self, theta: np.ndarray, size: np.ndarray, given: Given) -> tuple[np.ndarray, np.ndarray]:
        """Residuals at theta and their slopes: lanes that differ in one number each."""
        h = 1e-6 * size
        lanes = theta[:, None] + np.concatenate([np.zeros((len(theta), 1)), np.diag(h)], axis=1)
        found = self.residuals(lanes, given)
        return found[:, 0], (found[:, 1:] - found[:, :1]) / h


class Fitted(NamedTuple):
    """The least-squares solution, its residuals in sd (data rows, then priors), and the covariance."""

    form: Form
    theta: np.ndarray
    residuals: np.ndarray
    rows: int
    covariance: np.ndarray

    @property
    def chi2(self) -> float:
        """Sum of squares with the priors."""
        return float(np.sum(self.residuals**2))

    @property
    def rms(self) -> float:
        """Of the data rows, in sd."""
        return float(np.sqrt(np.mean(self.residuals[: self.rows] ** 2)))


def fit(form: Form, given: Given, theta: np.ndarray, size: np.ndarray, most: int = 25) -> Fitted:
    """SciPy's trust-region least squares; one batch of lanes gives residuals and slopes together."""
    kept: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

    def both(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        key = z.tobytes()
        if key not in kept:
            r, slopes = form.differences(z * size, size, given)
            kept[key] = np.nan_to_num(r, nan=1e6, posinf=1e6, neginf=-1e6), np.nan_to_num(slopes * size)
        return kept[key]

    found = least_squares(
        lambda z: both(z)[0], theta / size, lambda z: both(z)[1], method="trf", x_scale="jac", max_nfev=most,
        xtol=1e-9, ftol=1e-9, gtol=1e-9,
    )  # fmt: skip
    rows = len(found.fun) - len(form.strain(theta[:, None]))
    length = np.linalg.norm(found.jac, axis=0)  # of unit columns, as a start known exactly dwarfs all others
    unit = size / np.where(length > 0, length, 1.0)
    normal = found.jac * (unit / size)
    spread = np.linalg.pinv(normal.T @ normal) * np.outer(unit, unit)
    return Fitted(form, found.x * size, found.fun, rows, spread)


def plain(form: Form) -> Form:
    """The simulation as published: without effects."""
    return replace(form, effects=(), open=())
