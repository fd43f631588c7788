"""A network's first reading is scored outside the loop over the others, and nothing else changes."""

import jax
import jax.numpy as jnp
import numpy as np

import integrators as ig
import symplearn as sl
from symplearn._parameters import flatten


def test_value_and_gradient_are_those_of_the_loop_that_holds_it():
    """The likelihood alone, whose first reading is outside, and the filter that keeps its history agree to 1e-10."""
    times = 0.1 * np.arange(8)
    readings = np.stack([np.cos(times), -np.sin(times)], axis=1) + 0.1 * np.random.default_rng(0).normal(size=(8, 2))
    readings[3, 1] = np.nan
    noises = (sl.AdditiveGaussian(sl.ScaledIdentity(sl.Positive(s), 2)) for s in (1e-3, 1e-2))
    model = sl.StateSpaceModel(
        sl.Propagator(sl.NSSNN(1, 16, key=jax.random.key(0)), ig.Tao(10.0)), sl.FullState(), *noises,
        sl.Gaussian(jnp.array([1.0, 0.0]), 0.1 * jnp.eye(2)),
    )  # fmt: skip
    free, rebuild = flatten(model)
    assert free.size > 1000

    def alone(free):
        return sl.log_likelihood(sl.resolve(rebuild(free)), jnp.asarray(readings), spans)

    def with_history(free):
        return sl.unscented_filter(sl.resolve(rebuild(free)), jnp.asarray(readings), spans).log_likelihood

    spans = sl.intervals_between(jnp.asarray(times))
    for mode in (jax.value_and_grad, lambda f: lambda x: jax.jvp(f, (x,), (jnp.ones_like(x),))):
        for one, other in zip(jax.jit(mode(alone))(free), jax.jit(mode(with_history))(free), strict=True):
            # Round-off of a sum of 16 densities and their slopes.
            np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-10 * np.abs(other).max())
