"""Figure 4.1: multiple shooting and the marginal likelihood of the logistic map, smoothed by T and by Sigma / Gamma.

    python -m experiments.logistic_map [--quick] [--out DIR] [--seed N]

201 readings of y' = 3.78 y (1 - y) from 0.5 with noise of standard deviation 1e-8, as in the author's script; the
segments of multiple shooting start at the readings. A second figure shows what the first cannot: how small the ratio
must be before the likelihood has the minima of least squares, and how far a ratio alone fixes its shape (erratum E29).
"""

import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.figure import Figure

from symplearn._model import FullState, Gaussian, StateSpaceModel
from symplearn._noise import AdditiveGaussian, ScaledIdentity
from symplearn._objectives import MarginalLikelihood, TimeSeries
from symplearn._trajectory_objectives import EverySteps, MultipleShooting

from ._command import Run, command, print_table
from .objective_surfaces import PLAIN, strict_minima

TRUTH, START, LAST, NOISE = 3.78, 0.5, 200, 1e-8
HORIZONS = (201, 10, 5, 2)
# (Sigma, Gamma) of the ratios 1, 1e6, 5e15, 7e15, 1e16. The author has Gamma = 1e-16 throughout. At ratio 1 that gives
# more than 1e15 nats, which the library gives to impossible recordings, so both variances are 1e4 times larger there.
VARIANCES = ((1e-12, 1e-12), (1e-10, 1e-16), (0.5, 1e-16), (0.7, 1e-16), (1.0, 1e-16))
PANELS = ((201, (0,)), (10, (1,)), (5, (2,)), (2, (3, 4)))  # T, and which of the variances
TOWARDS_LEAST_SQUARES = (1.0, 0.1, 1e-2, 1e-4, 1e-6, 1e-8, 0.0)
GAMMA = 1e-8  # of that sweep
SCALES = {1.0: (1e-12, 1e-8, 1e-4, 1e-2), 1e6: (1e-16, 1e-12, 1e-8)}  # ratio: values of Gamma
CONSTANT = (LAST + 1) / 2 * math.log(2 * math.pi)


class Logistic(eqx.Module):
    """The logistic map (4.11)."""

    theta: Array

    def __call__(self, y: Float[Array, "1"], interval: Any) -> Float[Array, "1"]:
        return self.theta * y * (1 - y)


def recording(seed: int) -> np.ndarray:
    """y_0..y_200 with noise."""
    y = [START]
    for _ in range(LAST):
        y.append(TRUTH * y[-1] * (1 - y[-1]))
    return np.array(y) + NOISE * np.random.default_rng(seed).standard_normal(LAST + 1)


def parameters(quick: bool) -> np.ndarray:
    """theta = 2, 2.001, .., 4; every fourth where it is to be quick."""
    return np.linspace(2.0, 4.0, 501 if quick else 2001)


def model(theta: Array, Sigma: Any, Gamma: Any, initial: Any) -> StateSpaceModel:
    """The map with both noises."""
    process, measurement = (AdditiveGaussian(ScaledIdentity(variance, 1)) for variance in (Sigma, Gamma))
    return StateSpaceModel(
        dynamics=Logistic(theta),
        observation=FullState(),
        process_noise=process,
        measurement_noise=measurement,
        initial=initial,
    )


def _series(y: Array) -> TimeSeries:
    return TimeSeries(jnp.arange(y.shape[0], dtype=float), y[:, None])


@eqx.filter_jit
def _shooting(objective: MultipleShooting, thetas: Array, y: Array) -> Array:
    scores = jax.vmap(lambda theta: objective(model(theta, 1.0, PLAIN, None), _series(y)))(thetas)
    return scores / (math.pi * LAST)


def shooting(T: int, thetas: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The mean squares of multiple shooting with segments of T steps (4.9), in the form of erratum E27."""
    return np.asarray(_shooting(MultipleShooting(EverySteps(T)), jnp.asarray(thetas), jnp.asarray(y)))


def _noisy(theta: Array, Sigma: Array, Gamma: Array) -> StateSpaceModel:
    # The author's P_0 is his Gamma; it is scaled along with it.
    return model(theta, Sigma, Gamma, Gaussian(jnp.full(1, START), Gamma * jnp.eye(1)))


@eqx.filter_jit
def _likelihood(thetas: Array, Sigma: Array, Gamma: Array, y: Array) -> Array:
    return jax.vmap(lambda theta: MarginalLikelihood()(_noisy(theta, Sigma, Gamma), _series(y)))(thetas)


def likelihood(thetas: np.ndarray, Sigma: float, Gamma: float, y: np.ndarray) -> np.ndarray:
    """Minus the log marginal likelihood, in nats."""
    return np.asarray(_likelihood(jnp.asarray(thetas), jnp.asarray(Sigma), jnp.asarray(Gamma), jnp.asarray(y)))


def predicted(first: np.ndarray, second: np.ndarray, c: float, at: float) -> np.ndarray:
    """The likelihood at `at` times the first's variances, given that at `c` times, by erratum E29.

    Scaling both variances by c divides the quadratic part Q by c and adds log c to the logarithm of each determinant:
    J(c) = Q / c + D + (n + 1) / 2 log c.
    """
    terms = (LAST + 1) / 2
    Q = (first - second + terms * math.log(c)) / (1 - 1 / c)
    return Q / at + (first - Q) + terms * math.log(at)


def figures_of(values: np.ndarray, thetas: np.ndarray) -> dict[str, Any]:
    """Local minima, the lowest of them, and the curve's values over that at theta = 2."""
    at_truth = values[np.argmin(np.abs(thetas - TRUTH))] / values[0]
    return {
        "minima": int(strict_minima(values).sum()),
        "global_minimum": float(thetas[values.argmin()]),
        "normalised_at_truth": float(at_truth),
        "normalised_lowest": float(values.min() / values[0]),
        "normalised_highest": float(values.max() / values[0]),
    }


def scaling(thetas: np.ndarray, y: np.ndarray) -> dict[str, dict[str, Any]]:
    """Erratum E29: curves of one ratio at several Gamma, against the first normalised and against E29's rule."""
    found: dict[str, dict[str, Any]] = {}
    for ratio, Gammas in SCALES.items():
        curves = [likelihood(thetas, ratio * Gamma, Gamma, y) for Gamma in Gammas]
        found[f"{ratio:g}"] = {}
        for Gamma, values in zip(Gammas, curves, strict=True):
            by_rule = predicted(curves[0], curves[1], Gammas[1] / Gammas[0], Gamma / Gammas[0])
            found[f"{ratio:g}"][f"{Gamma:g}"] = figures_of(values, thetas) | {
                "from_normalised_first": float(np.abs(values / values[0] - curves[0] / curves[0][0]).max()),
                "from_predicted_of_range": float(np.abs(values - by_rule).max() / np.ptp(values)),
            }
    return found


def experiment(run: Run) -> None:
    """Every curve, its minima, both figures."""
    thetas, y = parameters(run.quick), recording(run.seed)
    shot = {T: shooting(T, thetas, y) for T in run.each("multiple shooting", HORIZONS)}
    likely = [likelihood(thetas, Sigma, Gamma, y) for Sigma, Gamma in run.each("likelihoods", VARIANCES)]
    sweep = {
        ratio: likelihood(thetas, ratio * GAMMA, GAMMA, y)
        for ratio in run.each("towards least squares", TOWARDS_LEAST_SQUARES)
    }
    metrics = {
        "multiple_shooting": {str(T): figures_of(values, thetas) for T, values in shot.items()},
        "likelihood": {
            f"{Sigma / Gamma:g}": figures_of(values, thetas)
            | {"Sigma": Sigma, "Gamma": Gamma, "without_constant": figures_of(values - CONSTANT, thetas)}
            for (Sigma, Gamma), values in zip(VARIANCES, likely, strict=True)
        },
        "towards_least_squares": {f"{ratio:g}": figures_of(values, thetas) for ratio, values in sweep.items()},
        "scaling": scaling(thetas, y),
        "truth": TRUTH,
    }
    run.write(metrics)
    run.save(draw(thetas, shot, likely), "logistic_map.png")
    run.save(draw_limits(thetas, sweep, y), "logistic_limits.png")
    _report(metrics)


def _report(metrics: dict[str, Any]) -> None:
    heading = ("curve", "local minima", "lowest at theta", "at truth / at 2", "lowest / at 2")
    rows: list[Sequence[Any]] = [heading]
    titles = {
        "multiple_shooting": "multiple shooting, T = {}",
        "likelihood": "likelihood, Sigma/Gamma = {}",
        "towards_least_squares": f"likelihood, Gamma = {GAMMA:g}, Sigma/Gamma = {{}}",
    }
    for kind, title in titles.items():
        rows += [[title.format(key), *_cells(found)] for key, found in metrics[kind].items()]
    print_table(*rows)
    print("\nErratum E29: one ratio at several Gamma. Largest deviations: of the normalised curve from the first one,")
    print(
        "and of the curve from Q / c + D + (n + 1) / 2 log c with Q and D from the first two, as a share of its range."
    )
    rows = [["Sigma/Gamma", "Gamma", *heading[1:4], "normalised", "Q/c + D + .."]]
    for ratio, each in metrics["scaling"].items():
        for Gamma, found in each.items():
            deviations = found["from_normalised_first"], found["from_predicted_of_range"]
            rows.append([ratio, Gamma, *_cells(found)[:3], *deviations])
    print_table(*rows)


def _cells(found: dict[str, Any]) -> list[Any]:
    return [found[key] for key in ("minima", "global_minimum", "normalised_at_truth", "normalised_lowest")]


def draw(thetas: np.ndarray, shot: dict[int, np.ndarray], likely: list[np.ndarray]) -> Figure:
    """One panel for each T with its Sigma / Gamma, all curves 1 at theta = 2."""
    figure = Figure(figsize=(11, 8), layout="constrained")
    for panel, (T, which) in zip(figure.subplots(2, 2, sharex=True).flat, PANELS, strict=True):
        panel.plot(thetas, shot[T] / shot[T][0], lw=0.9, color="tab:orange", label=f"multiple shooting, T = {T}")
        for i, style in zip(which, ("-", "--"), strict=False):
            label = rf"likelihood, $\Sigma/\Gamma$ = {VARIANCES[i][0] / VARIANCES[i][1]:.0e}"
            panel.plot(thetas, likely[i] / likely[i][0], style, color="tab:blue", lw=1.5, label=label)
        _finish(panel, f"T = {T}, local minima of multiple shooting: {strict_minima(shot[T]).sum()}")
    return figure


def draw_limits(thetas: np.ndarray, sweep: dict[float, np.ndarray], y: np.ndarray) -> Figure:
    """Left: towards least squares. Right: the same ratio at the smallest and the largest Gamma."""
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    for ratio in (1.0, 1e-2, 1e-6):
        label = rf"$\Sigma/\Gamma$ = {ratio:g}, local minima: {strict_minima(sweep[ratio]).sum()}"
        left.plot(thetas, sweep[ratio] / sweep[ratio][0], lw=0.9, label=label)
    _finish(left, rf"towards least squares, $\Gamma$ = {GAMMA:g}")
    for (ratio, Gammas), colour in zip(SCALES.items(), ("tab:blue", "tab:orange"), strict=True):
        for Gamma, style in ((Gammas[0], "-"), (Gammas[-1], "--")):
            values = likelihood(thetas, ratio * Gamma, Gamma, y)
            label = rf"$\Sigma/\Gamma$ = {ratio:g}, $\Gamma$ = {Gamma:g}"
            right.plot(thetas, values / values[0], style, color=colour, lw=1.3, label=label)
    _finish(right, "the ratio alone does not fix the shape")
    right.set_ylim(-0.8, 1.1)
    return figure


def _finish(panel: Any, title: str) -> None:
    panel.axvline(TRUTH, color="tab:red", ls=":", lw=1.2, label="truth")
    panel.set(title=title, xlabel=r"$\theta$", ylabel=r"J($\theta$) / J(2)", xlim=(2, 4))
    panel.set_ylim(0, min(3.0, panel.get_ylim()[1]))
    panel.legend(fontsize=9)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    command("logistic_map", "Figure 4.1: multiple shooting and the marginal likelihood.", experiment, arguments)


if __name__ == "__main__":
    main()
