"""A network learns the Hamiltonian of Tao's example by likelihood and by L1. Dissertation 5.4.3, Figures 5.8 to 5.11.

    python -m experiments.tao [--quick] [--out DIR] [--seed N] [--minutes M] [--width W] [--epochs E] [--repeats R]
                              [--scheduler ADDRESS]

88 data sets (a, n) of H = (q^2 + 1)(p^2 + 1) / 2 with noise v ~ U[1 - a, 1 + a] times each of n readings, 20 repeats of
each: new weights, batches and noise, the same for both objectives. Truth by SciPy's DOP853. All rows of one n are one
program; on a GPU the likelihood of all n is. `--minutes` stops in time; the same command again goes on from there.
With `--scheduler` the workers of a Dask cluster train, one n each.

Beyond the dissertation: the same likelihood with the mean of Tao's two copies in the filter, not the first copy, which
is nearly symplectic (specification E40), at the corners and the centre of the grid; and the likelihood on data with ten
times the noise of those given to L1.
"""

import importlib
import itertools
import math
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.integrate import solve_ivp

import integrators as ig
from symplearn._checkpoint import Checkpoint
from symplearn._distributions import Uniform
from symplearn._hamiltonian_objectives import MiniBatch, OneStepL1
from symplearn._model import FullState, Gaussian, Propagator, StateSpaceModel
from symplearn._neural_hamiltonian import NSSNN
from symplearn._noise import AdditiveGaussian, Multiplicative, ScaledIdentity
from symplearn._objectives import MARGINAL_LIKELIHOOD, TimeSeries
from symplearn._optimisers import Adam, ByLeaf
from symplearn._parameters import Positive
from symplearn._prior import Flat, HalfNormal, Prior
from symplearn._train import Training

from . import _tao_results as found
from ._cluster import elsewhere
from ._command import Run
from ._ensemble import Deadline, Ensemble, Weighted, plain, side_by_side, smaller, study_command
from ._tao_results import COUNTS, L1, MEAN, NOISES, POSTERIOR, WAYS, Cell, Judged

STEP, OMEGA, START = 0.01, 20.0, np.array([0.0, -3.0])
CORNERS = tuple(itertools.product((0.0, 0.1), (300, 1000)))
# Variances: of x_0, which is known, and of readings of 0, which have no multiplied noise.
CERTAIN, JITTER = 1e-8, 1e-10


class Settings(NamedTuple):
    """What is trained: the data sets (a, n), those for the mean of copies too, those for L1 alone, and how."""

    cells: tuple[Cell, ...]
    beyond: tuple[Cell, ...]
    quiet: tuple[Cell, ...]
    repeats: int
    width: int
    epochs: int
    batch: int = 512
    depth: int = 6

    @property
    def counts(self) -> list[int]:
        return sorted({n for _, n in self.cells})

    def rows(self, way: str, counts: Sequence[int]) -> list["Row"]:
        """The trainings of one way at these n."""
        return [Row(a, n, r) for a, n in self.of(way) if n in counts for r in range(self.repeats)]

    def of(self, way: str) -> tuple[Cell, ...]:
        """The data sets of one way."""
        others = {POSTERIOR: self.cells, L1: (*self.cells, *self.quiet), MEAN: self.beyond}
        return others[way]


class Row(NamedTuple):
    """One training: noise a, number of readings n, and which repeat."""

    a: float
    n: int
    repeat: int


FULL = Settings(tuple(itertools.product(NOISES, COUNTS)), (*CORNERS, (0.05, 600)), (), 20, 64, 400)
QUICK = Settings((*CORNERS, (0.05, 600)), ((0.05, 600),), ((0.01, 300), (0.01, 1000)), 5, 16, 160)


def energy(x: np.ndarray) -> np.ndarray:
    """H over the last axis."""
    return 0.5 * (x[..., 0] ** 2 + 1) * (x[..., 1] ** 2 + 1)


def orbit(count: int) -> np.ndarray:
    """The true states (count, 2)."""

    def field(t: float, x: np.ndarray) -> list[float]:
        return [x[1] * (x[0] ** 2 + 1), -x[0] * (x[1] ** 2 + 1)]

    times = STEP * np.arange(count)
    return solve_ivp(field, (0.0, times[-1]), START, "DOP853", times, rtol=1e-11, atol=1e-12).y.T


def recordings(rows: Sequence[Row], seed: int, length: int) -> TimeSeries:
    """The readings of all rows, NaN from n on: the intervals there have no length, so nothing moves."""
    truth, readings = orbit(length), np.full((len(rows), length, 2), np.nan)
    times = STEP * np.minimum(np.arange(length), np.array([row.n for row in rows])[:, None] - 1)
    for i, (a, n, repeat) in enumerate(rows):
        draw = np.random.default_rng([seed, repeat, n, round(100 * a)])
        readings[i, :n] = truth[:n] * draw.uniform(1 - a, 1 + a, (n, 2))
    return TimeSeries(times, readings)


def model_of(key: Array, a: Array, weight: Array, size: tuple[int, int], variance: Any) -> StateSpaceModel:
    """The NSSNN in Tao's integrator, and the noises as they are: Sigma = theta_q I, R = a^2 / 3 I."""
    return StateSpaceModel(
        Propagator(NSSNN(1, *size, key=key), ig.Tao(OMEGA, Weighted(weight))),
        FullState(),
        AdditiveGaussian(ScaledIdentity(variance, 2)),
        Multiplicative(Uniform(1 - a, 1 + a, dim=2), AdditiveGaussian(ScaledIdentity(JITTER, 2))),
        Gaussian(jnp.asarray(START), CERTAIN * jnp.eye(2)),
    )


@eqx.filter_jit
def _models(keys: Array, a: Array, weights: Array, size: tuple[int, int], learns: bool) -> Any:
    def one(key: Array, a: Array, weight: Array) -> StateSpaceModel:
        return model_of(key, a, weight, size, Positive(1e-3) if learns else 1e-3)

    return eqx.filter_vmap(one)(keys, a, weights)


def ensemble(settings: Settings, rows: dict[str, list[Row]], seed: int) -> Ensemble:
    """The trainings of these rows: of `L1` alone, or of one or both of the others."""
    flat = [row for way in rows for row in rows[way]]
    seeds = [np.random.SeedSequence([seed, row.repeat, row.n, round(100 * row.a)]).generate_state(1)[0] for row in flat]
    keys = jax.vmap(jax.random.key)(jnp.asarray(seeds))
    weights = jnp.asarray([0.5 if way == MEAN else 1.0 for way in rows for _ in rows[way]])
    models = _models(
        keys, jnp.asarray([row.a for row in flat]), weights, (settings.width, settings.depth), L1 not in rows
    )
    longest = max(row.n for row in flat)
    training = training_of(settings, L1 in rows, longest)
    return Ensemble(training, models, recordings(flat, seed, longest), keys, settings.epochs)


def training_of(settings: Settings, l1: bool, n: int) -> Training:
    """Adam with the published rates, which fall 20 times by 0.8; in log theta_q a rate of 0.5 is one of 0.5 theta_q."""
    decay = settings.epochs // 20
    network = Adam(0.05, decay, 0.8)
    if l1:
        size = min(settings.batch, n - 1)
        # The scale is a factor of the gradient, which Adam does not see.
        return Training(
            OneStepL1(1.0, MiniBatch(size, jax.random.key(0))), Prior(Flat()), network, math.ceil((n - 1) / size)
        )
    both = ByLeaf({"": network, "process_noise": Adam(0.5, decay, 0.8, betas=(0.1, 0.1))})
    return Training(MARGINAL_LIKELIHOOD, Prior({"dynamics": Flat(), "process_noise": HalfNormal(1e-12)}), both)


@eqx.filter_jit
def _simulated(systems: Any, count: int) -> Array:
    """Free runs (row, count, 2) from x_0 at steps of 1e-3, never projected."""
    tao = ig.Tao(OMEGA, ig.FirstCopy())
    times = STEP * jnp.arange(count)
    return eqx.filter_vmap(lambda system: ig.integrate(system, tao, START, times, 10).xs)(systems)


def judge(systems: Any, cells: int, n: int) -> Judged:
    """Free runs over twice the time of the data, against the truth."""
    xs = np.asarray(_simulated(systems, 2 * n)).reshape(cells, -1, 2 * n, 2)
    mse = np.mean(np.sum((xs - orbit(2 * n)) ** 2, axis=-1), axis=-1)
    off = np.mean((energy(xs) - energy(START)) ** 2, axis=-1)
    order = np.argsort(mse, axis=1)
    middle, least = order[:, order.shape[1] // 2], order[:, 0]
    runs = np.stack([xs[np.arange(cells), middle], xs[np.arange(cells), least]], axis=1)
    # The field of a network is bounded, so nothing is infinite; a wild energy is still cut.
    return Judged(np.minimum(np.stack([mse, off], axis=-1), 1e12), runs)


Results = dict[int, dict[str, Judged]]


def study(settings: Settings, run: Run, deadline: Deadline) -> Results:
    """All trainings that are done by the deadline, from what was done before on."""
    folder = run.out / "parts"
    folder.mkdir(exist_ok=True)
    seal = f"{settings} {run.seed}"
    if run.scheduler is not None:
        _on_cluster(settings, run, deadline)
        return _finished(settings, folder, seal)
    groups = [settings.counts] if jax.default_backend() == "gpu" else [[n] for n in settings.counts]

    def done(group: list[int]) -> bool:
        saved = all((folder / f"n_{n}.npz").exists() for n in group)
        return saved or _train(settings, group, run.seed, folder, seal, deadline)

    # The longest first, so that both cores are busy to the end.
    groups.reverse()
    side_by_side([partial(done, group) for group in groups], deadline)
    return _finished(settings, folder, seal)


def _finished(settings: Settings, folder: Path, seal: str) -> Results:
    """What is trained and judged at each n."""
    files = {n: folder / f"n_{n}.npz" for n in settings.counts}
    return {n: Checkpoint(file, seal).load(_blank(settings, n)) for n, file in files.items() if file.exists()}


def _on_cluster(settings: Settings, run: Run, deadline: Deadline) -> None:
    """Every n that is not done is a part of its own, the longest first; what it has begun goes along and comes back."""
    folder, until = run.out / "parts", time.time() + deadline.left()
    counts = [n for n in reversed(settings.counts) if not (folder / f"n_{n}.npz").exists()]
    begun = {n: sorted(folder.glob(f"{n}_*.npz")) for n in counts}
    sent = [{f"parts/{path.name}": path.read_bytes() for path in begun[n]} for n in counts]
    for n in elsewhere(run, [partial(_part, settings, n, until) for n in counts], sent):
        for path in begun[n] if (folder / f"n_{n}.npz").exists() else ():
            path.unlink(missing_ok=True)


def _part(settings: Settings, n: int, until: float, run: Run) -> int:
    """Train and judge all rows of one n, until a moment of `time.time` at most; n."""
    folder = run.out / "parts"
    folder.mkdir(exist_ok=True)
    deadline = Deadline(time.monotonic() + until - time.time())
    _train(settings, [n], run.seed, folder, f"{settings} {run.seed}", deadline)
    return n


def _blank(settings: Settings, n: int) -> dict[str, Judged]:
    sizes = {way: len(settings.rows(way, [n])) // settings.repeats for way in WAYS}
    return {
        way: Judged(np.zeros((size, settings.repeats, 2)), np.zeros((size, 2, 2 * n, 2)))
        for way, size in sizes.items()
        if size
    }


def _train(settings: Settings, group: list[int], seed: int, folder: Path, seal: str, deadline: Deadline) -> bool:
    """Train and judge all rows of these n; whether there was the time."""
    rows = {way: settings.rows(way, group) for way in (POSTERIOR, MEAN)}
    jobs = [("_".join(map(str, group[:1] + group[1:][-1:])) + "_posterior", rows)]
    jobs += [(f"{n}_l1", {L1: settings.rows(L1, [n])}) for n in group]
    systems: dict[str, dict[Row, Any]] = {way: {} for way in WAYS}
    for name, job in jobs:
        best = ensemble(settings, job, seed).run(name, folder / f"{name}.npz", deadline)
        if best is None:
            return False
        arrays, rest = eqx.partition(jax.tree.map(np.asarray, best.dynamics.system), eqx.is_array)
        places = [(way, row) for way in job for row in job[way]]
        for i, (way, row) in enumerate(places):
            systems[way][row] = eqx.combine(jax.tree.map(lambda leaf, i=i: leaf[i], arrays), rest)
    for n in group:
        judged = {}
        for way in _blank(settings, n):
            chosen = [systems[way][row] for row in settings.rows(way, [n])]
            stacked = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *chosen)
            judged[way] = judge(stacked, len(chosen) // settings.repeats, n)
        Checkpoint(folder / f"n_{n}.npz", seal).save(judged)
    for name, _ in jobs:
        (folder / f"{name}.npz").unlink(missing_ok=True)
    return True


def experiment(settings: Settings, deadline: Deadline, run: Run) -> None:
    """Train and judge, print the table, write metrics and figures of what is done."""
    print(smaller(settings, FULL, data_sets=(len(settings.cells), len(FULL.cells))), flush=True)
    done = found.outcomes({way: settings.of(way) for way in WAYS}, study(settings, run, deadline))
    numbers = found.metrics(done, settings.cells)
    found.show(done, numbers)
    said = {"repeats": settings.repeats, "width": settings.width, "epochs": settings.epochs}
    run.write(plain(numbers) | {"settings": said})
    run.save(found.maps(done), "maps.png")
    corners = [
        cell for cell in (CORNERS if set(CORNERS) <= set(settings.cells) else settings.cells) if (L1, cell) in done
    ]
    if corners:
        truth = orbit(2 * max(n for _, n in corners))
        run.save(found.runs(done, corners, 0, truth, STEP), "runs_median.png")
        run.save(found.runs(done, corners, 1, truth, STEP), "runs_least.png")
    if numbers["missing"]:
        print(f"\nout of time: {len(numbers['missing'])} data sets are missing; the same command goes on from here")


def main(arguments: Sequence[str] | None = None, settings: Settings | None = None) -> None:
    """The command line; `settings` are others than those of the options."""
    about = "Learn Tao's example by likelihood and by L1."
    study_command("tao", about, experiment, lambda quick: settings or (QUICK if quick else FULL), arguments, True)


if __name__ == "__main__":
    # Under its own name, by which the workers of a cluster find it.
    importlib.import_module("experiments.tao").main()
