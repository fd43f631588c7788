"""On linear models the unscented filter is the Kalman filter; on others the textbook's own."""

import equinox as eqx
import estimation_cases as cases
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

import integrators as ig
from symplearn._filter import log_likelihood, unscented_filter
from symplearn._markov_parameters import impulse_response
from symplearn._model import (
    Coordinates,
    FullState,
    Gaussian,
    LinearDynamics,
    LinearObservation,
    Propagator,
    StateSpaceModel,
    intervals_between,
)
from symplearn._noise import AdditiveGaussian, Dense
from symplearn._objectives import MARGINAL_LIKELIHOOD, TimeSeries
from symplearn._transforms import UnscentedTransform
from symplearn._triangular import semidefinite_cholesky

N = 12
SPANS = intervals_between(jnp.arange(float(N)))
HISTORY = eqx.filter_jit(unscented_filter)
SCORE = eqx.filter_jit(log_likelihood)


def recorded(system, seed=0, missing=()):
    ys = cases.simulate(*system, N, np.random.default_rng(seed))[1]
    for index in missing:
        ys[index] = np.nan
    return ys


# alpha 1e-3 has weights of 1e6, which cost six of sixteen digits (specification, section 0).
@pytest.mark.parametrize(("alpha", "tolerance"), [(1.0, 1e-12), (1e-3, 1e-8)])
@pytest.mark.parametrize("missing", [(), ((3,), (5, 0), (0, 1), (11,))])
def test_linear_models_give_the_kalman_filter(alpha, tolerance, missing):
    """The log likelihood and last moments are the Kalman filter's; a missing reading is a row never taken."""
    system = cases.linear_system()
    ys = recorded(system, missing=missing)
    expected, m, P = cases.kalman_log_likelihood(*system, ys)
    filtered = HISTORY(cases.as_model(*system), ys, SPANS, None, UnscentedTransform(alpha))
    assert float(filtered.log_likelihood) == pytest.approx(expected, rel=tolerance)
    np.testing.assert_allclose(filtered.filtered_means[-1], m, atol=10 * tolerance)
    np.testing.assert_allclose(filtered.filtered_covariances[-1], P, atol=10 * tolerance)
    # The increments are the log likelihood, summed in another order.
    assert float(jnp.sum(filtered.increments)) == pytest.approx(expected, rel=1e-9)
    assert float(SCORE(cases.as_model(*system), ys, SPANS, None, UnscentedTransform(alpha))) == pytest.approx(
        expected, rel=tolerance
    )


@pytest.mark.parametrize("kind", [np.int64, np.float32, float, list])
def test_numbers_of_any_kind_are_numbers(kind, monkeypatch):
    """Matrices, moments and readings in whole numbers, single precision or lists give the same likelihood, also where
    the first reading stands for the start."""
    # The tests' own check of annotations, which a user does not have, would speak first.
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    whole = [np.array([[0, 1], [-1, 0]]), np.eye(2, dtype=int), np.diag([2, 1]), np.eye(2, dtype=int)]
    A, H, Q, R, m0, P0, ys = (
        number.tolist() if kind is list else number.astype(kind)
        for number in (*whole, np.array([1, -1]), np.eye(2, dtype=int), np.arange(12).reshape(6, 2) % 5)
    )
    noises = AdditiveGaussian(Dense(Q)), AdditiveGaussian(Dense(R))
    series = TimeSeries(np.arange(6).tolist() if kind is list else np.arange(6).astype(kind), ys)
    model = StateSpaceModel(LinearDynamics(A), LinearObservation(H), *noises, Gaussian(m0, P0))
    exact = [np.array(number, float) for number in (A, H, Q, R, m0, P0, ys)]
    expected = cases.kalman_log_likelihood(*exact)[0]
    assert -float(MARGINAL_LIKELIHOOD(model, series)) == pytest.approx(expected, rel=1e-12)
    # Conditioned on the first reading: the same from a state known as well as it tells, but for its own increment.
    begun = StateSpaceModel(LinearDynamics(A), FullState(), *noises)
    later = np.where(np.arange(6)[:, None] == 0, np.nan, exact[6])
    expected = cases.kalman_log_likelihood(*exact[:4], exact[6][0], exact[3], later)[0]
    assert -float(MARGINAL_LIKELIHOOD.score(begun, series)) == pytest.approx(expected, rel=1e-12)
    responses = impulse_response(A, [[1], [0]], H, [[0], [0]], 3).blocks
    np.testing.assert_array_equal(responses[..., 0], [[0, 0], [1, 0], [0, -1]])


def test_a_row_wholly_missing_contributes_nothing():
    """Rows without a reading have increment 0 and innovations 0, and nothing is NaN."""
    system = cases.linear_system()
    filtered = HISTORY(cases.as_model(*system), recorded(system, missing=((3,),)), SPANS)
    assert float(filtered.increments[3]) == 0.0
    assert not bool(jnp.any(filtered.innovations[3]))
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(filtered))


@eqx.filter_jit
def slope_in_scale(model, ys):
    """The derivative of the score by a factor before A."""

    def score(a):
        return log_likelihood(eqx.tree_at(lambda m: m.dynamics.A, model, a * model.dynamics.A), ys, SPANS)

    return jax.grad(score)(1.0)


@pytest.mark.parametrize("known", ["start", "dynamics", "both"])
def test_singular_covariances_are_served(known):
    """A start or dynamics known exactly, wholly or in part, still gives the Kalman filter and slopes."""
    zero = np.zeros((3, 3))
    Q = {"start": None, "dynamics": np.diag([0.0, 0.0, 0.2]), "both": zero}[known]
    P0 = {"start": zero, "dynamics": np.diag([0.0, 1.0, 0.0]), "both": zero}[known]
    system = cases.linear_system(Q, P0)
    ys, model = recorded(system), cases.as_model(*system)
    # Dropped pivots are below 1e-14 of the variance.
    expected = cases.kalman_log_likelihood(*system, ys)[0]
    assert float(SCORE(model, ys, SPANS)) == pytest.approx(expected, rel=1e-12)
    A = system[0]

    def at(a):
        return cases.kalman_log_likelihood(a * A, *system[1:], ys)[0]

    slope = slope_in_scale(model, ys)
    # Central differences at 1e-6 keep eight digits.
    assert float(slope) == pytest.approx((at(1 + 1e-6) - at(1 - 1e-6)) / 2e-6, rel=1e-6)


def test_the_semidefinite_factor_is_a_square_root():
    """L L' = P for random covariances of every rank, and L is lower triangular."""
    rng = np.random.default_rng(3)
    for rank in range(5):
        half = rng.normal(size=(4, rank)) * rng.uniform(0.01, 10.0, size=(4, 1))
        L = np.asarray(semidefinite_cholesky(jnp.asarray(half @ half.T)))
        # A dropped pivot is 1e-14 of the variance, its column up to the square root of that.
        np.testing.assert_allclose(L @ L.T, half @ half.T, atol=1e-7 * max(1.0, np.abs(half @ half.T).max()))
        assert np.all(np.triu(L, 1) == 0)


def pendulum_model(transform_noise=1e-4):
    noises = AdditiveGaussian(Dense(transform_noise * np.eye(2))), AdditiveGaussian(Dense(0.04 * np.eye(1)))
    dynamics = Propagator(ig.problems.Pendulum(gravity=1.0), ig.Leapfrog(), substeps=5)
    initial = Gaussian(jnp.array([1.5, 0.0]), 0.1 * jnp.eye(2))
    return StateSpaceModel(dynamics, Coordinates((0,)), *noises, initial)


def pendulum_step(x, dt=0.2):
    """Five leapfrog steps of the unit pendulum, written out."""
    q, p = x
    for _ in range(5):
        p -= 0.5 * dt * np.sin(q)
        q += dt * p
        p -= 0.5 * dt * np.sin(q)
    return np.array([q, p])


def pendulum_readings(n=N, seed=4):
    x, ys = np.array([1.4, 0.1]), []
    rng = np.random.default_rng(seed)
    for _ in range(n):
        ys.append(x[:1] + 0.2 * rng.normal(size=1))
        x = pendulum_step(x)
    return np.array(ys)


@pytest.mark.parametrize(("alpha", "tolerance"), [(1.0, 1e-11), (0.5, 1e-11), (1e-3, 1e-6)])
def test_nonlinear_models_give_the_textbook_unscented_filter(alpha, tolerance):
    """On a pendulum seen by its angle the score is that of the filter with explicit weights, at any alpha."""
    ys, model = pendulum_readings(), pendulum_model()
    expected = cases.unscented_log_likelihood(
        pendulum_step, lambda x: x[:1], 1e-4 * np.eye(2), 0.04 * np.eye(1), np.array([1.5, 0.0]),
        0.1 * np.eye(2), ys, alpha,
    )  # fmt: skip
    assert float(SCORE(model, ys, SPANS, None, UnscentedTransform(alpha))) == pytest.approx(expected, rel=tolerance)


def scored(vector, ys):
    """The pendulum's score by gravity and the logarithm of the process noise."""
    model = eqx.tree_at(
        lambda m: (m.dynamics.system.gravity, m.process_noise.structure.covariance),
        pendulum_model(),
        (vector[0], jnp.exp(vector[1]) * jnp.eye(2)),
    )
    return log_likelihood(model, ys, SPANS)


# Five points at once, so that one compiled function serves two tests.
FORWARD = jax.jit(jax.vmap(lambda v, ys: (scored(v, ys), jax.jacfwd(scored)(v, ys)), in_axes=(0, None)))


@pytest.mark.slow
def test_derivatives_are_finite_differences_in_both_modes():
    """Forward and reverse derivatives agree with central differences, missing rows included."""
    ys = pendulum_readings()
    ys[4] = np.nan
    at, steps = jnp.array([1.02, -8.0]), 1e-5 * jnp.eye(2)
    values, slopes = FORWARD(jnp.concatenate([at[None], at + steps, at - steps]), ys)
    central = (values[1:3] - values[3:]) / 2e-5
    np.testing.assert_allclose(slopes[0], jax.jit(jax.grad(scored))(at, ys), rtol=1e-10)
    # Step 1e-5: truncation 1e-10, round-off 1e-15 * 30 / 1e-5.
    np.testing.assert_allclose(slopes[0], central, rtol=1e-6)


def test_a_failed_filter_says_so_and_stays_clean():
    """Where a trajectory escapes or a variance is negative: score -1e15, a fault, slopes 0 in both modes."""
    ys, wrong = pendulum_readings(), (1e200, -1e200, jnp.nan, jnp.inf)
    starts = jnp.array([[1.0, -8.0], *([g, -8.0] for g in wrong)])
    values, slopes = FORWARD(starts, ys)
    backward = jax.jit(jax.vmap(jax.grad(scored), in_axes=(0, None)))(starts, ys)
    assert bool(jnp.isfinite(values[0])) and bool(jnp.all(values[1:] == -1e15))
    for found in (slopes, backward):
        assert bool(jnp.any(found[0] != 0.0)) and bool(jnp.all(found[1:] == 0.0))
    negative = HISTORY(pendulum_model(-1e-1), ys, SPANS)
    assert not bool(negative.ok) and float(negative.log_likelihood) == -1e15
    assert all(not bool(jnp.any(jnp.isnan(leaf))) for leaf in jax.tree.leaves(negative))


def test_innovations_are_white_and_of_unit_variance():
    """Over 200 recordings made by the model, standardised innovations have mean 0 and variance 1."""
    system = cases.linear_system()
    ys = np.array([recorded(system, seed) for seed in range(200)])
    e = np.asarray(jax.jit(jax.vmap(lambda y: unscented_filter(cases.as_model(*system), y, SPANS)))(ys)
                   .standardised_innovations)  # fmt: skip
    count = e.size
    # Four standard errors of a mean, of a mean square, and of a lagged product.
    assert abs(e.mean()) < 4 / count**0.5
    assert abs((e**2).mean() - 1) < 4 * (2 / count) ** 0.5
    assert abs((e[:, 1:] * e[:, :-1]).mean()) < 4 / count**0.5


def test_bad_transforms_are_refused():
    """An alpha or beta that would make covariances indefinite is refused in one sentence."""
    with pytest.raises(ValueError, match="beta >= alpha"):
        UnscentedTransform(alpha=2.0, beta=2.0)
