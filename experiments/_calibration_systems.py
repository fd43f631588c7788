"""Four systems whose true motion is known from SciPy, and what the draws of their posteriors say it was and will be.

Nothing disturbs the true motions. Three priors of the process noise are tried: the dissertation's, which is
half-normal in the variance and so as good as excludes that there is none; one that is normal in the variance's
logarithm and has room for it; and the knowledge that there is none.
"""

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import integrators as ig
from symplearn._hamiltonians import PolynomialPotential
from symplearn._importance import AdaptiveImportance
from symplearn._infer import infer
from symplearn._learn import learn
from symplearn._model import Coordinates, FullState, Gaussian, LinearDynamics, Propagator, StateSpaceModel
from symplearn._noise import AdditiveGaussian, ScaledIdentity
from symplearn._objectives import TimeSeries
from symplearn._parameters import Learnt, Positive
from symplearn._posterior import Posterior
from symplearn._predict import posterior_forecast
from symplearn._prior import AbstractDensity, Flat, Laplace, Normal, Prior
from symplearn._random_walk import RandomWalk
from symplearn._sample import sample

from . import _cherry_case as cherry
from . import _henon_heiles_case as henon_heiles
from ._calibration_bands import DRAWS, LOGARITHM, NONE, PUBLISHED, Disturbance, Paths, System, told

# Nats that a descent may leave: draws need no better.
_TOLERANCE = 1e-2
_SAMPLERS = (AdaptiveImportance(), RandomWalk(steps=2000))


def _coefficients(posterior: Posterior) -> Array:
    return posterior.models(DRAWS).dynamics.system.coefficients


# Henon-Heiles, specification 5.15.
_SHOWN = 0.5
_HH_TIMES = _SHOWN * np.arange(1, round(henon_heiles.HORIZON / _SHOWN) + 1)
_HH_SAMPLER = AdaptiveImportance()


def _henon_heiles(propagator: str, disturbed: Disturbance) -> System:
    """Predicted by leapfrog in steps of 0.01, and what was learnt by leapfrog also in the steps of the learning."""
    prior = disturbed.prior(henon_heiles.PRIOR.densities["dynamics"])

    def predicted(seed: int, k: int, key: PRNGKeyArray) -> tuple[Posterior, Paths]:
        given = eqx.tree_at(lambda m: m.process_noise, henon_heiles.model(propagator), disturbed.noise(4))
        estimate = learn(given, henon_heiles.recording(seed, k), prior=prior, tolerance=_TOLERANCE)
        posterior = sample(estimate, sampler=_HH_SAMPLER, key=key)
        drawn = _coefficients(posterior)
        fine = _potentials(drawn, ig.Leapfrog(), round(_SHOWN / henon_heiles.FINE))
        found = {"": fine}
        if propagator == "symplectic":
            found["stepped_as_learnt"] = _potentials(drawn, ig.Leapfrog(), 2)
        return posterior, {way: _finite(paths, 10.0) for way, paths in found.items()}

    ways = ("", "stepped_as_learnt") if propagator == "symplectic" else ("",)
    settings = f"{henon_heiles.PROPAGATORS[propagator]}, {told(_HH_SAMPLER, prior)}"
    return System(_HH_TIMES, henon_heiles.READ_UNTIL, lambda: henon_heiles.truth(_HH_TIMES), predicted, ways, settings)


@eqx.filter_jit
def _potentials(drawn: Array, integrator: ig.AbstractIntegrator, substeps: int) -> Array:
    times = jnp.asarray(np.concatenate([[0.0], _HH_TIMES]))

    def one(c):
        return ig.integrate(PolynomialPotential(2, 3, c), integrator, henon_heiles.START, times, substeps).xs[1:]

    return jax.vmap(one)(drawn)


def _finite(paths: Any, escaped: float) -> np.ndarray:
    """Paths of which those that escape stay far away."""
    return np.clip(np.nan_to_num(np.asarray(paths), nan=escaped), -escaped, escaped)


# Cherry's problem, specification 5.16: one recording.
_CHERRY_TIMES = 0.1 * np.arange(round(cherry.TEST_UNTIL / 0.1) + 1)
# One step of order 4 per data interval: an error of 3e-5 in 0.4 s, that of Tao's method in steps of 0.05 is 2e-5.
_CHERRY_PROPAGATOR = (ig.suzuki4(ig.Tao(5.0)), 1)
_CHERRY_SAMPLER = AdaptiveImportance()


def _cherry(disturbed: Disturbance) -> System:
    prior = disturbed.prior(cherry.PRIOR.densities["dynamics"])

    def predicted(seed: int, k: int, key: PRNGKeyArray) -> tuple[Posterior, Paths]:
        given = eqx.tree_at(lambda m: m.process_noise, cherry.model(*_CHERRY_PROPAGATOR), disturbed.noise(4))
        estimate = learn(given, cherry.single(seed, k), prior=prior, tolerance=_TOLERANCE)
        posterior = sample(estimate, sampler=_CHERRY_SAMPLER, key=key)
        return posterior, {"": cherry.predictions(_coefficients(posterior), cherry.MONOMIALS, _CHERRY_TIMES)[:, 1:]}

    return System(
        _CHERRY_TIMES[1:],
        cherry.READ_UNTIL,
        lambda: cherry.truth(_CHERRY_TIMES)[1:],
        predicted,
        ("",),
        f"{_CHERRY_PROPAGATOR}, {told(_CHERRY_SAMPLER, prior)}",
    )


# The linear pendulum, specification 5.3: (1.7) with theta = (1, -9.81), and a matrix per data interval that learns.
PENDULUM_SYSTEM, PENDULUM_START = np.array([[0.0, 1.0], [-9.81, 0.0]]), np.array([0.1, -0.5])
PENDULUM_READINGS, PENDULUM_NOISE, _PENDULUM_EVERY = 40, 0.1, 0.1
_PENDULUM_TIMES = _PENDULUM_EVERY * np.arange(1, 2 * PENDULUM_READINGS + 1)


def pendulum_truth(times: np.ndarray) -> np.ndarray:
    """The true states (time, 2), by SciPy's matrix exponential."""
    return np.array([expm(PENDULUM_SYSTEM * t) @ PENDULUM_START for t in times])


def pendulum_recording(seed: int, k: int) -> TimeSeries:
    """Noise realisation k: the reading of the known start, and forty more."""
    times = _PENDULUM_EVERY * np.arange(PENDULUM_READINGS + 1)
    noise = np.random.default_rng([seed, k, 2]).normal(size=(len(times), 2))
    return TimeSeries(times, pendulum_truth(times) + PENDULUM_NOISE * noise)


def _pendulum(density: AbstractDensity, disturbed: Disturbance) -> System:
    prior = disturbed.prior(density)
    model = StateSpaceModel(
        LinearDynamics(jnp.zeros((2, 2))),
        FullState(),
        disturbed.noise(2),
        AdditiveGaussian(ScaledIdentity(Positive(1e-3), 2)),
        Gaussian(jnp.asarray(PENDULUM_START), jnp.zeros((2, 2))),
    )

    def predicted(seed: int, k: int, key: PRNGKeyArray) -> tuple[Posterior, Paths]:
        posterior = infer(model, pendulum_recording(seed, k), prior=prior, key=key, samplers=_SAMPLERS)
        A = np.asarray(posterior.models(DRAWS).dynamics.A)
        x, found = np.broadcast_to(PENDULUM_START, (DRAWS, 2)), []
        for _ in _PENDULUM_TIMES:
            x = np.einsum("nij,nj->ni", A, x)
            found.append(x)
        return posterior, {"": np.stack(found, axis=1)}

    until, settings = PENDULUM_READINGS * _PENDULUM_EVERY, told(prior, _SAMPLERS)
    return System(
        _PENDULUM_TIMES,
        until,
        lambda: pendulum_truth(_PENDULUM_TIMES),
        predicted,
        ("",),
        settings,
    )


# A double well, not the dissertation's: the position alone is read, the start is unknown, and all is the library's.
WELL_START, WELL_READINGS, WELL_EVERY, WELL_NOISE = (0.1, 0.9), 30, 0.5, 0.05
_WELL_TIMES = 0.25 * np.arange(1, 121)


@cache
def _well_orbit() -> Any:
    """H = p^2 / 2 - q^2 / 2 + q^4 / 4 from above the barrier."""
    return solve_ivp(
        lambda t, x: [x[1], x[0] - x[0] ** 3], (0, 30), WELL_START, "DOP853", rtol=1e-12, atol=1e-13, dense_output=True
    ).sol


def well_truth(times: np.ndarray) -> np.ndarray:
    """The true position (time, 1), by SciPy."""
    return _well_orbit()(times)[:1].T


def well_recording(seed: int, k: int) -> TimeSeries:
    """Noise realisation k: thirty positions, with an error of 0.05."""
    times = WELL_EVERY * np.arange(WELL_READINGS)
    noise = np.random.default_rng([seed, k, 3]).normal(size=(WELL_READINGS, 1))
    return TimeSeries(times, well_truth(times) + WELL_NOISE * noise)


def _double_well(disturbed: Disturbance, start_learns: bool = False) -> System:
    """By `infer` and `posterior_forecast` alone, with process noise and without.

    The start is standard normal: in the filter, whose sigma points are then far apart at first, or as two numbers that
    learn.
    """
    prior = disturbed.prior(Normal(0.0, 1.0))
    if start_learns:
        prior = Prior({**prior.densities, "initial": Normal(0.0, 1.0)})
        start = Gaussian(Learnt(jnp.zeros(2)), jnp.zeros((2, 2)))
    else:
        start = Gaussian(jnp.zeros(2), jnp.eye(2))
    model = StateSpaceModel(
        Propagator(PolynomialPotential(1, 4), ig.Leapfrog(), 10),
        Coordinates((0,)),
        disturbed.noise(2),
        AdditiveGaussian(ScaledIdentity(Positive(1e-3), 1)),
        start,
    )
    until = WELL_EVERY * (WELL_READINGS - 1)

    def predicted(seed: int, k: int, key: PRNGKeyArray) -> tuple[Posterior, Paths]:
        key, *keys = jax.random.split(key, 3)
        posterior = infer(model, well_recording(seed, k), prior=prior, key=key, samplers=_SAMPLERS)
        return posterior, {way: _forecast(posterior, until, way != "", keys) for way in ("", "process_noise")}

    return System(
        _WELL_TIMES,
        until,
        lambda: well_truth(_WELL_TIMES),
        predicted,
        ("", "process_noise"),
        told(prior, _SAMPLERS),
    )


def _forecast(posterior: Posterior, until: float, noisy: bool, keys: Sequence[PRNGKeyArray]) -> np.ndarray:
    """Readings without their error, first in sample and then beyond."""
    trained, later = (_WELL_TIMES[part] for part in (_WELL_TIMES <= until, _WELL_TIMES > until))
    parts = (
        posterior_forecast(
            posterior, times=times, draws=DRAWS, process_noise=noisy, in_sample=times is trained, key=key
        )
        for times, key in zip((trained, later), keys, strict=True)
    )
    return _finite(np.concatenate([np.asarray(one.readings) for one in parts], axis=1), 10.0)


# Made when they are asked for, in double precision.
SYSTEMS: dict[str, Callable[[], System]] = {
    "henon_heiles": lambda: _henon_heiles("symplectic", PUBLISHED),
    "henon_heiles_order4": lambda: _henon_heiles("order4_step_5_times_larger", PUBLISHED),
    "henon_heiles_order4_log": lambda: _henon_heiles("order4_step_5_times_larger", LOGARITHM),
    "cherry": lambda: _cherry(PUBLISHED),
    "cherry_log": lambda: _cherry(LOGARITHM),
    "cherry_none": lambda: _cherry(NONE),
    "pendulum_flat": lambda: _pendulum(Flat(), PUBLISHED),
    "pendulum_laplace_0.1": lambda: _pendulum(Laplace(0.1), PUBLISHED),
    "pendulum_flat_log": lambda: _pendulum(Flat(), LOGARITHM),
    "pendulum_flat_none": lambda: _pendulum(Flat(), NONE),
    "double_well": lambda: _double_well(PUBLISHED),
    "double_well_log": lambda: _double_well(LOGARITHM),
    "double_well_log_learnt_start": lambda: _double_well(LOGARITHM, start_learns=True),
    "double_well_none_learnt_start": lambda: _double_well(NONE, start_learns=True),
}


@cache
def system_called(name: str) -> System:
    """The system of a name."""
    return SYSTEMS[name]()
