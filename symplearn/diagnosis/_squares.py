"""The mean of a product of squares of correlated Gaussians, by joint cumulants (Isserlis 1918)."""

import itertools
from collections.abc import Iterator
from functools import reduce

import numpy as np
from jaxtyping import Float, Int


def log_product_of_squares(
    centre: Float[np.ndarray, "*lane a"], covariance: Float[np.ndarray, "*lane a a"], own: Int[np.ndarray, " a"]
) -> Float[np.ndarray, "*lane"]:
    """Log of the mean of |x_1|^2 |x_2|^2 ..., where `own` tells which vector each entry belongs to, from zero on."""
    blocks = [own == k for k in range(int(own[-1]) + 1)]
    means = [centre[..., None, b] for b in blocks]
    shared = [[covariance[..., b, :][..., c] for c in blocks] for b in blocks]
    whole = tuple(range(len(blocks)))
    cumulants = {some: _cumulant(some, means, shared) for n in whole for some in itertools.combinations(whole, n + 1)}
    product = sum(
        (np.prod([cumulants[some] for some in parts], axis=0) for parts in _partitions(whole)),
        np.zeros(centre.shape[:-1]),
    )
    return np.asarray(np.log(np.maximum(product, 1e-300)))


def _cumulant(
    some: tuple[int, ...], means: list[np.ndarray], shared: list[list[np.ndarray]]
) -> Float[np.ndarray, "*lane"]:
    """The joint cumulant of squares: 2^(n-1) times all m' C C ... m and all trace(C C ...) once around."""
    total = np.zeros(means[0].shape[:-2])
    for order in itertools.permutations(some):
        row = reduce(np.matmul, (shared[j][k] for j, k in itertools.pairwise(order)), means[order[0]])
        total += (row @ means[order[-1]].mT)[..., 0, 0]
    for order in itertools.permutations(some[1:]):
        ring = itertools.pairwise((some[0], *order, some[0]))
        total += np.trace(reduce(np.matmul, (shared[j][k] for j, k in ring)), axis1=-2, axis2=-1)
    return np.asarray(2.0 ** (len(some) - 1) * total)


def _partitions(some: tuple[int, ...]) -> Iterator[list[tuple[int, ...]]]:
    """All ways to part a set."""
    if not some:
        yield []
        return
    for size in range(len(some)):
        for beside in itertools.combinations(some[1:], size):
            for parts in _partitions(tuple(k for k in some[1:] if k not in beside)):
                yield [(some[0], *beside), *parts]
