"""Which channels bear a remainder of the sensors, and how large it is: all of them, or a single one."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import logsumexp

# As good as none.
_NONE = 1e-12


class Sizes(NamedTuple):
    """Of one channel: the likeliest size of an error against the noise, and log likelihoods under that size, on average
    over all sizes, and without the error."""

    best: float
    largest: float
    mean: float
    without: float


class Left(NamedTuple):
    """What an error of some size leaves of one channel: the whitened errors' sum of squares, and the log determinant
    of their covariance by the noise's variance."""

    square: float
    log: float


def log_likelihood(left: Left, number: int, known: float, variance: float, most: float) -> float:
    """Log likelihood of a channel's readings, but for a constant, under a noise that is `known`, or at its likeliest
    where that is NaN; minus infinity where the error, of a `variance` in the noise's, is larger than `most`."""
    white = max(left.square / max(number, 1) if np.isnan(known) else known**2, 1e-300)
    if not variance * white <= most**2:
        return -np.inf
    return -0.5 * (number * float(np.log(white)) + left.square / white + left.log)


def sizes(value: Callable[[float], float], tried: Float[np.ndarray, " size"]) -> Sizes:
    """Of a log likelihood by size; minus infinity where a size is not allowed."""
    values = np.array([value(float(size)) for size in tried])
    best = int(np.argmax(values))
    if not np.isfinite(values[best]):
        return Sizes(float(tried[0]), 0.0, -np.inf, 0.0)
    mean = values[best] + float(np.log(np.mean(np.exp(values - values[best]))))
    return Sizes(float(tried[best]), float(values[best]), float(mean), float(value(_NONE)))


def borne(channels: Sequence[Sizes]) -> tuple[list[float], float]:
    """Sizes of the errors of the likeliest bearers, as good as none elsewhere, and what that choice owes.

    An error of every sensor and one of a single sensor are as likely beforehand, each sensor alike.
    """
    number = len(channels)
    single, every = np.eye(number, dtype=bool), np.ones((1, number), bool)
    options = every if number == 1 else np.concatenate([every, single])
    prior = np.log([1.0] if number == 1 else [0.5, *[0.5 / number] * number])
    logs = prior + np.array([_log(channels, option) for option in options])
    chosen = options[int(np.argmax(logs))]
    taken = sum(one.largest if on else one.without for one, on in zip(channels, chosen, strict=True))
    owed = float(logsumexp(logs)) - taken if np.isfinite(logs).any() else -np.inf
    return [one.best if on else _NONE for one, on in zip(channels, chosen, strict=True)], owed


def _log(channels: Sequence[Sizes], on: Bool[np.ndarray, " channel"]) -> float:
    return sum(one.mean if bears else one.without for one, bears in zip(channels, on, strict=True))
