"""A likelihood's slope along the readings is that of its differences, though the times stay plain numbers."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import integrators as ig
import symplearn as sl


class Read(NamedTuple):
    times: np.ndarray
    readings: jax.Array


@pytest.fixture(scope="module")
def recorded():
    times = 0.3 * np.arange(12)
    readings = np.stack([np.cos(times), -np.sin(times)], axis=1)
    return times, readings + 0.1 * np.random.default_rng(0).normal(size=readings.shape)


def model():
    dynamics = sl.Propagator(sl.PolynomialPotential(1, 2, np.array([0.0, 0.5])), ig.Leapfrog(), 3)
    noises = sl.AdditiveGaussian(sl.ScaledIdentity(1e-4, 2)), sl.AdditiveGaussian(sl.ScaledIdentity(1e-2, 2))
    return sl.StateSpaceModel(dynamics, sl.FullState(), *noises, sl.Gaussian(jnp.array([1.0, 0.0]), 0.1 * jnp.eye(2)))


def test_only_the_readings(recorded):
    """Traced readings give the slope of central differences; what is not traced is still checked."""
    times, readings = recorded

    def score(readings):
        return sl.MarginalLikelihood()(model(), Read(times, readings))

    slope = np.asarray(jax.jit(jax.grad(score))(jnp.asarray(readings)))
    step = 1e-5 * np.eye(readings.size).reshape(-1, *readings.shape)
    many = jax.jit(jax.vmap(score))
    # The score is quadratic in a linear model's readings, so central differences are exact but for round-off. Seen:
    # score 21, slopes up to 18, difference 6e-10 (1e-15 of the score over a step of 1e-5); 30 times that is allowed.
    expected = np.asarray(many(readings + step) - many(readings - step)).reshape(readings.shape) / 2e-5
    np.testing.assert_allclose(slope, expected, atol=1e-9 * np.abs(expected).max())
    with pytest.raises(sl.InputError, match="infinite"):
        sl.MarginalLikelihood()(model(), Read(times, np.where(readings > 0.5, np.inf, readings)))
    with pytest.raises(sl.InputError, match="increasing"):
        jax.jit(lambda y: sl.MarginalLikelihood()(model(), Read(times[::-1], y)))(jnp.asarray(readings))
