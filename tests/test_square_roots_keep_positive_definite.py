"""The square-root filter keeps a right, positive definite covariance where the covariance form has lost it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy

from symplearn._filter import kalman_filter
from symplearn._model import Gaussian, Interval, LinearDynamics, LinearObservation, StateSpaceModel
from symplearn._noise import AdditiveGaussian, ScaledIdentity
from symplearn._triangular import forward_substitution, semidefinite_cholesky, triangularise

# 1 + EPSILON^2 is 1 in double precision: the textbook case of Bierman (1977) and Verhaegen and Van Dooren (1986).
EPSILON = 2.0**-27


def exact_posterior():
    """Covariance given two nearly equal, precise readings, in rational arithmetic."""
    e = sympy.Rational(1, 2**27)
    H = sympy.Matrix([[1, 1, 1], [1, 1, 1 + e]])
    S = H * H.T + e**2 * sympy.eye(2)
    return np.array((sympy.eye(3) - H.T * S.inv() * H).evalf(30).tolist(), dtype=float)


def readings_matrix():
    return np.array([[1.0, 1.0, 1.0], [1.0, 1.0, 1.0 + EPSILON]])


def test_nearly_equal_precise_readings_leave_the_right_covariance():
    """Where the textbook's P - K S K' has no digit left, the filter has the rational result to 1e-7."""
    H, truth = readings_matrix(), exact_posterior()
    noises = AdditiveGaussian(ScaledIdentity(0.0, 3)), AdditiveGaussian(ScaledIdentity(EPSILON**2, 2))
    model = StateSpaceModel(
        LinearDynamics(jnp.eye(3)), LinearObservation(jnp.asarray(H)), *noises, Gaussian(jnp.zeros(3), jnp.eye(3))
    )
    once = Interval(jnp.zeros(1), jnp.ones(1))
    ys = jnp.array([[0.0, 0.0], [jnp.nan, jnp.nan]])
    found = np.asarray(kalman_filter(model, ys, once).filtered_covariances[0])
    # The readings tell the difference of two numbers to 2^-27; its square root is what double precision keeps.
    np.testing.assert_allclose(found, truth, atol=1e-7)
    # L L' is semidefinite; forming it, and eigvalsh, round to a few 1e-16 of the largest entry.
    assert np.linalg.eigvalsh(found).min() > -1e-15
    S = H @ H.T + EPSILON**2 * np.eye(2)
    with np.errstate(all="ignore"):
        textbook = np.eye(3) - H.T @ np.linalg.pinv(S, rcond=0) @ H
    assert np.abs(textbook - truth).max() > 0.1


def test_ten_thousand_precise_readings_never_lose_it():
    """After 10,000 updates with noises twelve orders apart every covariance still has no negative eigenvalue."""
    n, A = 10_000, np.array([[1.0, 1.0], [0.0, 1.0]])
    noises = AdditiveGaussian(ScaledIdentity(1e-16, 2)), AdditiveGaussian(ScaledIdentity(1e-12, 1))
    parts = LinearDynamics(jnp.asarray(A)), LinearObservation(jnp.eye(1, 2))
    model = StateSpaceModel(*parts, *noises, Gaussian(jnp.zeros(2), 1e6 * jnp.eye(2)))
    spans = Interval(jnp.arange(n - 1.0), jnp.arange(1.0, n))
    found = jax.jit(kalman_filter)(model, jnp.zeros((n, 1)), spans)
    covariances = np.asarray(found.filtered_covariances)
    smallest = np.linalg.eigvalsh(covariances)[:, 0] / np.trace(covariances, axis1=1, axis2=2)
    assert bool(found.ok) and smallest.min() > -1e-15
    assert np.array_equal(covariances, np.swapaxes(covariances, 1, 2))


@pytest.mark.parametrize("shape", [(1, 3), (4, 4), (5, 12), (20, 45), (140, 300)])
def test_triangularise_is_qr(shape):
    """L is lower triangular with positive diagonal and L L' = M M', as NumPy's QR of M' has it."""
    M = np.random.default_rng(0).normal(size=shape) * np.logspace(0, -6, shape[0])[:, None]
    L, good = triangularise(jnp.asarray(M))
    R = np.linalg.qr(M.T, mode="r")
    expected = (R * np.sign(np.diagonal(R))[:, None]).T
    np.testing.assert_allclose(np.asarray(L) / np.logspace(0, -6, shape[0])[:, None],
                               expected / np.logspace(0, -6, shape[0])[:, None], atol=1e-13)  # fmt: skip
    assert bool(jnp.all(good)) and np.array_equal(L, np.tril(L))


@pytest.mark.parametrize("shape", [(1, 3), (4, 9), (20, 25)])
def test_its_derivatives_are_those_of_a_cholesky_factor(shape):
    """First derivatives in both modes, and second ones, in a batch, are JAX's own of the Cholesky factor of M M'."""
    M, way = (jnp.asarray(np.random.default_rng(k).normal(size=(3, *shape))) for k in (0, 1))

    def slopes(root):
        def along(M, way):
            return jax.jvp(root, (M,), (way,))[1]

        def weighed(M, way):
            return jnp.sum(jnp.sin(root(M)) * (1.0 + root(way)))

        return jax.jit(jax.vmap(lambda M, way: (
            along(M, way), jax.grad(weighed)(M, way), jax.jvp(jax.grad(weighed), (M, way), (way, M))[1]
        )))(M, way)  # fmt: skip

    ours = slopes(lambda M: triangularise(M)[0])
    theirs = slopes(lambda M: jnp.linalg.cholesky(M @ M.T))
    for one, other in zip(ours, theirs, strict=True):
        # Round-off of a M M' of condition up to 250: 4e-15 of the largest entry was seen.
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-13 * np.abs(other).max())


def test_dependent_rows_get_a_zero_column():
    """A row that repeats another adds no pivot, and the derivative is that of the pivots there are."""
    M = jnp.array([[1.0, 2.0, 0.0], [2.0, 4.0, 0.0], [0.0, 0.0, 0.0], [0.0, 1.0, 1.0]])
    L, good = triangularise(M)
    # Entries of up to 20, products of a few terms: round-off of some 1e-15.
    np.testing.assert_allclose(L @ L.T, M @ M.T, atol=1e-14)
    assert good.tolist() == [True, False, False, True] and not np.any(L[:, 1:3])
    slope = jax.jacrev(lambda M: triangularise(M)[0])(M)
    assert not np.any(slope[:, 1:3])

    def of_pivots(M):
        return jnp.linalg.cholesky(M[np.array([0, 3])] @ M[np.array([0, 3])].T)

    np.testing.assert_allclose(slope[np.ix_([0, 3], [0, 3])], jax.jacrev(of_pivots)(M), atol=1e-14)
    # The repeated row's entry is its product with the unit row along the first one.
    expected = jax.jacrev(lambda M: M[1] @ M[0] / jnp.linalg.norm(M[0]))(M)
    np.testing.assert_allclose(slope[1, 0], expected, atol=1e-14)


@pytest.mark.parametrize("size", [140, 550])
def test_many_rows_go_by_panels(size):
    """Of more rows than go one by one, one repeated, one of zeros and one a sum of two in other panels: L L' is M M',
    their pivots alone are zero; a slope is that of the Cholesky factor of the other rows."""
    rng = np.random.default_rng(size)
    M, way = rng.normal(size=(2, size, size + 9))
    M[50], M[70], M[size - 3] = 2.0 * M[3], 0.0, M[1] + M[40]
    (L, good), (slope, _) = jax.jvp(jax.jit(triangularise), (jnp.asarray(M),), (jnp.asarray(way),))
    assert np.flatnonzero(~np.asarray(good)).tolist() == [50, 70, size - 3] and np.array_equal(L, np.tril(L))
    # Sums of some hundred products of size one: round-off of 1e-13.
    np.testing.assert_allclose(L @ L.T, M @ M.T, atol=1e-11)
    kept = jnp.asarray(np.flatnonzero(good))
    assert not np.any(np.asarray(L)[:, ~np.asarray(good)])

    def root(M):
        return jnp.linalg.cholesky(M[kept] @ M[kept].T)

    expected = jax.jvp(root, (jnp.asarray(M),), (jnp.asarray(way),))[1]
    # Rows that are left out turn directions of none; a matrix of condition some thousands costs four digits.
    np.testing.assert_allclose(slope[np.ix_(kept, kept)], expected, atol=1e-9)


def test_forward_substitution_solves():
    """L e = r, with a zero on the diagonal counted as a missing channel."""
    L, r = np.array([[2.0, 0.0, 0.0], [1.0, 3.0, 0.0], [-1.0, 0.5, 0.7]]), np.array([1.0, -2.0, 0.3])
    np.testing.assert_allclose(L @ forward_substitution(jnp.asarray(L), jnp.asarray(r)), r, atol=1e-15)
    missing = np.array([[2.0, 0.0, 0.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 0.7]])
    e = forward_substitution(jnp.asarray(missing), jnp.array([1.0, 0.0, 0.3]))
    np.testing.assert_allclose(e, [0.5, 0.0, 0.8 / 0.7], atol=1e-15)


def test_factors_of_semidefinite_matrices():
    """Singular covariances have a factor, zero ones too; indefinite ones give NaN, for the filter to report."""
    half = np.random.default_rng(1).normal(size=(5, 3))
    L = np.asarray(semidefinite_cholesky(jnp.asarray(half @ half.T)))
    np.testing.assert_allclose(L @ L.T, half @ half.T, atol=1e-12)
    assert not np.any(semidefinite_cholesky(jnp.zeros((3, 3))))
    for wrong in ([[1.0, 2.0], [2.0, 1.0]], [[0.0, 1.0], [1.0, 0.0]], [[-1.0, 0.0], [0.0, 1.0]]):
        assert bool(jnp.any(jnp.isnan(semidefinite_cholesky(jnp.array(wrong)))))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("rows", [3, 20, 140])
def test_round_off_is_no_pivot_in_either_precision(rows, dtype):
    """The last row, a sum of two others that rounds, adds no pivot in single precision either, and all others do; and
    the covariance of such rows has a factor, with a column of zeros, where an indefinite one has none."""
    M = np.random.default_rng(rows).normal(size=(rows, rows + 9)).astype(dtype)
    M[-1] = dtype(0.3) * M[0] + dtype(0.7) * M[1]
    L, good = triangularise(jnp.asarray(M))
    assert L.dtype == dtype and good.tolist() == [True] * (rows - 1) + [False]
    P = M[[0, 1, -1]] @ M[[0, 1, -1]].T
    root = np.asarray(semidefinite_cholesky(jnp.asarray(P)))
    assert root.dtype == dtype and not np.any(root[:, 2])
    # What is dropped is round-off of the products.
    np.testing.assert_allclose(root @ root.T, P, atol=10 * np.finfo(dtype).eps * np.abs(P).max())
    assert np.any(np.isnan(semidefinite_cholesky(jnp.array([[1.0, 1.1], [1.1, 1.0]], dtype))))
