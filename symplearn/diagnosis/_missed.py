"""How far readings are missed, as a share of what they vary by."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ._calibrate import residuals, weights
from ._problem import Problem
from ._trajectory import Predictions


@np.errstate(all="ignore")  # a trajectory that ran away misses everything
def share_missed(problem: Problem, predictions: list[Predictions], rows: Sequence[int]) -> Float[np.ndarray, " lane"]:
    """What share of their variation, in the mean over columns, the first rows of every recording are missed by."""
    weight = weights(problem, rows)
    errors = residuals(problem, predictions, weight)
    number = sum((w > 0).sum(0) for w in weight)
    square = sum((x**2).sum(1) for x in errors) / np.maximum(number, 1)
    vary = variance_read(problem)
    some = np.isfinite(vary)
    share = np.sqrt((square[:, some] / vary[some]).sum(1) / max(some.sum(), 1))
    return np.where(np.isnan(share), np.inf, share)


def variance_read(problem: Problem) -> Float[np.ndarray, " channel"]:
    """Variance of every column's fitted readings, NaN where they do not vary."""
    read = np.concatenate([r.readings[: r.fitted] for r in problem.rows])
    seen = [column[~np.isnan(column)] for column in read.T]
    vary = np.array([column.var() if len(column) else 0.0 for column in seen])
    return np.where(vary > 0, vary, np.nan)
