"""Two mechanical systems with readings, each twice: as a model of ours, and as plain functions for other packages."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import integrators as ig
from symplearn._model import FullState, Gaussian, Propagator, StateSpaceModel, intervals_between
from symplearn._noise import AdditiveGaussian, Dense


class Case(NamedTuple):
    """A model, its parts as functions of arrays, and a recording."""

    model: StateSpaceModel
    force: Any
    read: Any
    substeps: int
    times: np.ndarray
    readings: np.ndarray

    @property
    def spans(self):
        return intervals_between(jnp.asarray(self.times))

    @property
    def lengths(self):
        """The data interval that ends at each reading (time, 1); none ends at the first."""
        return np.diff(self.times, prepend=self.times[0])[:, None]

    @property
    def numbers(self):
        """Q, R, and the mean and the covariance of the start."""
        start, noises = self.model.initial, (self.model.process_noise, self.model.measurement_noise)
        return (
            *(np.asarray(noise.covariance()) for noise in noises),
            np.asarray(start.mean),
            np.asarray(start.covariance),
        )

    def step(self, x, length):
        """Leapfrog over one data interval in NumPy."""
        for _ in range(self.substeps):
            x = leapfrog(self.force, x, length / self.substeps)
        return x

    def traced_step(self, x, length):
        """The same in JAX, for dynamax."""
        return jax.lax.fori_loop(0, self.substeps, lambda _, x: leapfrog(self.force, x, length / self.substeps), x)


def leapfrog(force, x, h):
    """Kick, drift, kick on x = [q, p], for arrays of NumPy and of JAX."""
    d = len(x) // 2
    kick, drift = np.eye(2 * d)[:, d:], np.eye(2 * d)[:, :d]
    x = x + 0.5 * h * (kick @ force(x[:d]))
    x = x + h * (drift @ x[d:])
    return x + 0.5 * h * (kick @ force(x[:d]))


def henon_heiles() -> Case:
    """Twenty readings of the whole state, five time units apart."""

    def force(q):
        return -q - (2 * q[0] * q[1]) * np.array([1.0, 0.0]) - (q[0] ** 2 - q[1] ** 2) * np.array([0.0, 1.0])

    start, times = np.array([0.2, -0.25, 0.3, -0.25]), 5.0 * np.arange(20)
    noises = 1e-6 * np.eye(4), 2.5e-3 * np.eye(4)
    readings = recorded(force, lambda x: x, start, times, 0.05)
    system = Propagator(ig.problems.HenonHeiles(), ig.Leapfrog(), substeps=20)
    model = stated(system, FullState(), noises, Gaussian(jnp.asarray(start), 1.01e-6 * jnp.eye(4)))
    return Case(model, force, lambda x: x, 20, times, readings)


class TipPlace(eqx.Module):
    """Where the tip of a pendulum of unit length is, to the right and upwards; its momentum is never read."""

    def __call__(self, x, context):
        return jnp.stack([jnp.sin(x[0]), -jnp.cos(x[0])])


def pendulum() -> Case:
    """A swinging pendulum at uneven times, seen by the place of its tip."""

    def force(q):
        return -2.0 * np.sin(q) if isinstance(q, np.ndarray) else -2.0 * jnp.sin(q)

    def read(x):
        xp = np if isinstance(x, np.ndarray) else jnp
        return xp.stack([xp.sin(x[0]), -xp.cos(x[0])])

    start, times = np.array([1.4, 0.1]), np.cumsum(np.random.default_rng(3).uniform(0.2, 0.8, size=30))
    noises = np.array([[1e-4, 2e-5], [2e-5, 4e-4]]), np.array([[0.02, 0.005], [0.005, 0.01]])
    readings = recorded(force, read, start, times, 0.1)
    system = Propagator(ig.problems.Pendulum(gravity=2.0), ig.Leapfrog(), substeps=5)
    model = stated(system, TipPlace(), noises, Gaussian(jnp.array([1.2, 0.0]), jnp.diag(jnp.array([0.1, 0.2]))))
    return Case(model, force, read, 5, times, readings)


def stated(dynamics, observation, noises, initial):
    process, measurement = (AdditiveGaussian(Dense(noise)) for noise in noises)
    return StateSpaceModel(dynamics, observation, process, measurement, initial)


def recorded(force, read, start, times, noise, seed=0):
    """Readings of SciPy's trajectory, not of the integrator under test."""
    d = len(start) // 2

    def slope(_, x):
        return np.concatenate([x[d:], force(x[:d])])

    # SciPy's own error bounds, far below any noise of these readings.
    xs = solve_ivp(slope, times[[0, -1]], start, t_eval=times, method="DOP853", rtol=1e-10, atol=1e-10).y.T
    exact = np.array([read(x) for x in xs])
    return exact + noise * np.random.default_rng(seed).normal(size=exact.shape)
