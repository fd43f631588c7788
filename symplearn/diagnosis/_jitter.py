"""A remainder in the times of single rows: each is read a little early or late, by chance.

Such an error is white, and in proportion to the rate of what is read: readings scatter most where they change fastest,
and where they turn as the sensor's noise has it. That is not a sensor noisier than stated, which scatters alike
everywhere.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from ._bearers import Left, Sizes, borne, log_likelihood, sizes
from ._calibrate import Fits, Priors, residuals, weights
from ._clock_errors import rates
from ._evidence import variance_inflation
from ._problem import Problem
from ._scatter import law_gain
from ._weighed import Estimate, correlated, largest, of_any_strength, trusting

# Variances of the error against the noise's that are tried, where the rate is its root mean square.
_RATIOS = np.geomspace(0.02, 50.0, 12)


@dataclass(frozen=True, eq=False)
class _Channel:
    """Columns [error, slopes] of one channel, all recordings end to end, with the squared rates by their mean."""

    columns: Float[np.ndarray, "column row"]
    rates: Float[np.ndarray, " row"]
    weight: Float[np.ndarray, " row"]

    @property
    def seen(self) -> Bool[np.ndarray, " row"]:
        return self.weight > 0

    def roots(self, ratio: float) -> Float[np.ndarray, " row"]:
        """What a reading is to be multiplied by to be in units of one reading's noise."""
        return np.sqrt(self.weight / (1.0 + ratio * self.rates))

    def left(self, ratio: float) -> Left:
        """What is left of the errors."""
        root = self.roots(ratio)
        return Left(float(((self.columns[0] * root) ** 2).sum()), -2 * float(np.log(root[self.seen]).sum()))


@np.errstate(all="ignore")  # a lane that diverged is told by its evidence
def weigh_jitter(problem: Problem, fits: Fits, priors: Priors, rows: Sequence[int]) -> list[Estimate]:
    """Estimates where the times of all rows jitter, about the trajectory fit.

    None for a combination with a wrongly given noise, which does the same for the most part.
    """
    weight, out = weights(problem, rows), []
    errors = residuals(problem, fits.predictions, weight)
    number = sum((w > 0).sum(0) for w in weight)
    for b in trusting(problem, fits):
        channels = [_channel(problem, fits, errors, weight, b, j) for j in range(problem.channels)]
        ratios, occam = borne([_sizes(problem, one, j) for j, one in enumerate(channels)])
        whole = [one.columns * one.roots(ratio) for one, ratio in zip(channels, ratios, strict=True)]
        logs = np.array([one.left(ratio).log for one, ratio in zip(channels, ratios, strict=True)])
        one = correlated(problem, fits, b, np.stack([x @ x.T for x in whole]), logs, number, occam, priors)
        column = np.concatenate([[1.0], fits.z[b] - one.z])
        left = [column @ x / noise for x, noise in zip(whole, one.noise, strict=True)]
        told = np.stack([np.where(c.seen, e, np.nan) for c, e in zip(channels, left, strict=True)], axis=1)
        value = one.log_evidence + law_gain(problem, one.combination, told)
        scores = sum(x[1:] * e / noise for x, e, noise in zip(whole, left, one.noise, strict=True))
        out.append(replace(one, kind="jitter", log_evidence=value, jitters=tuple(ratios),
                           inflation=variance_inflation(scores.T)))  # fmt: skip
    return of_any_strength(problem, priors, out)


def _channel(
    problem: Problem, fits: Fits, errors: Sequence[np.ndarray], weight: Sequence[np.ndarray], b: int, j: int
) -> _Channel:
    parts = []
    for k, (x, w) in enumerate(zip(errors, weight, strict=True)):
        slopes = np.zeros((problem.size, len(w)))
        slopes[problem.local(k)] = fits.predictions[k].slopes[b, :, :, j]
        parts.append(np.where(w[:, j] > 0, np.concatenate([x[b, None, :, j], slopes]), 0.0))
    times = [r.times[: len(w)] for r, w in zip(problem.rows, weight, strict=True)]
    squares = np.concatenate(rates([p.readings[b, :, j] for p in fits.predictions], times)) ** 2
    return _Channel(np.concatenate(parts, axis=1), squares, np.concatenate([w[:, j] for w in weight]))


def _sizes(problem: Problem, one: _Channel, j: int) -> Sizes:
    """Variances of the error against the noise's, which may be known."""
    known, number, most = problem.noise[j], int(one.seen.sum()), largest(problem, j)
    return sizes(lambda ratio: log_likelihood(one.left(ratio), number, known, ratio, most), _RATIOS)
