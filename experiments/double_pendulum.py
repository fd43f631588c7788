"""A network learns the Hamiltonian of the double pendulum by likelihood and by L1. Dissertation 5.4.4, Figs 5.12-5.14.

    python -m experiments.double_pendulum [--quick] [--out DIR] [--seed N] [--minutes M]
                                          [--width W] [--epochs E] [--repeats R] [--scheduler ADDRESS]

Masses and lengths 1, 2000 readings every 0.01 with noise v ~ U[0.99, 1.01] times each. From q1 = 1, as printed, the
motion is regular (specification E48), from q1 = 2 chaotic. Both, and all repeats, are one program; `--minutes` stops it
in time, and the same command goes on from there. With `--scheduler` the workers of a Dask cluster train, one way each.
Truth by SciPy's DOP853.

Beyond the dissertation: a learning step 5 times larger, on every fifth reading; and pieces of the recording filtered
side by side, each given its first reading, a few at a time: many steps of Adam for the price of one.
"""

import importlib
import math
import time
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.integrate import solve_ivp

import integrators as ig
from symplearn._distributions import Uniform
from symplearn._errors import InputError
from symplearn._hamiltonian_objectives import MiniBatch, OneStepL1
from symplearn._model import FullState, Gaussian, Interval, Propagator, StateSpaceModel
from symplearn._neural_hamiltonian import NSSNN
from symplearn._noise import AdditiveGaussian, Diagonal, Multiplicative, ScaledIdentity
from symplearn._objectives import MARGINAL_LIKELIHOOD, AbstractObjective, TimeSeries
from symplearn._optimisers import Adam, ByLeaf
from symplearn._parameters import Positive, resolve
from symplearn._prior import Flat, HalfNormal, Prior
from symplearn._train import Training

from . import _double_pendulum_results as found
from ._cluster import elsewhere
from ._command import Run
from ._double_pendulum_results import COARSE, GRAVITY, L1, POSTERIOR, STEP, WAYS
from ._ensemble import Deadline, Ensemble, plain, side_by_side, smaller, study_command

OMEGA, NOISE = 20.0, 0.01
STARTS = {"regular": (1.0, 0.0, 0.0, 0.0), "chaotic": (2.0, 0.0, 0.0, 0.0)}
CERTAIN, JITTER = 1e-8, 1e-10
SPARSE = 5  # readings in one of the larger learning step's intervals
DRAWS = 100  # paths of the stochastic simulation


class Settings(NamedTuple):
    """How much is trained: readings, repeats, units of a layer, epochs, and intervals of a piece and of a batch."""

    readings: int
    repeats: int
    width: int
    epochs: int
    piece: int
    batch: int = 512


FULL = Settings(2000, 20, 64, 1000, 50)
QUICK = Settings(200, 5, 16, 300, 25, 50)


class InPieces(AbstractObjective):
    """The likelihood of pieces of `length` intervals, each given its first reading; a composite likelihood.

    `batch.size` counts data intervals, a multiple of the length; without a batch all pieces count.
    """

    length: int = eqx.field(static=True)
    batch: MiniBatch | None

    def __check_init__(self) -> None:
        if self.batch is not None and self.batch.size < self.length:
            raise InputError(
                f"A batch of {self.batch.size} data intervals holds no piece of {self.length}; make it larger, or the "
                "pieces shorter."
            )

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
    times = np.tile(STEP * np.arange(settings.readings), (2 * settings.repeats, 1))
    rows = []
    for i, start in enumerate(STARTS.values()):
        truth = orbit(start, settings.readings)
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
    network, intervals = Adam(0.05, decay, 0.8), settings.readings - 1
    if way == L1:
        batch = MiniBatch(min(settings.batch, intervals), nothing)
        # The scale is a factor of the gradient, which Adam does not see.
        return Training(OneStepL1(1.0, batch), Prior(Flat()), network, math.ceil(intervals / batch.size))
    both = ByLeaf({"": network, "process_noise": Adam(1.0, decay, 0.8, betas=(0.1, 0.1))})
    prior = Prior({"dynamics": Flat(), "process_noise": HalfNormal(1e-12)})
    if way in (POSTERIOR, COARSE):
        return Training(MARGINAL_LIKELIHOOD, prior, both)
    size = settings.piece * max(1, settings.batch // settings.piece // 2)
    pieces = InPieces(settings.piece, MiniBatch(min(size, intervals // settings.piece * settings.piece), nothing))
    return Training(pieces, prior, both, math.ceil(intervals / size))


def ensemble(settings: Settings, way: str, seed: int) -> Ensemble:
    """The trainings of one way."""
    series, rows = recordings(settings, seed), 2 * settings.repeats
    keys = jax.random.split(jax.random.key(seed), rows)
    starts = jnp.repeat(jnp.asarray(list(STARTS.values())), settings.repeats, axis=0)
    models = _models(keys, starts, settings.width, way != L1)
    kept = TimeSeries(series.times[:, ::SPARSE], series.readings[:, ::SPARSE]) if way == COARSE else series
    return Ensemble(training_of(settings, way), models, kept, keys, settings.epochs)


def study(settings: Settings, run: Run, deadline: Deadline) -> dict[str, Any]:
    """The best models of each way that is done by the deadline."""
    folder = run.out / "parts"
    folder.mkdir(exist_ok=True)
    ensembles = {way: ensemble(settings, way, run.seed) for way in WAYS}
    if run.scheduler is not None:
        _on_cluster(settings, ensembles, run, deadline)
        deadline = Deadline(-math.inf)  # what is done is read here, and nothing trained
    jobs = [partial(one.run, way, folder / f"{way}.npz", deadline) for way, one in ensembles.items()]
    found = side_by_side(jobs, deadline)
    return {way: models for way, models in zip(WAYS, found, strict=True) if models is not None}


def _on_cluster(settings: Settings, ensembles: dict[str, Ensemble], run: Run, deadline: Deadline) -> None:
    """Every way that is not done is a part of its own; what it has begun goes along and comes back."""
    until, files = time.time() + deadline.left(), {way: run.out / "parts" / f"{way}.npz" for way in WAYS}
    ways = [way for way in WAYS if not ensembles[way].is_done(way, files[way])]
    sent = [{f"parts/{way}.npz": files[way].read_bytes()} if files[way].exists() else {} for way in ways]
    parts = [partial(_part, settings, way, _numbers(ensembles[way]), until) for way in ways]
    for _ in elsewhere(run, parts, sent):
        pass


def _numbers(of: Ensemble) -> list[np.ndarray]:
    return [np.asarray(leaf) for leaf in jax.tree.leaves((of.models, of.recordings))]


def _part(settings: Settings, way: str, numbers: Sequence[np.ndarray], until: float, run: Run) -> None:
    """Train one way on these numbers, until a moment of `time.time` at most."""
    folder, own = run.out / "parts", ensemble(settings, way, run.seed)
    folder.mkdir(exist_ok=True)
    # The file is sealed with its numbers, and another processor's own may differ in the last digit.
    structure = jax.tree.structure((own.models, own.recordings))
    models, series = jax.tree.unflatten(structure, [jnp.asarray(each) for each in numbers])
    moment = time.monotonic() + until - time.time()
    own._replace(models=models, recordings=series).run(way, folder / f"{way}.npz", Deadline(moment))


@eqx.filter_jit
def _simulated(models: Any, count: int) -> Array:
    """Free runs (row, count, 4) at steps of 1e-3, never projected."""

    def one(model: StateSpaceModel) -> Array:
        times = STEP * jnp.arange(count)
        return ig.integrate(model.dynamics.system, ig.Tao(OMEGA, ig.FirstCopy()), model.initial.mean, times, 10).xs

    return eqx.filter_vmap(one)(models)


@eqx.filter_jit
def _learnt(models: Any) -> Array:
    """The variances (row, 4) of the process noise."""
    return eqx.filter_vmap(lambda model: jnp.square(jnp.diagonal(resolve(model).process_noise.structure.root)))(models)


@eqx.filter_jit
def _errors(models: Any, truth: Array) -> Array:
    """One-step errors (row, time, 4) from true states (row, time, 4)."""
    interval = Interval(jnp.zeros(()), jnp.asarray(STEP))

    def one(model: StateSpaceModel, xs: Array) -> Array:
        return jax.vmap(lambda x: resolve(model).dynamics(x, interval))(xs[:-1]) - xs[1:]

    return eqx.filter_vmap(one)(models, truth)


@eqx.filter_jit
def _drawn(models: Any, variances: Array, count: int, key: Array) -> Array:
    """Angles (row, draw, count, 2) of stochastic simulations: free runs with process noise of these variances."""

    def one(model: StateSpaceModel, sd: Array, key: Array) -> Array:
        model, start = resolve(model), model.initial.mean

        def step(x: Array, xi: Array) -> tuple[Array, Array]:
            after = model.dynamics(x, Interval(jnp.zeros(()), jnp.asarray(STEP))) + sd * xi
            return after, after[:2]

        later = jax.lax.scan(step, start, jax.random.normal(key, (count - 1, 4)))[1]
        return jnp.concatenate([start[None, :2], later])

    def row(model: StateSpaceModel, sd: Array, key: Array) -> Array:
        return jax.vmap(lambda key: one(model, sd, key))(jax.random.split(key, DRAWS))

    return eqx.filter_vmap(row)(models, jnp.sqrt(variances), jax.random.split(key, len(variances)))


def stochastic(models: Any, truth: np.ndarray, seed: int) -> found.Drawn:
    """Stochastic simulations of the models over the true states (row, time, 4) of the time of the data."""
    variances, errors = _learnt(models), _errors(models, jnp.asarray(truth))
    key, count = jax.random.key(seed), truth.shape[1]
    draws = [_drawn(models, each, count, key) for each in (variances, jnp.mean(errors**2, axis=1))]
    return found.Drawn(*map(np.asarray, (*draws, errors, variances)))


def experiment(settings: Settings, deadline: Deadline, run: Run) -> None:
    """Train and judge, print the table, write metrics and the figures of what is done."""
    print(smaller(settings, FULL), flush=True)
    best, size = study(settings, run, deadline), 2 * settings.readings
    xs = {way: np.asarray(_simulated(models, size)) for way, models in best.items()}
    truth = {name: orbit(start, size) for name, start in STARTS.items()}
    drawn = None
    if POSTERIOR in best:
        rows = np.repeat(np.array(list(truth.values())), settings.repeats, axis=0)[:, : settings.readings]
        drawn = stochastic(best[POSTERIOR], rows, run.seed)
    regimes = {}
    for i, name in enumerate(STARTS):
        own = slice(i * settings.repeats, (i + 1) * settings.repeats)
        draws = None if drawn is None else found.Drawn(*(each[own] for each in drawn))
        regimes[name] = found.Regime(truth[name], {way: each[own] for way, each in xs.items()}, draws)
    numbers = found.metrics(regimes)
    found.show(regimes, numbers)
    missing = [way for way in WAYS if way not in best]
    run.write(plain(numbers) | {"missing": missing, "settings": settings._asdict()})
    if POSTERIOR in best:
        run.save(found.draw(regimes), "double_pendulum.png")
        run.save(found.phase(regimes), "double_pendulum_phase.png")
    if missing:
        print(f"out of time: {', '.join(missing)} not done; the same command goes on from here")


def main(arguments: Sequence[str] | None = None, settings: Settings | None = None) -> None:
    """The command line; `settings` are others than those of the options."""
    about = "Learn the double pendulum by likelihood and by L1."
    study_command(
        "double_pendulum", about, experiment, lambda quick: settings or (QUICK if quick else FULL), arguments, True
    )


if __name__ == "__main__":
    # Under its own name, by which the workers of a cluster find it.
    importlib.import_module("experiments.double_pendulum").main()
