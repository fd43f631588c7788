"""The marginal likelihood in Markov parameters (3.4) is the filter's (3.2): the same number, to round-off."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from symplearn._distributions import Uniform
from symplearn._errors import InputError
from symplearn._markov_parameters import (
    impulse_response,
    joint_output_covariance,
    markov_log_likelihood,
    markov_parameters_of,
    output_covariances,
)
from symplearn._model import Coordinates, Gaussian, LinearDynamics, LinearObservation, StateSpaceModel
from symplearn._noise import AdditiveGaussian, Dense, Multiplicative, WienerIncrement
from symplearn._objectives import MarginalLikelihood, TimeSeries

SPACING = 0.25
# States, channels, inputs, rows.
SIZES = [(1, 2, 1, 6), (3, 2, 2, 12), (5, 1, 3, 18)]
filtered = eqx.filter_jit(MarginalLikelihood())


def random_system(size, known_start):
    """A, B, H, D, Sigma, Gamma, m_0, P_0 as plain matrices, and readings and inputs of any kind."""
    states, channels, inputs, rows = size
    rng = np.random.default_rng([*size, known_start])
    A = rng.normal(size=(states, states))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    B, H, D = (rng.normal(size=s) for s in ((states, inputs), (channels, states), (channels, inputs)))
    Q, R = (root @ root.T for root in (rng.normal(size=(d, d)) for d in (states, channels)))
    R += 0.1 * np.eye(channels)
    m, P = np.zeros(states), np.zeros((states, states))
    if not known_start:
        m, P = rng.normal(size=states), np.diag(rng.uniform(0.2, 2.0, states))
    return (A, B, H, D, Q, R, m, P), 2.0 * rng.normal(size=(rows, channels)), rng.normal(size=(rows, inputs))


def as_model(A, B, H, D, Q, R, m, P):
    noises = AdditiveGaussian(Dense(Q)), AdditiveGaussian(Dense(R))
    dynamics = LinearDynamics(jnp.asarray(A), jnp.asarray(B))
    return StateSpaceModel(
        dynamics, LinearObservation(jnp.asarray(H), jnp.asarray(D)), *noises, Gaussian(jnp.asarray(m), jnp.asarray(P))
    )


def as_series(readings, inputs):
    return TimeSeries(SPACING * jnp.arange(len(readings)), jnp.asarray(readings), jnp.asarray(inputs))


def kalman_log_likelihood(A, B, H, D, Q, R, m, P, ys, us):
    """The textbook Kalman filter with inputs, measurement first."""
    total = 0.0
    for y, u in zip(ys, us, strict=True):
        S, r = H @ P @ H.T + R, y - H @ m - D @ u
        total -= 0.5 * (r @ np.linalg.solve(S, r) + np.linalg.slogdet(2 * np.pi * S)[1])
        K = P @ H.T @ np.linalg.inv(S)
        m, P = A @ (m + K @ r) + B @ u, A @ (P - K @ S @ K.T) @ A.T + Q
    return total


def explicit_covariance(A, B, H, D, Q, R, m, P, rows):
    """Lambda by the sums of the specification, section 1.5, with the part of x_0."""
    power = np.linalg.matrix_power
    blocks = [[None] * rows for _ in range(rows)]
    for j in range(rows):
        for k in range(rows):
            block = H @ power(A, j) @ P @ (H @ power(A, k)).T + R * (j == k)
            for i in range(1, min(j, k) + 1):
                block = block + H @ power(A, j - min(j, k) + i - 1) @ Q @ (H @ power(A, k - min(j, k) + i - 1)).T
            blocks[j][k] = block
    return np.block(blocks)


def explicit_mean(A, B, H, D, Q, R, m, P, us):
    """The readings of the noiseless system, one step after another."""
    mean = []
    for u in us:
        mean.append(H @ m + D @ u)
        m = A @ m + B @ u
    return np.array(mean)


@pytest.mark.parametrize("known_start", [True, False])
@pytest.mark.parametrize("size", SIZES)
def test_both_forms_give_one_number(size, known_start):
    """(3.2) = (3.4) for random systems of (d_x, d_y, d_u, rows), with x_0 = 0 and with x_0 ~ N(m_0, P_0)."""
    system, ys, us = random_system(size, known_start)
    model, series = as_model(*system), as_series(ys, us)
    markov = float(markov_log_likelihood(model, series))
    # Round-off of numbers of some 100 nats; the largest relative difference seen is 4e-15.
    assert markov == pytest.approx(-float(filtered(model, series)), rel=1e-12)
    assert markov == pytest.approx(kalman_log_likelihood(*system, ys, us), rel=1e-12)


@pytest.mark.parametrize("known_start", [True, False])
@pytest.mark.parametrize("size", SIZES)
def test_its_mean_and_covariance_are_the_explicit_sums(size, known_start):
    """Lambda, its diagonal blocks and G U are the double sums of section 1.5, term by term."""
    system, ys, us = random_system(size, known_start)
    model, series, rows = as_model(*system), as_series(ys, us), size[-1]
    expected = explicit_covariance(*system, rows)
    joint = np.asarray(joint_output_covariance(model, series.times)).reshape(ys.size, -1)
    tolerance = 1e-13 * np.abs(expected).max()
    np.testing.assert_allclose(joint, expected, rtol=0, atol=tolerance)
    for k, block in enumerate(output_covariances(model, series.times)):
        each = slice(k * size[1], (k + 1) * size[1])
        np.testing.assert_allclose(block, expected[each, each], rtol=0, atol=tolerance)
    mean = explicit_mean(*system, us)
    score = multivariate_normal.logpdf(ys.ravel(), mean.ravel(), expected)
    assert float(markov_log_likelihood(model, series)) == pytest.approx(score, rel=1e-11)
    at_rest = (*system[:-2], np.zeros(size[0]), system[-1])
    forced = markov_parameters_of(model, rows).response(jnp.asarray(us))
    np.testing.assert_allclose(forced, explicit_mean(*at_rest, us), rtol=0, atol=1e-13 * np.abs(mean).max())


def test_the_mean_is_needed():
    """Without its mean vec(G U), as (3.4) is printed, the number is another one (E14)."""
    system, ys, us = random_system(SIZES[1], True)
    as_printed = multivariate_normal.logpdf(ys.ravel(), None, explicit_covariance(*system, len(ys)))
    assert abs(as_printed - kalman_log_likelihood(*system, ys, us)) > 1.0


def test_missing_readings_are_left_out_of_both():
    """With whole rows and single channels missing, both forms are the density of what was read."""
    system, ys, us = random_system(SIZES[1], False)
    ys[[0, 7]], ys[3, 1] = np.nan, np.nan
    model, series = as_model(*system), as_series(ys, us)
    seen = ~np.isnan(ys.ravel())
    covariance = explicit_covariance(*system, len(ys))[np.ix_(seen, seen)]
    expected = multivariate_normal.logpdf(ys.ravel()[seen], explicit_mean(*system, us).ravel()[seen], covariance)
    assert float(markov_log_likelihood(model, series)) == pytest.approx(expected, rel=1e-12)
    assert -float(filtered(model, series)) == pytest.approx(expected, rel=1e-12)


@pytest.mark.slow
def test_both_forms_have_one_gradient():
    """Derivatives by A, B, H and D agree, so that both forms have the same maximum."""
    system, ys, us = random_system(SIZES[1], False)
    series = as_series(ys, us)

    def slope(score):
        return jax.jit(jax.grad(lambda matrices: score(as_model(*matrices, *system[4:]), series)))(system[:4])

    for one, other in zip(slope(markov_log_likelihood), slope(MarginalLikelihood()), strict=True):
        np.testing.assert_allclose(one, -other, rtol=0, atol=1e-11 * float(jnp.abs(other).max()))


def test_several_recordings_noise_per_unit_time_and_other_observations():
    """Sums over recordings, a `WienerIncrement`, and a model without inputs that reads coordinates: as the filter."""
    system, ys, us = random_system(SIZES[1], False)
    model, recordings = as_model(*system), [as_series(ys, us), as_series(ys[::-1], us)]
    wiener = eqx.tree_at(lambda m: m.process_noise, model, WienerIncrement(Dense(system[4])))
    assert float(markov_log_likelihood(wiener, recordings)) == pytest.approx(
        -float(filtered(wiener, recordings)), rel=1e-12
    )
    parts = LinearDynamics(jnp.asarray(system[0])), Coordinates((2, 0))
    free = eqx.tree_at(lambda m: (m.dynamics, m.observation), model, parts)
    undriven = TimeSeries(recordings[0].times, jnp.asarray(ys))
    assert float(markov_log_likelihood(free, undriven)) == pytest.approx(-float(filtered(free, undriven)), rel=1e-12)


def test_a_singular_lambda_is_a_value():
    """Without measurement noise and with x_0 known, Lambda is singular: -1e15 nats, and derivatives without NaN."""
    system, ys, us = random_system(SIZES[1], True)

    def score(gamma):
        return markov_log_likelihood(as_model(*system[:5], gamma * jnp.eye(2), *system[6:]), as_series(ys, us))

    value, slope = jax.value_and_grad(score)(0.0)
    assert float(value) == -1e15 and bool(jnp.isfinite(slope))


def test_what_is_not_linear_is_refused():
    """Uneven rows, no inputs, no start, other dynamics and other noises are refused in one sentence."""
    system, ys, us = random_system(SIZES[1], True)
    model, series = as_model(*system), as_series(ys, us)
    uneven = TimeSeries(series.times.at[3].add(0.1 * SPACING), series.readings, series.inputs)
    part = eqx.tree_at
    never = part(lambda m: m.initial, model, None)
    doubled = part(lambda m: m.measurement_noise, model, Multiplicative(Uniform(jnp.full(2, 0.9), jnp.full(2, 1.1))))
    curved = part(lambda m: m.dynamics, model, replace=lambda x, interval: x**2)
    refused = [
        (model, uneven, "evenly spaced"),
        (model, TimeSeries(series.times, series.readings), "2 inputs"),
        (never, series, "no initial"),
        (doubled, series, "additive Gaussian"),
        (curved, series, "linear systems"),
    ]
    for bad, recording, words in refused:
        with pytest.raises(InputError, match=words):
            markov_log_likelihood(bad, recording)
    with pytest.raises(InputError, match="no input matrix"):
        markov_parameters_of(part(lambda m: (m.dynamics.B, m.observation.feedthrough), model, (None, None)), 3)
    with pytest.raises(InputError, match="at least 1"):
        impulse_response(*(jnp.asarray(matrix) for matrix in system[:4]), lag=0)
