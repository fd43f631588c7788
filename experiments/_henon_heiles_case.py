"""Henon-Heiles as section 5.4.1 records it: truth, recordings, models, and how learnt potentials predict."""

from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.integrate import solve_ivp

import integrators as ig
from symplearn._hamiltonians import PolynomialPotential
from symplearn._model import FullState, Gaussian, Propagator, StateSpaceModel
from symplearn._noise import AdditiveGaussian, ScaledIdentity
from symplearn._objectives import TimeSeries
from symplearn._parameters import Positive
from symplearn._prior import HalfNormal, Laplace, Prior

START = np.array([0.2, -0.25, 0.3, -0.25])
ENERGY = 0.122708
READ_EVERY, READ_UNTIL, NOISE = 5.0, 100.0, 0.05
HORIZON, SHOWN_EVERY, FINE = 200.0, 0.1, 0.01
# The kinds of section 5.4.2; 5.4.1 states none.
PRIOR = Prior({"dynamics": Laplace(0.1), "process_noise": HalfNormal(1.0), "measurement_noise": HalfNormal(1.0)})
# The share of the amplitude, the largest norm of the true state, at which a prediction has lost the truth.
LOST = 0.2
# Propagators and their steps per data interval. In 5 s from the start, with the true potential, leapfrog is off by
# 3.5e-3, and Blanes and Moan's in steps five times longer by 2.2e-4. Suzuki's composition in those is off by 1.3e-2.
PROPAGATORS: dict[str, tuple[Any, int]] = {
    "symplectic": (ig.Leapfrog(), 20),
    "rk2": (ig.RK2.midpoint(), 20),
    "order4_step_5_times_larger": (ig.BlanesMoan4(), 4),
}


@cache
def _orbit() -> Any:
    """The true orbit up to the horizon, a function of time, by SciPy."""

    def motion(t, x):
        q1, q2, p1, p2 = x
        return [p1, p2, -q1 - 2 * q1 * q2, -q2 - q1**2 + q2**2]

    return solve_ivp(motion, (0, HORIZON), START, method="DOP853", rtol=1e-12, atol=1e-13, dense_output=True).sol


def truth(times: np.ndarray) -> np.ndarray:
    """The true states (time, 4) at times up to the horizon."""
    return _orbit()(times).T


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


def predictions(coefficients: Any, times: np.ndarray) -> np.ndarray:
    """States (draw, time, 4) by leapfrog in steps of 0.01, with each set of coefficients (draw, 9)."""
    return np.asarray(_predictions(jnp.asarray(coefficients), jnp.asarray(times)))


@eqx.filter_jit
def _predictions(coefficients: Float[Array, "draw term"], times: Float[Array, " time"]) -> Float[Array, "draw time 4"]:
    substeps = round(SHOWN_EVERY / FINE)

    def one(c):
        return ig.integrate(PolynomialPotential(2, 3, c), ig.Leapfrog(), START, times, substeps).xs

    return jax.vmap(one)(coefficients)


def stepped_as_learnt(propagator: str, coefficients: Any) -> ig.Trajectory:
    """The trajectory of a learnt potential in the steps, and by the integrator, that it was learnt with."""
    integrator, substeps = PROPAGATORS[propagator]
    steps = np.linspace(0.0, HORIZON, round(HORIZON / READ_EVERY) * substeps + 1)
    return ig.integrate(PolynomialPotential(2, 3, jnp.asarray(coefficients)), integrator, START, steps)


@eqx.filter_jit
def _energies(coefficients: Float[Array, "draw term"]) -> Float[Array, " draw"]:
    q, p = jnp.split(jnp.asarray(START), 2)
    return jax.vmap(lambda c: PolynomialPotential(2, 3, c).energy(q, p))(coefficients)


def energies_at_start(coefficients: Any) -> np.ndarray:
    """The learnt Hamiltonians at the start (draw,), of coefficients (draw, 9)."""
    return np.asarray(_energies(jnp.asarray(coefficients)))


def amplitude() -> float:
    """The largest norm of the true state up to the horizon."""
    return float(np.linalg.norm(truth(shown_times()), axis=1).max())


def tracking_time(predicted: np.ndarray, true: np.ndarray, times: np.ndarray, amplitude: float) -> float:
    """How long the error stays below a fifth of the amplitude; the horizon where it always does."""
    with np.errstate(over="ignore", invalid="ignore"):  # a prediction that escapes has lost the truth
        error = np.linalg.norm(predicted - true, axis=1)
    lost = np.flatnonzero(~(error <= LOST * amplitude))
    return float(times[lost[0]]) if lost.size else float(times[-1])
