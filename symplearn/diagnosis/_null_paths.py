"""The simulation without effects beside a missing force of any strength: where every search begins."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ._calibrate import Priors
from ._noisy import PathFit, fit_paths
from ._problem import Combination, Problem
from ._start import typical_forces
from ._stochastic import run_filter
from ._trajectory import Stepper

# Intensities of the missing force that are tried, as shares of the forces already there.
SHARES = np.geomspace(3e-5, 0.3, 8)


def null_paths(
    stepper: Stepper, seed: Float[np.ndarray, " z"], rows: Sequence[int], priors: Priors, steps: int
) -> list[PathFit]:
    """The simulation without effects under missing forces of several intensities."""
    problem, noise = stepper.problem, rough_noise(stepper.problem, rows)
    first = [filtered_path(stepper, rows, r, seed, noise) for r in range(len(rows))]
    typical = typical_forces(problem, seed, first)
    starts = [PathFit((), intensity(problem, rows, typical, share), seed, noise, first) for share in SHARES]
    return fit_paths(stepper, starts, priors, rows, steps)


def beside(fit: PathFit, problem: Problem, rows: Sequence[int], typical: np.ndarray, combination: Combination,
           z: np.ndarray, every: int) -> list[PathFit]:  # fmt: skip
    """Where fits of a combination with a missing force begin: at the paths of one without effects."""
    some = SHARES[:-1:every]
    return [PathFit(combination, intensity(problem, rows, typical, x), z, fit.noise, fit.paths) for x in some]


def intensity(problem: Problem, rows: Sequence[int], typical: np.ndarray, share: float) -> Float[np.ndarray, " d"]:
    """Squared force times the time over which it would be felt: a tenth of the shortest recording's length."""
    length = min(r.times[n - 1] - r.times[0] for r, n in zip(problem.rows, rows, strict=True))
    return (share * np.maximum(typical, 1e-300)) ** 2 * length / 10


def rough_noise(problem: Problem, rows: Sequence[int]) -> Float[np.ndarray, " channel"]:
    """Reading noise from third differences, which a smooth motion hardly has."""
    out = []
    for j, known in enumerate(problem.noise):
        columns = [r.readings[:n, j] for r, n in zip(problem.rows, rows, strict=True)]
        joined = np.concatenate([np.diff(column, 3) ** 2 / 20 for column in columns])
        spread = np.nanstd(np.concatenate(columns))
        rough = np.sqrt(np.nanmedian(joined) / 0.455) if np.isfinite(joined).any() else spread
        count = max(1.0, float(np.median(problem.rows[0].counts[:, j])))
        out.append(known if np.isfinite(known) else max(rough, 1e-6 * spread) * np.sqrt(count))
    return np.array(out)


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
    means = np.array(filtered.filtered_means[: rows[r]])
    means[0] = x
    return means if bool(filtered.ok) else np.tile(x, (rows[r], 1))
