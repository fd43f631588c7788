"""Mixtures of widths of several effects' priors: what all choices of them gain over the widest."""

import itertools
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int

# So many effects have every choice of their widths weighed.
_TOGETHER = 3

# Log weights of some choices, and after them of the widest.
Weigh = Callable[[Int[np.ndarray, "lane choice effect"]], Float[np.ndarray, "lane weighed"]]


def over_widest(logs: Float[np.ndarray, "lane weighed"]) -> Float[np.ndarray, " lane"]:
    """What all choices of widths gain over the widest, which is the last."""
    return np.asarray(np.logaddexp.reduce(logs[:, :-1], axis=1) - np.log(logs.shape[1] - 1) - logs[:, -1])


def over_choices(
    weighed: Weigh, widths: Float[np.ndarray, "lane effect width"], centre: Float[np.ndarray, "lane a"],
    own: Int[np.ndarray, " a"],
) -> Float[np.ndarray, " lane"]:  # fmt: skip
    """The same of every effect's `widths` with every other's. Of more than three effects these are too many: there as
    if each width were likelier or not whatever the others are, about a likely choice.

    That is the one nearest to the effects' sizes, of which `centre` has the entries and `own` tells whose each is, or
    the one that its lines lead to, whichever is likelier.
    """
    lanes, effects, number = widths.shape
    if effects <= _TOGETHER:
        every = _choices(number, effects)
        return over_widest(weighed(np.broadcast_to(every, (lanes, *every.shape))))
    sizes = np.stack([np.sqrt((centre[:, own == k] ** 2).mean(1)) for k in range(effects)], axis=1)
    nearest = np.abs(np.log(widths / np.maximum(sizes, 1e-300)[..., None])).argmin(-1)
    first, before = _lines(weighed, nearest, number)
    second, after = _lines(weighed, before[:, :-1].reshape(lanes, effects, number).argmax(-1), number)
    better = first > second
    top, logs = np.where(better, first, second), np.where(better[:, None], before, after)
    lines = np.logaddexp.reduce(logs[:, :-1].reshape(lanes, effects, number), axis=-1) - np.log(number)
    return np.asarray(top + (lines - top[:, None]).sum(-1) - logs[:, -1])


def _lines(
    weighed: Weigh, about: Int[np.ndarray, "lane effect"], number: int
) -> tuple[Float[np.ndarray, " lane"], Float[np.ndarray, "lane weighed"]]:
    """Log weights of a choice of widths; and of those with one of them another, effect by effect."""
    effects = about.shape[1]
    choices = np.tile(about[:, None], (1, effects * number, 1))
    for k in range(effects):
        choices[:, k * number : (k + 1) * number, k] = np.arange(number)
    logs = weighed(choices)
    return logs[np.arange(len(about)), about[:, 0]], logs


@lru_cache
def _choices(widths: int, effects: int) -> Int[np.ndarray, "choice effect"]:
    return np.array(list(itertools.product(range(widths), repeat=effects)))
