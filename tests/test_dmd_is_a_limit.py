"""Dynamic mode decomposition is the limit of exact readings of the marginal likelihood. Theorem 3."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import minimize

from symplearn._dynamic_modes import dmd, total_dmd
from symplearn._errors import InputError
from symplearn._filter import log_likelihood
from symplearn._model import FullState, Gaussian, LinearDynamics, StateSpaceModel, intervals_between
from symplearn._noise import AdditiveGaussian, Dense, ScaledIdentity
from symplearn._objectives import TimeSeries

D, N = 3, 30
GAMMAS = (1e-6, 1e-8, 1e-10)
SIGMAS = {
    "identity": np.eye(D),
    "diagonal": np.diag([0.3, 0.1, 0.2]),
    "dense": np.array([[0.5, 0.2, -0.1], [0.2, 0.3, 0.05], [-0.1, 0.05, 0.4]]),
}


def nonlinear_readings(n=N, d=D, seed=0):
    """Rows of a noisy nonlinear map, so that no linear model is true."""
    rng = np.random.default_rng(seed)
    M = rng.normal(size=(d, d)) / np.sqrt(d)
    rows = [rng.normal(size=d)]
    for _ in range(n):
        rows.append(np.sin(M @ rows[-1]) + 0.5 * rng.normal(size=d))
    return np.array(rows)


YS = nonlinear_readings()


def series(readings, dt=0.1, inputs=None):
    return timed(dt * np.arange(len(readings)), readings, inputs)


def timed(times, readings, inputs=None):
    return TimeSeries(jnp.asarray(times), jnp.asarray(readings), None if inputs is None else jnp.asarray(inputs))


def least_squares(before, after):
    """The textbook solution by NumPy, as a matrix from earlier to later rows."""
    return np.linalg.lstsq(before, after, rcond=None)[0].T


A_DMD = least_squares(YS[:-1], YS[1:])
RESIDUALS = YS[1:] - YS[:-1] @ A_DMD.T


@jax.jit
@jax.value_and_grad
def score(matrices, gamma):
    """-log L of (A, Sigma) given the first reading, for readings with errors of variance gamma, and its slopes."""
    A, Sigma = matrices
    readings = jnp.asarray(YS)
    noises = AdditiveGaussian(Dense(Sigma)), AdditiveGaussian(ScaledIdentity(gamma, D))
    model = StateSpaceModel(LinearDynamics(A), FullState(), *noises, Gaussian(readings[0], jnp.eye(D)))
    spans = intervals_between(0.1 * jnp.arange(N + 1.0))
    # The first reading is at the mean of the initial distribution: its own term is a constant.
    first = -0.5 * D * jnp.log(2 * jnp.pi * (1.0 + gamma))
    return first - log_likelihood(model, readings, spans)


@pytest.mark.parametrize("sigma", SIGMAS)
def test_the_slope_at_dmd_vanishes_with_the_reading_noise(sigma):
    """At A_DMD the gradient of -log L by A falls linearly with Gamma, whatever the fixed Sigma."""
    A = jnp.asarray(dmd(series(YS)).A)
    slopes = [np.abs(score((A, SIGMAS[sigma]), gamma)[1][0]).max() for gamma in GAMMAS]
    # Linear to first order in Gamma / Sigma: the ratio of two decades is 100. Round-off of a sum of 30 terms of size 10
    # over a variance of 0.1 is 1e-12, below the last slope.
    assert slopes[0] > 1e-7
    np.testing.assert_allclose([slopes[0] / slopes[1], slopes[1] / slopes[2]], 100.0, rtol=0.05)


def test_the_likelihood_is_the_residual_sum():
    """With Sigma = I and Gamma to 0, log L = -1/2 sum ||y_k - A y_{k-1}||^2 - (n d / 2) log 2 pi: (3.9), for any A."""
    rng = np.random.default_rng(1)
    for A in (A_DMD, np.zeros((D, D)), rng.normal(size=(D, D))):
        residual = np.sum((YS[1:] - YS[:-1] @ A.T) ** 2)
        value = score((jnp.asarray(A), jnp.eye(D)), 1e-12)[0]
        # The next term is Gamma times a sum of some hundreds.
        assert float(-value) == pytest.approx(-0.5 * residual - 0.5 * N * D * np.log(2 * np.pi), abs=1e-8)


def test_dmd_and_the_residual_covariance_are_stationary_together():
    """With Sigma learnt too, (A_DMD, residual covariance) is where both gradients vanish with Gamma."""
    both = (jnp.asarray(A_DMD), jnp.asarray(RESIDUALS.T @ RESIDUALS / N))
    slopes = [[np.abs(slope).max() for slope in score(both, gamma)[1]] for gamma in GAMMAS]
    # As above; the slope by Sigma divides by the variance once more.
    np.testing.assert_allclose(np.divide(slopes[0], slopes[1]), 100.0, rtol=0.05)
    np.testing.assert_allclose(np.divide(slopes[1], slopes[2]), 100.0, rtol=0.05)


def descend(start, unpack, gamma=1e-10):
    """SciPy's BFGS on -log L, with the gradient by automatic differentiation."""

    def scored(free):
        matrices, pull = jax.vjp(unpack, jnp.asarray(free))
        value, slopes = score(matrices, gamma)
        return float(value), np.asarray(pull(slopes)[0])

    found = minimize(scored, start, jac=True, method="BFGS", options={"gtol": 1e-6, "maxiter": 500})
    return unpack(jnp.asarray(found.x))


@pytest.mark.parametrize("sigma", SIGMAS)
def test_a_descent_from_elsewhere_ends_at_dmd(sigma):
    """The maximum likelihood A for small Gamma, found by descent from 0, is A_DMD, whatever the fixed Sigma."""
    A, _ = descend(np.zeros(D * D), lambda free: (free.reshape(D, D), jnp.asarray(SIGMAS[sigma])))
    # A slope of 1e-6 over a curvature of at least 1 (30 rows of variance 0.3 over a variance of at most 1).
    np.testing.assert_allclose(A, dmd(series(YS)).A, atol=1e-6)


def test_a_descent_in_both_ends_at_dmd_and_the_residual_covariance():
    """The joint maximum likelihood of A and Sigma is A_DMD and the residual covariance: a profile likelihood."""
    lower = np.tril_indices(D)

    def unpack(free):
        L = jnp.zeros((D, D)).at[lower].set(free[D * D :])
        return free[: D * D].reshape(D, D), L @ L.T

    A, Sigma = descend(np.concatenate([np.zeros(D * D), np.eye(D)[lower]]), unpack)
    np.testing.assert_allclose(A, A_DMD, atol=1e-6)
    np.testing.assert_allclose(Sigma, RESIDUALS.T @ RESIDUALS / N, atol=1e-6)


@pytest.mark.parametrize(("n", "d"), [(2, 1), (5, 5), (20, 2), (50, 7), (200, 20)])
def test_dmd_is_least_squares(n, d):
    """On random readings A is NumPy's least squares solution."""
    ys = np.random.default_rng(n + d).normal(size=(n + 1, d))
    model = dmd(series(ys))
    assert model.B is None
    # Round-off times the condition of the square case.
    np.testing.assert_allclose(model.A, least_squares(ys[:-1], ys[1:]), atol=1e-11)


@pytest.mark.parametrize("decompose", [dmd, total_dmd])
def test_recordings_are_pooled_without_their_seam(decompose):
    """Of several recordings the pairs are pooled; a recording cut in two, with its shared row, loses nothing."""
    whole = decompose(series(YS)).A
    cut = decompose([series(YS[:11]), series(YS[10:])]).A
    np.testing.assert_allclose(cut, whole, atol=1e-12)  # round-off
    other = nonlinear_readings(n=12, seed=3)
    pooled = dmd((series(YS), series(other))).A
    expected = least_squares(np.vstack([YS[:-1], other[:-1]]), np.vstack([YS[1:], other[1:]]))
    np.testing.assert_allclose(pooled, expected, atol=1e-12)


@pytest.mark.parametrize("decompose", [dmd, total_dmd])
def test_pairs_with_a_missing_reading_are_dropped(decompose):
    """A row with a missing reading takes the pairs before and after it along, and nothing else."""
    holes = YS.copy()
    holes[7, 1] = np.nan
    holes[20] = np.nan
    parts = [series(YS[:7]), series(YS[8:20]), series(YS[21:])]
    np.testing.assert_allclose(decompose(series(holes)).A, decompose(parts).A, atol=1e-12)


def test_the_inputs_have_their_own_matrix():
    """With inputs, A and B are the least squares solution of y_k = A y_{k-1} + B u_{k-1}."""
    rng = np.random.default_rng(5)
    us, A, B = rng.normal(size=(N + 1, 2)), 0.5 * rng.normal(size=(D, D)), rng.normal(size=(D, 2))
    ys = [rng.normal(size=D)]
    for u in us[:-1]:
        ys.append(A @ ys[-1] + B @ u)
    exact = dmd(series(np.array(ys), inputs=us), control=True)
    np.testing.assert_allclose(exact.A, A, atol=1e-11)  # no noise: round-off alone
    np.testing.assert_allclose(exact.B, B, atol=1e-11)
    found = dmd(series(YS, inputs=us), control=True)
    expected = least_squares(np.hstack([YS, us])[:-1], YS[1:])
    np.testing.assert_allclose(np.hstack([found.A, found.B]), expected, atol=1e-12)


def test_a_low_rank_keeps_the_modes_of_many_channels():
    """Of 40 channels that follow 3 modes, 11 rows give the 3 eigenvalues at rank 3, and are too few without."""
    rng = np.random.default_rng(6)
    modes = np.array([0.9, 0.8 * np.exp(0.7j), 0.8 * np.exp(-0.7j)])
    shapes = rng.normal(size=(40, 2)) @ np.array([[1.0], [1.0j]])
    shapes = np.hstack([rng.normal(size=(40, 1)), shapes, shapes.conj()])
    ys = np.real(np.array([shapes @ modes**k for k in range(11)]))
    for decompose in (dmd, total_dmd):
        with pytest.raises(InputError, match="span .* directions, but 40 are needed"):
            decompose(series(ys))
        found = np.linalg.eigvals(np.asarray(decompose(series(ys), rank=3).A))
        leading = found[np.argsort(-np.abs(found))]
        # Exact data: round-off times the condition of ten powers of the modes. The other 37 are 0.
        np.testing.assert_allclose(np.sort_complex(leading[:3]), np.sort_complex(modes), atol=1e-8)
        assert np.abs(leading[3:]).max() < 1e-8


def test_total_dmd_is_total_least_squares():
    """A is U_21 U_11^-1 of the left singular vectors of [Y_0; Y_1]: the textbook's total least squares (Van Huffel)."""
    U = np.linalg.svd(np.vstack([YS[:-1].T, YS[1:].T]))[0]
    expected = U[D:, :D] @ np.linalg.inv(U[:D, :D])
    np.testing.assert_allclose(total_dmd(series(YS)).A, expected, atol=1e-12)  # round-off
    exact = np.array([np.linalg.matrix_power(A_DMD, k) @ YS[0] for k in range(5)])
    # Without errors both are the truth. Five powers of a stable matrix lose some digits to its condition.
    np.testing.assert_allclose(total_dmd(series(exact)).A, A_DMD, atol=1e-9)
    np.testing.assert_allclose(dmd(series(exact)).A, A_DMD, atol=1e-9)


def test_total_dmd_is_the_less_biased_with_noise_on_the_readings():
    """Over 200 recordings of a rotation with errors, `total_dmd` has no bias that is seen, and `dmd` has."""
    A = expm(0.1 * np.array([[-0.02, 1.0], [-1.0, -0.02]]))
    path = np.array([np.linalg.matrix_power(A, k) @ [1.0, 0.0] for k in range(201)])
    rng = np.random.default_rng(7)
    noisy = [series(path + 0.1 * rng.normal(size=path.shape)) for _ in range(200)]
    errors = {f: np.array([np.asarray(f(one).A) - A for one in noisy]) for f in (dmd, total_dmd)}
    bias = {f: np.abs(error.mean(axis=0)).max() for f, error in errors.items()}
    standard_error = errors[total_dmd].std(axis=0).max() / np.sqrt(len(noisy))
    # Least squares shrinks A by noise variance / signal variance = 0.01 / 0.1, some 5 to 10 percent of its entries.
    assert bias[dmd] > 0.02
    assert bias[total_dmd] < 4 * standard_error
    assert bias[total_dmd] < 0.1 * bias[dmd]


UNEVEN = timed([0.0, 0.1, 0.2, 0.4, 0.5], nonlinear_readings(n=4))
TWINS = np.repeat(YS[:, :1], 2, axis=1)
DRIVEN = series(YS, inputs=np.ones((N + 1, 1)))


@pytest.mark.parametrize("decompose", [dmd, total_dmd])
@pytest.mark.parametrize(
    ("recordings", "sentence"),
    [
        (UNEVEN, "they last from 0.1 to 0.2"),
        ([series(YS, 0.1), series(YS[:3], 0.2)], "they last from 0.1 to 0.2"),
        (series(YS[:3]), "complete pairs of readings span 2 directions, but 3 are needed"),
        (series(TWINS), "complete pairs of readings span 1 directions, but 2 are needed"),
        (series(np.full((5, 2), np.nan)), "no complete pair"),
        (series(np.zeros((5, 2))), "no complete pair of readings that are not all zero"),
        ([series(YS), series(YS[:, :2])], "different numbers of channels"),
        ([series(YS), DRIVEN], "different numbers of inputs"),
        (DRIVEN, "have inputs, which this decomposition would ignore"),
        ([], "give one, or a list of at least one"),
    ],
)
def test_what_cannot_be_decomposed_is_refused(decompose, recordings, sentence):
    """Uneven spacing, too few pairs and recordings that do not belong together are refused in one sentence."""
    with pytest.raises(InputError, match=sentence):
        decompose(recordings)


def test_times_rounded_in_a_file_are_even():
    """Times printed with few digits still count as evenly spaced."""
    rounded = timed(np.round(np.arange(N + 1) / 3.0, 2), YS)
    np.testing.assert_array_equal(dmd(rounded).A, dmd(series(YS)).A)


def test_options_that_do_not_fit_are_refused():
    """A rank below one or above what the readings span, and control without inputs, are refused."""
    for decompose in (dmd, total_dmd):
        with pytest.raises(InputError, match="at least 1, but is 0"):
            decompose(series(YS), rank=0)
        with pytest.raises(
            InputError, match="3 directions, but 4 are needed; give more rows, or a `rank` of at most 3"
        ):
            decompose(series(YS), rank=4)
    with pytest.raises(InputError, match="the recordings have no inputs"):
        dmd(series(YS), control=True)
