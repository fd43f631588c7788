"""Filtering with Tao's integrator three ways on the same data: projected by first copy or by mean, and doubled.

    python -m experiments.tao_filtering [--quick] [--out DIR] [--seed N]

Truth by SciPy's DOP853 at 1e-10, readings of the full state with Gaussian noise, prior mean drawn from the prior. Each
filter projects after every data interval (5.18), or keeps the doubled state [q, p, x, y]. A fourth one, RK4 with 20
steps an interval, tells the integrator's error from the unscented transform's. Realisation r has the seed N + r.

Found: at small steps the mean of copies is as good as the doubled state, and the first copy overconfident; at coarse
steps (tao, 0.05) the doubled filter alone is nearly right, and long free runs keep their energy only doubled.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.figure import Figure
from scipy.integrate import solve_ivp

import integrators as ig
from symplearn._doubled import AffineDoubledObservation, DoubledPropagator, doubled, doubled_transform
from symplearn._filter import unscented_filter
from symplearn._model import FullState, Gaussian, Interval, Propagator, StateSpaceModel, intervals_between
from symplearn._noise import AdditiveGaussian, ScaledIdentity
from symplearn._smoother import smooth
from symplearn._transforms import STANDARD

from ._command import Run, command, print_table

FIRST, MEAN, DOUBLED, REFERENCE = WAYS = ("first copy", "mean of copies", "doubled", "reference")
TAO_WAYS = WAYS[:3]
PROJECTED = "projected"
COLOURS = dict(zip(WAYS, ("tab:red", "tab:blue", "tab:green", "0.4"), strict=True))
OMEGA, OMEGAS = 20.0, (1.0, 5.0, 20.0, 50.0)
NORMAL_90 = 1.6449  # a normal's 90 % band, in standard deviations
ROUNDS = 4  # of parabolas through three log likelihoods, each round a third as wide


class Scaled(ig.AbstractHamiltonian):
    """A Hamiltonian times an unknown factor: time runs faster or slower."""

    factor: Float[Array, ""] = eqx.field(converter=ig.as_parameter)
    base: ig.AbstractHamiltonian

    def energy(self, q: Float[Array, " d"], p: Float[Array, " d"]) -> Float[Array, ""]:
        return self.factor * self.base.energy(q, p)


@dataclass(frozen=True)
class Case:
    """A system and how it is read: `count` readings every `interval`; `substeps` to choose from, the main one first.

    `system(theta)` has the parameter 1 in truth; `field` and `energy` are the same by hand. `prior` and `noise` are
    standard deviations, `driven` the process noise's variance per interval where it is not 0, `free` the start of the
    long propagation as a share of `start`, and its step.
    """

    name: str
    system: Callable[[Any], ig.AbstractHamiltonian]
    field: Callable[[float, np.ndarray], list[float]]
    energy: Callable[[np.ndarray], np.ndarray]
    start: tuple[float, ...]
    interval: float
    count: int
    substeps: tuple[int, ...]
    noise: float
    prior: float
    driven: float
    free: tuple[float, float]


def tao_field(t: float, x: np.ndarray) -> list[float]:
    """Hamilton's equations of H = (q^2 + 1)(p^2 + 1) / 2."""
    return [x[1] * (x[0] ** 2 + 1), -x[0] * (x[1] ** 2 + 1)]


def tao_energy(x: np.ndarray) -> np.ndarray:
    """H over the last axis."""
    return 0.5 * (x[..., 0] ** 2 + 1) * (x[..., 1] ** 2 + 1)


def cherry_field(t: float, x: np.ndarray) -> list[float]:
    """Hamilton's equations of (5.23)."""
    q1, q2, p1, p2 = x
    velocity = [p1 + p1 * p2 - q1 * q2, -2.0 * p2 + 0.5 * (p1**2 - q1**2)]
    return [*velocity, -q1 + q1 * p2 + q2 * p1, 2.0 * q2 + q1 * p1]


def cherry_energy(x: np.ndarray) -> np.ndarray:
    """H of (5.23) over the last axis."""
    q1, q2, p1, p2 = np.moveaxis(x, -1, 0)
    return 0.5 * (q1**2 + p1**2) - q2**2 - p2**2 + 0.5 * p2 * (p1**2 - q1**2) - q1 * q2 * p1


# The specification's 5.18 at a coarser grid of readings, and at its own, where each step is projected; Cherry as in
# 5.16. Cherry's long run starts nearer to 0: from its own start it escapes at t = 28.
TAO_CASE = Case(
    "tao", lambda theta: Scaled(theta, ig.problems.TaoExample()), tao_field, tao_energy, (0.0, -3.0),
    0.1, 201, (5, 2, 10), 0.05, 0.1, 1e-6, (1.0, 0.02),
)  # fmt: skip
FINE_CASE = replace(TAO_CASE, name="tao_each_step", interval=0.01, count=1001, substeps=(1,), free=(1.0, 0.01))
CHERRY_CASE = Case(
    "cherry", ig.problems.Cherry, cherry_field, cherry_energy, (0.15, 0.1, -0.05, 0.1),
    0.4, 21, (8, 4, 16), 0.01, 0.05, 1e-6, (0.001, 0.05),
)  # fmt: skip


class Data(NamedTuple):
    """Truth (time, 2d), readings (realisation, time, 2d) and prior means (realisation, 2d) of one case."""

    truth: np.ndarray
    readings: Array
    priors: Array


def observe(case: Case, realisations: int, seed: int) -> Data:
    """The data of all realisations, by SciPy and numpy."""
    times = case.interval * np.arange(case.count)
    span = (0.0, float(times[-1]))
    truth = solve_ivp(case.field, span, case.start, "DOP853", times, rtol=1e-10, atol=1e-12).y.T
    keys = [np.random.default_rng(seed + r) for r in range(realisations)]
    readings = [truth + case.noise * key.standard_normal(truth.shape) for key in keys]
    priors = [truth[0] + case.prior * key.standard_normal(truth.shape[1]) for key in keys]
    return Data(truth, jnp.asarray(np.array(readings)), jnp.asarray(np.array(priors)))


class Weighted(ig.AbstractProjection):
    """First copy by the weights (1, 0), mean of copies by (1/2, 1/2): one compiled program for both."""

    weights: Float[Array, "2"]

    def __call__(self, copies: Float[Array, "2 two_d"]) -> Float[Array, " two_d"]:
        return self.weights @ copies


def model_of(
    case: Case, kind: str, substeps: int, projection: Any, theta: Any, omega: Any, variance: Any, prior: Array
) -> Any:
    """The state-space model of one kind of filter, and its transform with the same sigma points."""
    size = len(case.start)
    integrator = ig.RK4() if kind == REFERENCE else ig.Tao(omega, projection)
    model = StateSpaceModel(
        Propagator(case.system(theta), integrator, 20 if kind == REFERENCE else substeps),
        FullState(),
        AdditiveGaussian(ScaledIdentity(variance, size)),
        AdditiveGaussian(ScaledIdentity(case.noise**2, size)),
        Gaussian(prior, case.prior**2 * jnp.eye(size)),
    )
    return (doubled(model, ig.MeanOfCopies()), doubled_transform(STANDARD)) if kind == DOUBLED else (model, STANDARD)


@partial(jax.jit, static_argnums=(0, 1, 2))
def estimate(
    case: Case, kind: str, substeps: int, weights: Array, theta: Array, omega: float, variance: float, data: Any
) -> Any:
    """Log likelihoods, and moments of the phase point, filtered and smoothed, each realisation with its own parameter.

    The compiler takes seconds and a run milliseconds, so one program serves all that differ in numbers alone.
    """

    intervals = intervals_between(case.interval * jnp.arange(case.count))

    def one(theta: Array, readings: Array, prior: Array) -> Any:
        model, transform = model_of(case, kind, substeps, Weighted(weights), theta, omega, variance, prior)
        filtered = unscented_filter(model, readings, intervals, None, transform)
        smoothed = smooth(model, filtered, intervals, None, transform)
        read = FullState() if kind != DOUBLED else AffineDoubledObservation(FullState(), ig.MeanOfCopies())
        H = read.slope(filtered.filtered_means[0])
        moments = [(m @ H.T, H @ P @ H.T) for m, P in (
            (filtered.filtered_means, filtered.filtered_covariances), (smoothed.means, smoothed.covariances)
        )]  # fmt: skip
        return filtered.log_likelihood, *moments

    # Five at a time, for over 20,000 matrices at once the smoother's batched solves hang on two cores (jaxlib 0.10).
    return jax.lax.map(lambda each: one(*each), (theta, *data), batch_size=5)


def spread(values: np.ndarray) -> dict[str, float]:
    """Median and the 10 % and 90 % quantiles over the realisations."""
    low, middle, high = np.quantile(values, (0.1, 0.5, 0.9))
    return {"median": float(middle), "low": float(low), "high": float(high)}


def judge(truth: np.ndarray, means: np.ndarray, covariances: np.ndarray) -> dict[str, Any]:
    """Errors of one kind of estimate: bias is the error that is left in the mean of all realisations.

    That mean has itself an error of rmse / sqrt(realisations), which `bias_floor` tells.
    """
    error = means - truth
    scaled = np.abs(error) / np.sqrt(np.diagonal(covariances, axis1=-2, axis2=-1))
    nees = np.einsum("rti,rti->rt", error, np.linalg.solve(covariances, error[..., None])[..., 0])
    rmse = np.sqrt(np.mean(error**2, axis=(1, 2)))
    return {
        "bias": float(np.sqrt(np.mean(error.mean(axis=0) ** 2))),
        "bias_floor": float(np.sqrt(np.mean(error.var(axis=0, ddof=1) / len(error)))),
        "rmse": spread(rmse),
        "coverage_90": spread(np.mean(scaled < NORMAL_90, axis=(1, 2))),
        "nees": spread(nees.mean(axis=1) / truth.shape[1]),
    }


def most_likely(at: Callable[[Array], Array], best: Array, width: float = 0.01) -> np.ndarray:
    """The parameter of the highest log likelihood of each realisation, by parabolas from a first guess `best`."""
    for _ in range(ROUNDS):
        low, middle, high = at(best - width), at(best), at(best + width)
        bend = 2.0 * middle - low - high
        step = 0.5 * width * (high - low) / jnp.where(bend > 0.0, bend, 1.0)
        step = jnp.where(bend > 0.0, jnp.clip(step, -3.0 * width, 3.0 * width), width * jnp.sign(high - low))
        best, width = best + step, width / 3.0
    return np.asarray(best)


class Fit(NamedTuple):
    """What one filter says of all realisations: nats, moments of the states, and its most likely parameters."""

    likelihoods: np.ndarray
    filtered: tuple[np.ndarray, np.ndarray]
    smoothed: tuple[np.ndarray, np.ndarray]
    theta: np.ndarray


def fit(case: Case, way: str, setting: Any, data: Data) -> Fit:
    """One filter at one setting (substeps, omega, process noise variance)."""
    substeps, *numbers = setting
    given = data.readings, data.priors
    kind = PROJECTED if way in (FIRST, MEAN) else way
    weights = jnp.array([1.0, 0.0] if way == FIRST else [0.5, 0.5])
    at = partial(estimate, case, kind, substeps, weights, omega=numbers[0], variance=numbers[1], data=given)
    truly = jnp.ones(len(data.priors))
    likelihoods, filtered, smoothed = jax.tree.map(np.asarray, at(truly))
    return Fit(likelihoods, filtered, smoothed, most_likely(lambda theta: at(theta)[0], truly))


def summary(case: Case, data: Data, found: Fit, exact: Fit) -> dict[str, Any]:
    """Everything that is measured of a filter, beside the reference's on the same data."""
    half = case.count // 2  # the second half, where the prior is forgotten
    (m, P), sd = found.filtered, exact.theta.std(ddof=1)
    off = case.energy(m[:, half:]) / case.energy(np.array(case.start)) - 1.0
    return {
        "filtered": judge(data.truth[half:], m[:, half:], P[:, half:]),
        "smoothed": judge(data.truth, *found.smoothed),
        "energy_mean": spread(off.mean(axis=1)),
        "energy_sd": spread(off.std(axis=1)),
        "log_likelihood_gain": spread(found.likelihoods - exact.likelihoods),
        "parameter_bias": float(found.theta.mean() - 1.0),
        "parameter_sd": float(found.theta.std(ddof=1)),
        # Against the reference on the same data: the noise of the realisations drops out.
        "parameter_shift_in_sd": float((found.theta - exact.theta).mean() / sd),
    }


@partial(jax.jit, static_argnums=(0, 1, 2))
def propagate(case: Case, way: str, count: int, omega: float, sd: float, draws: Array) -> Array:
    """Phase points of a free run of `count` intervals of one step each; noise enters both copies alike."""
    share, dt = case.free
    start = share * jnp.asarray(case.start)
    integrator = ig.Tao(jnp.asarray(omega), ig.FirstCopy() if way == FIRST else ig.MeanOfCopies())
    kind, copies = (DoubledPropagator, 2) if way == DOUBLED else (Propagator, 1)
    flow = kind(case.system(1.0), integrator)

    def step(state: Array, data: Any) -> Any:
        k, xi = data
        after = flow(state, Interval(k * dt, (k + 1) * dt)) + share * sd * jnp.tile(xi, copies)
        return after, after.reshape(copies, -1).mean(axis=0)

    return jax.lax.scan(step, jnp.tile(start, copies), (jnp.arange(count), draws))[1]


def energy_error(case: Case, points: Array, start: float) -> np.ndarray:
    """Energy of a free run relative to its start, less 1; 10 where it is off by more than that, or has overflowed."""
    with np.errstate(over="ignore", invalid="ignore"):
        error = case.energy(np.asarray(points)) / start - 1.0
    return np.where(np.abs(error) <= 10.0, error, 10.0)


def drift(case: Case, error: np.ndarray) -> dict[str, Any]:
    """Least-squares slope of an energy error, the largest early and late, and when it escaped.

    The slope is of what went before the escape.
    """
    ends, tenth = np.flatnonzero(error == 10.0), len(error) // 10
    kept = error[: max(ends[0], 2)] if len(ends) else error
    return {
        "slope": float(np.polyfit(case.free[1] * np.arange(len(kept)), kept, 1)[0]),
        "largest_early": float(np.abs(error[:tenth]).max()),
        "largest_late": float(np.abs(error[-tenth:]).max()),
        "end": float(error[-1]),
        "escaped_at": float(ends[0] * case.free[1]) if len(ends) else None,
    }


def free_runs(case: Case, run: Run) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Energy over many intervals without process noise for every omega, and with a little; and the curves to draw."""
    count, noisy = (10_000, 2_000) if run.quick else (100_000, 10_000)
    size, realisations = len(case.start), 5 if run.quick else 20
    start = float(case.energy(case.free[0] * np.array(case.start)))
    draws = [np.random.default_rng(run.seed + 1000 + r).standard_normal((noisy, size)) for r in range(realisations)]
    metrics: dict[str, Any] = {}
    curves = {}
    for way in TAO_WAYS:

        def error(omega: float, sd: float, xi: Any, way: str = way) -> np.ndarray:
            return energy_error(case, propagate(case, way, len(xi), omega, sd, jnp.asarray(xi)), start)

        runs = {omega: error(omega, 0.0, np.zeros((count, size))) for omega in OMEGAS}
        curves[way] = runs[OMEGA]
        shaken = [drift(case, error(OMEGA, 1e-4, xi)) for xi in draws]
        metrics[way] = {
            "no_noise": {f"omega_{omega:g}": drift(case, one) for omega, one in runs.items()},
            "small_noise": {key: spread(np.array([one[key] for one in shaken])) for key in ("slope", "end")},
        }
    return metrics, curves


def sweep(case: Case, run: Run) -> dict[str, Any]:
    """All comparisons of one case: along omega, along the step, and with process noise."""
    data = observe(case, 5 if run.quick else 20, run.seed)
    main, others = case.substeps[0], () if run.quick else case.substeps[1:]
    exact = {variance: fit(case, REFERENCE, (1, OMEGA, variance), data) for variance in (0.0, case.driven)}
    settings = (
        [(main, omega, 0.0) for omega in OMEGAS] + [(s, OMEGA, 0.0) for s in others] + [(main, OMEGA, case.driven)]
    )
    results = {}
    for setting in run.each(case.name, settings):
        substeps, omega, variance = setting
        found = {way: fit(case, way, setting, data) for way in TAO_WAYS} | {REFERENCE: exact[variance]}
        name = f"step_{case.interval / substeps:g}_omega_{omega:g}_noise_{variance:g}"
        results[name] = {way: summary(case, data, one, exact[variance]) for way, one in found.items()}
    return results


def show(case: Case, results: dict[str, Any], free: dict[str, Any]) -> None:
    """Print the table of one case."""
    heads = ("bias", "rmse", "cover 90", "NEES", "smoothed rmse", "nats gained", "param. shift/sd", "energy error")
    rows = []
    for setting, ways in results.items():
        for way, found in ways.items():
            if way == REFERENCE and setting != next(iter(results)):
                continue  # it knows neither omega nor step
            kept = found["filtered"]
            numbers = [kept["bias"], *(kept[k]["median"] for k in ("rmse", "coverage_90", "nees"))]
            numbers += [found["smoothed"]["rmse"]["median"], found["log_likelihood_gain"]["median"]]
            rows.append((setting, way, *numbers, found["parameter_shift_in_sd"], found["energy_mean"]["median"]))
    print(f"\n{case.name}: medians of all realisations, filtered from the second half on")
    print_table(("setting", "filter", *heads), *rows)
    print(f"\n{case.name}, free run of steps of {case.free[1]:g}: relative energy error")
    drifts = [
        (omega, way, *found["no_noise"][omega].values()) for way, found in free.items() for omega in found["no_noise"]
    ]
    print_table(("omega", "propagated", "slope", "first tenth", "last tenth", "end", "escaped at"), *sorted(drifts))


def draw(case: Case, results: dict[str, Any], curves: dict[str, np.ndarray]) -> Figure:
    """Energy of the free run, and how consistent and how biased the filters are along omega."""
    figure = Figure(figsize=(13.0, 3.4), layout="constrained")
    energy, *others = figure.subplots(1, 4)
    for way, error in curves.items():
        thinned = np.abs(error).reshape(200, -1).max(axis=1)
        times = case.free[1] * len(error) * (np.arange(200) + 0.5) / 200
        energy.semilogy(times, thinned.clip(1e-16, 1e2), color=COLOURS[way], label=way)
    energy.set(xlabel="time", title=f"{case.name}: free |dH / H|, omega {OMEGA:g}")
    energy.legend(fontsize=8)
    prefix = f"step_{case.interval / case.substeps[0]:g}_omega_"
    values = (
        ("filtered: rms error in its own sd", lambda found: found["filtered"]["nees"]["median"] ** 0.5, 1.0),
        ("nats against RK4's", lambda found: found["log_likelihood_gain"]["median"], 0.0),
        ("parameter against RK4's, in its sd", lambda found: found["parameter_shift_in_sd"], 0.0),
    )
    for axes, (title, value, ideal) in zip(others, values, strict=True):
        for way in TAO_WAYS:
            heights = [value(results[f"{prefix}{omega:g}_noise_0"][way]) for omega in OMEGAS]
            axes.plot(OMEGAS, heights, "o-", color=COLOURS[way], label=way)
        axes.axhline(ideal, color="0.7", linewidth=1.0, zorder=0)
        axes.set(xscale="log", xlabel="omega", title=title)
    return figure


def experiment(run: Run) -> None:
    """Measure both cases, print their tables, write metrics and figures."""
    metrics = {}
    for case in (TAO_CASE, CHERRY_CASE) if run.quick else (TAO_CASE, FINE_CASE, CHERRY_CASE):
        results = sweep(case, run)
        free, curves = free_runs(case, run)
        metrics[case.name] = {"filters": results, "free": free}
        show(case, results, free)
        run.save(draw(case, results, curves), f"{case.name}.png")
    run.write(metrics)


if __name__ == "__main__":
    command("tao_filtering", "Filter with Tao's integrator projected and doubled, and compare.", experiment)
