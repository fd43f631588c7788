"""Truths drawn from priors and recordings drawn from truths, in NumPy: no code is shared with the models under test.

Variances have half-normal priors, written as sizes of the underlying normal numbers; all else is normal.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

PROCESS, ERROR = "process_noise.structure.variance", "measurement_noise.structure.variance"
STIFFNESS, CUBIC, GRAVITY = "dynamics.system.stiffness", "dynamics.system.cubic", "dynamics.system.gravity"
MATRIX, START = "dynamics.A", "initial.mean"
Values = Mapping[str, Any]
Rows = tuple[np.ndarray, np.ndarray]
# Mean and deviation of whatever multiplies the state or its force.
FACTOR, FACTOR_SD = 1.0, 0.2
READINGS = 25

# Decay: x' = a x + w, y = x + v, from 1.
DECAY, DECAY_NOISES = 0.8, (0.1, 0.1)


def decay_truth(rng: np.random.Generator) -> dict[str, Any]:
    """A factor and two variances."""
    return _variances(DECAY_NOISES, rng) | {MATRIX: DECAY + FACTOR_SD * rng.normal()}


def _variances(sizes: tuple[float, float], rng: np.random.Generator) -> dict[str, Any]:
    process, error = np.array(sizes) * np.abs(rng.normal(size=2))
    return {PROCESS: process, ERROR: error}


def decay_recording(truth: Values, rng: np.random.Generator) -> Rows:
    """Readings of x' = a x + w from 1."""
    x = np.ones(READINGS)
    for k in range(1, READINGS):
        x[k] = truth[MATRIX] * x[k - 1] + np.sqrt(truth[PROCESS]) * rng.normal()
    return np.arange(float(READINGS)), (x + np.sqrt(truth[ERROR]) * rng.normal(size=READINGS))[:, None]


# The other three: leapfrog, and the coordinate is read every half second, after four steps.
EVERY, STEPS = 0.5, 4


def leapfrog_recording(
    force: Callable[[float], float], start: Any, process: float, error: float, rng: np.random.Generator
) -> Rows:
    """Readings of q, stepped by kick, drift, kick, with process noise in q and p once per data interval."""
    (q, p), h = start, EVERY / STEPS
    path = [q]
    for _ in range(READINGS - 1):
        for _ in range(STEPS):
            p += 0.5 * h * force(q)
            q += h * p
            p += 0.5 * h * force(q)
        q, p = q + np.sqrt(process) * rng.normal(), p + np.sqrt(process) * rng.normal()
        path.append(q)
    return EVERY * np.arange(READINGS), (np.array(path) + np.sqrt(error) * rng.normal(size=READINGS))[:, None]


# A linear oscillator, whose start is unknown.
OSCILLATOR_START, OSCILLATOR_START_SD, OSCILLATOR_NOISES = (1.0, 0.0), 0.3, (0.01, 0.1)


def oscillator_truth(rng: np.random.Generator) -> dict[str, Any]:
    """A stiffness and two variances."""
    return _variances(OSCILLATOR_NOISES, rng) | {STIFFNESS: FACTOR + FACTOR_SD * rng.normal()}


def oscillator_recording(truth: Values, rng: np.random.Generator) -> Rows:
    """Readings of an oscillator from a start of its own, near (1, 0)."""
    start = np.array(OSCILLATOR_START) + OSCILLATOR_START_SD * rng.normal(size=2)
    return leapfrog_recording(lambda q: -truth[STIFFNESS] * q, start, truth[PROCESS], truth[ERROR], rng)


# Duffing's oscillator, which nothing disturbs and whose start learns.
DUFFING_START, DUFFING_START_SD, DUFFING_NOISE = (1.0, 0.0), 0.3, 0.01


def duffing_truth(rng: np.random.Generator) -> dict[str, Any]:
    """A stiffness, a cubic one, a variance and a start."""
    stiffness, cubic = FACTOR + FACTOR_SD * rng.normal(size=2)
    error = DUFFING_NOISE * np.abs(rng.normal())
    start = np.array(DUFFING_START) + DUFFING_START_SD * rng.normal(size=2)
    return {STIFFNESS: stiffness, CUBIC: cubic, ERROR: error, START: start}


def duffing_recording(truth: Values, rng: np.random.Generator) -> Rows:
    """Readings of Duffing's oscillator."""
    return leapfrog_recording(
        lambda q: -truth[STIFFNESS] * q - truth[CUBIC] * q**3, truth[START], 0.0, truth[ERROR], rng
    )


# A pendulum with process noise: a standard deviation of 0.02 per data interval or so, beside an amplitude of 1.2.
PENDULUM_START, PENDULUM_NOISES = (1.2, 0.0), (5e-4, 0.01)


def pendulum_truth(rng: np.random.Generator) -> dict[str, Any]:
    """Gravity over length, and two variances."""
    return _variances(PENDULUM_NOISES, rng) | {GRAVITY: FACTOR + FACTOR_SD * rng.normal()}


def pendulum_recording(truth: Values, rng: np.random.Generator) -> Rows:
    """Readings of a pendulum from a known start."""
    return leapfrog_recording(lambda q: -truth[GRAVITY] * np.sin(q), PENDULUM_START, truth[PROCESS], truth[ERROR], rng)
