"""The simulation without effects beside a missing force of any strength: where every search begins."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ._calibrate import Priors
from ._missed import rough_noise
from ._motion import extent
from ._noisy import PathFit, fit_paths
from ._problem import Combination, Problem
from ._start import typical_forces
from ._stochastic import run_filter, trajectories
from ._trajectory import Stepper

# Intensities of the missing force that are tried, as shares of the forces already there.
SHARES = np.geomspace(3e-5, 0.3, 8)


def null_paths(
    stepper: Stepper, seed: Float[np.ndarray, " z"], rows: Sequence[int], priors: Priors, steps: int
) -> list[PathFit]:
    """The simulation without effects under missing forces of several intensities.

    Each begins twice, at a path that strong forces lead along the readings and at the trajectory of `seed`: the first
    may be thrown out far where little is read, the second where something strong is missing.
    """
    problem, noise = stepper.problem, rough_noise(stepper.problem, rows)
    ways = [[filtered_path(stepper, rows, r, seed, noise) for r in range(len(rows))]]
    trajectory = trajectories(stepper, seed, (), rows)
    if all(np.isfinite(path).all() for path in trajectory):
        ways.append(trajectory)
    typical = typical_forces(problem, seed, min(ways, key=extent))
    starts = [PathFit((), intensity(problem, rows, typical, x), seed, noise, way) for way in ways for x in SHARES]
    fits = fit_paths(stepper, starts, priors, rows, steps)
    best = [max(fits[k :: len(SHARES)], key=lambda fit: fit.log_evidence) for k in range(len(SHARES))]
    return _settled(stepper, best, priors, rows, steps)


def _settled(stepper: Stepper, fits: list[PathFit], priors: Priors, rows: Sequence[int], steps: int) -> list[PathFit]:
    """Fits by rising intensity; what has not settled begins again at the next that has, the stronger one first."""
    tried: set[tuple[int, int]] = set()
    for _ in fits[1:]:
        begun = {  # of two, the stronger comes last and stays
            k: j for k in range(len(fits)) for j in (k - 1, k + 1) if _may_begin_at(fits, k, j) and (k, j) not in tried
        }
        tried |= set(begun.items())
        starts = [replace(fits[j], intensity=fits[k].intensity, laplace=None) for k, j in begun.items()]
        for k, again in zip(begun, fit_paths(stepper, starts, priors, rows, steps), strict=True):
            fits = [*fits[:k], max(fits[k], again, key=lambda fit: fit.log_evidence), *fits[k + 1 :]]
    return fits


def _may_begin_at(fits: Sequence[PathFit], k: int, j: int) -> bool:
    """Whether one fit has not settled and the other, if there is one, has."""
    return 0 <= j < len(fits) and fits[j].converged and not fits[k].converged


def beside(fit: PathFit, problem: Problem, rows: Sequence[int], typical: np.ndarray, combination: Combination,
           z: np.ndarray, every: int) -> list[PathFit]:  # fmt: skip
    """Where fits of a combination with a missing force begin: at the paths of one without effects."""
    some = SHARES[:-1:every]
    return [PathFit(combination, intensity(problem, rows, typical, x), z, fit.noise, fit.paths) for x in some]


def intensity(problem: Problem, rows: Sequence[int], typical: np.ndarray, share: float) -> Float[np.ndarray, " d"]:
    """Squared force times the time over which it would be felt: a tenth of the shortest recording's length."""
    length = min(r.times[n - 1] - r.times[0] for r, n in zip(problem.rows, rows, strict=True))
    return (share * np.maximum(typical, 1e-300)) ** 2 * length / 10


def filtered_path(stepper: Stepper, rows: Sequence[int], r: int, z: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """A path near the readings: filtered with a strong missing force, from a wide initial state."""
    problem, course = stepper.problem, stepper.courses[r]
    x = z[r * problem.state : (r + 1) * problem.state]
    spread = np.diag(np.maximum(0.05 * np.abs(x), 1e-3 * np.abs(x).max() + 1e-12) ** 2)
    spread[problem.initial.sd == 0] = 0.0
    force = typical_forces(problem, z, [np.tile(x, (1, 1))] * len(rows))
    span = float(np.median(np.diff(problem.rows[r].times)))
    strong = np.maximum(force, np.abs(force).max() * 1e-3) ** 2 * span * 10
    _, filtered = run_filter(
        problem, course, r, z, (), noise, 0 * noise, strong, spread, problem.rows[r].readings[: rows[r]]
    )
    means = np.array(filtered.filtered_means)[: rows[r]]
    means[0] = x
    return means if bool(filtered.ok) else np.tile(x, (rows[r], 1))
