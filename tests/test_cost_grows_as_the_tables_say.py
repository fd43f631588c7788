"""The likelihood costs linearly with n, cubically with d_x and d_y, and nothing with d_theta. Tables 2.1-2.3."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks._operations import operations
from symplearn._filter import log_likelihood
from symplearn._model import Gaussian, LinearDynamics, LinearObservation, StateSpaceModel
from symplearn._noise import Additive, AdditiveGaussian, Dense, Diagonal, Multiplicative, ScaledIdentity
from symplearn._transforms import STANDARD, Cubature, Taylor

SIZES = range(3, 10)


class Wave(eqx.Module):
    """A nonlinear map of given size whose own operations can be counted apart; every parameter is used once."""

    matrix: Any
    theta: Any

    def __call__(self, x, record):
        return jnp.sin(self.matrix @ x) + jnp.sum(self.theta * x[0])


class Known(eqx.Module):
    """A noise distribution given by its two moments."""

    mean: Any
    structure: Any


def model(dx, dy, parameters=1, linear=False, multiplied=False):
    """The shapes are all that counts."""
    noises = [AdditiveGaussian(ScaledIdentity(0.1, dim)) for dim in (dx, dy)]
    if multiplied:
        noises = [
            Multiplicative(Known(jnp.ones(dim), Diagonal(0.1 * jnp.ones(dim))), noise)
            for dim, noise in zip((dx, dy), noises, strict=True)
        ]
    A, H, theta = jnp.eye(dx), jnp.ones((dy, dx)), jnp.ones(parameters)
    parts = (LinearDynamics(A), LinearObservation(H)) if linear else (Wave(A, theta), Wave(H, theta))
    return StateSpaceModel(*parts, *noises, Gaussian(jnp.zeros(dx), jnp.eye(dx)))


def cost(n, dx, dy, transform=STANDARD, **options):
    made = model(dx, dy, **options)
    return operations(
        lambda ys: log_likelihood(made, ys, jnp.zeros(n), jnp.zeros(n + 1), transform), jnp.zeros((n + 1, dy))
    )


def own(made, dx, dy):
    """Operations of one evaluation of the dynamics and of the observation: the F and H of the tables."""
    F = operations(lambda x: made.dynamics(x, None), jnp.zeros(dx))
    return F, operations(lambda x: made.observation(x, None), jnp.zeros(dx))


def growth(counts):
    """The degree of the polynomial through counts at consecutive sizes: how many differences it takes to reach 0."""
    degree = -1
    while np.any(counts):
        counts, degree = np.diff(counts), degree + 1
    return degree


CASES = {
    "unscented": {},
    "cubature": {"transform": Cubature()},
    "Taylor": {"transform": Taylor()},
    "Kalman": {"linear": True},
    "multiplied": {"multiplied": True},
}


@pytest.mark.parametrize("options", CASES.values(), ids=CASES.keys())
def test_cost_is_linear_in_the_number_of_readings(options):
    """Each further reading costs the same."""
    assert growth(np.array([cost(n, 3, 2, **options) for n in range(2, 8)])) == 1


@pytest.mark.parametrize("options", CASES.values(), ids=CASES.keys())
def test_cost_is_cubic_in_the_state_and_in_the_reading(options):
    """Operations are polynomials of degree 3 in d_x and in d_y, dense matrices in the model included."""
    assert growth(np.array([cost(4, dx, 2, **options) for dx in SIZES])) == 3
    assert growth(np.array([cost(4, 3, dy, **options) for dy in SIZES])) == 3


def test_parameters_cost_nothing_but_their_use_in_the_model():
    """Apart from evaluations of Psi and h, the number of parameters does not matter."""
    n, dx, dy = 4, 3, 2
    points = 2 * dx + 1
    overheads = set()
    for parameters in (1, 10, 1000):
        F, H = own(model(dx, dy, parameters), dx, dy)
        # A count of the program has the dearer branch, a prediction, before the first reading too.
        overheads.add(cost(n, dx, dy, parameters=parameters) - points * (n + 1) * (F + H))
    assert len(overheads) == 1


def test_multiplicative_noise_does_not_change_the_order():
    """What (2.10)-(2.12) add is linear in n and of no higher order than the filter itself (Table 2.3)."""
    added = [cost(n, 3, 2, multiplied=True) - cost(n, 3, 2) for n in range(2, 6)]
    assert growth(np.array(added)) == 1
    ratio = cost(4, 30, 30, multiplied=True) / cost(4, 30, 30)
    assert 1.0 < ratio < 2.0


def test_a_dense_multiplicative_covariance_is_cubic_too():
    """Correlated factors keep the order: Schur's product is factorised, not the columns multiplied two by two."""

    def correlated(dx):
        factor, added = (Known(mean, Dense(jnp.eye(dx))) for mean in (jnp.ones(dx), jnp.zeros(dx)))
        noise = Multiplicative(factor, Additive(added))
        made = eqx.tree_at(lambda m: m.process_noise, model(dx, 2), noise)
        return operations(lambda ys: log_likelihood(made, ys, jnp.zeros(4)), jnp.zeros((5, 2)))

    assert growth(np.array([correlated(dx) for dx in SIZES])) == 3


def kalman_flops(n, dx, dy):
    """Table 2.2, KF total."""
    return n * (6 * dx**3 + dy**3 + 6 * dx**2 * dy + 4 * dx * dy**2 + dy**2 + 3 * dx * dy - dx + 3 * dy + 8)


def unscented_flops(n, dx, dy, F, H):
    """Table 2.2, UKF total, its lost row completed as in specification section 2."""
    cubic = 14 / 3 * dx**3 + dy**3 + 6 * dx**2 * dy + 8 * dx * dy**2
    rest = 26 * dx**2 + 6 * dy**2 + 13 * dx * dy + 6 * dx + 9 * dy + 13
    return n * (cubic + rest + (2 * dx + 1) * (F + H)) + 18


@pytest.mark.parametrize(("dx", "dy"), [(4, 4), (10, 2), (30, 3), (30, 30)])
def test_cost_is_within_a_small_factor_of_the_tables(dx, dy):
    """The square-root form costs no more than a small multiple of the covariance form that Table 2.2 prices.

    Gram-Schmidt runs over whole rows where a triangular algorithm would stop short, hence a factor up to six.
    """
    n = 10
    F, H = own(model(dx, dy), dx, dy)
    assert 0.5 < cost(n, dx, dy) / unscented_flops(n + 1, dx, dy, F, H) < 6
    assert 0.5 < cost(n, dx, dy, linear=True) / kalman_flops(n + 1, dx, dy) < 6
