"""How large a motion may be, from what is read: coordinates in nanocoulombs, momenta in kilogrammes times kilometres.

A coordinate is as large as moves a reading by what the readings vary; a momentum moves its coordinate by that in the
time in which they do; and what is not read has as much kinetic energy as what is.
"""

import numpy as np
from jaxtyping import Bool, Float

from ._along import What, along, readings, velocity
from ._problem import Problem

# Displacements that are tried.
_TRIED = np.geomspace(1e-15, 1e15, 31)
# How far beside a mean that tells nothing the same is tried.
_ASIDE = 1.0
# A displacement shows that moves a reading by this share of what the readings vary.
_SHOWN = 0.3


@np.errstate(all="ignore")  # what is not finite far out is left out
def sizes_of_motion(problem: Problem, z: Float[np.ndarray, " z"], r: int) -> Float[np.ndarray, " state"]:
    """Size of every component of the phase point in its own unit, NaN where the recording does not tell.

    **Arguments:** - `z`: the unknowns, at their prior means. - `r`: the recording, from 0.
    """
    begin = z[r * problem.state : (r + 1) * problem.state]
    at_mean = _sizes_about(problem, z, r, begin)
    width, d = problem.equations.width, problem.equations.dim
    if np.isfinite(at_mean[[*range(d), *range(width, width + d)]]).all():
        return at_mean
    return np.where(np.isfinite(at_mean), at_mean, _sizes_about(problem, z, r, _aside(problem, begin)))


@np.errstate(all="ignore")
def is_read(problem: Problem, z: Float[np.ndarray, " z"], r: int) -> Bool[np.ndarray, " state"]:
    """Which components of the phase point move what is read.

    **Arguments:** - `z`: the unknowns, at their prior means. - `r`: the recording, from 0.
    """
    begin = z[r * problem.state : (r + 1) * problem.state]
    about = begin, _aside(problem, begin)
    return np.any([np.isfinite(_sizes_read(problem, z, r, point)) for point in about], axis=0)


def _aside(problem: Problem, begin: Float[np.ndarray, " state"]) -> Float[np.ndarray, " state"]:
    """Where nothing is known the mean is zero, which may be a singularity: no angle, no distance."""
    return np.where(np.isinf(problem.initial.sd), begin + _ASIDE, begin)


def _sizes_about(
    problem: Problem, z: Float[np.ndarray, " z"], r: int, begin: Float[np.ndarray, " state"]
) -> Float[np.ndarray, " state"]:
    """The same by displacements from one phase point."""
    width, d, out = problem.equations.width, problem.equations.dim, np.full(problem.state, np.nan)
    time, shown = _variation(problem, r)[1], _sizes_read(problem, z, r, begin)
    pace = np.array([_slope(_moved(problem, velocity, r, z, begin, width + i)[:, i]) for i in range(d)])
    out[:d], out[width : width + d] = shown[:d], shown[width : width + d]
    q, p = out[:d], out[width : width + d]
    energy = _middle(np.concatenate([q**2 / (time**2 * pace), p**2 * pace]))
    out[:d] = np.where(np.isfinite(q), q, np.sqrt(energy * pace) * time)
    out[width : width + d] = np.where(np.isfinite(p), p, out[:d] / (time * pace))
    return out


def _sizes_read(
    problem: Problem, z: Float[np.ndarray, " z"], r: int, begin: Float[np.ndarray, " state"]
) -> Float[np.ndarray, " state"]:
    """What moves a reading by what the readings vary, NaN where nothing does."""
    vary, _ = _variation(problem, r)
    return np.array([_shown(_moved(problem, readings, r, z, begin, i), vary) for i in range(problem.state)])


def _variation(problem: Problem, r: int) -> tuple[Float[np.ndarray, " channel"], float]:
    """How much every channel varies, NaN where it does not, and in what time."""
    rows = problem.rows[r]
    y, t = rows.readings[: rows.fitted], rows.times[: rows.fitted]
    vary, times = np.full(y.shape[1], np.nan), []
    for j, column in enumerate(y.T):
        seen = np.isfinite(column)
        if seen.sum() > 2 and np.ptp(column[seen]) > 0:
            vary[j] = np.std(column[seen])
            times.append(vary[j] / np.sqrt(np.mean((np.diff(column[seen]) / np.diff(t[seen])) ** 2)))
    return vary, _middle(np.array(times))


def _moved(
    problem: Problem, what: What, r: int, z: np.ndarray, begin: np.ndarray, i: int
) -> Float[np.ndarray, "tried value"]:
    """What changes where one component of the phase point is displaced by what is tried."""
    # Functions are mapped over as many points as the longest recording has rows.
    unit, most, parts = np.arange(problem.state) == i, max(len(one.times) for one in problem.rows), []
    for some in np.array_split(_TRIED, -(-len(_TRIED) // most)):
        there, here = (along(problem, what, r, z, (), begin + size[:, None] * unit) for size in (some, 0 * some))
        parts.append(there - here)
    return np.concatenate(parts)


def _shown(moved: Float[np.ndarray, "tried channel"], vary: Float[np.ndarray, " channel"]) -> float:
    """The smallest displacement that shows."""
    enough = (np.abs(moved) > _SHOWN * vary).any(1)
    return float(_TRIED[enough.argmax()]) if enough.any() else np.nan


def _slope(moved: Float[np.ndarray, " tried"]) -> float:
    """What changes by what is displaced, where it changes most evenly: in the middle of what is finite."""
    slopes = np.abs(moved) / _TRIED
    return _middle(slopes[slopes > 0])


def _middle(values: Float[np.ndarray, " value"]) -> float:
    """The median of what is finite, NaN where nothing is."""
    some = values[np.isfinite(values)]
    return float(np.median(some)) if len(some) else np.nan
