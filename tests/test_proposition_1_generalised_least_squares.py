"""Proposition 1: at rest and without covariances across times, the maximum of (3.4) is generalised least squares."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.stats import multivariate_normal

from symplearn._errors import InputError
from symplearn._markov_estimators import (
    full_information_markov,
    generalised_least_squares_markov,
    least_squares_markov,
)
from symplearn._markov_parameters import MarkovParameters, output_covariances
from symplearn._model import Gaussian, LinearDynamics, LinearObservation, StateSpaceModel
from symplearn._noise import AdditiveGaussian, Dense
from symplearn._objectives import TimeSeries

ROWS, LAG, CHANNELS, INPUTS = 60, 4, 2, 2


def system(rng, initial=(0.0, 0.0)):
    """A slowly decaying system with much process noise, so that Lambda_k changes from row to row."""
    A = rng.normal(size=(3, 3))
    A *= 0.97 / np.abs(np.linalg.eigvals(A)).max()
    B, H, D = rng.normal(size=(3, INPUTS)), rng.normal(size=(CHANNELS, 3)), rng.normal(size=(CHANNELS, INPUTS))
    mean, variance = initial[0] * np.ones(3), initial[1] * np.eye(3)
    Q, R = np.diag([1.0, 0.5, 2.0]), np.array([[0.3, 0.1], [0.1, 0.2]])
    model = StateSpaceModel(
        LinearDynamics(jnp.asarray(A), jnp.asarray(B)),
        LinearObservation(jnp.asarray(H), jnp.asarray(D)),
        AdditiveGaussian(Dense(Q)),
        AdditiveGaussian(Dense(R)),
        Gaussian(jnp.asarray(mean), jnp.asarray(variance)),
    )
    return model, (A, B, H, D, Q, R, mean, variance)


def simulate(matrices, rng, rows=ROWS):
    """Readings and inputs of one rollout, by numpy."""
    A, B, H, D, Q, R, mean, variance = matrices
    us, x, ys = rng.normal(size=(rows, INPUTS)), mean + np.sqrt(variance) @ rng.normal(size=3), []
    for u in us:
        ys.append(H @ x + D @ u + np.linalg.cholesky(R) @ rng.normal(size=CHANNELS))
        x = A @ x + B @ u + np.sqrt(Q) @ rng.normal(size=3)
    return np.array(ys), us


def marginal_covariances(matrices, rows=ROWS):
    """Lambda_k, by the sum of section 1.5, and the part of x_0."""
    A, _, H, _, Q, R, _, variance = matrices
    out, power, total = [], np.eye(3), np.zeros((CHANNELS, CHANNELS))
    for _ in range(rows):
        out.append(R + total + H @ power @ variance @ power.T @ H.T)
        total, power = total + H @ power @ Q @ power.T @ H.T, A @ power
    return np.array(out)


def convolve(blocks, us):
    """sum_i G_i u_{k-i}, by two loops."""
    return np.array([sum(blocks[i] @ us[k - i] for i in range(min(k + 1, len(blocks)))) for k in range(len(us))])


def weighted_sum(blocks, ys, us, covariances, first=0):
    """sum_k ||y_k - sum_i G_i u_{k-i}||^2 with weight Lambda_k^-1, from row `first` on."""
    residuals = (ys - convolve(blocks, us))[first:]
    return sum(r @ np.linalg.solve(S, r) for r, S in zip(residuals, covariances[first:], strict=True))


def as_series(ys, us):
    return TimeSeries(jnp.arange(float(len(ys))), jnp.asarray(ys), jnp.asarray(us))


def slope_at(objective, blocks, step=1e-3):
    """Central differences of a quadratic, which they are exact for, along 30 random directions."""
    rng = np.random.default_rng(5)
    directions = rng.normal(size=(30, *blocks.shape))
    return np.array([(objective(blocks + step * d) - objective(blocks - step * d)) / (2 * step) for d in directions])


def test_minus_log_density_is_half_the_weighted_sum():
    """-log N with the blocks of Lambda on its diagonal is half the sum of squares weighted by Lambda_k^-1, plus a
    constant."""
    rng = np.random.default_rng(0)
    model, matrices = system(rng)
    ys, us = simulate(matrices, rng)
    covariances = np.asarray(output_covariances(model, jnp.arange(float(ROWS))))
    joint = block_diag(*marginal_covariances(matrices))
    gaps = []
    for _ in range(10):
        blocks = rng.normal(size=(ROWS, CHANNELS, INPUTS)) * 0.8 ** np.arange(ROWS)[:, None, None]
        mean = np.asarray(MarkovParameters(blocks).response(jnp.asarray(us)))
        np.testing.assert_allclose(mean, convolve(blocks, us), rtol=0, atol=1e-12)
        density = multivariate_normal.logpdf(ys.ravel(), mean.ravel(), joint)
        gaps.append(-density - 0.5 * weighted_sum(blocks, ys, us, covariances))
    # Objectives of some 100 nats, to round-off.
    assert np.ptp(gaps) < 1e-10


@pytest.mark.parametrize("initial", [(0.0, 0.0), (2.0, 1.5)])
def test_its_minimiser_is_generalised_least_squares(initial):
    """The estimator without cross-covariances is the stationary point of the density, at rest or from a Gaussian x_0;
    that of (3.15) is so for rows nbar-1, ..., n; the least-squares one is not."""
    rng = np.random.default_rng(1)
    model, matrices = system(rng, initial)
    ys, us = simulate(matrices, rng)
    series, covariances = as_series(ys, us), marginal_covariances(matrices)
    A, _, H, _, _, _, mean, _ = matrices
    free = np.array([H @ np.linalg.matrix_power(A, k) @ mean for k in range(ROWS)])

    def objective(first):
        return lambda blocks: weighted_sum(blocks, ys - free, us, covariances, first)

    every = full_information_markov(series, LAG, model, cross_covariances=False)
    later = generalised_least_squares_markov(series, LAG, model)
    printed = generalised_least_squares_markov(series, LAG, model, printed_start=True)
    for found, first in ((every, 0), (later, LAG - 1), (printed, LAG)):
        # Slopes elsewhere are of order 10 to 100.
        assert np.abs(slope_at(objective(first), np.asarray(found.blocks))).max() < 1e-9
    plain = np.asarray(least_squares_markov(series, LAG).blocks)
    assert np.abs(slope_at(objective(LAG - 1), plain)).max() > 1.0


def test_with_cross_covariances_it_is_the_formula():
    """The whole Lambda gives (V' Lambda^-1 V)^+ V' Lambda^-1 vec(Y), the maximum of the exact likelihood (3.10)."""
    rng = np.random.default_rng(2)
    model, matrices = system(rng)
    A, _, H, _, Q, R, _, _ = matrices
    ys, us = simulate(matrices, rng, 25)
    power = [np.linalg.matrix_power(A, k) for k in range(25)]
    joint = np.block([[
        R * (j == k) + sum((H @ power[j - i] @ Q @ (H @ power[k - i]).T for i in range(1, min(j, k) + 1)),
                           np.zeros((CHANNELS, CHANNELS)))
        for k in range(25)] for j in range(25)])  # fmt: skip
    for lag, tolerance in ((LAG, 1e-10), (25, 1e-7)):
        U = np.array([np.concatenate([us[k - i] if i <= k else np.zeros(INPUTS) for i in range(lag)])
                      for k in range(25)])  # fmt: skip
        V, weight = np.kron(U, np.eye(CHANNELS)), np.linalg.inv(joint)
        # vec stacks columns: of [G_0, ..., G_{lag-1}] (channel, lag * input).
        vec = np.linalg.pinv(V.T @ weight @ V, rcond=1e-11, hermitian=True) @ V.T @ weight @ ys.ravel()
        expected = vec.reshape(lag, INPUTS, CHANNELS).swapaxes(1, 2)
        found = np.asarray(full_information_markov(as_series(ys, us), lag, model).blocks)
        # With lag = n + 1 there are twice as many unknowns as readings; the normal equations square the condition.
        np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * np.abs(expected).max())


def test_missing_readings_and_several_recordings():
    """Missing rows leave the sum of squares, missing channels the weighted sum; recordings add."""
    rng = np.random.default_rng(3)
    model, matrices = system(rng)
    rollouts = [simulate(matrices, rng) for _ in range(2)]
    rollouts[0][0][20], rollouts[1][0][[7, 30], 1] = np.nan, np.nan
    recordings = [as_series(ys, us) for ys, us in rollouts]
    covariances = marginal_covariances(matrices)

    def objective(blocks, weights):
        total = 0.0
        for ys, us in rollouts:
            for r, S in list(zip(ys - convolve(blocks, us), weights, strict=True))[LAG - 1 :]:
                seen = ~np.isnan(r)
                total += r[seen] @ np.linalg.solve(S[np.ix_(seen, seen)], r[seen])
        return total

    plain, weighted = (
        np.asarray(found.blocks)
        for found in (
            least_squares_markov(recordings, LAG),
            generalised_least_squares_markov(recordings, LAG, model),
        )
    )
    ones = np.tile(np.eye(CHANNELS), (ROWS, 1, 1))
    assert np.abs(slope_at(lambda blocks: objective(blocks, ones), plain)).max() < 1e-8
    assert np.abs(slope_at(lambda blocks: objective(blocks, covariances), weighted)).max() < 1e-9
    assert np.abs(slope_at(lambda blocks: objective(blocks, covariances), plain)).max() > 1.0


def test_what_cannot_be_estimated_is_refused():
    """Too few rows (E18), no inputs, inputs that do not vary, uneven rows, a lag beyond the recording: one sentence."""
    rng = np.random.default_rng(4)
    model, matrices = system(rng)
    ys, us = simulate(matrices, rng)
    series = as_series(ys, us)
    # 60 rows from k = nbar - 1 on bear nbar d_u unknowns up to nbar = 20: 41 rows, 40 unknowns; not 21: 40, 42.
    assert least_squares_markov(series, 20).lag == 20
    with pytest.raises(InputError, match="Channel 0 has 40 readings.*42 unknowns"):
        least_squares_markov(series, 21)
    with pytest.raises(InputError, match="42 unknowns"):
        generalised_least_squares_markov(series, 21, model)
    holes = ys.copy()
    holes[30, 1] = holes[40, 1] = np.nan
    with pytest.raises(InputError, match="Channel 1 has 39"):
        least_squares_markov(as_series(holes, us), 20)
    with pytest.raises(InputError, match="has none"):
        least_squares_markov(TimeSeries(series.times, series.readings), LAG)
    with pytest.raises(InputError, match="persistently exciting"):
        least_squares_markov(as_series(ys, np.ones_like(us)), LAG)
    with pytest.raises(InputError, match="persistently exciting"):
        generalised_least_squares_markov(as_series(ys, np.ones_like(us)), LAG, model)
    uneven = TimeSeries(series.times.at[10:].add(1.0), series.readings, series.inputs)
    with pytest.raises(InputError, match="evenly spaced"):
        least_squares_markov(uneven, LAG)
    with pytest.raises(InputError, match="longer than"):
        full_information_markov(series, ROWS + 1, model)
    with pytest.raises(InputError, match="at least 1"):
        least_squares_markov(series, 0)
    silent = StateSpaceModel(
        model.dynamics, model.observation, model.process_noise, AdditiveGaussian(Dense(np.zeros((2, 2)))), model.initial
    )
    with pytest.raises(InputError, match="positive definite"):
        full_information_markov(series, LAG, silent)
