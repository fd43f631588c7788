"""The general hidden Markov model is the state-space model where its noises are added or multiplied, and more."""

from typing import Any

import equinox as eqx
import estimation_cases as cases
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from symplearn._distributions import Gamma, MultivariateNormal, Uniform
from symplearn._errors import InputError
from symplearn._filter import unscented_filter
from symplearn._fit import Estimate
from symplearn._forecast import forecast
from symplearn._hidden_markov import HiddenMarkovModel
from symplearn._model import Gaussian, LinearObservation, StateSpaceModel, intervals_between
from symplearn._noise import Additive, AdditiveGaussian, Dense, Diagonal, Multiplicative, WienerIncrement
from symplearn._objectives import MarginalLikelihood, TimeSeries
from symplearn._predict import stochastic_forecast
from symplearn._prior import Flat, Prior
from symplearn._simulate import simulate
from symplearn._smoother import smooth
from symplearn._transforms import STANDARD, GaussHermite, UnscentedTransform

N = 12
TIMES = jnp.arange(float(N))
SPANS = intervals_between(TIMES)


@eqx.filter_jit
def history(model, ys, transform=STANDARD):
    filtered = unscented_filter(model, ys, SPANS, None, transform)
    return filtered, smooth(model, filtered, SPANS, None, transform)


class Added(eqx.Module):
    """f(x) + w, for a part f of a state-space model."""

    part: Any

    def __call__(self, x, w, record):
        return self.part(x, record) + w


class Multiplied(eqx.Module):
    """f(x) .* w."""

    part: Any

    def __call__(self, x, w, record):
        return self.part(x, record) * w


class Bent(eqx.Module):
    """A smooth map of the plane that is not affine."""

    def __call__(self, x, record=None):
        return jnp.stack([x[0] + 0.3 * x[1], x[1] - 0.3 * jnp.sin(x[0])])


def with_added_noise(model):
    """The same model in the general form."""
    Q, R = model.process_noise.structure, model.measurement_noise.structure
    w, v = (MultivariateNormal(jnp.zeros(one.matrix.shape[0]), one) for one in (Q, R))
    return HiddenMarkovModel(Added(model.dynamics), Added(model.observation), w, v, model.initial)


def recorded(system):
    ys = cases.simulate(*system, N, np.random.default_rng(0))[1]
    ys[3], ys[5, 0] = np.nan, np.nan
    return jnp.asarray(ys)


def assert_same(ours, theirs, atol):
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=atol)


def test_linear_and_added_it_is_the_state_space_model():
    """The objective's filter gives the Kalman filter's numbers to 1e-12, with readings missing in part."""
    system = cases.linear_system()
    ys = recorded(system)
    filtered = MarginalLikelihood().filter(with_added_noise(cases.as_model(*system)), TimeSeries(TIMES, ys))
    expected, m, P = cases.kalman_log_likelihood(*system, np.asarray(ys))
    assert float(filtered.log_likelihood) == pytest.approx(expected, rel=1e-12)
    np.testing.assert_allclose(filtered.filtered_means[-1], m, atol=1e-12)
    np.testing.assert_allclose(filtered.filtered_covariances[-1], P, atol=1e-12)


def test_nonlinear_and_added_it_is_the_state_space_model():
    """With kappa = -dim w its sigma points lie as far out as the state-space model's: filter and smoother agree."""
    noises = (AdditiveGaussian(Dense(one)) for one in (0.02 * np.eye(2), np.array([[0.1, 0.03], [0.03, 0.2]])))
    model = StateSpaceModel(Bent(), Bent(), *noises, Gaussian(jnp.array([1.0, 0.3]), 0.2 * jnp.eye(2)))
    ys = jnp.asarray(np.random.default_rng(1).normal(size=(N, 2)))
    ours = history(with_added_noise(model), ys, UnscentedTransform(1.0, 2.0, -2.0))
    assert_same(ours, history(model, ys), 1e-12 * 40)


def moments_of(moments):
    return moments.mean, moments.covariance, moments.source @ moments.factor.T


def test_multiplied_it_has_the_multiplicative_moments():
    """For f(x) .* w with a product rule its moments are (2.10)-(2.12), f nonlinear and w correlated."""
    mean, root = jnp.array([0.7, -0.4]), jnp.array([[0.5, 0.0], [0.2, 0.3]])
    w = MultivariateNormal([0.9, 1.2], Dense([[0.2, 0.05], [0.05, 0.1]]))
    own = Gaussian(mean, jnp.eye(2))
    general = HiddenMarkovModel(Multiplied(Bent()), Multiplied(Bent()), w, w, own)
    model = StateSpaceModel(Bent(), Bent(), Multiplicative(w), Multiplicative(w), own)
    # Order 3 is exact for squares of w, and takes the same points in x for both.
    rule = GaussHermite(3)
    assert_same(moments_of(general.predict(rule, mean, root, None)), moments_of(model.predict(rule, mean, root, None)),
                1e-12)  # fmt: skip
    assert_same(moments_of(general.read(rule, mean, root, None)), moments_of(model.read(rule, mean, root, None)),
                1e-12)  # fmt: skip


def test_noise_inside_a_function_has_its_closed_moments():
    """x exp(w) and sin(x + v) of Gaussian x, w, v have their textbook means, variances and covariances with x."""
    m, P, w, q, r = 0.8, 0.3, -0.1, 0.15, 0.2
    model = HiddenMarkovModel(
        lambda x, w, interval: x * jnp.exp(w), lambda x, v, context: jnp.sin(x + v),
        MultivariateNormal([w], Diagonal([q])), MultivariateNormal([0.0], Diagonal([r])),
    )  # fmt: skip
    at = GaussHermite(20), jnp.array([m]), jnp.sqrt(jnp.array([[P]])), None
    gain = np.exp(w + 0.5 * q)
    expected = m * gain, (m**2 + P) * np.exp(2 * w + 2 * q) - (m * gain) ** 2, P * gain
    # Twenty points integrate these entire functions to round-off.
    np.testing.assert_allclose([one.item() for one in moments_of(model.predict(*at))], expected, rtol=1e-11)
    s = P + r
    mean = np.sin(m) * np.exp(-0.5 * s)
    expected = mean, 0.5 * (1 - np.cos(2 * m) * np.exp(-2 * s)) - mean**2, P * np.cos(m) * np.exp(-0.5 * s)
    np.testing.assert_allclose([one.item() for one in moments_of(model.read(*at))], expected, rtol=1e-11)


def test_noise_inside_a_function_has_the_moments_of_draws():
    """With two states and one noise inside a frequency, moments are those of a million NumPy draws to 1e-2."""

    def turn(x, w, interval):
        angle = interval + w[0]
        return jnp.stack([x[0] * jnp.cos(angle) - x[1] * jnp.sin(angle), x[0] * jnp.sin(angle) + x[1] * jnp.cos(angle)])

    mean, root = np.array([1.0, -0.5]), np.array([[0.4, 0.0], [0.1, 0.3]])
    noise = MultivariateNormal([0.2], Diagonal([0.09]))
    model = HiddenMarkovModel(turn, turn, noise, noise)
    rng = np.random.default_rng(7)
    x, angle = mean + rng.normal(size=(1_000_000, 2)) @ root.T, 0.5 + 0.2 + 0.3 * rng.normal(size=1_000_000)
    c, s = np.cos(angle), np.sin(angle)
    y = np.stack([x[:, 0] * c - x[:, 1] * s, x[:, 0] * s + x[:, 1] * c], axis=1)
    found = moments_of(model.predict(GaussHermite(8), jnp.asarray(mean), jnp.asarray(root), 0.5))
    cross = (x - mean).T @ (y - y.mean(axis=0)) / len(y)
    # Standard errors at a million draws of size 1 are about 1e-3.
    for ours, theirs in zip(found, (y.mean(axis=0), np.cov(y.T), cross), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-2)


def drawn(model, count=20_000):
    def draw(key):
        series, states = simulate(model, TIMES[:3], key)
        return series.readings, states

    return (np.asarray(one) for one in jax.jit(jax.vmap(draw))(jax.random.split(jax.random.key(8), count)))


@pytest.mark.slow
def test_simulated_recordings_have_the_models_moments():
    """20,000 recordings of a linear model with noise of four kinds have its closed means and covariances."""
    A, H, Q, R, m0, P0 = cases.linear_system()
    factor, shift = Gamma([25.0, 16.0], [0.04, 0.05]), Uniform([0.0, -1.0], [1.0, 1.0])
    initial = Gaussian(jnp.asarray(m0), jnp.asarray(P0))
    noises = WienerIncrement(Dense(Q)), Multiplicative(factor, Additive(shift))
    model = StateSpaceModel(cases.Linear(jnp.asarray(A)), LinearObservation(jnp.asarray(H)), *noises, initial)
    readings, states = drawn(model)
    m, P = m0, P0
    for _ in range(2):
        m, P = A @ m, A @ P @ A.T + Q
    error = np.sqrt(np.diag(P) / len(states))
    assert np.all(np.abs(states[:, -1].mean(axis=0) - m) < 4 * error)
    # The standard error of a covariance is at most sqrt(2 P_ii P_jj / n).
    scale = np.sqrt(2 * np.outer(np.diag(P), np.diag(P)) / len(states))
    assert np.all(np.abs(np.cov(states[:, -1].T) - P) < 4 * scale)
    wbar, W = np.array([1.0, 0.8]), np.diag([25 * 0.04**2, 16 * 0.05**2])
    E, V = H @ m, H @ P @ H.T
    mean = E * wbar + [0.5, 0.0]
    covariance = V * (W + np.outer(wbar, wbar)) + np.outer(E, E) * W + np.diag([1 / 12, 4 / 12])
    assert np.all(np.abs(readings[:, -1].mean(axis=0) - mean) < 4 * np.sqrt(np.diag(covariance) / len(states)))
    scale = np.sqrt(2 * np.outer(np.diag(covariance), np.diag(covariance)) / len(states))
    # Products have heavier tails than a Gaussian: half as much again.
    assert np.all(np.abs(np.cov(readings[:, -1].T) - covariance) < 6 * scale)
    general, _ = drawn(
        HiddenMarkovModel(
            Added(model.dynamics), Multiplied(model.observation), MultivariateNormal(jnp.zeros(3), Dense(Q)), factor,
            initial,
        )
    )  # fmt: skip
    assert np.all(np.abs(general[:, -1].mean(axis=0) - E * wbar) < 4 * np.sqrt(np.diag(covariance) / len(states)))


def test_what_cannot_be_drawn_is_refused():
    """Noise that is too short, a model without a start and one that escapes get one sentence."""
    system = cases.linear_system()
    model, key = cases.as_model(*system), jax.random.key(0)
    short = eqx.tree_at(lambda m: m.measurement_noise, model, Multiplicative(Uniform(0.9, 1.1)))
    with pytest.raises(InputError, match="dim=2"):
        simulate(short, TIMES, key)
    with pytest.raises(InputError, match="initial"):
        simulate(StateSpaceModel(model.dynamics, model.observation, *2 * [model.process_noise]), TIMES, key)
    with pytest.raises(InputError, match="not finite from t = 2"):
        simulate(cases.as_model(1e200 * system[0], *system[1:]), TIMES, key)
    for times in (TIMES[::-1], TIMES.at[-1].set(jnp.inf)):
        with pytest.raises(InputError, match="finite times that strictly increase"):
            simulate(model, times, key)
    with pytest.raises(InputError, match=r"inputs \(n, input\) or None, but was given shapes \(12,\) and \(12,\)"):
        simulate(model, TIMES, key, inputs=TIMES)


def test_paths_of_the_general_form_are_refused_for_what_it_is():
    """A general model's noise cannot be left out of a path: the sentence says so and names `forecast`, which serves."""
    system = cases.linear_system()
    model, ys = cases.as_model(*system), jnp.asarray(recorded(system))
    ends = []
    for one in (model, with_added_noise(model)):
        estimate = Estimate(one, TimeSeries(TIMES, ys), MarginalLikelihood(), Prior(Flat()), *[0.0] * 4, True, 0)
        ends.append(forecast(estimate, until=N + 2.0))
    assert_same(ends[1], ends[0], atol=1e-11)  # sigma points of a linear map: round-off, and weights of some units
    with pytest.raises(
        InputError, match="of a `StateSpaceModel`, but the model is `HiddenMarkovModel`; use `forecast`"
    ):
        stochastic_forecast(estimate, until=N + 2.0, key=jax.random.key(0))
