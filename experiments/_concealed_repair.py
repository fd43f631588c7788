"""What today's practice works on: smoothed motions and the force that the recalibrated simulation leaves over."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import UnivariateSpline

from ._concealed_effects import Modes, World, rates
from ._concealed_files import read_effects, read_setup
from ._concealed_hiding import recalibrated
from ._concealed_sensors import Recorded, Setup, moved

Force = Callable[[np.ndarray, np.ndarray], np.ndarray]  # positions and velocities, (coordinate, row), to forces
_ENDS = 6  # rows
_SUBSTEPS = 4  # of Runge and Kutta between rows
_AWAY = 1e3  # sd; an error beyond this is counted as this


class Smoothed(NamedTuple):
    """One recording: positions, velocities, momenta, their slope and the simulation's force, (coordinate, row)."""

    times: np.ndarray
    q: np.ndarray
    v: np.ndarray
    p: np.ndarray
    slope: np.ndarray
    force: np.ndarray

    def inside(self) -> "Smoothed":
        """Without the ends, where the derivatives of splines are worst."""
        cut = slice(_ENDS, len(self.times) - _ENDS)
        return Smoothed(self.times[cut], *(one[:, cut] for one in self[1:]))


class Practice(NamedTuple):
    """All recordings up to where they are used, with the recalibrated simulation."""

    setup: Setup
    runs: tuple[Smoothed, ...]
    end: np.ndarray  # the true state of the first recording at the last row used: no better start can be had


def smoothed(answer: dict[str, Any], seen: tuple[np.ndarray, ...], held_out: float) -> Practice | None:
    """Smooth and differentiate; None where a coordinate's position is not read."""
    setup, public = read_setup(answer)
    places = []
    for i in range(setup.system.dof):
        own = [k for k, r in enumerate(setup.readings) if r.kind == "position" and r.sees == (i,)]
        if not own:
            return None
        places.append(own[0])
    cuts = [len(s) - int(held_out * len(s) + 1e-9) for s in seen]
    used = tuple(np.where(np.arange(len(s))[:, None] < k, s, np.nan) for s, k in zip(seen, cuts, strict=True))
    best = recalibrated(setup, public, used)
    values = dict(setup.values) | {f.name: float(best.theta[i]) for i, f in enumerate(best.form.free)}
    setup = setup._replace(values=values)
    runs = [_run(setup, r, s[:k], places) for r, s, k in zip(setup.records, used, cuts, strict=True)]
    effects = (*read_effects(answer["effects"]), *read_effects(answer["remainder"]))
    motion = moved(read_setup(answer)[0], setup.records[0], effects)
    return Practice(setup, tuple(runs), motion.one(float(runs[0].times[-1]))[: 2 * setup.system.dof])


def _run(setup: Setup, record: Recorded, seen: np.ndarray, places: list[int]) -> Smoothed:
    times = record.times[: len(seen)]
    q, v, a = [], [], []
    for k in places:
        there = np.isfinite(seen[:, k])
        sd = setup.noise[setup.readings[k].column]
        # Degree 5, as smooth as the noise's true sd lets it be.
        spline = UnivariateSpline(times[there], seen[there, k], np.full(there.sum(), 1 / sd), k=5, s=there.sum())
        q.append(spline(times))
        v.append(spline.derivative(1)(times))
        a.append(spline.derivative(2)(times))
    q_, v_ = np.array(q), np.array(v)
    p = momenta(setup, q_, v_)
    # Slope of p along the smoothed motion: differentiate p(q, v) along (v, a).
    h = 1e-6
    slope = (momenta(setup, q_ + h * v_, v_ + h * np.array(a)) - momenta(setup, q_ - h * v_, v_ - h * np.array(a))) / (
        2 * h
    )
    world = setup.world(record, ())
    force = np.array([_force(world, t, np.concatenate([q_[:, k], p[:, k]])) for k, t in enumerate(times)]).T
    return Smoothed(times, q_, v_, p, slope, force)


def momenta(setup: Setup, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Momenta of velocities; velocities are linear in momenta."""
    d = len(q)
    rest = np.array([np.broadcast_to(x, q.shape[1]) for x in setup.system.velocity(q, np.zeros_like(q), setup.values)])
    matrix = np.empty((q.shape[1], d, d))
    for j in range(d):
        unit = np.zeros_like(q)
        unit[j] = 1.0
        one = np.array([np.broadcast_to(x, q.shape[1]) for x in setup.system.velocity(q, unit, setup.values)])
        matrix[:, :, j] = (one - rest).T
    return np.linalg.solve(matrix, (v - rest).T[:, :, None])[:, :, 0].T


def _force(world: World, t: float, x: np.ndarray) -> np.ndarray:
    return np.array(rates(t, x, world, Modes(t)))[world.system.dof :]


def free_run_errors(
    answer: dict[str, Any], seen: tuple[np.ndarray, ...], early: Practice, whole: Practice, force: Force | None
) -> dict[str, float]:
    """Held-out rms error of the first recording from the true state, and the forecast's, in sd of the noise."""
    noise = np.array([answer["noise"][c] for c in answer["columns"]])
    record = early.setup.records[0]
    cut = len(early.runs[0].times)
    later = record.times[cut - 1 :]
    ahead = _readings(early, later, force)[1:] - seen[0][cut:]
    beyond = _readings(whole, np.concatenate([record.times[-1:], record.forecast]), force)[1:]
    errors = {"holdout": ahead / noise, "forecast": (beyond - np.array(answer["forecast"][0])) / noise}
    return {name: float(min(np.sqrt(np.nanmean(e**2)), _AWAY)) for name, e in errors.items()}


def _stepped(field: Callable[[float, np.ndarray], np.ndarray], t: float, x: np.ndarray, h: float) -> np.ndarray:
    """One step of the classical Runge-Kutta method: terms may jump with the sign of a velocity."""
    a = field(t, x)
    b = field(t + h / 2, x + h / 2 * a)
    c = field(t + h / 2, x + h / 2 * b)
    return x + h / 6 * (a + 2 * b + 2 * c + field(t + h, x + h * c))


def _readings(practice: Practice, times: np.ndarray, force: Force | None) -> np.ndarray:
    """The repaired simulation's readings from the smoothed end on, shape (row, column); what runs away stays away."""
    setup, d = practice.setup, practice.setup.system.dof
    world = setup.world(setup.records[0], ())
    extent = np.max([np.max(np.abs(np.concatenate([one.q, one.p])), axis=1) for one in practice.runs], axis=0)

    def field(t: float, x: np.ndarray) -> np.ndarray:
        found = np.array(rates(t, x, world, Modes(t)), dtype=float)
        if force is not None:
            v = np.array(setup.system.velocity(x[:d], x[d:], setup.values), dtype=float)
            found[d:] += np.ravel(force(x[:d, None], v[:, None]))
        return found

    x = np.full((2 * d, len(times)), 1e9)
    x[:, 0] = now = practice.end
    for k, (t, end) in enumerate(zip(times[:-1], times[1:], strict=True), 1):
        for h in [(end - t) / _SUBSTEPS] * _SUBSTEPS:
            now = _stepped(field, t, now, h)
            t += h
        if not np.max(np.abs(now) / extent) < 5.0:
            break
        x[:, k] = now
    return np.stack([r.see(x[:d], x[d:], setup.values) for r in setup.readings], axis=1)
