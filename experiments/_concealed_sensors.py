"""From motions to readings: sensors with their faults, kinds of noise, and the small remainders that have no name."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ._concealed_effects import Effect, Inputs, World
from ._concealed_motion import Motion, true_motion
from ._concealed_systems import Generator, Reading, System, Values

NOISES = ("gaussian", "uniform", "student", "quantised")


class Recorded(NamedTuple):
    """One recording: its rows' times, from where it is integrated, the state there, and its input."""

    number: int  # from 1
    times: np.ndarray
    begin: float
    start: np.ndarray
    inputs: Inputs | None
    forecast: np.ndarray  # times after the last row


class Setup(NamedTuple):
    """All but the effects: the system, its true parameters, sensors, noise, and recordings."""

    system: System
    values: Values
    readings: tuple[Reading, ...]
    noise: dict[str, float]  # true standard deviation by column
    kind: str  # one of NOISES
    freedom: float  # degrees of freedom of Student's noise
    records: tuple[Recorded, ...]

    def world(self, record: Recorded, effects: Sequence[Effect], values: Values | None = None) -> World:
        """What moves in one recording."""
        here = tuple(e for e in effects if not e.recordings or record.number in e.recordings)
        return World(self.system, values or self.values, here, record.inputs, float(record.times[0]))


def faulty(effects: Sequence[Effect], column: str, h: Any, dt: Any) -> Any:
    """(1 + g) h + b + r (t - t_0), and a ripple with the position: what the column shows of h but for noise."""
    shown = h
    for e in effects:
        if e.target == column and e.word == "sensor_gain":
            shown = shown + e.values["g"] * h
        elif e.target == column and e.word == "sensor_bias":
            shown = shown + e.values["b"]
        elif e.target == column and e.word == "sensor_drift":
            shown = shown + e.values["r"] * dt
        elif e.target == column and e.word == "ripple":
            shown = shown + e.values["a"] * np.sin(2 * np.pi * h / e.values["w"] + e.values["phi"])
    return shown


def delay(effects: Sequence[Effect], column: str) -> Any:
    """How late a column is."""
    return sum(e.values["tau"] for e in effects if e.word == "sensor_delay" and e.target == column)


def moved(setup: Setup, record: Recorded, effects: Sequence[Effect]) -> Motion:
    """The true motion in one recording, as far as it is forecast."""
    world = setup.world(record, effects)
    end = float(record.forecast[-1] if len(record.forecast) else record.times[-1])
    start = np.concatenate([record.start, _beginning(world)])
    late = max(delay(world.effects, r.column) for r in setup.readings)
    return true_motion(world, start, record.begin, end, 1.01 * late)


def _beginning(world: World) -> np.ndarray:
    """Where the extra states begin."""
    found: list[float] = []
    for e in world.effects:
        if e.word == "hidden_oscillator":
            found += [e.values["z_0"] * e.values["kappa"], e.values["w_0"] * e.values["kappa"]]
        elif e.word == "hysteresis":
            found.append(0.0)
    return np.array(found)


def expected(
    setup: Setup, record: Recorded, effects: Sequence[Effect], motion: Motion, times: np.ndarray
) -> np.ndarray:
    """Readings without noise at times, shape (time, column)."""
    world, d = setup.world(record, effects), setup.system.dof
    columns = []
    for reading in setup.readings:
        x = motion.at(times - delay(world.effects, reading.column))
        h = reading.see(x[:d], x[d : 2 * d], setup.values)
        columns.append(faulty(world.effects, reading.column, h, times - world.origin))
    return np.stack(columns, axis=1)


def noisy(rng: Generator, setup: Setup, effects: Sequence[Effect], clean: np.ndarray, number: int) -> np.ndarray:
    """Readings with noise of the case's kind; a wrong noise and outliers are put in here."""
    found = clean.copy()
    for k, reading in enumerate(setup.readings):
        sd, n = setup.noise[reading.column], len(clean)
        found[:, k] += sd * _standard(rng, setup, n)
        for e in effects:
            here = e.target == reading.column and (not e.recordings or number in e.recordings)
            if e.word == "sensor_outliers" and here:
                hit = rng.random(n) < e.values["e"]
                found[:, k] += hit * rng.normal(size=n) * e.values["sd"]
        if setup.kind == "quantised":
            step = sd * QUANTUM
            found[:, k] = step * np.round(found[:, k] / step)
    return found


# Of a quantised sensor: step in standard deviations of all its noise, of which the rest is Gaussian.
QUANTUM = 1.6


def _standard(rng: Generator, setup: Setup, n: int) -> np.ndarray:
    """Noise of unit variance."""
    if setup.kind == "uniform":
        return rng.uniform(-np.sqrt(3), np.sqrt(3), n)
    if setup.kind == "student":
        return rng.standard_t(setup.freedom, n) / np.sqrt(setup.freedom / (setup.freedom - 2))
    if setup.kind == "quantised":
        return rng.normal(size=n) * np.sqrt(1 - QUANTUM**2 / 12)
    return rng.normal(size=n)
