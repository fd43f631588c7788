"""How far the Gaussian about a fit holds.

Where readings tell nothing of a direction, as of the angle of an orbit of which only the distance is read, the Gaussian
is as wide there as the prior, along a tangent: a standard deviation off, the orbit is another one. What starts so far
out is filtered to nowhere, and what is drawn there says nothing.
"""

from functools import partial

import numpy as np
from jaxtyping import Float

from ._lasting import colour_ratio, total_noise
from ._stochastic import free_run, row_roots
from ._trajectory import Stepper
from ._weighed import Estimate

# The mean of the readings one standard deviation up and down may differ from those between by this chi-square.
_BENT = 1.0
# How often a direction is halved that leads farther.
_HALVINGS = 30
# Directions of a correlation matrix below this share of its longest are round-off.
_ROUND_OFF = 1e-12


def covariance_within_reach(
    stepper: Stepper, e: Estimate, recording: int, inflation: float = 1.0
) -> Float[np.ndarray, "local local"]:
    """Posterior covariance of all that one recording depends on, its phase point first, that one shortened along every
    direction until the readings of a run are even in it.

    What goes with the phase point is shortened with it; what is known beside it stays.
    """
    problem = stepper.problem
    local = problem.local(recording)
    whole = e.covariance[np.ix_(local, local)] * inflation
    middle = _readings(stepper, e, recording, np.zeros(len(local)))
    for along in _with_the_start(whole, problem.state):
        share = _share(stepper, e, recording, along, middle)
        whole = whole - (1.0 - share**2) * np.outer(along, along)
    return whole


def _with_the_start(whole: Float[np.ndarray, "local local"], state: int) -> Float[np.ndarray, "direction local"]:
    """The principal directions of the phase point, by its components' own widths, a standard deviation long each, and
    how all else follows."""
    width = np.sqrt(np.diagonal(whole)[:state])
    free = np.flatnonzero(np.isfinite(width) & (width > 0))
    values, vectors = np.linalg.eigh(whole[np.ix_(free, free)] / np.outer(width[free], width[free]))
    kept = values > _ROUND_OFF * values[-1] if len(values) else np.zeros(0, bool)
    inverse = vectors[:, kept] / np.sqrt(values[kept]) / width[free, None]
    return (whole[:, free] @ inverse).T


def _share(
    stepper: Stepper, e: Estimate, recording: int, along: Float[np.ndarray, " local"], middle: np.ndarray
) -> float:
    """The largest share of a direction, halved again and again, in which readings are even about those of the fit."""
    for share in 0.5 ** np.arange(_HALVINGS):
        both = stepper.ahead(partial(_readings, stepper, e, recording), [-share * along, share * along])
        if float(((sum(both) / 2 - middle) ** 2).sum()) <= _BENT:
            break
    return float(share)


def _readings(
    stepper: Stepper, e: Estimate, recording: int, off: Float[np.ndarray, " local"]
) -> Float[np.ndarray, "fitted channel"]:
    """Readings of the fitted rows that were read, by their noise, of a run that begins `off` the fit."""
    problem, z = stepper.problem, e.z.copy()
    rows = problem.rows[recording]
    z[problem.local(recording)] += off
    run, _ = free_run(problem, stepper.courses[recording], z, e.combination, recording,
                      z[recording * problem.state : (recording + 1) * problem.state], 0)  # fmt: skip
    n = rows.fitted
    scale = row_roots(problem, recording, n, colour_ratio(e)) / total_noise(e)
    return np.where(np.isnan(rows.readings[:n]), 0.0, run[:n] * scale)
