"""Section 5.4.1: Henon-Heiles learnt with a symplectic propagator and with Runge-Kutta's of the same order.

    python -m experiments.henon_heiles [--quick] [--out DIR] [--seed N]

Twenty readings of the full state in 100 s, noise 0.05, start known (specification 5.15, E41); nine coefficients and two
variances learn in steps of 0.25, by `learn`, from zero coefficients, and `sample` draws the posterior. Every learnt
potential predicts 200 s by leapfrog in steps of 0.01. The truth is DOP853's, not an integrator of ours. Each noise
realisation leaves a file, and a run that was stopped goes on where it was.
"""

import json
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from scipy.integrate import solve_ivp

import integrators as ig
from symplearn._fit import Estimate
from symplearn._hamiltonians import PolynomialPotential
from symplearn._importance import AdaptiveImportance
from symplearn._learn import learn
from symplearn._model import FullState, Gaussian, Propagator, StateSpaceModel
from symplearn._noise import AdditiveGaussian, ScaledIdentity
from symplearn._objectives import TimeSeries
from symplearn._parameters import Positive
from symplearn._posterior import Posterior
from symplearn._prior import HalfNormal, Laplace, Prior
from symplearn._sample import sample

from ._command import Run, command, print_table
from ._henon_heiles_figures import View, hamiltonians, phases, spreads, trajectories, variances

START = np.array([0.2, -0.25, 0.3, -0.25])
READ_EVERY, READ_UNTIL, NOISE = 5.0, 100.0, 0.05
HORIZON, SHOWN_EVERY, FINE = 200.0, 0.1, 0.01
# The kinds of section 5.4.2; 5.4.1 states none.
PRIOR = Prior({"dynamics": Laplace(0.1), "process_noise": HalfNormal(1.0), "measurement_noise": HalfNormal(1.0)})
# The share of the amplitude, the largest norm of the true state, at which a prediction has lost the truth.
LOST = 0.2
DRAWS = 200
QUICK, FULL = 5, 20
SAMPLERS = {True: AdaptiveImportance(draws=1600, target=500, batch=500), False: AdaptiveImportance()}
IN_QUICK = ("symplectic", "rk2")  # each propagator more compiles for half a minute
ENERGY = 0.122708
PUBLISHED = {
    "H_symplectic": 0.1219,
    "H_rk2": 0.1211,
    "tracking_time_symplectic": 150.0,
    "tracking_time_rk2": 20.0,
    "process_noise_ratio_rk2_over_symplectic": 10.0,
}
# Propagators and their steps per data interval. The last costs what leapfrog does: five stages in a step five times as
# long.
PROPAGATORS: dict[str, tuple[Any, int]] = {
    "symplectic": (ig.Leapfrog(), 20),
    "rk2": (ig.RK2.midpoint(), 20),
    "heun": (ig.RK2.heun(), 20),
    "order4_step_5_times_larger": (ig.suzuki4(ig.Leapfrog()), 4),
}


def truth(times: np.ndarray) -> np.ndarray:
    """The true states (time, 4), by SciPy."""

    def motion(t, x):
        q1, q2, p1, p2 = x
        return [p1, p2, -q1 - 2 * q1 * q2, -q2 - q1**2 + q2**2]

    found = solve_ivp(motion, (0, times[-1]), START, method="DOP853", rtol=1e-12, atol=1e-13, t_eval=times)
    return found.y.T


def recording(seed: int, k: int) -> TimeSeries:
    """Noise realisation k: a row at time 0 without readings, as the start is known, and twenty with."""
    times = np.arange(0.0, READ_UNTIL + READ_EVERY / 2, READ_EVERY)
    readings = truth(times) + NOISE * np.random.default_rng([seed, k]).normal(size=(len(times), 4))
    readings[0] = np.nan
    return TimeSeries(times, readings)


def model(propagator: str) -> StateSpaceModel:
    """The cubic potential (5.21) with all coefficients zero, and both variances to learn."""
    integrator, substeps = PROPAGATORS[propagator]
    return StateSpaceModel(
        dynamics=Propagator(PolynomialPotential(2, 3), integrator, substeps),
        observation=FullState(),
        process_noise=AdditiveGaussian(ScaledIdentity(Positive(1e-3), 4)),
        measurement_noise=AdditiveGaussian(ScaledIdentity(Positive(1e-3), 4)),
        initial=Gaussian(jnp.asarray(START), 1e-8 * jnp.eye(4)),
    )


def shown_times() -> np.ndarray:
    """The times at which predictions are looked at."""
    return np.linspace(0.0, HORIZON, round(HORIZON / SHOWN_EVERY) + 1)


@eqx.filter_jit
def predictions(coefficients: Float[Array, "draw term"], times: Float[Array, " time"]) -> Float[Array, "draw time 4"]:
    """Leapfrog in steps of 0.01 with each set of coefficients."""
    substeps = round(SHOWN_EVERY / FINE)

    def one(c):
        return ig.integrate(PolynomialPotential(2, 3, c), ig.Leapfrog(), START, times, substeps).xs

    return jax.vmap(one)(coefficients)


@eqx.filter_jit
def energies(coefficients: Float[Array, "draw term"], x: Float[Array, "time 4"]) -> Float[Array, "draw time"]:
    """The Hamiltonian with each set of coefficients, at each state."""

    def one(c, x):
        return PolynomialPotential(2, 3, c).energy(*jnp.split(x, 2))

    return jax.vmap(jax.vmap(one, (None, 0)), (0, None))(coefficients, x)


def energies_at_start(coefficients: Any) -> np.ndarray:
    """The learnt Hamiltonians at the start."""
    return np.asarray(energies(jnp.asarray(coefficients), jnp.asarray(START)[None])[:, 0])


def tracking_time(predicted: np.ndarray, true: np.ndarray, times: np.ndarray) -> float:
    """How long the error stays below a fifth of the amplitude; the horizon where it always does."""
    error = np.linalg.norm(predicted - true, axis=1)
    lost = np.flatnonzero(~(error <= LOST * np.linalg.norm(true, axis=1).max()))
    return float(times[lost[0]]) if lost.size else float(times[-1])


def learnt(propagator: str, series: TimeSeries, sampler: AdaptiveImportance, key: PRNGKeyArray) -> dict[str, Any]:
    """Everything that is kept of one realisation under one propagator."""
    estimate = learn(model(propagator), series, prior=PRIOR)
    posterior = sample(estimate, sampler=sampler, key=key)
    times = shown_times()
    true, values = truth(times), estimate.values()
    best = np.asarray(values["dynamics.system.coefficients"])
    found = {
        "coefficients": best.tolist(),
        "process_noise": float(values["process_noise.structure.variance"]),
        "measurement_noise": float(values["measurement_noise.structure.variance"]),
        "log_posterior": estimate.log_posterior,
        "converged": estimate.converged,
        "won_by": " ".join(estimate.attempts[0][:2]),
        "starts_within_half_a_nat": _near(estimate),
        "starts": len(estimate.attempts),
        "H": float(energies_at_start(best[None])[0]),
        "tracking_time": tracking_time(np.asarray(predictions(best[None], times)[0]), true, times),
    }
    return found | _of_posterior(posterior, true, times)


def _near(estimate: Estimate) -> int:
    best = estimate.log_posterior
    return sum(one.log_posterior is not None and best - one.log_posterior < 0.5 for one in estimate.attempts)


def _of_posterior(posterior: Posterior, true: np.ndarray, times: np.ndarray) -> dict[str, Any]:
    drawn = np.asarray(posterior.models(DRAWS).dynamics.system.coefficients)
    paths = np.asarray(predictions(drawn, times))
    finite = np.isfinite(paths).all(axis=(1, 2))
    low, high = np.quantile(np.nan_to_num(paths, nan=np.inf), [0.025, 0.975], axis=0)
    inside = (low <= true) & (true <= high)
    noise = np.asarray(posterior.values["process_noise.structure.variance"]).ravel()
    trained = times <= READ_UNTIL
    return {
        "draws": drawn.tolist(),
        "process_noise_draws": noise[:: max(1, len(noise) // 1000)].tolist(),
        "process_noise_median": float(np.median(noise)),
        "measurement_noise_median": float(posterior.median()["measurement_noise.structure.variance"]),
        "H_quantiles": np.quantile(energies_at_start(drawn), [0.025, 0.5, 0.975]).tolist(),
        "coverage_trained": float(inside[trained].mean()),
        "coverage_predicted": float(inside[~trained].mean()),
        "band_width_trained": float(np.mean((high - low)[trained])),
        "band_width_predicted": float(np.mean((high - low)[~trained])),
        "escaping_draws": int((~finite).sum()),
        "posterior_converged": posterior.converged,
        "pareto_k": posterior.drawn.pareto_k,
    }


def realisation(run: Run, propagator: str, k: int) -> dict[str, Any]:
    """One realisation's results, from its file if there is one."""
    # A quick run draws fewer samples, so its files are its own.
    path = run.out / ("quick" if run.quick else "full") / f"seed{run.seed}_{k:02d}_{propagator}.json"
    if path.exists():
        return json.loads(path.read_text(encoding="utf-8"))
    key = jax.random.fold_in(jax.random.key(run.seed), k)
    found = learnt(propagator, recording(run.seed, k), SAMPLERS[run.quick], key)
    path.parent.mkdir(exist_ok=True)
    unfinished = path.with_suffix(".part")
    unfinished.write_text(json.dumps(found), encoding="utf-8")
    unfinished.replace(path)  # whole or not at all
    return found


def spread(values: Sequence[float]) -> dict[str, float]:
    """Median, quartiles and extremes."""
    lower, middle, upper = np.quantile(values, [0.25, 0.5, 0.75])
    ends = {"smallest": float(np.min(values)), "largest": float(np.max(values))}
    return {"median": float(middle), "lower_quartile": float(lower), "upper_quartile": float(upper), **ends}


def metrics(results: dict[str, list[dict[str, Any]]]) -> dict[str, Any]:
    """The keys of the issue, each a spread over the realisations."""
    found: dict[str, Any] = {"H_true": ENERGY, "published": PUBLISHED, "realisations": len(results["symplectic"])}
    medians = {name: np.array([one["process_noise_median"] for one in runs]) for name, runs in results.items()}
    for name, runs in results.items():
        for key in ("H", "tracking_time", "coverage_trained", "coverage_predicted", "band_width_trained"):
            found[f"{key}_{name}"] = spread([one[key] for one in runs])
        found[f"H_error_{name}"] = spread([abs(one["H"] - ENERGY) for one in runs])
        found[f"H_in_95_percent_interval_{name}"] = int(sum(_holds(one) for one in runs))
        found[f"process_noise_{name}"] = spread(medians[name].tolist())
        found[f"learnt_without_failure_{name}"] = int(sum(one["converged"] for one in runs))
        found[f"posteriors_converged_{name}"] = int(sum(one["posterior_converged"] for one in runs))
        if name != "symplectic":
            found[f"process_noise_ratio_{name}_over_symplectic"] = spread(
                (medians[name] / medians["symplectic"]).tolist()
            )
    return found


def _holds(one: dict[str, Any]) -> bool:
    return one["H_quantiles"][0] <= ENERGY <= one["H_quantiles"][2]


def experiment(run: Run) -> None:
    """Every propagator on every realisation, the metrics, the table and the figures."""
    count, names = (QUICK, IN_QUICK) if run.quick else (FULL, tuple(PROPAGATORS))
    todo = [(name, k) for name in names for k in range(count)]
    results: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
    for name, k in run.each("realisations", todo):
        results[name].append(realisation(run, name, k))
    found = metrics(results)
    run.write(found)
    _draw(run, results)
    _report(found | {"quick": run.quick})


def _draw(run: Run, results: dict[str, list[dict[str, Any]]]) -> None:
    """The dissertation's figures for the first realisation, and the spread over all."""
    times, series = shown_times(), recording(run.seed, 0)
    true, views = truth(times), []
    for name in ("symplectic", "rk2"):
        one = results[name][0]
        best, drawn = np.array([one["coefficients"]]), np.array(one["draws"])
        path, paths = np.asarray(predictions(best, times)[0]), np.asarray(predictions(drawn, times))
        integrator, substeps = PROPAGATORS[name]
        steps = np.linspace(0.0, READ_UNTIL, round(READ_UNTIL / READ_EVERY) * substeps + 1)
        hamiltonian = PolynomialPotential(2, 3, jnp.asarray(best[0]))
        as_learnt = ig.integrate(hamiltonian, integrator, START, steps)
        noise = np.array(one["process_noise_draws"])
        levels = energies_at_start(drawn)
        views.append(
            View(name, path, paths, levels, steps, np.asarray(as_learnt.energies), noise, one["tracking_time"])
        )
    run.save(phases(true, views, series), "phases.png")
    run.save(hamiltonians(times, views, ENERGY, READ_UNTIL), "hamiltonians.png")
    run.save(trajectories(times, true, views, series, READ_UNTIL), "trajectories.png")
    run.save(variances(views), "process_noise.png")
    run.save(spreads(results, ENERGY, PUBLISHED), "spreads.png")


def _report(found: dict[str, Any]) -> None:
    rows: list[Sequence[Any]] = [["quantity", "published (one draw)", "median", "quartiles"]]
    for key in sorted(found):
        if isinstance(found[key], dict) and "median" in found[key]:
            one = found[key]
            quartiles = f"{one['lower_quartile']:.4g} .. {one['upper_quartile']:.4g}"
            rows.append([key, PUBLISHED.get(key, ""), one["median"], quartiles])
    print_table(*rows)
    print(f"true H = {found['H_true']:.4f}; {found['realisations']} noise realisations; tracking ends at {HORIZON:g} s")
    if found["quick"]:
        print("quick: Heun and order 4 in larger steps are in the full run only, and the posteriors are drawn coarser")


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    command("henon_heiles", "Section 5.4.1: leapfrog against Runge-Kutta.", experiment, arguments)


if __name__ == "__main__":
    main()
