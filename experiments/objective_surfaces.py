"""Figure 1.3: three objectives of a linear pendulum as surfaces over its parameters, and their local minima counted.

    python -m experiments.objective_surfaces [--quick] [--out DIR] [--seed N]

The pendulum (1.7) starts at a known state and is read whole every 0.1 s with noise of standard deviation 0.1. The
dissertation prints neither start, grid nor Sigma: those of specification 5.2 are used. Truth by scipy's matrix
exponential, the model by JAX's. Realisation r has the seed N + r; seed 0 is the specification's one.

A narrow valley that crosses a grid aslant leaves minima on it that the function does not have. So the first realisation
is counted a second time on a grid of frequency and amplitude ratio, whose lines run along the valleys.
"""

import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from symplearn._model import FullState, Gaussian, LinearDynamics, StateSpaceModel
from symplearn._noise import AdditiveGaussian, ScaledIdentity
from symplearn._objectives import AbstractObjective, MarginalLikelihood, TimeSeries
from symplearn._trajectory_objectives import PropagatorLeastSquares, SimulationLeastSquares

from ._command import Run, command, print_table

TRUTH = np.array([1.0, -9.81])
START = np.array([0.1, -0.5])
STEP, NOISE = 0.1, 0.1
COUNTS = (20, 40, 80)
THETA_1, THETA_2 = np.linspace(0.05, 4.0, 80), np.linspace(-20.0, -0.2, 100)
# sqrt(-theta_1 theta_2), the angular frequency, and sqrt(-theta_2 / theta_1), the ratio of the two amplitudes.
FREQUENCY, RATIO = np.linspace(0.1, 8.95, 160), np.geomspace(0.25, 16.0, 50)
DRAWN = 1e-3  # the Sigma of the figure's third column
# Minus the log density of r with this variance is pi r^2, without a constant: least squares straight from the nats.
PLAIN = 1 / (2 * math.pi)
# The local minima of specification 5.2 at n = 20, 40, 80, and the range of the negative log likelihood at Sigma = 1e-3.
SPECIFIED = {
    "simulation": (14, 27, 90),
    "propagator": (1, 1, 1),
    "likelihood_1e-05": (6, 11, 17),
    "likelihood_0.0001": (2, 2, 4),
    "likelihood_0.001": (1, 1, 1),
    "likelihood_0.01": (1, 1, 1),
}
SPECIFIED_RANGE = (115, 211, 420)


def strict_minima(values: np.ndarray) -> np.ndarray:
    """Where a grid of one or more dimensions is smaller than all its neighbours, diagonal ones included.

    A point on the border is never counted: what lies beyond is unknown. So count the numbers of specification 5.2. No
    point of a plateau is counted.
    """
    centre = tuple(slice(1, -1) for _ in values.shape)
    inner = values[centre]
    lowest = np.ones(inner.shape, bool)
    for shift in np.ndindex(*(3,) * values.ndim):
        if set(shift) != {1}:
            window = tuple(slice(s, s + size - 2) for s, size in zip(shift, values.shape, strict=True))
            lowest &= inner < values[window]
    return np.pad(lowest, 1)


def readings(seed: int, n: int) -> np.ndarray:
    """y_0..y_n (n + 1, 2): the true pendulum with noise. One seed's longer recordings begin with its shorter ones."""
    A = scipy.linalg.expm(STEP * np.array([[0.0, TRUTH[0]], [TRUTH[1], 0.0]]))
    states = np.array([np.linalg.matrix_power(A, k) @ START for k in range(n + 1)])
    return states + NOISE * np.random.default_rng(seed).standard_normal(states.shape)


def pendulum(theta: Array, Sigma: Any, Gamma: Any) -> StateSpaceModel:
    """The model at one point of the grid, its start known exactly."""
    field = jnp.zeros((2, 2)).at[0, 1].set(theta[0]).at[1, 0].set(theta[1])
    process, measurement = (AdditiveGaussian(ScaledIdentity(variance, 2)) for variance in (Sigma, Gamma))
    initial = Gaussian(jnp.asarray(START), jnp.zeros((2, 2)))
    dynamics = LinearDynamics(jax.scipy.linalg.expm(STEP * field))
    return StateSpaceModel(
        dynamics=dynamics,
        observation=FullState(),
        process_noise=process,
        measurement_noise=measurement,
        initial=initial,
    )


@eqx.filter_jit
def surface(
    objective: AbstractObjective,
    thetas: Float[Array, "point 2"],
    Sigma: Float[Array, ""],
    Gamma: Float[Array, ""],
    y: Float[Array, "time 2"],
) -> Float[Array, " point"]:
    """The objective at each point, in nats, in batches that fit a cache."""
    series = TimeSeries(STEP * jnp.arange(y.shape[0]), y)
    return jax.lax.map(lambda theta: objective(pendulum(theta, Sigma, Gamma), series), thetas, batch_size=2000)


def surfaces(y: np.ndarray, thetas: np.ndarray) -> dict[str, np.ndarray]:
    """Each objective over (point, 2): mean squares (1.2), (1.3) and nats (2.4) for each Sigma."""
    n, at = len(y) - 1, jnp.asarray(thetas)
    # The start is known, so the error of the first reading is no error of the model's: (1.2) sums from 1.
    later = jnp.asarray(y).at[0].set(jnp.nan)
    one, plain, Gamma = jnp.asarray(1.0), jnp.asarray(PLAIN), jnp.asarray(NOISE**2)
    found = {
        "simulation": surface(SimulationLeastSquares(), at, one, plain, later) / (math.pi * n),
        "propagator": surface(PropagatorLeastSquares(), at, plain, one, jnp.asarray(y)) / (math.pi * n),
    }
    for Sigma in (1e-5, 1e-4, 1e-3, 1e-2):
        found[f"likelihood_{Sigma:g}"] = surface(MarginalLikelihood(), at, jnp.asarray(Sigma), Gamma, jnp.asarray(y))
    return {name: np.asarray(values) for name, values in found.items()}


def figures_of(values: np.ndarray) -> dict[str, Any]:
    """What is counted and measured on one surface (theta_1, theta_2)."""
    i, j = np.unravel_index(values.argmin(), values.shape)
    lowest = np.array([THETA_1[i], THETA_2[j]])
    return {
        "minima": int(strict_minima(values).sum()),
        "range": float(np.ptp(values)),
        "global_minimum": lowest.tolist(),
        "global_minimum_error": float(np.max(np.abs(lowest / TRUTH - 1))),
    }


def rectangle() -> np.ndarray:
    """The points (theta_1, theta_2) of the dissertation's kind of grid (80, 100, 2)."""
    return np.stack(np.meshgrid(THETA_1, THETA_2, indexing="ij"), axis=-1)


def along_valleys() -> np.ndarray:
    """The points (theta_1, theta_2) of the grid of frequency and amplitude ratio (160, 50, 2)."""
    frequency, ratio = np.meshgrid(FREQUENCY, RATIO, indexing="ij")
    return np.stack([frequency / ratio, -frequency * ratio], axis=-1)


def minima_along_valleys(seed: int, n: int) -> dict[str, int]:
    """The local minima of each objective on that grid, no farther out than the rectangle reaches."""
    at = along_valleys()
    inside = np.all((at >= (THETA_1[0], THETA_2[0])) & (at <= (THETA_1[-1], THETA_2[-1])), axis=-1)
    found = surfaces(readings(seed, n), at.reshape(-1, 2))
    # Outside counts as lower, so that a point beside it is on the border.
    bounded = {name: np.where(inside, values.reshape(inside.shape), -np.inf) for name, values in found.items()}
    return {name: int((strict_minima(values) & inside).sum()) for name, values in bounded.items()}


def spread(values: Sequence[Any]) -> dict[str, Any]:
    """Median and extremes over the realisations, and the first one."""
    lowest, median, highest = np.quantile(np.asarray(values, dtype=float), (0.0, 0.5, 1.0), axis=0).tolist()
    return {"median": median, "lowest": lowest, "highest": highest, "first": values[0]}


def experiment(run: Run) -> None:
    """Surfaces of every realisation, their spreads, and the figure of the first."""
    at, realisations = rectangle(), 2 if run.quick else 20
    work = [(seed, n) for seed in range(run.seed, run.seed + realisations) for n in COUNTS]
    measured: dict[tuple[str, int], list] = {(name, n): [] for name in SPECIFIED for n in COUNTS}
    drawn: dict[tuple[str, int], np.ndarray] = {}
    for seed, n in run.each("surfaces", work):
        for name, values in surfaces(readings(seed, n), at.reshape(-1, 2)).items():
            measured[name, n].append(figures_of(values.reshape(at.shape[:2])))
            drawn.setdefault((name, n), values.reshape(at.shape[:2]))
    metrics: dict[str, dict[str, Any]] = {name: {} for name in SPECIFIED}
    for n in run.each("surfaces along the valleys", COUNTS):
        for name, minima in minima_along_valleys(run.seed, n).items():
            metrics[name][str(n)] = _summary(name, n, measured[name, n]) | {"minima_along_valleys_first": minima}
    run.write({"objectives": metrics, "realisations": realisations, "truth": TRUTH.tolist()})
    run.save(draw(drawn), "objective_surfaces.png")
    _report(metrics, realisations)


def _summary(name: str, n: int, measured: list[dict[str, Any]]) -> dict[str, Any]:
    summary: dict[str, Any] = {key: spread([one[key] for one in measured]) for key in measured[0]}
    summary["minima"]["specification"] = SPECIFIED[name][COUNTS.index(n)]
    if name == f"likelihood_{DRAWN:g}":
        summary["range"]["specification"] = SPECIFIED_RANGE[COUNTS.index(n)]
    return summary


def _report(metrics: dict[str, Any], realisations: int) -> None:
    print(
        f"Local minima, medians [extremes] of {realisations} noise realisations. `first`: the one drawn, at seed 0 the"
    )
    print(
        "specification's; `along`: the same, counted on the grid along the valleys. `error`: of the worse parameter of"
    )
    print("the lowest point. `range`: mean squares or nats; in brackets the specification's.")
    rows: list[Sequence[Any]] = [["objective", "n", "spec.", "first", "minima", "along", "lowest at", "error", "range"]]
    for name, each in metrics.items():
        rows += [[name, n, *_cells(found)] for n, found in each.items()]
    print_table(*rows)


def _cells(found: dict[str, Any]) -> list[str]:
    minima, reach = found["minima"], found["range"]
    specified = f" ({reach['specification']})" if "specification" in reach else ""
    return [
        f"{minima['specification']}",
        f"{minima['first']:g}",
        f"{minima['median']:g} [{minima['lowest']:g}..{minima['highest']:g}]",
        f"{found['minima_along_valleys_first']}",
        "({:.2f}, {:.1f})".format(*found["global_minimum"]["median"]),
        f"{found['global_minimum_error']['median']:.0%}",
        f"{reach['median']:.3g}{specified}",
    ]


def draw(values: dict[tuple[str, int], np.ndarray]) -> Figure:
    """Rows: 20, 40, 80 data. Columns: simulation, propagator, negative log likelihood. Its minima as dots."""
    figure = Figure(figsize=(12, 10), layout="constrained")
    titles = {
        "simulation": "simulation, (1.2)",
        "propagator": "propagator, (1.3)",
        f"likelihood_{DRAWN:g}": f"negative log likelihood, $\\Sigma$ = {DRAWN:g} I",
    }
    axes = figure.subplots(len(COUNTS), len(titles), sharex=True, sharey=True)
    for row, n in zip(axes, COUNTS, strict=True):
        for panel, (name, title) in zip(row, titles.items(), strict=True):
            _panel(figure, panel, values[name, n])
            panel.set_title(f"{title}\nn = {n}, local minima: {strict_minima(values[name, n]).sum()}", fontsize=10)
        row[0].set_ylabel(r"$\theta_2$ [1/s$^2$]")
    for panel in axes[-1]:
        panel.set_xlabel(r"$\theta_1$")
    figure.suptitle("White cross: the truth. Circles: local minima on the grid. Colours end at the 98th percentile.")
    return figure


def _panel(figure: Figure, panel: Any, values: np.ndarray) -> None:
    levels = np.linspace(values.min(), np.quantile(values, 0.98), 40)
    image = panel.contourf(THETA_1, THETA_2, values.T, levels=levels, cmap="viridis", extend="max")
    ticks = MaxNLocator(6).tick_values(levels[0], levels[-1])
    figure.colorbar(image, ax=panel, ticks=ticks[(ticks >= levels[0]) & (ticks <= levels[-1])])
    i, j = np.nonzero(strict_minima(values))
    panel.plot(THETA_1[i], THETA_2[j], "o", ms=3.5, mfc="none", mec="orangered", mew=0.9)
    panel.plot(*TRUTH, "x", color="white", ms=9, mew=2)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    command("objective_surfaces", "Figure 1.3: objectives of a linear pendulum as surfaces.", experiment, arguments)


if __name__ == "__main__":
    main()
