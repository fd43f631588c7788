"""Problems on which noise levels are found without a hand: recordings by SciPy, models, priors, reference noises."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import integrators as ig
from symplearn._hamiltonians import Polynomial, PolynomialPotential
from symplearn._model import Coordinates, FullState, Gaussian, LinearDynamics, Propagator, StateSpaceModel
from symplearn._noise import AdditiveGaussian, LogVariance, ScaledIdentity, StandardDeviation
from symplearn._objectives import TimeSeries
from symplearn._parameters import Learnt, Positive
from symplearn._prior import HalfNormal, Laplace, Normal, Prior

from . import _cherry_case as cherry
from . import _henon_heiles_case as henon_heiles

_NOISES = {"process_noise": HalfNormal(1.0), "measurement_noise": HalfNormal(1.0)}
_KNOWN = 1e-8


class Problem(NamedTuple):
    """`model(process, measurement)` starts at two variances; `recording(seed, k)` is data set k; `process` and
    `measurement` are the true variances, or where there is no process noise a millionth of the readings' square.

    `best` is what learns of the dynamics at the truth, for a start from there; None where the model has no truth.
    """

    model: Callable[[float, float], StateSpaceModel]
    recording: Callable[[int, int], TimeSeries]
    prior: Prior
    process: float
    measurement: float
    best: np.ndarray | None = None


def _noisy(times: np.ndarray, true: np.ndarray, sd: float, seed: int, k: int) -> TimeSeries:
    return TimeSeries(times, true + sd * np.random.default_rng([seed, k]).normal(size=true.shape))


def _scalars(process: float, measurement: float, state: int, read: int) -> tuple[AdditiveGaussian, AdditiveGaussian]:
    return (
        AdditiveGaussian(ScaledIdentity(Positive(process), state)),
        AdditiveGaussian(ScaledIdentity(Positive(measurement), read)),
    )


def _linear(start: tuple[float, float]) -> Callable[[float, float], StateSpaceModel]:
    """The linear model of section 3.3: all of A learns, from 0; x_0 is known."""

    def model(process: float, measurement: float) -> StateSpaceModel:
        dynamics = LinearDynamics(Learnt(jnp.zeros((2, 2))))
        known = Gaussian(jnp.asarray(start), jnp.zeros((2, 2)))
        return StateSpaceModel(dynamics, FullState(), *_scalars(process, measurement, 2, 2), known)

    return model


_RATES = np.array([[0.0, 1.0], [-9.81, 0.0]])


def linear_pendulum(seed: int, k: int) -> TimeSeries:
    """Section 3.3.1: 41 readings in 4 s of the linear pendulum from (0.1, -0.5), noise 0.1."""
    times = np.linspace(0.0, 4.0, 41)
    return _noisy(times, np.array([expm(_RATES * t) @ [0.1, -0.5] for t in times]), 0.1, seed, k)


def nonlinear_pendulum(seed: int, k: int) -> TimeSeries:
    """Section 3.3.2: 27 readings in 4 s of the pendulum from (2.5, 0), noise 0.1, which no linear model fits."""
    times = np.linspace(0.0, 4.0, 27)
    return _noisy(times, _solved(lambda t, x: [x[1], -9.81 * np.sin(x[0])], [2.5, 0.0], times), 0.1, seed, k)


def double_well(seed: int, k: int) -> TimeSeries:
    """The position alone, 81 readings in 12 s, noise 0.03, of the double well q'' = q - q^3 from (1.5, 0)."""
    times = np.linspace(0.0, 12.0, 81)
    true = _solved(lambda t, x: [x[1], x[0] - x[0] ** 3], [1.5, 0.0], times)
    return _noisy(times, true[:, :1], 0.03, seed, k)


def _double_well(process: float, measurement: float) -> StateSpaceModel:
    noise = AdditiveGaussian(ScaledIdentity(LogVariance(Learnt(np.log(measurement))), 1))
    return StateSpaceModel(
        dynamics=Propagator(PolynomialPotential(1, 4), ig.Leapfrog(), 10),
        observation=Coordinates((0,)),
        process_noise=AdditiveGaussian(ScaledIdentity(LogVariance(Learnt(np.log(process))), 2)),
        measurement_noise=noise,
        initial=Gaussian(Learnt(jnp.zeros(2)), _KNOWN * jnp.eye(2)),
    )


_SHAKEN = {"rate": 2.0, "process": 1e-3, "measurement": 4e-4}


def shaken_oscillator(seed: int, k: int) -> TimeSeries:
    """An oscillator pushed at random between its 101 readings: both noises are there, to be told apart."""
    rng, rate = np.random.default_rng([seed, k]), _SHAKEN["rate"]
    step, x, rows = expm(0.2 * np.array([[0.0, 1.0], [-(rate**2), 0.0]])), np.array([1.0, 0.0]), []
    for _ in range(101):
        rows.append(x + np.sqrt(_SHAKEN["measurement"]) * rng.normal(size=2))
        x = step @ x + np.sqrt(_SHAKEN["process"]) * rng.normal(size=2)
    return TimeSeries(0.2 * np.arange(101), np.array(rows))


def _shaken(process: float, measurement: float) -> StateSpaceModel:
    def noise(variance: float) -> AdditiveGaussian:
        return AdditiveGaussian(ScaledIdentity(StandardDeviation(Positive(np.sqrt(variance))), 2))

    oscillator = Propagator(Polynomial(1, 2), ig.yoshida4(ig.Tao(5.0)), 1)
    known = Gaussian(jnp.asarray([1.0, 0.0]), _KNOWN * jnp.eye(2))
    return StateSpaceModel(oscillator, FullState(), noise(process), noise(measurement), known)


def _solved(motion: Callable[[float, Any], Any], start: list[float], times: np.ndarray) -> np.ndarray:
    return solve_ivp(motion, (0, times[-1]), start, method="DOP853", rtol=1e-11, atol=1e-12, t_eval=times).y.T


def _henon_heiles(process: float, measurement: float) -> StateSpaceModel:
    return _with_noises(henon_heiles.model("symplectic"), process, measurement)


def _cherry(process: float, measurement: float) -> StateSpaceModel:
    # One step of order 4 per data interval, as good as eight of Tao's method, and less work.
    return _with_noises(cherry.model(ig.suzuki4(ig.Tao(5.0)), 1), process, measurement)


def _with_noises(model: StateSpaceModel, process: float, measurement: float) -> StateSpaceModel:
    noises = _scalars(process, measurement, 4, 4)
    return StateSpaceModel(model.dynamics, model.observation, *noises, model.initial)


ZOO = {
    "linear_pendulum": Problem(
        _linear((0.1, -0.5)), linear_pendulum, Prior({"dynamics": Laplace(10.0)} | _NOISES), 1e-7, 0.01
    ),
    "nonlinear_pendulum": Problem(
        _linear((2.5, 0.0)), nonlinear_pendulum, Prior({"dynamics": Laplace(10.0)} | _NOISES), 0.1, 0.01
    ),
    "double_well": Problem(
        _double_well,
        double_well,
        Prior(
            {
                "dynamics": Laplace(1.0),
                "initial": Normal(0.0, 2.0),
                # Of the logarithms of variances, within e^-24 and 1 by two standard deviations.
                "process_noise": Normal(-12.0, 6.0),
                "measurement_noise": Normal(-12.0, 6.0),
            }
        ),
        1e-6,
        9e-4,
        np.array([0.0, -0.5, 0.0, 0.25]),
    ),
    "shaken_oscillator": Problem(_shaken, shaken_oscillator, Prior({"dynamics": Laplace(1.0)} | _NOISES), 1e-3, 4e-4),
    "henon_heiles": Problem(
        _henon_heiles,
        henon_heiles.recording,
        henon_heiles.PRIOR,
        1e-7,
        henon_heiles.NOISE**2,
        np.array([0.0, 0.0, 0.5, 0.0, 0.5, 0.0, 1.0, 0.0, -1 / 3]),
    ),
    "cherry": Problem(_cherry, cherry.single, cherry.PRIOR, 1e-8, cherry.NOISE**2),
}
