"""The posterior of the two noise variances on a grid, A maximised or integrated out, and the hills of it.

Whether a density has a second hill hangs on what it is a density over: of variances, of standard deviations or of their
logarithms. One grid tells all of them, and other priors too, as they differ by known functions of the two variances.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.interpolate import RectBivariateSpline

from symplearn._descent import put, stacked, start
from symplearn._fit import Estimate, fit
from symplearn._laplace_kinks import Task
from symplearn._log_posterior import negative_log_posterior
from symplearn._objectives import MARGINAL_LIKELIHOOD, TimeSeries
from symplearn._parameters import flatten
from symplearn._prior import HalfNormal, Laplace, LogDensity, Prior

from ._pendulum_case import model

# log10 of the variances; below 1e-6 neither variance changes the likelihood of readings with noise of 0.1.
GRID = np.arange(-6.0, 1.01, 0.25)
# Between its points the grid is filled by a spline, and a hill counts that rises so many nats above its saddle.
FINER, PROMINENT = 3, 0.25
_HALF = HalfNormal(1.0)
# The density over the variances themselves: the Jacobian of the logarithm, in which they learn, taken out again.
_OVER_VARIANCES = LogDensity(lambda v: _HALF.log_density(v) - jnp.log(v))
PRIOR = Prior({"dynamics": Laplace(10.0), "process_noise": _OVER_VARIANCES, "measurement_noise": _OVER_VARIANCES})
_STEPS, _TOLERANCE = 300, 1e-8


class Landscape(NamedTuple):
    """Log posterior density over the variances (process, measurement) on `GRID`, in nats.

    `height` has A at its best, which is `A`, and `curvature` its second derivatives by A; `marginal` has A integrated
    out by Laplace's method.
    """

    height: Float[np.ndarray, "process measurement"]
    marginal: Float[np.ndarray, "process measurement"]
    A: Float[np.ndarray, "process measurement 2 2"]
    curvature: Float[np.ndarray, "process measurement 4 4"]

    def at(self, variances: tuple[float, float]) -> tuple[int, int]:
        """The grid's point nearest to log10 variances."""
        process, measurement = (int(np.argmin(np.abs(GRID - v))) for v in variances)
        return process, measurement


class Hill(NamedTuple):
    """A local maximum: log10 of both variances, its height in nats, how far it rises above the saddle to a higher one,
    and the cells (process, measurement) of the finer grid from which it is uphill to it."""

    variances: tuple[float, float]
    height: float
    prominence: float
    cells: np.ndarray

    @property
    def of_process_noise(self) -> bool:
        """Whether the process noise is the larger one."""
        return self.variances[0] > self.variances[1]


def landscape(series: TimeSeries, known: np.ndarray | None, A: np.ndarray) -> Landscape:
    """The landscape of one data set, every point's A descending from one start; `known` is the state at time 0, None
    where the first reading is all that is known of it."""
    process, measurement = (one.ravel() for one in np.meshgrid(10**GRID, 10**GRID, indexing="ij"))
    models = _models(known, np.broadcast_to(A, (process.size, 2, 2)), process, measurement)
    places = start(models)
    moves = jnp.ones_like(places.free).at[:, 4:].set(0.0)
    task = Task(series, MARGINAL_LIKELIHOOD, PRIOR, jnp.zeros(6), _TOLERANCE)
    places = task.descend(models, places, moves, 0.0, _STEPS, _TOLERANCE)
    shape = (GRID.size, GRID.size)
    height = -np.asarray(places.score)
    # (2 pi)^2 / sqrt(det) for the four entries of A; where the curvature is no covariance the point has no mass.
    curvature = np.asarray(_curvatures(models, places.free, series))
    determinants = np.linalg.det(curvature)
    sound = determinants > 0
    marginal = height + 2 * np.log(2 * np.pi) - 0.5 * np.log(np.where(sound, determinants, 1.0))
    marginal = np.where(sound, marginal, marginal.min())
    A = np.asarray(places.free)[:, :4]
    return Landscape(
        height.reshape(shape), marginal.reshape(shape), A.reshape(*shape, 2, 2), curvature.reshape(*shape, 4, 4)
    )


def _models(known: np.ndarray | None, A: np.ndarray, process: Any, measurement: Any) -> Any:
    one = model(known, A[0])
    free = start(stacked([one])).free[0]
    rows = np.concatenate([A.reshape(-1, 4), np.log(process)[:, None], np.log(measurement)[:, None]], axis=1)
    lanes = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(rows), *leaf.shape)), eqx.filter(one, eqx.is_array))
    models = eqx.combine(lanes, eqx.filter(one, eqx.is_array, inverse=True))
    return put(models, jnp.asarray(rows, free.dtype))


@eqx.filter_jit
def _curvatures(models: Any, free: Array, series: TimeSeries) -> Float[Array, "point 4 4"]:
    """Second derivatives of minus the log posterior by the entries of A."""

    def one(model, free):
        rebuild = flatten(model)[1]

        def score(entries):
            placed = rebuild(jnp.concatenate([entries, free[4:]]))
            return negative_log_posterior(placed, series, MARGINAL_LIKELIHOOD, PRIOR)

        return jax.jacfwd(jax.jacfwd(score))(free[:4])

    return eqx.filter_vmap(one)(models, free)


def summit(hill: Hill, found: Landscape, series: TimeSeries, known: np.ndarray) -> Estimate:
    """The local maximum of all six numbers that a hill of `height` leads to, over the variances."""
    begin = model(known, found.A[found.at(hill.variances)], *(float(10**v) for v in hill.variances))
    return fit(begin, series, prior=PRIOR)


def densities(over_variances: np.ndarray, first_reading: float) -> dict[str, np.ndarray]:
    """The log density on the grid over other coordinates, under other priors, and without the first reading.

    **Arguments:** `over_variances` - a landscape's `height` or `marginal`; `first_reading` - the squared distance of
    the first reading from the known state.
    """
    process, measurement = np.meshgrid(np.log(10.0) * GRID, np.log(10.0) * GRID, indexing="ij")
    logs, first, second = process + measurement, np.exp(process), np.exp(measurement)
    # Half-normal of variance 1 over the standard deviations instead: exp(-v / 2) / sqrt(v) for exp(-v^2 / 2).
    over_sds = over_variances + 0.5 * (first**2 + second**2) - 0.5 * (first + second)
    without = over_variances + 0.5 * first_reading / second + measurement
    return {
        "variances": over_variances,
        "sds": over_variances + 0.5 * logs,
        "log_variances": over_variances + logs,
        "prior_of_sds_over_sds": over_sds,
        "prior_of_sds_over_log_variances": over_sds + 0.5 * logs,
        "without_first_reading_variances": without,
        "without_first_reading_log_variances": without + logs,
    }


def densities_read(found: Landscape, first_reading: float) -> dict[str, np.ndarray]:
    """`densities` of a landscape, joint with A at its best, and marginal."""
    joint, marginal = densities(found.height, first_reading), densities(found.marginal, first_reading)
    return {f"joint_{name}": one for name, one in joint.items()} | {f"marginal_{n}": one for n, one in marginal.items()}


def masses(marginal: np.ndarray, cells: np.ndarray) -> dict[str, float]:
    """The share of the posterior mass in some cells of the finer grid: under half-normal priors of the variances, of
    the standard deviations, and under priors flat in the logarithms from 1e-6 to 10."""
    logs = np.add.outer(np.log(10.0) * GRID, np.log(10.0) * GRID)
    squares = np.add.outer(10 ** (2 * GRID), 10 ** (2 * GRID))
    over_logs = {
        "prior_of_variances": marginal + logs,
        "prior_of_sds": densities(marginal, 0.0)["prior_of_sds_over_log_variances"],
        "prior_flat_in_logs": marginal + 0.5 * squares,
    }
    found = {}
    for name, values in over_logs.items():
        weights = finer(values)
        weights = np.exp(weights - weights.max())
        found[name] = float(weights[cells].sum() / weights.sum())
    return found


def finer(values: np.ndarray) -> np.ndarray:
    """The values on a finer grid, by a cubic spline."""
    points = np.linspace(GRID[0], GRID[-1], FINER * (GRID.size - 1) + 1)
    return RectBivariateSpline(GRID, GRID, values)(points, points)


def hills(values: np.ndarray) -> list[Hill]:
    """The hills of values on the grid that rise `PROMINENT` nats above their saddles, the highest first.

    Cells are flooded from the highest down, and a cell joins the highest neighbour's hill; where two hills meet, the
    lower one has come to its saddle, and is part of the higher one if it is not prominent.
    """
    fine = finer(values)
    labels, peaks, merged = np.full(fine.shape, -1), [], {}

    def top(label: int) -> int:
        while label in merged:
            label = merged[label]
        return label

    found: list[Any] = []
    for i, j in zip(*np.unravel_index(np.argsort(-fine, axis=None), fine.shape), strict=True):
        around = labels[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2]
        near = sorted({top(label) for label in around[around >= 0]})
        if not near:
            labels[i, j] = len(peaks)
            peaks.append((i, j))
            continue
        # Hills are numbered from the highest down.
        labels[i, j] = near[0]
        for label in near[1:]:
            prominence = fine[peaks[label]] - fine[i, j]
            if prominence >= PROMINENT:
                found.append((label, prominence))
            merged[label] = near[0]
    return _told(fine, labels, peaks, merged, [(0, np.inf), *found])


def _told(fine: np.ndarray, labels: np.ndarray, peaks: list[Any], merged: dict[int, int], found: Any) -> list[Hill]:
    """The prominent hills with their cells; what is not prominent belongs to the hill it ran into."""
    own = {label for label, _ in found}
    belongs = []
    for label in range(len(peaks)):
        while label not in own:
            label = merged[label]
        belongs.append(label)
    cells = np.array(belongs)[labels]
    points = np.linspace(GRID[0], GRID[-1], fine.shape[0])
    return [
        Hill(
            (float(points[peaks[label][0]]), float(points[peaks[label][1]])),
            float(fine[peaks[label]]),
            float(prominence),
            cells == label,
        )
        for label, prominence in sorted(found, key=lambda one: -fine[peaks[one[0]]])
    ]
