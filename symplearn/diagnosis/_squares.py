"""The mean of a product of squares of correlated Gaussians, by joint cumulants (Isserlis 1918)."""

import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int


def log_product_of_squares(
    centre: Float[np.ndarray, "*lane a"], covariance: Float[np.ndarray, "*lane a a"], own: Int[np.ndarray, " a"]
) -> Float[np.ndarray, "*lane"]:
    """Log of the mean of |x_1|^2 |x_2|^2 ..., where `own` tells which vector each entry belongs to, from zero on."""
    blocks = [own == k for k in range(int(own[-1]) + 1)]
    means = [centre[..., None, b] for b in blocks]
    shared = [[covariance[..., b, :][..., c] for c in blocks] for b in blocks]
    cumulants = _cumulants(means, shared)
    moments: dict[tuple[int, ...], np.ndarray] = {(): np.ones(centre.shape[:-1])}
    for some in _subsets(len(blocks)):
        # Its first member is in one cumulant, with some of the others or with none of them.
        parts = [(some[0], *c) for n in range(len(some)) for c in itertools.combinations(some[1:], n)]
        moments[some] = np.sum([cumulants[part] * moments[_without(some, part)] for part in parts], axis=0)
    return np.asarray(np.log(np.maximum(moments[tuple(range(len(blocks)))], 1e-300)))


def _cumulants(
    means: Sequence[Float[np.ndarray, "*lane 1 _"]], shared: Sequence[Sequence[Float[np.ndarray, "*lane _ _"]]]
) -> dict[tuple[int, ...], Float[np.ndarray, "*lane"]]:
    """Joint cumulants of all sets of squares: 2^(n-1) times all m' C C ... m and all trace(C C ...) once around.

    Sums over orders grow by one member at a time, as Held and Karp's (1962) tours do: ways through a set that end at
    one of its members, from a mean or from the set's first.
    """
    found: dict[tuple[int, ...], np.ndarray] = {}
    rows: dict[tuple[tuple[int, ...], int], np.ndarray] = {}
    rings: dict[tuple[tuple[int, ...], int], np.ndarray] = {}
    for some in _subsets(len(means)):
        total = np.zeros(means[0].shape[:-2])
        for k in some:
            less = _without(some, (k,))
            rows[some, k] = sum((rows[less, j] @ shared[j][k] for j in less), np.zeros(())) if less else means[k]
            total = total + (rows[some, k] * means[k])[..., 0, :].sum(-1)
        first = some[0]
        for k in some[1:] or some:
            less = _without(some, (k,))
            ways = [rings[less, j] @ shared[j][k] for j in less[1:]] if len(less) > 1 else [shared[first][k]]
            rings[some, k] = sum(ways, np.zeros(()))
            back = rings[some, k] if len(some) == 1 else rings[some, k] @ shared[k][first]
            total = total + np.trace(back, axis1=-2, axis2=-1)
        found[some] = np.asarray(2.0 ** (len(some) - 1) * total)
    return found


def _subsets(number: int) -> list[tuple[int, ...]]:
    """All sets of some members, smallest first."""
    return [some for n in range(number) for some in itertools.combinations(range(number), n + 1)]


def _without(some: tuple[int, ...], part: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(k for k in some if k not in part)
