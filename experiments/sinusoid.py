"""Figure 1.2: the simulation and the propagator objective of two frequencies as data of a sinusoid come in.

    python -m experiments.sinusoid [--quick] [--out DIR] [--seed N]

Data sin(t_i), i = 1..n, every 0.1; models sin(omega t). The objectives (1.4) and (1.5) are the library's, for the phase
as the state: x' = x + omega dt, y = sin x. Multiple shooting with one step per segment, each from the true phase
t_{i-1}, is (1.5). Without noise the seed plays no part.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from matplotlib.figure import Figure

from symplearn._model import Gaussian, Interval, StateSpaceModel
from symplearn._noise import AdditiveGaussian, ScaledIdentity
from symplearn._objectives import AbstractObjective, TimeSeries
from symplearn._trajectory_objectives import EverySteps, MultipleShooting, SegmentStarts, SimulationLeastSquares

from ._command import Run, command, print_table
from .objective_surfaces import PLAIN

STEP = 0.1
CANDIDATES = (0.95, 0.5)
# Specification 5.1, E1: where the better model overtakes the worse one, values at n = 100 and 700, and the limit (1.6).
CROSSINGS = (629, 1256, 1884)
SPECIFIED = {0.95: {100: 0.0465, 700: 1.087}, 0.5: {100: 1.240, 700: 0.995}}
SPECIFIED_STEP = {0.95: 1.25e-5, 0.5: 1.25e-3}
LIMITS = {0.95: 1.0, 0.5: 1.0, 0.0: 0.5, -1.0: 2.0}
LONG = 20000


class Rotation(eqx.Module):
    """The phase turns by omega each unit of time."""

    omega: Array

    def __call__(self, phase: Float[Array, "1"], interval: Interval) -> Float[Array, "1"]:
        return phase + self.omega * interval.length


class Sine(eqx.Module):
    """The sine of the phase is read."""

    def __call__(self, phase: Float[Array, "1"], instant: Any) -> Float[Array, "1"]:
        return jnp.sin(phase)


@eqx.filter_jit
def mean_squares(
    objective: AbstractObjective,
    omega: Float[Array, ""],
    initial: Any,
    y: Float[Array, " time"],
    n: Int[Array, " count"],
) -> Float[Array, " count"]:
    """J of the first n readings after the one at t = 0, for each n."""
    process, measurement = AdditiveGaussian(ScaledIdentity(1.0, 1)), AdditiveGaussian(ScaledIdentity(PLAIN, 1))
    model = StateSpaceModel(
        dynamics=Rotation(omega),
        observation=Sine(),
        process_noise=process,
        measurement_noise=measurement,
        initial=initial,
    )
    k = jnp.arange(y.shape[0])

    def upto(n):
        seen = jnp.where(k <= n, y, jnp.nan)[:, None]  # what is missing is not scored
        return objective(model, TimeSeries(STEP * k, seen)) / (jnp.pi * n)

    return jax.lax.map(upto, n, batch_size=256)


def simulation(omega: float, longest: int, n: np.ndarray) -> np.ndarray:
    """J_sim (1.4) at each n, up to `longest`."""
    at_zero = Gaussian(jnp.zeros(1), jnp.zeros((1, 1)))
    y = jnp.asarray(np.sin(STEP * np.arange(longest + 1)))
    return np.asarray(mean_squares(SimulationLeastSquares(), jnp.asarray(omega), at_zero, y, jnp.asarray(n)))


def propagation(omega: float, longest: int, n: np.ndarray) -> np.ndarray:
    """J_prop (1.5) at each n, up to `longest`."""
    times = STEP * np.arange(longest + 1)
    phases = SegmentStarts(jnp.asarray(times[:-1, None]))
    objective = MultipleShooting(EverySteps(1))
    return np.asarray(mean_squares(objective, jnp.asarray(omega), phases, jnp.asarray(np.sin(times)), jnp.asarray(n)))


def crossings(first: np.ndarray, second: np.ndarray, n: np.ndarray) -> list[int]:
    """The n from which the order of the two is another than before."""
    above = first > second
    return n[1:][above[1:] != above[:-1]].tolist()


def experiment(run: Run) -> None:
    """Both objectives at every n, where they cross, and the figure."""
    n = np.arange(1, (1000 if run.quick else 2000) + 1)
    J_sim, J_prop, limits = {}, {}, {}
    for omega in run.each("objectives", CANDIDATES):
        J_sim[omega], J_prop[omega] = simulation(omega, len(n), n), propagation(omega, len(n), n)
    for omega in run.each("long-time limits", LIMITS):
        limits[omega] = float(simulation(omega, LONG, np.array([LONG]))[0])
    found: dict[str, Any] = {
        "crossings": crossings(J_sim[0.95], J_sim[0.5], n),
        "crossings_specification": [i for i in CROSSINGS if i <= len(n)],
        "simulation": {str(w): {str(i): float(J[i - 1]) for i in (100, 700, len(n))} for w, J in J_sim.items()},
        "simulation_specification": {str(w): {str(i): J for i, J in at.items()} for w, at in SPECIFIED.items()},
        "propagator": {str(w): {str(i): float(J[i - 1]) for i in (100, 700, len(n))} for w, J in J_prop.items()},
        "propagator_specification": {str(w): J for w, J in SPECIFIED_STEP.items()},
        f"simulation_at_{LONG}": {str(w): J for w, J in limits.items()},
        "limit": {str(w): J for w, J in LIMITS.items()},
    }
    run.write(found)
    run.save(draw(n, J_sim, J_prop, found["crossings"]), "sinusoid.png")
    _report(found)


def _report(found: dict[str, Any]) -> None:
    rows: list[Sequence[Any]] = [["quantity", "specification", "ours"]]
    rows.append(["J_sim changes order at n", found["crossings_specification"], found["crossings"]])
    for omega in map(str, CANDIDATES):
        for n, J in found["simulation_specification"][omega].items():
            rows.append([f"J_sim({omega}), n = {n}", J, found["simulation"][omega][n]])
        for n, J in found["propagator"][omega].items():
            rows.append([f"J_prop({omega}), n = {n}", found["propagator_specification"][omega], J])
    for omega, J in found["limit"].items():
        rows.append([f"J_sim({omega}), n = {LONG}, against its limit", J, found[f"simulation_at_{LONG}"][omega]])
    print_table(*rows)


def draw(n: np.ndarray, J_sim: dict[float, np.ndarray], J_prop: dict[float, np.ndarray], crossed: list[int]) -> Figure:
    """(a) the outputs of both models, (b) their objectives as data come in: simulation above, propagator below."""
    figure = Figure(figsize=(11, 9), layout="constrained")
    outputs, simulated, propagated = figure.subplots(3, 1, height_ratios=(3, 3, 2))
    times = STEP * np.arange(0, crossed[0] + 100)
    outputs.plot(times, np.sin(times), color="black", lw=1.2, label=r"truth, $\omega$ = 1")
    for omega, colour in zip(CANDIDATES, ("tab:blue", "tab:orange"), strict=True):
        label = rf"$\omega$ = {omega}"
        outputs.plot(times, np.sin(omega * times), color=colour, lw=1.2, label=label)
        simulated.plot(STEP * n, J_sim[omega], color=colour, label=label)
        propagated.plot(STEP * n, J_prop[omega], color=colour, label=label)
    for i in crossed:
        simulated.axvline(STEP * i, color="grey", lw=0.8, ls=":")
        simulated.annotate(f"n = {i} ", (STEP * i, 0.05), ha="right")
    outputs.set(title="(a) outputs", xlabel="t", ylabel="y", xlim=(0, times[-1]), ylim=(-1.1, 1.5))
    simulated.set(title="(b) simulation objective (1.4) of the data up to t", ylim=(0, 1.6))
    propagated.set(title="propagator objective (1.5)", yscale="log", ylim=(4e-6, 1e-2))
    outputs.legend(loc="upper right", ncols=3)
    for panel in (simulated, propagated):
        panel.set(xlabel="t", ylabel="J", xlim=(0, STEP * n[-1]))
        panel.legend(loc="upper right", ncols=2)
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    command("sinusoid", "Figure 1.2: two objectives as data come in; noiseless, so any seed.", experiment, arguments)


if __name__ == "__main__":
    main()
