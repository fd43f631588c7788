"""What a rig's true form predicts: fitted by SciPy from the truth on, and run on over the rows that are held out."""

from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from ._rigs_nature import Rig, Values, motion

# Standard deviations beyond which a reading counts no more, so that a motion that is lost ends nothing.
_LOST = 1e6


def held_out(rig: Rig, readings: np.ndarray, fitted: int) -> np.ndarray:
    """Rms errors, by column, of the rows after the first ones that are fitted."""
    values, parameters, states = _predicted(rig, _fit(rig, readings, fitted))
    shown = rig.shown(states, rig.times, values, parameters)
    return np.asarray(np.sqrt(np.mean((readings - shown)[fitted:] ** 2, axis=0)))


def sizes(rig: Rig) -> dict[str, float]:
    """By effect, what the readings lose without it, all else as it is, in sd of the noise (rms)."""

    def read(values: Values) -> np.ndarray:
        states = motion(rig, values, rig.parameters, rig.start, rig.times)
        return rig.shown(states, rig.times, values, rig.parameters) / rig.noise

    whole = read(rig.values)
    return {k: float(np.sqrt(np.mean((whole - read(rig.values | {k: 0.0})) ** 2))) for k in rig.effects}


def _fit(rig: Rig, readings: np.ndarray, fitted: int) -> np.ndarray:
    """Values of effects, parameters and the start, in shares of the true ones, by least squares with the priors."""
    first = replace(rig, times=rig.times[:fitted])
    given = np.array(list(rig.given.values()))

    def errors(z: np.ndarray) -> np.ndarray:
        values, parameters, states = _predicted(first, z)
        missed = (readings[:fitted] - first.shown(states, first.times, values, parameters)) / rig.noise
        off = (np.array(list(parameters.values())) - given[:, 0]) / given[:, 1]
        return np.concatenate([np.clip(np.nan_to_num(missed.ravel(), nan=_LOST), -_LOST, _LOST), off])

    begin = np.zeros(len(_free(rig)) + len(rig.parameters) + len(rig.start))
    return np.asarray(least_squares(errors, begin, x_scale=0.01, max_nfev=25).x)


def _free(rig: Rig) -> list[str]:
    return [k for k, value in rig.values.items() if value and (k in rig.effects or "joined" in rig.effects)]


def _predicted(rig: Rig, z: np.ndarray) -> tuple[Values, Values, np.ndarray]:
    """Values, parameters and states of some shares."""
    free = _free(rig)
    values = rig.values | {k: rig.values[k] * (1 + x) for k, x in zip(free, z, strict=False)}
    rest = z[len(free) :]
    parameters = {k: v + rig.given[k][1] * x for (k, v), x in zip(rig.parameters.items(), rest, strict=False)}
    size = np.maximum(np.abs(rig.start), 0.1 * rig.scale)
    start = rig.start + size * rest[len(parameters) :]
    return values, parameters, motion(rig, values, parameters, start, rig.times, quickly=True)
