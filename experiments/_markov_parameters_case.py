"""Random linear systems with A = I, as section 3.2.2.1 draws them: recordings, exact Markov parameters, a floor."""

from typing import NamedTuple

import numpy as np

# Channels, states and inputs.
SIZES = {"small": (2, 5, 3), "large": (8, 10, 5)}
NOISES = (0.25, 0.5, 1.0)
LAG = 18


class Case(NamedTuple):
    """One random system with a recording of it: readings (row, channel), inputs (row, input), and the exact G.

    `noise` is the standard deviation of both noises; B, H and D are the system's matrices, `exact` (lag, channel,
    input) its Markov parameters D, H B, H B, ...
    """

    noise: float
    B: np.ndarray
    H: np.ndarray
    D: np.ndarray
    inputs: np.ndarray
    readings: np.ndarray

    @property
    def exact(self) -> np.ndarray:
        return np.array([self.D, *[self.H @ self.B] * (LAG - 1)])

    def first(self, equations: int) -> "Case":
        """The rows that make so many equations: each needs the inputs of the LAG - 1 rows before."""
        rows = slice(0, equations + LAG - 1)
        return self._replace(inputs=self.inputs[rows], readings=self.readings[rows])


def case(seed: int, size: str, noise: float, repeat: int, equations: int) -> Case:
    """A system and its recording, which hang on the seed, the size, the noise and the repeat alone."""
    channels, states, inputs = SIZES[size]
    rng = np.random.default_rng([seed, list(SIZES).index(size), round(100 * noise), repeat])
    H, D = (rng.normal(size=(channels, columns)) / channels**0.5 for columns in (states, inputs))
    B = rng.normal(size=(states, inputs)) / states**0.5
    rows = equations + LAG - 1
    # Rows one after another, so that a shorter recording is the beginning of a longer one.
    draws = rng.normal(size=(rows, inputs + states + channels))
    us, process, measurement = np.split(draws, [inputs, inputs + states], axis=1)
    steps = us @ B.T + noise * process
    x = np.concatenate([np.zeros((1, states)), np.cumsum(steps, axis=0)[:-1]])
    return Case(noise, B, H, D, us, x @ H.T + us @ D.T + noise * measurement)


def spectral_error(blocks: np.ndarray, exact: np.ndarray) -> float:
    """The spectral norm of [G_0, ..., G_{lag-1}] less the exact one."""
    return float(np.linalg.norm(np.concatenate(np.asarray(blocks) - exact, axis=1), 2))


def floor(given: Case) -> np.ndarray:
    """Markov parameters by one who knows that A = I: least squares of reading differences on two inputs.

    y_k - y_{k-1} = D u_k + (H B - D) u_{k-1} + noise.
    """
    rows = slice(LAG - 1, None)
    inputs, differences = given.inputs[rows], np.diff(given.readings[rows], axis=0)
    design = np.concatenate([inputs[1:], inputs[:-1]], axis=1)
    found = np.linalg.lstsq(design, differences, rcond=None)[0].T
    D, later = np.split(found, 2, axis=1)
    return np.array([D, *[D + later] * (LAG - 1)])
