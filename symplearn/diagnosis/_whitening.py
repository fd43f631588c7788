"""Readings' errors and slopes whitened as an estimate takes their remainder: what is regressed on beside it."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from ._bend import Form
from ._calibrate import Fits, weights
from ._clock_errors import whitened_beside
from ._coloured import whitened_series
from ._positional import cleared_of, whitened_along
from ._problem import Problem
from ._weighed import Estimate

# Columns of all readings by the noise of a fit of one lane, recordings end to end (as `by_the_noise` gives them).
Whiten = Callable[[Float[np.ndarray, "column reading"]], Float[np.ndarray, "column reading"]]


def whitening(problem: Problem, fits: Fits, rows: Sequence[int], estimate: Estimate) -> Whiten | None:
    """What whitens the readings of a fit of one lane, and counts them by the noise that is left of the remainder that
    an estimate has; None for one without."""
    if estimate.kind not in ("coloured", "clock", "positional", "kinematic"):
        return None
    weight = weights(problem, rows)
    scale = fits.noise[0] / estimate.noise

    def whiten(columns: Float[np.ndarray, "column reading"]) -> Float[np.ndarray, "column reading"]:
        ends = np.cumsum([0, *(w.size for w in weight)])
        parts = [columns[:, a:b].reshape(len(columns), *w.shape) * scale
                 for a, b, w in zip(ends[:-1], ends[1:], weight, strict=True)]  # fmt: skip
        for j in range(problem.channels):
            own = [np.where(w[:, j] > 0, part[..., j] / np.sqrt(np.where(w[:, j] > 0, w[:, j], 1.0)), 0.0)
                   for part, w in zip(parts, weight, strict=True)]  # fmt: skip
            for part, x in zip(parts, _channel(problem, fits, weight, estimate, j, own), strict=True):
                part[..., j] = x
        return np.concatenate([part.reshape(len(columns), -1) for part in parts], axis=1)

    return whiten


def _channel(
    problem: Problem, fits: Fits, weight: Sequence[np.ndarray], estimate: Estimate, j: int, columns: list[np.ndarray]
) -> list[Float[np.ndarray, "column _"]]:
    """One channel's columns, by recording, each in units of one reading's noise."""
    own, shown = [w[:, j] for w in weight], [p.readings[0, :, j] for p in fits.predictions]
    times = [r.times[: len(w)] for r, w in zip(problem.rows, weight, strict=True)]
    if estimate.kind == "coloured":
        return [whitened_series(x, w, t, estimate.colours[j]).T for x, w, t in zip(columns, own, times, strict=True)]
    if estimate.kind == "clock":
        return _beside_a_clock(estimate, j, columns, shown, own, times)
    form = estimate.bends[j].shapes.form if estimate.bends else Form.BENDS
    return whitened_along(columns, shown, times, own, estimate.bent[j], estimate.kind == "kinematic", form)


def _beside_a_clock(
    estimate: Estimate, j: int, columns: Sequence[Float[np.ndarray, "column _"]],
    shown: Sequence[Float[np.ndarray, " _"]], weight: Sequence[Float[np.ndarray, " _"]],
    times: Sequence[Float[np.ndarray, " _"]],
) -> list[Float[np.ndarray, "column _"]]:  # fmt: skip
    """The same beside errors of the sensor and its clock, and beside the curve that may go with them."""
    both = estimate.colours[j], estimate.clocks[j]
    if not estimate.bends:
        return whitened_beside(columns, shown, weight, times, both)
    curves = [
        np.where(w > 0, estimate.bends[j].shapes(x, t).T, 0.0) for w, x, t in zip(weight, shown, times, strict=True)
    ]
    joint = [np.concatenate(pair) for pair in zip(columns, curves, strict=True)]
    done = whitened_beside(joint, shown, weight, times, both)
    number = len(columns[0])
    return cleared_of([x[:number] for x in done], [x[number:] for x in done], estimate.bent[j])
