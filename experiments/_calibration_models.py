"""Small models for simulation-based calibration, with priors and recordings as in `_calibration_simulators`."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import integrators as ig
from symplearn._importance import AdaptiveImportance
from symplearn._model import Coordinates, FullState, Gaussian, LinearDynamics, Propagator, StateSpaceModel
from symplearn._noise import AdditiveGaussian, ScaledIdentity
from symplearn._objectives import TimeSeries
from symplearn._parameters import Learnt, Positive
from symplearn._prior import AbstractDensity, HalfNormal, Normal, Prior
from symplearn._random_walk import RandomWalk

from . import _calibration_simulators as sim
from ._calibration_simulators import ERROR, PROCESS, Rows, Values


class Oscillator(ig.AbstractSeparableHamiltonian):
    """p^2 / 2 + stiffness q^2 / 2 + cubic q^4 / 4."""

    stiffness: jax.Array
    cubic: jax.Array | float = 0.0

    def kinetic(self, p):
        return 0.5 * p @ p

    def potential(self, q):
        return jnp.sum(0.5 * self.stiffness * q**2 + 0.25 * self.cubic * q**4)


class Pendulum(ig.AbstractSeparableHamiltonian):
    """p^2 / 2 - gravity cos q."""

    gravity: jax.Array

    def kinetic(self, p):
        return 0.5 * p @ p

    def potential(self, q):
        return -self.gravity * jnp.sum(jnp.cos(q))


class Study(NamedTuple):
    """One model to calibrate: how it is built of values by name, its prior, and how truths and recordings are drawn.

    What learns starts at `begin`. `told` is what a wrong model is told of the truth.
    """

    build: Callable[[Values], StateSpaceModel]
    prior: Prior
    begin: Values
    draw: Callable[[np.random.Generator], dict[str, Any]]
    record: Callable[[Values, np.random.Generator], Rows]
    samplers: tuple[Any, ...] = (AdaptiveImportance(), RandomWalk())
    told: Callable[[Values], Values] = lambda truth: {}

    def model(self, values: Values, truth: Values) -> StateSpaceModel:
        """The model at these values, and of what it is told."""
        return self.build({**values, **self.told(truth)})

    def recording(self, truth: Values, rng: np.random.Generator) -> TimeSeries:
        """A recording drawn from the truth."""
        times, readings = self.record(truth, rng)
        return TimeSeries(jnp.asarray(times), jnp.asarray(readings))


def _number(values: Values, name: str) -> jax.Array:
    return jnp.asarray(np.asarray(values[name], dtype=float))


def _noise(values: Values, name: str, dim: int) -> AdditiveGaussian:
    return AdditiveGaussian(ScaledIdentity(Positive(_number(values, name)), dim))


def _known(mean: Any) -> Gaussian:
    return Gaussian(jnp.asarray(mean), jnp.zeros((len(mean), len(mean))))


def _densities(factor: float, sizes: tuple[float, float]) -> dict[str, AbstractDensity]:
    process, error = (HalfNormal(size**2) for size in sizes)
    return {"dynamics": Normal(factor, sim.FACTOR_SD**2), "process_noise": process, "measurement_noise": error}


def _decay(values: Values) -> StateSpaceModel:
    """Kalman's filter, which is exact."""
    noises = _noise(values, PROCESS, 1), _noise(values, ERROR, 1)
    dynamics = LinearDynamics(_number(values, sim.MATRIX).reshape(1, 1))
    return StateSpaceModel(dynamics, FullState(), *noises, _known(np.ones(1)))


def _decay_with_known_error(values: Values) -> StateSpaceModel:
    right, known = _decay(values), AdditiveGaussian(ScaledIdentity(_number(values, ERROR), 1))
    return StateSpaceModel(right.dynamics, right.observation, right.process_noise, known, right.initial)


def _stepped(hamiltonian: Any, process: Any, values: Values, initial: Gaussian) -> StateSpaceModel:
    propagator = Propagator(hamiltonian, ig.Leapfrog(), sim.STEPS)
    return StateSpaceModel(propagator, Coordinates((0,)), process, _noise(values, ERROR, 1), initial)


def _oscillator(values: Values) -> StateSpaceModel:
    """Leapfrog is linear here, and the unscented filter exact."""
    initial = Gaussian(jnp.asarray(sim.OSCILLATOR_START), sim.OSCILLATOR_START_SD**2 * jnp.eye(2))
    return _stepped(Oscillator(_number(values, sim.STIFFNESS)), _noise(values, PROCESS, 2), values, initial)


def _duffing(values: Values) -> StateSpaceModel:
    """No process noise, and a start that learns: the unscented filter has nothing to approximate."""
    system = Oscillator(_number(values, sim.STIFFNESS), _number(values, sim.CUBIC))
    start = Gaussian(Learnt(_number(values, sim.START)), jnp.zeros((2, 2)))
    return _stepped(system, AdditiveGaussian(ScaledIdentity(0.0, 2)), values, start)


def _pendulum(values: Values) -> StateSpaceModel:
    """The unscented filter approximates: the process noise, which is small, goes through a sine."""
    system = Pendulum(_number(values, sim.GRAVITY))
    return _stepped(system, _noise(values, PROCESS, 2), values, _known(sim.PENDULUM_START))


DECAY = Study(
    _decay,
    Prior(_densities(sim.DECAY, sim.DECAY_NOISES)),
    {sim.MATRIX: sim.DECAY, PROCESS: 0.05, ERROR: 0.05},
    sim.decay_truth,
    sim.decay_recording,
)
STUDIES: dict[str, Study] = {
    "decay": DECAY,
    "oscillator": Study(
        _oscillator,
        Prior(_densities(sim.FACTOR, sim.OSCILLATOR_NOISES)),
        {sim.STIFFNESS: sim.FACTOR, PROCESS: 0.005, ERROR: 0.05},
        sim.oscillator_truth,
        sim.oscillator_recording,
    ),
    # Not beside the first, with which it shares programs: two at a time are run.
    "decay_by_random_walk": DECAY._replace(samplers=(RandomWalk(steps=2000),)),
    "duffing": Study(
        _duffing,
        Prior(
            {
                "dynamics": Normal(sim.FACTOR, sim.FACTOR_SD**2),
                "measurement_noise": HalfNormal(sim.DUFFING_NOISE**2),
                "initial": Normal(jnp.asarray(sim.DUFFING_START), sim.DUFFING_START_SD**2),
            }
        ),
        {sim.STIFFNESS: sim.FACTOR, sim.CUBIC: sim.FACTOR, ERROR: 0.005, sim.START: sim.DUFFING_START},
        sim.duffing_truth,
        sim.duffing_recording,
    ),
    "pendulum": Study(
        _pendulum,
        Prior(_densities(sim.FACTOR, sim.PENDULUM_NOISES)),
        {sim.GRAVITY: sim.FACTOR, PROCESS: 2e-4, ERROR: 5e-3},
        sim.pendulum_truth,
        sim.pendulum_recording,
    ),
}
# Posteriors that are wrong, and must be told as wrong: of a model that is told half of the error's variance.
WRONG: dict[str, Study] = {
    "decay_with_half_the_noise": DECAY._replace(
        build=_decay_with_known_error,
        prior=Prior({name: one for name, one in DECAY.prior.densities.items() if name != "measurement_noise"}),
        told=lambda truth: {ERROR: 0.5 * truth[ERROR]},
    )
}
