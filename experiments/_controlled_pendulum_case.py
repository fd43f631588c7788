"""The damped pendulum with random inputs of section 3.3.3: its data sets, the model (3.21), and errors of estimates."""

from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import expm

GRAVITY, DAMPING = 9.81, 1.0
# Seconds of training data; as many are tested on.
TRAINED = 20.0
SPACINGS = tuple(round(0.05 * k, 2) for k in range(2, 11))
RATIOS = tuple(round(0.025 * k, 3) for k in range(9))


class DataSets(NamedTuple):
    """The data sets of one cell, side by side: `times` (row,), the rest (set, row); the first `trained` + 1 rows train.

    `truth` is the angle without noise. `readings` have it, in all rows.
    """

    times: np.ndarray
    inputs: np.ndarray
    truth: np.ndarray
    readings: np.ndarray
    trained: int


class Systems(NamedTuple):
    """Linear systems, one for each data set: A (set, 2, 2), B and H (set, 2), D and the start x0 (set,), (set, 2)."""

    A: np.ndarray
    B: np.ndarray
    H: np.ndarray
    D: np.ndarray
    x0: np.ndarray


def truth(spacing: float) -> np.ndarray:
    """The matrix of (3.20) that takes the state over one data interval."""
    return expm(np.array([[0.0, 1.0], [-GRAVITY, -DAMPING]]) * spacing)


def data_sets(seed: int, spacing: float, ratio: float, count: int) -> DataSets:
    """The first `count` data sets of a cell: a data set hangs on the seed, its cell and its number alone."""
    trained = int(TRAINED / spacing + 1e-9)
    rows, cell = 2 * trained + 1, [round(1000 * spacing), round(1000 * ratio)]
    generators = [np.random.default_rng([seed, *cell, k]) for k in range(count)]
    inputs = np.sqrt(spacing) * np.array([one.normal(size=rows) for one in generators])
    unit = np.array([one.normal(size=rows) for one in generators])
    system = Systems(truth(spacing), np.array([0.0, 1.0]), np.array([1.0, 0.0]), np.zeros(()), np.zeros(2))
    angles = outputs(Systems(*(np.broadcast_to(m, (count, *m.shape)) for m in system)), inputs)
    # The largest of the angles themselves, not of their absolute values (specification 5.7).
    noise = ratio * angles.max(axis=1, keepdims=True) * unit
    return DataSets(spacing * np.arange(rows), inputs, angles, angles + noise, trained)


def outputs(systems: Systems, inputs: np.ndarray) -> np.ndarray:
    """Readings (set, row) of the systems without noise."""
    x, found = systems.x0, []
    with np.errstate(over="ignore", invalid="ignore"):  # an estimate may be unstable
        for u in inputs.T:
            found.append(np.sum(systems.H * x, axis=1) + systems.D * u)
            x = np.einsum("kij,kj->ki", systems.A, x) + systems.B * u[:, None]
    return np.array(found).T


def mean_squares(systems: Systems, data: DataSets) -> tuple[np.ndarray, np.ndarray]:
    """Each system's mean squared error against the noiseless angle: over rows 1 to n, and over n + 1 to 2 n."""
    with np.errstate(over="ignore", invalid="ignore"):
        squares = np.nan_to_num((outputs(systems, data.inputs) - data.truth) ** 2, nan=np.inf)
        return squares[:, 1 : data.trained + 1].mean(axis=1), squares[:, data.trained + 1 :].mean(axis=1)


def impulse_response(systems: Systems, count: int) -> np.ndarray:
    """The readings (set, count) at rest after a unit input: D, H B, H A B, ..."""
    inputs = np.zeros((len(systems.A), count))
    inputs[:, 0] = 1.0
    return outputs(systems._replace(x0=np.zeros_like(systems.x0)), inputs)


def rows_of(systems: Systems, k: Any) -> Systems:
    """Some of the systems."""
    return Systems(*(part[k] for part in systems))
