"""A network learns the Hamiltonian of the double pendulum by likelihood and by L1. Dissertation 5.4.4, Figs 5.12-5.14.

    python -m experiments.double_pendulum [--quick] [--out DIR] [--seed N] [--minutes M]
                                          [--width W] [--epochs E] [--repeats R]

Masses and lengths 1, 2000 readings every 0.01 with noise v ~ U[0.99, 1.01] times each. From q1 = 1, as printed, the
motion is regular (specification E48), from q1 = 2 chaotic. Both, and all repeats, are one program; `--minutes` stops it
in time, and the same command goes on from there. Truth by SciPy's DOP853.

Beyond the dissertation: pieces of the recording filtered side by side, each given its first reading, a few at a time:
many steps of Adam for the price of one, and a program as short as one piece.
"""

import math
import sys
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from matplotlib.figure import Figure
from scipy.integrate import solve_ivp

import integrators as ig
from symplearn._distributions import Uniform
from symplearn._hamiltonian_objectives import MiniBatch, OneStepL1
from symplearn._model import FullState, Gaussian, Interval, Propagator, StateSpaceModel
from symplearn._neural_hamiltonian import NSSNN
from symplearn._noise import AdditiveGaussian, Diagonal, Multiplicative, ScaledIdentity
from symplearn._objectives import MARGINAL_LIKELIHOOD, AbstractObjective, TimeSeries
from symplearn._optimisers import Adam, ByLeaf
from symplearn._parameters import Positive, resolve
from symplearn._prior import Flat, HalfNormal, Prior
from symplearn._train import Training

from ._command import Run, command, print_table
from ._ensemble import Deadline, Ensemble, options, side_by_side

STEP, OMEGA, NOISE, GRAVITY = 0.01, 20.0, 0.01, 9.81
STARTS = {"regular": (1.0, 0.0, 0.0, 0.0), "chaotic": (2.0, 0.0, 0.0, 0.0)}
POSTERIOR, L1, PIECES = WAYS = ("posterior", "l1", "posterior_in_pieces")
COLOURS = dict(zip(WAYS, ("tab:blue", "tab:red", "tab:green"), strict=True))
CERTAIN, JITTER = 1e-8, 1e-10
FAR, DRAWS = 0.5, 100  # radians; paths of the stochastic simulation


class Settings(NamedTuple):
    """How much is trained: readings, repeats, units of a layer, epochs, and intervals of a piece and of a batch."""

    count: int
    repeats: int
    width: int
    epochs: int
    piece: int
    batch: int = 512


FULL = Settings(2000, 20, 64, 1000, 50)
QUICK = Settings(500, 5, 16, 150, 25)


class InPieces(AbstractObjective):
    """The likelihood of pieces of `length` intervals, each given its first reading; a composite likelihood.

    `batch.size` counts data intervals, a multiple of the length; without a batch all pieces count.
    """

    length: int = eqx.field(static=True)
    batch: MiniBatch | None

    def score(self, model: StateSpaceModel, series: TimeSeries) -> Array:
        starts = self.length * np.arange((len(series.times) - 1) // self.length)
        chosen, weight = jnp.asarray(starts), 1.0
        if self.batch is not None:
            kept = self.batch.size // self.length
            chosen, weight = jax.random.choice(self.batch.key, chosen, (kept,), replace=False), len(starts) / kept
        places = chosen[:, None] + jnp.arange(self.length + 1)
        free = eqx.tree_at(lambda m: m.initial, model, None)
        scores = jax.vmap(lambda t, y: MARGINAL_LIKELIHOOD.score(free, TimeSeries(t, y)))
        return weight * jnp.sum(scores(series.times[places], series.readings[places]))


def energy(x: np.ndarray) -> np.ndarray:
    """H (5.28) over the last axis, with the denominator of specification E46."""
    a, b, p, r = np.moveaxis(x, -1, 0)
    kinetic = (p**2 + 2 * r**2 - 2 * p * r * np.cos(a - b)) / (2 * (1 + np.sin(a - b) ** 2))
    return kinetic - GRAVITY * (2 * np.cos(a) + np.cos(b))


def orbit(start: Sequence[float], count: int) -> np.ndarray:
    """The true states (count, 4), from velocities by the mass matrix and forces by dL/dq."""

    def field(t: float, x: np.ndarray) -> list[float]:
        a, b, p, r = x
        c, s = np.cos(a - b), np.sin(a - b)
        u, w = (p - c * r) / (2 - c**2), (2 * r - c * p) / (2 - c**2)
        return [u, w, -u * w * s - 2 * GRAVITY * np.sin(a), u * w * s - GRAVITY * np.sin(b)]

    times = STEP * np.arange(count)
    return solve_ivp(field, (0.0, times[-1]), start, "DOP853", times, rtol=1e-12, atol=1e-12).y.T


def recordings(settings: Settings, seed: int) -> TimeSeries:
    """The readings of all rows: the repeats of the regular motion, then those of the chaotic one."""
    times = np.tile(STEP * np.arange(settings.count), (2 * settings.repeats, 1))
    rows = []
    for i, start in enumerate(STARTS.values()):
        truth = orbit(start, settings.count)
        draws = [np.random.default_rng([seed, i, r]) for r in range(settings.repeats)]
        rows += [truth * draw.uniform(1 - NOISE, 1 + NOISE, truth.shape) for draw in draws]
    return TimeSeries(times, np.array(rows))


@eqx.filter_jit
def _models(keys: Array, starts: Array, width: int, learns: bool) -> Any:
    def one(key: Array, start: Array) -> StateSpaceModel:
        variances = jnp.full(4, 1e-3)
        return StateSpaceModel(
            Propagator(NSSNN(2, width, key=key), ig.Tao(OMEGA, ig.FirstCopy())),
            FullState(),
            AdditiveGaussian(Diagonal(Positive(variances) if learns else variances)),
            Multiplicative(Uniform(1 - NOISE, 1 + NOISE, dim=4), AdditiveGaussian(ScaledIdentity(JITTER, 4))),
            Gaussian(start, CERTAIN * jnp.eye(4)),
        )

    return eqx.filter_vmap(one)(keys, starts)


def training_of(settings: Settings, way: str) -> Training:
    """Adam with the published rates, which fall 20 times by 0.8; in log theta_q a rate of 1 is one of theta_q."""
    decay, nothing = settings.epochs // 20, jax.random.key(0)
    network, intervals = Adam(0.05, decay, 0.8), settings.count - 1
    if way == L1:
        batch = MiniBatch(min(settings.batch, intervals), nothing)
        # The scale is a factor of the gradient, which Adam does not see.
        return Training(OneStepL1(1.0, batch), Prior(Flat()), network, math.ceil(intervals / batch.size))
    both = ByLeaf({"": network, "process_noise": Adam(1.0, decay, 0.8, betas=(0.1, 0.1))})
    prior = Prior({"dynamics": Flat(), "process_noise": HalfNormal(1e-12)})
    if way == POSTERIOR:
        return Training(MARGINAL_LIKELIHOOD, prior, both)
    size = settings.piece * max(1, settings.batch // settings.piece // 2)
    pieces = InPieces(settings.piece, MiniBatch(min(size, intervals // settings.piece * settings.piece), nothing))
    return Training(pieces, prior, both, math.ceil(intervals / size))


def study(settings: Settings, run: Run, deadline: Deadline) -> dict[str, Any]:
    """The best models of each way that is done by the deadline."""
    folder = run.out / "parts"
    folder.mkdir(exist_ok=True)
    series, rows = recordings(settings, run.seed), 2 * settings.repeats
    keys = jax.random.split(jax.random.key(run.seed), rows)
    starts = jnp.repeat(jnp.asarray(list(STARTS.values())), settings.repeats, axis=0)

    def best(way: str) -> Any | None:
        models = _models(keys, starts, settings.width, way != L1)
        ensemble = Ensemble(training_of(settings, way), models, series, keys, settings.epochs)
        return ensemble.run(way, folder / f"{way}.npz", deadline)

    found = side_by_side([partial(best, way) for way in WAYS], deadline)
    return {way: models for way, models in zip(WAYS, found, strict=True) if models is not None}


@eqx.filter_jit
def _simulated(models: Any, count: int) -> Array:
    """Free runs (row, count, 4) at steps of 1e-3, never projected."""

    def one(model: StateSpaceModel) -> Array:
        times = STEP * jnp.arange(count)
        return ig.integrate(model.dynamics.system, ig.Tao(OMEGA, ig.FirstCopy()), model.initial.mean, times, 10).xs

    return eqx.filter_vmap(one)(models)


@eqx.filter_jit
def _drawn(models: Any, count: int, key: Array) -> Array:
    """Angles (row, draw, count, 2) of stochastic simulations: free runs with the learnt process noise."""

    def one(model: StateSpaceModel, key: Array) -> Array:
        model = resolve(model)
        root, start = model.process_noise.structure.root, model.initial.mean

        def step(x: Array, xi: Array) -> tuple[Array, Array]:
            after = model.dynamics(x, Interval(jnp.zeros(()), jnp.asarray(STEP))) + root @ xi
            return after, after[:2]

        later = jax.lax.scan(step, start, jax.random.normal(key, (count - 1, 4)))[1]
        return jnp.concatenate([start[None, :2], later])

    def row(model: StateSpaceModel, key: Array) -> Array:
        return jax.vmap(lambda key: one(model, key))(jax.random.split(key, DRAWS))

    return eqx.filter_vmap(row)(models, jax.random.split(key, jax.tree.leaves(models)[0].shape[0]))


def spread(values: np.ndarray) -> dict[str, float]:
    """Median and the 10 % and 90 % quantiles over the repeats."""
    low, middle, high = np.quantile(values, (0.1, 0.5, 0.9))
    return {"median": float(middle), "low": float(low), "high": float(high)}


def judge(xs: np.ndarray, truth: np.ndarray) -> dict[str, Any]:
    """Of all repeats (5.29), its maximum, and the time until an angle is off by half a radian."""
    off = np.abs(energy(xs) - energy(truth[0]))
    far = np.any(np.abs(xs[..., :2] - truth[:, :2]) > FAR, axis=-1)
    until = STEP * np.where(far.any(axis=1), far.argmax(axis=1), len(truth))
    return {
        "mean_hamiltonian_error": spread(off.mean(axis=1)),
        "maximum_hamiltonian_error": spread(off.max(axis=1)),
        "time_to_half_radian": spread(until),
    }


def calibrate(draws: np.ndarray, xs: np.ndarray, truth: np.ndarray) -> dict[str, Any]:
    """The spread of the stochastic simulation against the true error of the free run, over the time of the data.

    `coverage_90` is the share of angles inside the middle 90 % of the draws, `error_over_spread` the median over time
    of |error| / standard deviation (0.67 for a normal), `rank_correlation` that of the two over time (Spearman).
    """
    half = len(truth) // 2
    draws, angles, nominal = draws[:, :, :half], truth[:half, :2], xs[:, :half, :2]
    low, high = np.quantile(draws, (0.05, 0.95), axis=1)
    error = np.abs(nominal - angles).mean(axis=-1)[:, 1:]
    sd = draws.std(axis=1).mean(axis=-1)[:, 1:]
    ranks = [np.argsort(np.argsort(each, axis=1), axis=1) for each in (error, sd)]
    return {
        "coverage_90": spread(np.mean((low <= angles) & (angles <= high), axis=(1, 2))),
        "error_over_spread": spread(np.median(error / np.maximum(sd, 1e-12), axis=1)),
        "rank_correlation": spread(np.array([np.corrcoef(*pair)[0, 1] for pair in zip(*ranks, strict=True)])),
    }


class Drawing(NamedTuple):
    """What a figure shows of one regime: truth, free runs of each way, and draws, all of one repeat."""

    truth: np.ndarray
    runs: dict[str, np.ndarray]
    draws: np.ndarray | None


def draw(drawings: dict[str, Drawing]) -> Figure:
    """Figures 5.12 and 5.13 (angles in time, with the draws) and 5.14 (the absolute Hamiltonian error)."""
    figure = Figure(figsize=(15.0, 3.6 * len(drawings)), layout="constrained")
    panels = figure.subplots(len(drawings), 3, squeeze=False)
    for row, (regime, (truth, runs, draws)) in zip(panels, drawings.items(), strict=True):
        times = STEP * np.arange(len(truth))
        for i in (0, 1):
            if draws is not None:
                row[i].plot(times, draws[:30, :, i].T, color="tab:blue", alpha=0.08, linewidth=0.6)
            row[i].plot(times, truth[:, i], color="0.3", linewidth=2.0, label="truth")
            for way, xs in runs.items():
                row[i].plot(times, xs[:, i], color=COLOURS[way], linewidth=1.0, label=way)
            row[i].axvline(times[len(times) // 2], color="0.8", linewidth=1.0)
            limit = 1.5 * np.abs(truth[:, i]).max()
            row[i].set(title=f"{regime}: q{i + 1}; data end at the line", xlabel="time", ylim=(-limit, limit))
        for way, xs in runs.items():
            row[2].semilogy(times, np.abs(energy(xs) - energy(truth[0])).clip(1e-6), color=COLOURS[way], label=way)
        row[2].set(title=f"{regime}: absolute Hamiltonian error", xlabel="time")
        row[2].legend(fontsize=8)
    return figure


def experiment(settings: Settings, deadline: Deadline, run: Run) -> None:
    """Train and judge, print the table, write metrics and the figure of what is done."""
    if settings != FULL:
        print(
            f"SMALLER: {settings.count} of {FULL.count} readings, {settings.repeats} of {FULL.repeats} repeats, width "
            f"{settings.width} of {FULL.width}, {settings.epochs} of {FULL.epochs} epochs: no number is the full run's."
        )
    best, size = study(settings, run, deadline), 2 * settings.count
    xs = {way: np.asarray(_simulated(models, size)) for way, models in best.items()}
    draws = np.asarray(_drawn(best[POSTERIOR], size, jax.random.key(run.seed))) if POSTERIOR in best else None
    metrics: dict[str, Any] = {}
    drawings, rows = {}, []
    for i, (regime, start) in enumerate(STARTS.items()):
        own, truth = slice(i * settings.repeats, (i + 1) * settings.repeats), orbit(start, size)
        metrics[regime] = {way: judge(all_xs[own], truth) for way, all_xs in xs.items()}
        rows += [(regime, way, *(each["median"] for each in found.values())) for way, found in metrics[regime].items()]
        if draws is None:
            continue
        metrics[regime]["calibration"] = calibrate(draws[own], xs[POSTERIOR][own], truth)
        # The repeat in the middle of the posterior's Hamiltonian errors is drawn.
        off = np.abs(energy(xs[POSTERIOR][own]) - energy(truth[0])).mean(axis=1)
        one = int(np.argsort(off)[len(off) // 2])
        drawings[regime] = Drawing(truth, {way: all_xs[own][one] for way, all_xs in xs.items()}, draws[own][one])
    print_table(("motion", "way", "mean |H error|", "largest", "time to 0.5 rad"), *rows)
    for regime, found in metrics.items() if draws is not None else ():
        print(f"{regime}: spread against error:", {k: round(v["median"], 3) for k, v in found["calibration"].items()})
    missing = [way for way in WAYS if way not in best]
    run.write(metrics | {"missing": missing, "settings": settings._asdict()})
    if drawings:
        run.save(draw(drawings), "double_pendulum.png")
    if missing:
        print(f"out of time: {', '.join(missing)} not done; the same command goes on from here")


def main(arguments: Sequence[str] | None = None, settings: Settings | None = None) -> None:
    """The command line; `settings` are others than those of the options."""
    deadline, sizes, others = options("double_pendulum", sys.argv[1:] if arguments is None else arguments)

    def chosen(run: Run) -> None:
        experiment((settings or (QUICK if run.quick else FULL))._replace(**sizes), deadline, run)

    about = (
        "Learn the double pendulum by likelihood and by L1. --minutes M stops in time; --width, --epochs, --repeats."
    )
    command("double_pendulum", about, chosen, others)


if __name__ == "__main__":
    main()
