"""What the oracle says of a wrong noise and of outliers: likelihoods of the errors against the true readings."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.optimize import minimize

from ._concealed_effects import Effect

NOISY = ("sensor_noise", "sensor_outliers")
FAR = 5.0  # sd beyond which the oracle takes a reading for an outlier, where there are any


def noise_widths(effects: Sequence[Effect], seen: tuple[np.ndarray, ...]) -> dict[str, float]:
    found, n = {}, sum(len(s) for s in seen)
    for e in effects:
        if e.word == "sensor_noise":
            found["|".join([*e.key, "s"])] = 3.92 * e.values["s"] / np.sqrt(2 * n)
        elif e.word == "sensor_outliers":
            part = e.values["e"]
            found["|".join([*e.key, "e"])] = 3.92 * float(np.sqrt(part * (1 - part) / n))
            found["|".join([*e.key, "sd"])] = 3.92 * e.values["sd"] / float(np.sqrt(2 * max(part * n, 1)))
    return found


def without_outliers(answer: Any, effects: Sequence[Effect], seen: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
    """The readings, those far from the truth blanked where outliers were put in."""
    hit = {str(e.target) for e in effects if e.word == "sensor_outliers"}
    found = []
    for readings, clean in zip(seen, answer["clean"], strict=True):
        kept = readings.copy()
        for k, column in enumerate(answer["columns"]):
            if column in hit:
                far = np.abs(readings[:, k] - np.array(clean)[:, k]) > FAR * answer["noise"][column]
                kept[far, k] = np.nan
        found.append(kept)
    return tuple(found)


def noise_margins(answer: Any, effects: Sequence[Effect], seen: tuple[np.ndarray, ...]) -> dict[str, float]:
    """Margins of a wrong noise and of outliers, from the errors against the true readings."""
    found = {}
    for e in effects:
        if e.word not in NOISY:
            continue
        k, column = answer["columns"].index(e.target), str(e.target)
        pairs = zip(seen, answer["clean"], strict=True)
        error = np.concatenate([s[:, k] - np.array(c)[:, k] for s, c in pairs])
        error = error[np.isfinite(error)]
        stated = answer["stated_noise"].get(column)
        plain, free, mixed = _likelihoods(error, stated or float(np.std(error)), answer["noise"][column])
        penalty = np.log(len(error))
        if e.word == "sensor_noise":
            found |= {f"nothing of {column}": plain - free - penalty, f"outliers of {column}": mixed - free + penalty}
        else:
            bare = plain if stated else free
            found |= {f"nothing of {column}": bare - mixed - 2 * penalty, f"noise of {column}": free - mixed - penalty}
    return found


def _likelihoods(error: np.ndarray, stated: float, noise: float) -> tuple[float, float, float]:
    """-2 log likelihood with the stated sd, with the best sd, and with the best mixture of narrow and wide."""
    n, square = len(error), float(np.mean(error**2))
    plain = n * np.log(2 * np.pi * stated**2) + n * square / stated**2
    free = n * np.log(2 * np.pi * square) + n

    def minus(z: np.ndarray) -> float:
        part, sd = 1 / (1 + np.exp(-z[0])), np.exp(z[1])
        wide = np.hypot(noise, sd)
        density = (1 - part) * np.exp(-((error / noise) ** 2) / 2) / noise
        return -2 * float(
            np.sum(np.log((density + part * np.exp(-((error / wide) ** 2) / 2) / wide) / np.sqrt(2 * np.pi)))
        )

    mixed = minimize(minus, np.array([-3.0, np.log(10 * noise)]), method="Nelder-Mead").fun
    return plain, free, float(mixed)
