"""Nature draws a setting: system, parameters and what is known of them, sensors, noise, rows, starts and inputs."""

from typing import NamedTuple

import numpy as np

from ._concealed_effects import Inputs, World
from ._concealed_fit import Free
from ._concealed_motion import true_motion
from ._concealed_planes import ZOO
from ._concealed_sensors import NOISES, Recorded, Setup
from ._concealed_systems import Generator, Reading, System, log_uniform


class Unsuitable(Exception):
    """A draw that does not do what its case claims; nature draws again."""


class Public(NamedTuple):
    """What the simulation file says besides the system."""

    free: tuple[Free, ...]  # the other parameters are known
    noise: dict[str, float]  # stated standard deviations
    initial: dict[str, tuple[float, float]]  # state: mean and sd; sd 0: known exactly
    blanks: tuple[tuple[tuple[int, int], ...], ...]  # by recording: empty cells (row, column)


class Wish(NamedTuple):
    """What a case asks of its setting."""

    system: str
    records: int = 1
    unread: int | None = None  # a coordinate that no sensor may see
    state_noise: bool = False  # the noise must be stated
    known: str | None = None  # a parameter that must be given as known
    quiet: bool = False  # weak effects hide in noise: many rows
    healthy: bool = False
    late: bool = False  # a delay acts: the start must not be known exactly


def drawn_setting(rng: Generator, wish: Wish) -> tuple[Setup, Public]:
    """A setup and what is published of it."""
    system = ZOO[wish.system]
    values = {name: float(f"{value:.5g}") for name, value in system.draw(rng).items()}
    readings = _sensors(rng, system, wish)
    records = _records(rng, system, values, wish, len(readings))
    noise = _noise(rng, system, values, readings, records[0], wish)
    kind = str(rng.choice(NOISES, p=[0.25] * 4 if wish.healthy else [0.7, 0.1, 0.1, 0.1]))
    setup = Setup(system, values, readings, noise, kind, float(rng.choice([5.0, 6.0, 8.0, 12.0])), records)
    stated = wish.state_noise or rng.random() < 0.5
    public = Public(
        _calibrated(rng, system, values, wish),
        {c: float(f"{sd:.4g}") for c, sd in noise.items()} if stated else {},
        _initial(rng, system, records, wish),
        tuple(_blanks(rng, len(r.times), len(readings)) for r in records),
    )
    return setup, public


def _sensors(rng: Generator, system: System, wish: Wish) -> tuple[Reading, ...]:
    """All positions, one coordinate, a nonlinear reading, velocities, or positions with velocities."""
    fit = [r for r in system.readings if wish.unread is None or wish.unread not in r.sees]
    of = {kind: [r for r in fit if r.kind == kind] for kind in ("position", "velocity", "nonlinear")}
    ways = [("positions", 0.5), ("one", 0.2), ("nonlinear", 0.1), ("velocity", 0.1), ("both", 0.1)]
    weights = np.array([w for _, w in ways])
    way = str(rng.choice([n for n, _ in ways], p=weights / weights.sum()))
    if way == "one":
        return (of["position"][rng.integers(len(of["position"]))],)
    if way in ("nonlinear", "velocity") and of[way]:
        one = of[way][rng.integers(len(of[way]))]
        others = [r for r in of["position"] if not set(r.sees) & set(one.sees)]
        return (one, *others)
    if way == "both":
        return (*of["position"], *of["velocity"])[:3]
    return tuple(of["position"])


def _records(rng: Generator, system: System, values: dict[str, float], wish: Wish, columns: int) -> tuple:
    """Rows: even, uneven or with a gap; 3 to 40 periods, 14 to 45 rows in each."""
    period = system.period(values)
    low, high = (450, 1200) if wish.quiet else (120, 700)
    rows = log_uniform(rng, low, high / (1 + 0.3 * (columns - 1))) / wish.records
    dt = float(f"{period / log_uniform(rng, 14, 45):.3g}")
    rows = float(np.clip(rows, 3 * period / dt, 40 * period / dt))
    begin = float(rng.choice([0.0, 0.0, 0.0, round(rng.uniform(0.5, 5.0), 2)]))
    signal = _signal(rng, 2 * np.pi / period)
    way = str(rng.choice(["even", "uneven", "gap"], p=[0.7, 0.15, 0.15]))
    found = []
    for number in range(1, wish.records + 1):
        n = int(rows * rng.uniform(0.8, 1.2)) if wish.records > 1 else int(rows)
        times = np.round(begin + dt * _ticks(rng, max(n, 40), way), 8)
        after = np.round(times[-1] + dt * np.arange(1, max(n, 40) // 4 + 1), 8)
        inputs = _inputs(rng, system, np.concatenate([times, after]), signal)
        found.append(Recorded(number, times, float(times[0]), system.start(rng, values), inputs, after))
    return tuple(found)


def _ticks(rng: Generator, n: int, way: str) -> np.ndarray:
    ticks = np.arange(n, dtype=float)
    if way == "uneven":
        ticks = ticks + np.concatenate([[0.0], rng.uniform(-0.4, 0.4, n - 1)])
    if way == "gap":
        begin, length = rng.integers(n // 4, n // 2), rng.integers(n // 20, n // 8)
        ticks = np.delete(ticks, slice(begin, begin + length))
    return np.round(ticks, 3)


def _signal(rng: Generator, omega: float) -> tuple[np.ndarray, np.ndarray, str, bool]:
    """Frequencies and phases of an input, whether it goes in steps, and whether it is linear between rows."""
    how = str(rng.choice(["sines", "steps"]))
    return omega * rng.uniform(0.2, 2.2, 4), rng.uniform(-np.pi, np.pi, 4), how, bool(rng.random() < 0.4)


def _inputs(rng: Generator, system: System, times: np.ndarray, signal: tuple) -> Inputs | None:
    if system.drive is None:
        return None
    omegas, phases, how, linear = signal
    values = np.sum([np.sin(w * times + phi) for w, phi in zip(omegas, phases, strict=True)], axis=0) / 2
    return Inputs(times, np.round(np.sign(values) if how == "steps" else values, 4), linear and how != "steps")


def _noise(rng: Generator, system: System, values: dict, readings: tuple, record: Recorded, wish: Wish) -> dict:
    """A part of each reading's own variation; five digits."""
    world = World(system, values, (), record.inputs, float(record.times[0]))
    x = true_motion(world, record.start, record.begin, float(record.times[-1])).at(record.times)
    d = system.dof
    part = log_uniform(rng, 0.015, 0.12) if wish.quiet else log_uniform(rng, 0.004, 0.06)
    seen = [r.see(x[:d], x[d:], values) for r in readings]
    return {
        r.column: float(f"{part * rng.uniform(0.7, 1.4) * np.std(h):.5g}") for r, h in zip(readings, seen, strict=True)
    }


def _calibrated(rng: Generator, system: System, values: dict[str, float], wish: Wish) -> tuple[Free, ...]:
    """At most two calibrated parameters: a prior mean wrong inside its sd, or a flat prior's starting guess."""
    open_to = [n for n in values if n not in system.always_known and n != wish.known]
    count = int(rng.choice([0, 1, 2], p=[0.3, 0.45, 0.25]))
    found = []
    for place, name in enumerate(rng.permutation(open_to)[:count]):
        value = values[str(name)]
        if place == 0 and rng.random() < 0.25:
            found.append(Free(str(name), float(f"{value * (1 + rng.uniform(-0.05, 0.05)):.4g}"), None))
            continue
        sd = abs(value) * log_uniform(rng, 0.002, 0.05)
        found.append(Free(str(name), float(f"{value + sd * rng.uniform(-0.9, 0.9):.6g}"), float(f"{sd:.3g}")))
    return tuple(found)


def _initial(rng: Generator, system: System, records: tuple, wish: Wish) -> dict[str, tuple[float, float]]:
    """Mostly nothing; otherwise a prior of the first coordinates, and momenta known as zero after a release at rest."""
    if len(records) > 1 or rng.random() < 0.65:
        return {}
    d, start = system.dof, records[0].start
    found = {}
    for name, value in zip(system.coordinates, start[:d], strict=True):
        sd = float(f"{0.05 * max(abs(value), 0.1):.2g}")
        found[name] = (float(f"{value + sd * rng.uniform(-0.9, 0.9):.4g}"), sd)
    if np.all(start[d:] == 0) and not wish.late and rng.random() < 0.5:
        found |= {name: (0.0, 0.0) for name in system.momenta}
    return found


def _blanks(rng: Generator, rows: int, columns: int) -> tuple[tuple[int, int], ...]:
    """Empty cells, in a sixth of the recordings."""
    if rng.random() > 1 / 6:
        return ()
    hit = rng.random((rows, columns)) < rng.uniform(0.03, 0.15)
    hit[0] = hit[-1] = False
    return tuple((int(a), int(b)) for a, b in np.argwhere(hit))
