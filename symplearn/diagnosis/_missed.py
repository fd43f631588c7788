"""How far readings are missed beyond their noise, as a share of what they vary by beyond it."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ._build import rows_fitted
from ._calibrate import residuals, weights
from ._problem import Problem
from ._trajectory import Predictions

# Standard errors of a mean square by which one has to be above that of noise, to be of something else.
_ABOVE = 3.0


@np.errstate(all="ignore")  # a trajectory that ran away misses everything
def share_missed(problem: Problem, predictions: list[Predictions], rows: Sequence[int]) -> Float[np.ndarray, " lane"]:
    """What share of their variation, in the mean over columns, the first rows of every recording are missed by; nothing
    of a column that shows hardly more than noise, however it is missed."""
    weight = weights(problem, rows)
    errors = residuals(problem, predictions, weight)
    number = sum((w > 0).sum(0) for w in weight)
    square = sum((x**2).sum(1) for x in errors) / np.maximum(number, 1)
    noise, vary = variances(problem)
    some = np.isfinite(vary)
    beyond = np.maximum(square - noise * (1 + _ABOVE * np.sqrt(2 / np.maximum(number, 1))), 0.0)
    share = np.sqrt((beyond[:, some] / vary[some]).sum(1) / max(some.sum(), 1))
    return np.where(np.isnan(share), np.inf, share)


def variances(problem: Problem) -> tuple[Float[np.ndarray, " channel"], Float[np.ndarray, " channel"]]:
    """Of every column's fitted readings, that of their noise and that of what they show beside it; NaN for the latter
    where it is not clear that they show anything."""
    rows = rows_fitted(problem.rows)
    read = np.concatenate([r.readings[: r.fitted] for r in problem.rows])
    counts = np.concatenate([r.counts[: r.fitted] for r in problem.rows])
    seen = counts > 0
    number, mean = np.maximum(seen.sum(0), 1), np.where(seen, 1 / np.maximum(counts, 1), 0.0).sum(0)
    noise = rough_noise(problem, rows) ** 2 * mean / number
    vary = np.array([column[there].var() if there.any() else 0.0 for column, there in zip(read.T, seen.T, strict=True)])
    shown = vary - noise
    return noise, np.where(shown > _ABOVE * np.sqrt(2 / number) * noise, shown, np.nan)


def rough_noise(problem: Problem, rows: Sequence[int]) -> Float[np.ndarray, " channel"]:
    """Reading noise from third differences, which a smooth motion hardly has."""
    out = []
    for j, known in enumerate(problem.noise):
        columns = [r.readings[:n, j] for r, n in zip(problem.rows, rows, strict=True)]
        joined = np.concatenate([np.diff(column, 3) ** 2 / 20 for column in columns])
        spread = np.nanstd(np.concatenate(columns))
        rough = np.sqrt(np.nanmedian(joined) / 0.455) if np.isfinite(joined).any() else spread
        counts = np.concatenate([r.counts[:n, j] for r, n in zip(problem.rows, rows, strict=True)])
        count = float(np.median(counts[counts > 0])) if counts.any() else 1.0
        out.append(known if np.isfinite(known) else max(rough, 1e-6 * spread) * np.sqrt(count))
    return np.array(out)
