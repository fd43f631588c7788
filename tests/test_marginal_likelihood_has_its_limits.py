"""As one noise vanishes the marginal likelihood becomes simulation error or one-step prediction error."""

import equinox as eqx
import estimation_cases as cases
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

import integrators as ig
from symplearn._filter import log_likelihood
from symplearn._model import (
    Coordinates,
    Gaussian,
    LinearObservation,
    Propagator,
    StateSpaceModel,
    intervals_between,
)
from symplearn._noise import AdditiveGaussian, Dense

N, SD = 12, 0.2
TIMES = jnp.linspace(0.0, 5.5, N)
DYNAMICS = Propagator(ig.problems.Pendulum(gravity=1.0), ig.Leapfrog(), substeps=10)
START = np.array([1.5, 0.0])


def path():
    """The simulation alone, from the known start."""
    return np.asarray(ig.integrate(DYNAMICS.system, ig.Leapfrog(), jnp.asarray(START), TIMES, substeps=10).xs)


@jax.jit
def score(ys, Q, R, P0, H, m0):
    noises = AdditiveGaussian(Dense(Q)), AdditiveGaussian(Dense(R))
    model = StateSpaceModel(DYNAMICS, LinearObservation(H), *noises, Gaussian(m0, P0))
    return log_likelihood(model, ys, intervals_between(TIMES))


def simulation_score(ys):
    return multivariate_normal(cov=SD**2).logpdf(ys[:, 0] - path()[:, 0]).sum()


def noisy_angle():
    return path()[:, :1] + SD * np.random.default_rng(0).normal(size=(N, 1))


def test_theorem_1_no_process_noise_gives_simulation_error():
    """With the start known and the process noise at zero, the score is that of the free run (Theorem 1)."""
    ys, H, zero = noisy_angle(), np.eye(1, 2), np.zeros((2, 2))
    found = float(score(ys, zero, SD**2 * np.eye(1), zero, H, START))
    assert found == pytest.approx(simulation_score(ys), abs=1e-11)


def test_theorem_1_is_approached_linearly():
    """The distance to the free run falls a hundredfold for each hundredfold in the process noise."""
    ys, H = noisy_angle(), np.eye(1, 2)
    gaps = [
        float(score(ys, e * np.eye(2), SD**2 * np.eye(1), e * np.eye(2), H, START)) - simulation_score(ys)
        for e in (1e-6, 1e-8, 1e-10)
    ]
    # First order in the noise: the next order is e times smaller; round-off is 1e-12 of gaps down to 1e-7.
    assert gaps[0] / gaps[1] == pytest.approx(100, abs=1) and gaps[1] / gaps[2] == pytest.approx(100, abs=1)


def test_theorem_1_for_linear_models_is_exact():
    """The same holds for a linear model and all its channels, to round-off."""
    zero = np.zeros((3, 3))
    A, H, _, R, m0, _ = system = cases.linear_system(zero, zero)
    ys = cases.simulate(*system, N, np.random.default_rng(1))[1]
    free = np.array([H @ np.linalg.matrix_power(A, k) @ m0 for k in range(N)])
    expected = multivariate_normal(cov=R).logpdf(ys - free).sum()
    found = log_likelihood(cases.as_model(*system), jnp.asarray(ys), intervals_between(TIMES))
    assert float(found) == pytest.approx(expected, abs=1e-11)


def test_theorem_2_no_measurement_noise_gives_one_step_prediction_error():
    """As the noise of an invertible reading vanishes, the score tends to that of one-step predictions."""
    rng, H, Q = np.random.default_rng(2), np.array([[1.0, 0.3], [-0.2, 0.8]]), np.diag([0.02, 0.05])
    P0 = 0.1 * np.eye(2)
    ys = path() @ H.T + 0.2 * rng.normal(size=(N, 2))
    xs = np.linalg.solve(H, ys.T).T
    ahead = np.array([DYNAMICS(jnp.asarray(x), _interval(k)) for k, x in enumerate(xs[:-1])])
    expected = multivariate_normal(START, P0).logpdf(xs[0]) - N * np.log(abs(np.linalg.det(H)))
    expected += multivariate_normal(cov=Q).logpdf(xs[1:] - ahead).sum()
    gaps = [float(score(ys, Q, g * np.eye(2), P0, H, START)) - expected for g in (1e-6, 1e-8, 1e-10)]
    # Linear decay, ratio 100 within 5 per two decades (specification, T2); 1e-10 leaves less than 1e-6.
    assert gaps[0] / gaps[1] == pytest.approx(100, abs=5) and gaps[1] / gaps[2] == pytest.approx(100, abs=5)
    assert abs(gaps[2]) < 1e-6


def _interval(k):
    return jax.tree.map(lambda leaf: leaf[k], intervals_between(TIMES))


def test_the_propagator_is_the_trajectory():
    """Chained over data intervals the propagator of the filter is the integrator's own trajectory."""
    x = jnp.asarray(START)
    for k in range(3):
        x = DYNAMICS(x, _interval(k))
    np.testing.assert_allclose(x, path()[3], atol=1e-13)
    assert np.array_equal(Coordinates((1, 0))(x), x[::-1])
    with pytest.raises(TypeError, match="separable"):
        Propagator(ig.problems.Cherry(), ig.Leapfrog())
    with pytest.raises(ValueError, match="at least one substep"):
        eqx.filter(Propagator(ig.problems.Cherry(), ig.Tao(), substeps=0), eqx.is_array)
