"""Process noise per unit time compares across sampling rates; noise per data interval does not, nor do gaps in it."""

from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from symplearn._fit import fit
from symplearn._model import AbstractAffine, FullState, Gaussian, LinearDynamics, LinearObservation, StateSpaceModel
from symplearn._noise import AdditiveGaussian, Dense, LogVariance, ScaledIdentity, WienerIncrement
from symplearn._objectives import MARGINAL_LIKELIHOOD, TimeSeries
from symplearn._parameters import AbstractKnown, Learnt, flatten, resolve
from symplearn._prior import Flat

N, DRIFT, RATE = 81, np.array([0.3, -0.2]), 0.5
NAME = "process_noise.structure.variance.log_variance"


class Drifting(AbstractKnown, AbstractAffine):
    """x' = x + drift times the length of the interval: Brownian motion with a drift, at any times."""

    drift: Any

    def slope(self, x):
        return jnp.eye(x.shape[0])

    def __call__(self, x, interval=None):
        return x + self.drift * interval.length


def model(noise):
    """The state is read exactly, so the likelihood is that of the increments."""
    exact = AdditiveGaussian(ScaledIdentity(0.0, dim=2))
    start = Gaussian(jnp.zeros(2), jnp.eye(2))
    return StateSpaceModel(Drifting(jnp.asarray(DRIFT)), FullState(), noise, exact, start)


def sampled(times, seed):
    """Brownian motion with a variance of 0.5 per unit time at the given times, by numpy."""
    rng, spans = np.random.default_rng(seed), np.diff(times)
    steps = DRIFT * spans[:, None] + np.sqrt(RATE * spans)[:, None] * rng.normal(size=(len(spans), 2))
    return np.vstack([rng.normal(size=2), steps]).cumsum(axis=0)


TIMES = {
    "fast": 0.1 * np.arange(N),
    "slow": 0.4 * np.arange(N),
    "irregular": np.cumsum(np.random.default_rng(8).uniform(0.02, 1.0, N)),
}


def learnable(kind, v):
    return model(kind(ScaledIdentity(LogVariance(Learnt(np.log(v))), dim=2)))


@pytest.fixture(scope="module")
def estimates():
    """The recordings with the increments they were made of, and the variances per unit time learnt from them.

    Learnt by its logarithm under a flat prior, a variance is the maximum of the likelihood.
    """
    found = {}
    for seed, (name, times) in enumerate(TIMES.items()):
        path = sampled(times, seed)
        residuals = np.diff(path, axis=0) - DRIFT * np.diff(times)[:, None]
        series = TimeSeries(jnp.asarray(times), jnp.asarray(path))
        estimate = fit(learnable(WienerIncrement, 1.0), series, prior=Flat())
        assert estimate.converged
        rate = float(np.exp(estimate.values()[NAME]))
        found[name] = SimpleNamespace(rate=rate, series=series, residuals=residuals)
    return found


def test_a_variance_per_unit_time_is_one_at_every_rate(estimates):
    """At two rates and at irregular times the estimate is the mean of d^2 / dt, and the true rate within its error."""
    for name, found in estimates.items():
        spans = np.diff(TIMES[name])[:, None]
        # A fit stops within 1e-5 nats, of 80 nats of curvature in log v.
        assert found.rate == pytest.approx(np.mean(found.residuals**2 / spans), rel=1e-3)
        # 160 squares have a standard error of sqrt(2 / 160) = 11 %; three of them.
        assert found.rate == pytest.approx(RATE, rel=0.34)


@eqx.filter_jit
def slope(given, series):
    free, rebuild = flatten(given)
    return jax.jacfwd(lambda free: MARGINAL_LIKELIHOOD(rebuild(free), series))(free)[0]


def test_a_variance_per_interval_is_another_at_every_rate(estimates):
    """Per data interval the likelihood has its maximum at the mean of d^2, which grows with the interval."""
    best = {name: np.mean(found.residuals**2) for name, found in estimates.items()}
    for name, found in estimates.items():
        # A sum of 160 terms of order one; 80 nats of curvature in log v at the maximum.
        assert abs(slope(learnable(AdditiveGaussian, best[name]), found.series)) < 1e-10
        assert slope(learnable(AdditiveGaussian, 1.1 * best[name]), found.series) > 5.0
    # Four times the interval: between 2 and 8 within four standard errors of the ratio, 16 % each.
    assert 2.0 < best["slow"] / best["fast"] < 8.0


@eqx.filter_jit
def log_likelihood(given, times, readings):
    return -MARGINAL_LIKELIHOOD(given, TimeSeries(times, readings))


def score(given, times, readings):
    return float(log_likelihood(given, jnp.asarray(times), jnp.asarray(readings)))


# What is split off by rows without readings, at random places between the readings.
COARSE = np.array([0.0, 0.5, 0.8, 2.0, 2.7])
SPLITS = np.array([0.1, 0.6, 0.7, 1.3, 1.9])
COVARIANCE = np.array([[0.5, 0.2], [0.2, 0.3]])


def split(path):
    """The same readings with rows in between that have none."""
    times = np.sort(np.concatenate([COARSE, SPLITS]))
    readings = np.full((len(times), 2), np.nan)
    readings[np.searchsorted(times, COARSE)] = path
    return times, readings


def test_noise_per_unit_time_composes_over_split_intervals():
    """Rows without a reading split data intervals and change nothing: the likelihood is that of the increments."""
    path, given = sampled(COARSE, 9), model(WienerIncrement(Dense(COVARIANCE)))
    expected = stats.multivariate_normal(np.zeros(2), np.eye(2)).logpdf(path[0])
    for span, step in zip(np.diff(COARSE), np.diff(path, axis=0), strict=True):
        expected += stats.multivariate_normal(DRIFT * span, COVARIANCE * span).logpdf(step)
    assert score(given, COARSE, path) == pytest.approx(expected, rel=1e-12)
    assert score(given, *split(path)) == pytest.approx(expected, rel=1e-12)


def test_noise_per_interval_counts_the_intervals():
    """Per data interval each split adds a draw, so the likelihood is that of as many draws as there are rows."""
    path, given = sampled(COARSE, 9), model(AdditiveGaussian(Dense(COVARIANCE)))
    draws = np.diff(np.searchsorted(split(path)[0], COARSE))
    found = [score(given, COARSE, path), score(given, *split(path))]
    for counts, value in zip((np.ones(4), draws), found, strict=True):
        expected = stats.multivariate_normal(np.zeros(2), np.eye(2)).logpdf(path[0])
        for count, span, step in zip(counts, np.diff(COARSE), np.diff(path, axis=0), strict=True):
            expected += stats.multivariate_normal(DRIFT * span, COVARIANCE * count).logpdf(step)
        assert value == pytest.approx(expected, rel=1e-12)
    assert abs(found[0] - found[1]) > 0.1


A = np.array([[0.9, 0.3], [-0.2, 0.8]])
H = np.array([[1.0, 0.0], [0.5, 1.0]])
R = np.array([[0.2, 0.1], [0.1, 0.3]])


@pytest.mark.parametrize("kind", [WienerIncrement, AdditiveGaussian])
def test_missing_readings_are_dropped_from_the_joint_gaussian(kind):
    """Rows missing in whole or in part, the first and the last too: the rest has its own joint Gaussian density.

    At irregular times; the joint covariance is built from the noises, without a filter, by SciPy.
    """
    rng, n = np.random.default_rng(10), len(COARSE)
    ys = rng.normal(size=(n, 2))
    ys[0, 1] = ys[2] = ys[4, 0] = np.nan
    start = Gaussian(jnp.array([0.5, -1.0]), jnp.asarray(0.7 * np.eye(2)))
    parts = LinearDynamics(jnp.asarray(A)), LinearObservation(jnp.asarray(H))
    noises = kind(Dense(COVARIANCE)), AdditiveGaussian(Dense(R))
    given = resolve(StateSpaceModel(*parts, *noises, start))
    lengths = np.diff(COARSE) if kind is WienerIncrement else np.ones(n - 1)
    # x = F w, with w the start and the n - 1 noises.
    powers = [np.linalg.matrix_power(A, k) for k in range(n)]
    F = np.block([[powers[k - j] if j <= k else np.zeros((2, 2)) for j in range(n)] for k in range(n)])
    W = np.zeros((2 * n, 2 * n))
    W[:2, :2] = 0.7 * np.eye(2)
    for k, length in enumerate(lengths, start=1):
        W[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = COVARIANCE * length
    G, seen = np.kron(np.eye(n), H), ~np.isnan(ys.ravel())
    mean = G @ np.concatenate([power @ [0.5, -1.0] for power in powers])
    covariance = G @ F @ W @ F.T @ G.T + np.kron(np.eye(n), R)
    joint = stats.multivariate_normal(mean[seen], covariance[np.ix_(seen, seen)])
    assert score(given, COARSE, ys) == pytest.approx(joint.logpdf(ys.ravel()[seen]), rel=1e-12)
