"""The modes of a posterior: which draws belong to the same hill, how much mass it holds, and its own peak."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from ._arviz import arviz
from ._counts import refuse_count
from ._errors import InputError
from ._fit import Estimate, fit
from ._lane_loops import with_lane_loops
from ._parameters import flatten
from ._posterior import Posterior, evenly, log_posterior_of, models_at
from ._sampler import LogDensity, possible
from ._student_mixture import scatter

# A draw is linked to one of so many nearest draws of higher density, and the density looked at so often on the way.
_CANDIDATES, _STOPS, _AT_ONCE = 8, 5, 250


@dataclasses.dataclass(frozen=True)
class Mode:
    """One hill of a posterior: its draws, its peak, and its `share` of the posterior mass.

    `share_sd` is the share's Monte Carlo standard error; where it is large, the chains seldom change hills, and the
    share says more of where they started. `free` (draw, parameter) are its draws in free coordinates. `estimate` is the
    most probable model of this hill; None for a density of the user's own.
    """

    share: float
    share_sd: float
    free: Float[Array, "draw parameter"]
    estimate: Estimate | None

    def draws(self, count: int | None = None) -> Float[Array, "draw parameter"]:
        """Free coordinates of `count` evenly spaced draws, or of all.

        **Raises:** `InputError` where `count` is not from 1 to the number of draws.
        """
        return evenly(self.free, count)

    def models(self, count: int | None = None) -> Any:
        """The draws as models in plain arrays, stacked, as `Posterior.models` gives them."""
        if self.estimate is None:
            raise InputError("This mode is of a density without a model; its draws are in `free`.")
        return models_at(self.estimate.model, self.draws(count))

    def __str__(self) -> str:
        peak = "" if self.estimate is None else f", log posterior at most {self.estimate.log_posterior:.3f} nats"
        return f"Mode: {100 * self.share:.1f} +- {100 * self.share_sd:.1f} % of the posterior mass{peak}"


def modes(
    posterior: Posterior,
    *,
    log_density: LogDensity | None = None,
    depth: float = 1.0,
    draws: int = 1000,
    least: float = 0.02,
) -> tuple[Mode, ...]:
    """The hills of a posterior, the one of the most mass first; `modes(posterior)[0]` is the dominant one.

    Each of `draws` evenly spaced draws is linked to the nearest one of higher density, in coordinates whitened by their
    covariance, if on the straight way there the log density falls by less than `depth` nats; to the next nearest if
    not. What hangs together is a mode (Koontz et al. 1976, IEEE Trans. Comput. 25, 936); the other draws go with their
    nearest. Modes of less than a share `least` are not told, so that shares may add up to less than one. For some
    twenty parameters at most: beyond, no two draws are near each other.

    `posterior_forecast(modes(posterior)[0], ...)` is the decision rule of sec. 3.3.2.1 where the mean of a posterior
    with two modes is near neither.

    **Arguments:** `log_density` - for a posterior that `sample_density` gave, the density it was given.

    **Raises:** `InputError` for such a posterior without `log_density`, where `depth` is not positive, or of fewer
    than two `draws`.
    """
    refuse_count("modes", "draws", draws, least=2)
    if posterior.estimate is None and log_density is None:
        raise InputError("This posterior does not hold its density; give `log_density`, as `sample_density` had it.")
    if not depth > 0:
        raise InputError(f"`modes` needs a positive `depth` between two modes, but was given {depth}.")
    density: Any = log_density if posterior.estimate is None else log_posterior_of(posterior.estimate)
    free, heights = np.asarray(posterior.draws()), np.asarray(posterior.log_posterior).reshape(-1)
    z = _white(free)
    # Resampled draws and rejected proposals are there several times.
    distinct = np.sort(np.unique(free, axis=0, return_index=True)[1])
    chosen = distinct[np.arange(min(draws, len(distinct))) * len(distinct) // min(draws, len(distinct))]
    summits = _summits(density, free[chosen], heights[chosen], z[chosen], depth)
    labels = summits[cKDTree(z[chosen]).query(z)[1]]
    found = []
    for label in np.unique(labels):
        inside = labels == label
        if inside.mean() >= least:
            peak = free[inside][np.argmax(heights[inside])], float(heights[inside].max())
            estimate = None if posterior.estimate is None else _estimate(posterior.estimate, density, *peak, depth)
            found.append(Mode(*_share(inside, posterior), jnp.asarray(free[inside]), estimate))
    return tuple(sorted(found, key=lambda mode: -mode.share))


def _white(free: np.ndarray) -> np.ndarray:
    """Draws in coordinates in which their covariance is the unit matrix."""
    scales = np.maximum(free.std(axis=0), 1e-300)
    scaled = (free - free.mean(axis=0)) / scales
    root = np.linalg.cholesky(scatter(scaled, np.full(len(free), 1.0 / len(free))))
    return np.linalg.solve(root, scaled.T).T


def _summits(density: Any, free: np.ndarray, heights: np.ndarray, z: np.ndarray, depth: float) -> np.ndarray:
    """For each draw the one that its links end at."""
    distances = cdist(z, z)
    distances[heights[:, None] >= heights] = np.inf
    links = np.arange(len(z))
    for candidates in np.argsort(distances, axis=1)[:, :_CANDIDATES].T:
        loose = np.flatnonzero((links == np.arange(len(z))) & np.isfinite(distances[np.arange(len(z)), candidates]))
        to = candidates[loose]
        joined = _falls(density, free[loose], free[to], heights[loose]) < depth
        links[loose[joined]] = to[joined]
    while not np.array_equal(links, links[links]):
        links = links[links]
    return links


def _falls(density: Any, start: np.ndarray, end: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """By how many nats the log density falls below `heights` on the straight ways from draws to others."""
    shares = np.arange(1, _STOPS + 1)[:, None] / (_STOPS + 1)
    falls = []
    for k in range(0, len(start), _AT_ONCE):
        # Always as many at once, for one compiled program.
        rows = np.minimum(np.arange(k, k + _AT_ONCE), len(start) - 1)
        stops = start[rows, None] + shares * (end - start)[rows, None]
        values = np.asarray(_values(density, jnp.asarray(stops)))
        falls.append((heights[rows] - values.min(axis=1))[: len(start) - k])
    return np.concatenate(falls) if falls else np.zeros(0)


@eqx.filter_jit
def _values(density, stops):
    return possible(jax.vmap(jax.vmap(with_lane_loops(density)))(stops))


def _share(inside: np.ndarray, posterior: Posterior) -> tuple[float, float]:
    """The share of the draws, and its Monte Carlo standard error."""
    share = float(inside.mean())
    by_chain = inside.reshape(posterior.free.shape[:2]).astype(float)
    return share, float(arviz().mcse(by_chain)) if share < 1.0 else 0.0


def _estimate(estimate: Estimate, density: Any, peak: np.ndarray, height: float, depth: float) -> Estimate:
    """The most probable model of a hill: the one sampled around if that is of it, else fitted from the best draw."""
    vector, rebuild = flatten(estimate.model)
    own = np.asarray(vector)
    if estimate.log_posterior >= height and _falls(density, peak[None], own[None], np.array([height]))[0] < depth:
        return estimate
    return fit(rebuild(jnp.asarray(peak)), estimate.recording, estimate.objective, prior=estimate.prior)
