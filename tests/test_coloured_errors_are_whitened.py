"""Readings with a coloured error are whitened exactly as a dense Gaussian process has it."""

import numpy as np
import pytest
from engine_cases import autocovariance
from scipy.linalg import solve_triangular

from symplearn.diagnosis._coloured import Colour, fit_colour, whitened_gram, whitened_residuals, whitened_series

NUMBER = 40


def irregular_times(seed=0):
    return np.cumsum(np.random.default_rng(seed).gamma(2.0, 0.1, NUMBER))


def covariance(times, weight, ratio, frequency, damping):
    lags = times[:, None] - times
    return ratio * autocovariance(lags, frequency, damping) + np.diag(1 / weight)


def readings(seed=0):
    """Columns to whiten (2 lanes, 3 columns), weights with a quarter missing, and times."""
    rng = np.random.default_rng(seed)
    weight = rng.uniform(0.5, 20.0, NUMBER)
    weight[rng.permutation(NUMBER)[: NUMBER // 4]] = 0.0
    return rng.normal(size=(2, 3, NUMBER)), weight, irregular_times(seed)


def dense_gram(columns, weight, times, *shape):
    seen = weight > 0
    S = covariance(times[seen], weight[seen], *shape)
    return columns[:, seen] @ np.linalg.solve(S, columns[:, seen].T), np.linalg.slogdet(S)[1]


@pytest.mark.parametrize("damping", [30.0, 2.0, 1.001, 0.999, 0.3, 0.05])
@pytest.mark.parametrize("ratio", [0.1, 1e4])
def test_the_gram_matrix_is_the_dense_gaussian_process(ratio, damping):
    """Gram matrix and log determinant equal the dense ones: any damping, irregular times, missing rows, weights."""
    columns, weight, times = readings()
    shapes = [(ratio, 2.0, damping), (ratio, 11.0, damping)]
    gram, logs = whitened_gram(columns, weight, times, [Colour(*shape, 0.0) for shape in shapes])
    for lane, shape in enumerate(shapes):
        expected, determinant = dense_gram(columns[lane], weight, times, *shape)
        # Covariances of condition up to 1e6 cost the dense solution six of sixteen digits.
        np.testing.assert_allclose(gram[lane], expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())
        np.testing.assert_allclose(logs[lane], determinant, rtol=1e-8)


def test_just_above_critical_damping_is_matern():
    """At the grid's damping of 1.001 the process is Matern's of order 3/2, to a thousandth."""
    columns, weight, times = readings(1)
    gram, logs = whitened_gram(columns, weight, times, [Colour(3.0, 5.0, 1.001, 0.0)] * 2)
    expected, determinant = dense_gram(columns[0], weight, times, 3.0, 5.0, 1.0)
    # The autocovariance moves by less than the change of the damping, 1e-3.
    np.testing.assert_allclose(gram[0], expected, atol=1e-3 * np.abs(expected).max())
    np.testing.assert_allclose(logs[0], determinant, atol=1e-3 * NUMBER)


def test_the_whitened_series_is_the_cholesky_factor_at_work():
    """Row by row the whitened columns are L^-1 times the columns, where L L' is the dense covariance."""
    columns, weight, times = readings(2)
    seen = weight > 0
    L = np.linalg.cholesky(covariance(times[seen], weight[seen], 5.0, 3.0, 0.3))
    found = whitened_series(columns[0], weight, times, Colour(5.0, 3.0, 0.3, 0.0))
    np.testing.assert_allclose(found[seen], solve_triangular(L, columns[0][:, seen].T, lower=True), atol=1e-9)
    assert not found[~seen].any()
    lanes = whitened_residuals(columns[0], weight, times, [Colour(5.0, 3.0, 0.3, 0.0)] * 3)
    np.testing.assert_allclose(lanes, found.T, atol=1e-12)  # round-off


def gain(residual, weight, times, colour):
    """Log evidence of a coloured error, its choice on the grid paid for, over that of white noise of sd 1."""
    gram, logs = whitened_gram(residual[None, None], weight, times, [colour])
    coloured = -0.5 * (gram[0, 0, 0] + logs[0]) + colour.occam
    return coloured + 0.5 * ((weight * residual**2).sum() - np.log(weight).sum())


def test_white_noise_is_left_white():
    """On white noise no coloured error is worth its price: the mean of evidence ratios over draws is one."""
    rng, lanes, number = np.random.default_rng(0), 24, 150
    times, weight = 0.1 * np.arange(number), np.ones(number)
    residuals = rng.normal(size=(lanes, number))
    colours = fit_colour([residuals], [weight], [times], known=1.0)
    gains = np.array([gain(x, weight, times, c) for x, c in zip(residuals, colours, strict=True)])
    # Markov's inequality on a ratio of mean one: above e^3 once in 20 draws; 24 are on average below 3.
    assert gains.max() < 3.0 and np.exp(gains).mean() < 3.0
    free = fit_colour([residuals], [weight], [times], known=None)
    # A colour that is chosen all the same is a small one, or one that is white itself: faster than the rows.
    assert np.median([c.ratio for c in free]) < 1.0


@pytest.mark.parametrize(
    ("ratio", "frequency", "damping"), [(30.0, 3.0, 0.1), (30.0, 1.0, 1.001)], ids=["ringing", "smooth"]
)
def test_a_coloured_error_is_recovered(ratio, frequency, damping):
    """Errors drawn from the process are found with its size and its memory, to the grid's own spacing."""
    rng, number = np.random.default_rng(1), 300
    times, weight = [0.15 * np.arange(number)] * 2, [np.ones(number)] * 2
    L = np.linalg.cholesky(covariance(times[0], weight[0], ratio, frequency, damping))
    residuals = [0.2 * (L @ rng.normal(size=(number, 4))).T for _ in range(2)]
    for colour in fit_colour(residuals, weight, times, known=None):
        # One step of the grid is a factor 4.8 in ratio and about 2 in memory; two recordings of some forty memories
        # hold the truth to less than that.
        assert abs(np.log(colour.ratio / ratio)) < np.log(8)
        memory, true_memory = max(2 * colour.damping, 1) / colour.frequency, max(2 * damping, 1) / frequency
        assert abs(np.log(memory / true_memory)) < np.log(2.2)
        assert (colour.damping < 0.5) == (damping < 0.5)


def test_recordings_are_weighed_together():
    """The colour of two recordings is that of their joint likelihood, whichever comes first."""
    rng, number = np.random.default_rng(2), 80
    times, weight = [np.cumsum(rng.gamma(2.0, 0.1, number)) for _ in range(2)], [np.ones(number)] * 2
    residuals = [rng.normal(size=(3, number)).cumsum(1) for _ in range(2)]
    forth = fit_colour(residuals, weight, times, known=0.5)
    back = fit_colour(residuals[::-1], weight, times[::-1], known=0.5)
    for one, other in zip(forth, back, strict=True):
        assert (one.ratio, one.frequency, one.damping) == (other.ratio, other.frequency, other.damping)
        np.testing.assert_allclose(one.occam, other.occam, rtol=1e-9)


def test_a_residual_that_is_not_finite_has_no_colour():
    """A lane that diverged gets a colour that claims nothing, and spoils no other lane."""
    rng, number = np.random.default_rng(3), 60
    residuals = rng.normal(size=(2, number))
    residuals[1, 30:] = np.inf
    times, weight = [0.1 * np.arange(number)], [np.ones(number)]
    fine, broken = fit_colour([residuals], weight, times, known=1.0)
    alone = fit_colour([residuals[:1]], weight, times, known=1.0)[0]
    assert broken.occam == -np.inf and fine == alone
