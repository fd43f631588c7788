"""The motion that was recorded, as the simulation without effects follows it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Float

from .._thinning import highest_frequency
from ._along import along_all, force, parts, readings, velocity
from ._problem import Problem

# Of a parameter's own size, for the derivative of a force that hangs on it smoothly.
_STEP = 1e-6
# Share of the Nyquist frequency up to which oscillations are tried, and of the highest that is read.
_NYQUIST, _ABOVE = 0.9, 1.1


def rms(values: np.ndarray) -> float:
    """Root mean square of the finite values; 1 where there is none, or none but zeros."""
    mean = float(np.sqrt(_mean_square(values)))
    return mean if np.isfinite(mean) and mean > 0 else 1.0


def _mean_square(values: np.ndarray) -> float:
    """Of the finite values; 0 where there is none."""
    square = values[np.isfinite(values)] ** 2
    return float(square.mean()) if square.size else 0.0


def extent(paths: Sequence[Float[np.ndarray, "_ state"]]) -> float:
    """How far paths lead: the mean logarithm of their columns' root mean squares."""
    return float(np.mean([np.log(rms(column)) for column in np.concatenate(paths).T]))


@dataclass(frozen=True)
class Motion:
    """The motion that was recorded, as the simulation without effects follows it; rows of all recordings."""

    q: Float[np.ndarray, "row d"]
    v: Float[np.ndarray, "row d"]
    forces: Float[np.ndarray, " d"]  # root mean square
    levels: Float[np.ndarray, " channel"]  # root mean square of the expected readings
    times: tuple[Float[np.ndarray, " _"], ...]  # by recording
    # What the stiffness of each coordinate changes by, per unit of each calibrated parameter.
    stiffening: Float[np.ndarray, "d parameter"] = field(default_factory=lambda: np.zeros((1, 0)))
    # Power that forces which turn round with the motion feed into each coordinate, by row.
    turning: Float[np.ndarray, "row d"] = field(default_factory=lambda: np.zeros((0, 1)))
    momenta: Float[np.ndarray, " d"] = field(default_factory=lambda: np.zeros(1))  # the largest
    highest: float = 0.0  # frequency that stands out of the noise of a reading, in rad/time

    @property
    def first(self) -> float:
        return min(float(t[0]) for t in self.times)

    @property
    def last(self) -> float:
        return max(float(t[-1]) for t in self.times)

    @property
    def windows(self) -> Float[np.ndarray, "recording 2"]:
        """From when to when every recording is read."""
        return np.array([[t[0], t[-1]] for t in self.times])

    @property
    def span(self) -> float:
        """Of the longest recording; their clocks may begin far apart."""
        return max(float(t[-1] - t[0]) for t in self.times)

    @cached_property
    def gap(self) -> float:
        """Median time between rows."""
        return float(np.median(np.concatenate([np.diff(t) for t in self.times])))

    @property
    def frequencies(self) -> tuple[float, float]:
        """From one cycle in the recording to half the Nyquist frequency, or the highest that is read, in rad/time."""
        highest = np.clip(_ABOVE * self.highest, np.pi / (2 * self.gap), _NYQUIST * np.pi / self.gap)
        return 2 * np.pi / self.span, max(float(highest), 2 * np.pi / self.span)

    def own_frequency(self, i: int) -> float:
        """Typical frequency of one coordinate's motion, in rad/time."""
        return rms(self.v[:, i]) / rms(self.q[:, i] - np.nanmean(self.q[:, i]))


def motion_along(problem: Problem, z: np.ndarray, paths: Sequence[Float[np.ndarray, "_ state"]]) -> Motion:
    """The motion along given paths."""
    d = problem.equations.dim
    v, push, each, shown = (along_all(problem, what, z, paths) for what in (velocity, force, parts, readings))
    back = [np.where(np.arange(path.shape[1]) < problem.equations.width, path, -path) for path in paths]
    turning = 0.5 * (push - along_all(problem, force, z, back))[:, :d] * v[:, :d]
    p, span = np.concatenate(paths)[:, problem.equations.momentum], max(np.ptp(r.times) for r in problem.rows)
    own = [each[:, np.equal(problem.equations.pushed, i)] for i in range(d)]
    momenta = np.max(np.abs(p), axis=0, where=np.isfinite(p), initial=0.0)
    return Motion(
        q=np.concatenate([path[:, :d] for path in paths]),
        v=v[:, :d],
        forces=np.array([_there(push[:, i], own[i], 2 * momenta[i] / span) for i in range(d)]),
        levels=np.array([rms(column) for column in shown.T]),
        times=tuple(r.times[: len(path)] for r, path in zip(problem.rows, paths, strict=True)),
        stiffening=stiffening(problem, z, paths),
        turning=turning,
        momenta=momenta,
        highest=2 * np.pi * max(highest_frequency(r.times[: r.fitted], r.readings[: r.fitted]) for r in problem.rows),
    )


def _there(push: Float[np.ndarray, " row"], parts: Float[np.ndarray, "row part"], turn: float) -> float:
    """How strong the forces on a coordinate are: that of the energy and the known others, which may hold each other, as
    where a motor turns against its brake. At least what would turn the fastest motion round while it is recorded: what
    glides, or is hardly held, has no force to compare with, and what is missing may be all that bends its path."""
    apart = sum(_mean_square(one) for one in (push - parts.sum(1), *parts.T))
    size = max(float(np.sqrt(max(_mean_square(push), apart))), turn)
    return size if size > 0 else 1.0


def stiffening(
    problem: Problem, z: np.ndarray, paths: Sequence[Float[np.ndarray, "_ state"]]
) -> Float[np.ndarray, "d parameter"]:
    """What the stiffness of each coordinate along given paths changes by, per unit of each calibrated parameter."""
    here, out = stiffness(problem, z, paths), []
    for k in range(problem.head, problem.head + problem.calibrated.parameters):
        moved, step = z.copy(), _STEP * (abs(z[k]) or 1.0)
        moved[k] += step
        out.append((stiffness(problem, moved, paths) - here) / step)
    return np.reshape(out, (-1, problem.equations.dim)).T


def stiffness(
    problem: Problem, z: np.ndarray, paths: Sequence[Float[np.ndarray, "_ state"]]
) -> Float[np.ndarray, " d"]:
    """How much of the force on each coordinate goes against its place, by regression along given paths."""
    push, points = along_all(problem, force, z, paths), np.concatenate(paths)
    return np.array([-regressed(points[:, i], push[:, i]) for i in range(problem.equations.dim)])


def regressed(x: Float[np.ndarray, " row"], y: Float[np.ndarray, " row"]) -> float:
    """The slope of the line through some points; 0 where all lie above each other, or none is finite."""
    some = np.isfinite(x) & np.isfinite(y)
    centred = x[some] - x[some].mean() if some.any() else np.zeros(0)
    square = float(centred @ centred)
    return float(centred @ y[some]) / square if square > 0 else 0.0
