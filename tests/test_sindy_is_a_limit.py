"""SINDy with forward differences and an L1 penalty is the limit of exact readings of a MAP. Theorem 4, corrected."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import minimize

from symplearn._errors import InputError
from symplearn._filter import log_likelihood
from symplearn._model import FullState, Gaussian, Interval, StateSpaceModel, intervals_between
from symplearn._noise import AdditiveGaussian, ScaledIdentity
from symplearn._objectives import TimeSeries
from symplearn._prior import Laplace
from symplearn._reading_slopes import CentralDifference, ForwardDifference, TotalVariation
from symplearn._sparse_regression import ForwardEuler, PolynomialLibrary, SparseModel, sindy
from symplearn._sparsity import Lasso, SequentialThresholding

DT, N, MU = 0.1, 20, 1.0
CUBIC = PolynomialLibrary(2, 3)


def van_der_pol(t, x):
    return [x[1], MU * (1 - x[0] ** 2) * x[1] - x[0]]


def lorenz(t, x):
    return [10 * (x[1] - x[0]), x[0] * (28 - x[2]) - x[1], x[0] * x[1] - 8 / 3 * x[2]]


def solved(rates, start, times):
    """SciPy's DOP853 at 1e-10 (time, state)."""
    return solve_ivp(rates, (times[0], times[-1]), start, "DOP853", times, rtol=1e-10, atol=1e-12).y.T


def series(times, readings, inputs=None):
    return TimeSeries(jnp.asarray(times), jnp.asarray(readings), None if inputs is None else jnp.asarray(inputs))


TIMES = DT * np.arange(N + 1)
YS = solved(van_der_pol, [0.0, 2.0], TIMES)


def monomials(ys):
    """The library (row, term) by NumPy, low degrees first."""
    x, v = ys.T
    return np.stack([x**0, x, v, x**2, x * v, v**2, x**3, x**2 * v, x * v**2, v**3], axis=1)


FEATURES, SLOPES = monomials(YS[:-1]), np.diff(YS, axis=0) / DT


def objective(theta, weight, features=FEATURES, slopes=SLOPES):
    """(4.3)."""
    return np.sum((slopes - features @ theta) ** 2) + weight * np.abs(theta).sum()


@jax.jit
@jax.value_and_grad
def minus_log_likelihood(theta):
    """-log L for exact readings and unit process noise, stepped by forward Euler, and its slope by theta."""
    # The next term in Gamma is 1e-13 times sums of some hundreds.
    noises = AdditiveGaussian(ScaledIdentity(1.0, 2)), AdditiveGaussian(ScaledIdentity(1e-13, 2))
    readings = jnp.asarray(YS)
    dynamics = ForwardEuler(SparseModel(theta, CUBIC))
    model = StateSpaceModel(dynamics, FullState(), *noises, Gaussian(readings[0], jnp.eye(2)))
    return -log_likelihood(model, readings, intervals_between(jnp.asarray(TIMES)))


RATE = 0.05  # lambda~ of the prior
WEIGHT = 2 * RATE / DT**2


def test_the_posterior_is_the_sindy_objective():
    """-log posterior = (dt^2 / 2) [sum ||.||^2 + (2 rate / dt^2) |theta|_1] + constant, over 20 random theta."""
    thetas = np.random.default_rng(0).normal(size=(20, 10, 2))
    prior = Laplace(1 / RATE)
    posterior = np.array(
        [
            float(minus_log_likelihood(jnp.asarray(theta))[0] - jnp.sum(prior.log_density(jnp.asarray(theta))))
            for theta in thetas
        ]
    )
    scaled = 0.5 * DT**2 * np.array([objective(theta, WEIGHT) for theta in thetas])
    difference = posterior - scaled
    assert difference.std() < 1e-9 * posterior.std()
    # As printed, (4.6) has dt / 2 and lambda = 2 rate / dt: then the difference is no constant at all.
    printed = 0.5 * DT * np.array([objective(theta, 2 * RATE / DT) for theta in thetas])
    assert (posterior - printed).std() > posterior.std()


def test_the_map_is_the_lasso():
    """Proximal gradient descent on the filter's own likelihood, with the prior's rate, ends at `Lasso`'s theta."""
    found = sindy(series(TIMES, YS), CUBIC, Lasso(WEIGHT))
    assert found.converged
    step = 1 / (DT**2 * np.linalg.eigvalsh(FEATURES.T @ FEATURES)[-1])
    theta, momentum, t = np.zeros((10, 2)), np.zeros((10, 2)), 1.0
    # FISTA (Beck and Teboulle 2009) with the restart of O'Donoghue and Candes.
    for _ in range(4000):
        trial = momentum - step * np.asarray(minus_log_likelihood(jnp.asarray(momentum))[1])
        new = np.sign(trial) * np.maximum(np.abs(trial) - step * RATE, 0.0)
        t = 1.0 if np.sum((momentum - new) * (new - theta)) > 0 else t
        later = 0.5 * (1 + np.sqrt(1 + 4 * t**2))
        theta, momentum, t = new, new + (t - 1) / later * (new - theta), later
    np.testing.assert_allclose(found.coefficients, theta, atol=1e-6)  # what Theorem 4's test asks
    assert 0 < np.count_nonzero(found.coefficients) < 20


@pytest.mark.parametrize("weight", [1e-6, 1e-2, 1.0, 100.0])
@pytest.mark.parametrize("name", ["van der pol", "random", "collinear"])
def test_the_lasso_is_optimal(name, weight):
    """2 X'(b - X theta) is weight * sign(theta) where theta is not 0 and at most the weight elsewhere."""
    rng = np.random.default_rng(1)
    X = {"van der pol": FEATURES, "random": rng.normal(size=(15, 30)), "collinear": np.repeat(FEATURES, 2, axis=1)}[
        name
    ]
    b = SLOPES[:, 1] if len(X) == N else rng.normal(size=15)
    theta, converged, _ = Lasso(weight)(X, b)
    assert converged
    pull, active = 2 * X.T @ (b - X @ theta), theta != 0
    # `Lasso` promises 1e-10 of the largest slope, 2 |X_i| |b|.
    allowed = 1e-9 * 2 * np.linalg.norm(X, axis=0) * np.linalg.norm(b)
    assert np.all(np.abs(pull - weight * np.sign(theta))[active] <= allowed[active])
    assert np.all(np.abs(pull)[~active] <= weight + allowed[~active])


def test_the_lasso_of_orthonormal_features_is_a_soft_threshold():
    """With X'X = I each coefficient is that of least squares, drawn towards 0 by half the weight: closed form."""
    rng = np.random.default_rng(2)
    X, b = np.linalg.qr(rng.normal(size=(12, 5)))[0], rng.normal(size=12)
    free = X.T @ b
    expected = np.sign(free) * np.maximum(np.abs(free) - 0.5, 0)
    assert 0 < np.count_nonzero(expected) < 5
    np.testing.assert_allclose(Lasso(1.0)(X, b)[0], expected, atol=1e-12)  # round-off
    np.testing.assert_allclose(Lasso(0.0)(X, b)[0], free, atol=1e-12)
    assert not np.any(Lasso(2 * np.abs(free).max() + 1e-9)(X, b)[0])


TRUE = {
    "van der pol": (van_der_pol, [0.5, 2.0], CUBIC, {"x0": {"x1": 1}, "x1": {"x0": -1, "x1": MU, "x0^2 x1": -MU}}),
    "lorenz": (
        lorenz,
        [2.0181, 3.5065, 11.8044],
        PolynomialLibrary(3, 2),
        {
            "x0": {"x0": -10, "x1": 10},
            "x1": {"x0": 28, "x1": -1, "x0 x2": -1},
            "x2": {"x0 x1": 1, "x2": -8 / 3},
        },
    ),
}


@pytest.mark.parametrize("system", TRUE)
def test_thresholding_finds_the_equations(system):
    """From 10 s of exact readings sequential thresholding finds the terms of Van der Pol and Lorenz, and no others."""
    rates, start, library, equations = TRUE[system]
    dt = {"van der pol": 0.01, "lorenz": 0.002}[system]
    times = dt * np.arange(round(10 / dt) + 1)
    model = sindy(series(times, solved(rates, start, times)), library, SequentialThresholding(0.1), CentralDifference())
    assert model.converged
    theta = np.zeros((len(model.terms), len(start)))
    for state, right in enumerate(equations.values()):
        for term, number in right.items():
            theta[model.terms.index(term), state] = number
    np.testing.assert_array_equal(np.asarray(model.coefficients) != 0, theta != 0)
    # Slopes err by dt^2 |x'''| / 6: some 1e-4 on Van der Pol and 1e-3 of the slope on Lorenz.
    np.testing.assert_allclose(model.coefficients, theta, rtol=5e-3)


def test_thresholding_refits_what_is_left():
    """The coefficients left are the (ridge) least squares solution on the terms left, all at least the threshold."""
    X, b, ridge = FEATURES, SLOPES[:, 1], 0.01
    theta, converged, _ = SequentialThresholding(0.3, ridge)(X, b)
    kept = theta != 0
    assert converged and 0 < kept.sum() < 10 and np.all(np.abs(theta[kept]) >= 0.3)
    expected = np.linalg.solve(X[:, kept].T @ X[:, kept] + ridge * np.eye(kept.sum()), X[:, kept].T @ b)
    np.testing.assert_allclose(theta[kept], expected, rtol=1e-9)  # round-off times the condition of X'X


def test_what_has_not_converged_says_so():
    """A lasso of one sweep and a thresholding of one step are flagged, in the record and where it prints."""
    for few, enough in (
        (Lasso(1e-4, max_sweeps=1), Lasso(1e-4)),
        (SequentialThresholding(0.3, max_steps=1), SequentialThresholding(0.3)),
    ):
        stopped, done = (sindy(series(TIMES, YS), CUBIC, penalty) for penalty in (few, enough))
        assert not stopped.converged and "NOT CONVERGED" in str(stopped)
        assert done.converged and "NOT" not in str(done) and done.steps > stopped.steps == 1


@pytest.mark.parametrize(("derivative", "order"), [(ForwardDifference(), 1), (CentralDifference(), 2)])
def test_differences_have_their_order(derivative, order):
    """On times spaced unevenly the largest error of a slope falls with the order said, at both ends too."""
    errors = []
    for n in (100, 200, 400):
        s = np.linspace(0, 1, n + 1)
        times = s + 0.3 * s**2
        points, slopes = derivative(times, np.sin(3 * times)[:, None])
        at = times[: len(points)]
        np.testing.assert_array_equal(points[:, 0], np.sin(3 * at))
        errors.append(np.abs(slopes[:, 0] - 3 * np.cos(3 * at)).max())
    # The next order is a hundredth at 100 rows.
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), order, atol=0.05)


def test_total_variation_minimises_its_objective():
    """The smoothed path is that of SciPy's minimiser on integral (x - y)^2 / 2 + weight * (variation of slopes)."""
    rng = np.random.default_rng(3)
    times, weight = np.cumsum(rng.uniform(0.5, 1.5, 9)), 0.3
    y = np.abs(times - 4) + 0.3 * rng.normal(size=9)
    gaps = np.diff(times)
    masses = 0.5 * (np.append(gaps, 0) + np.append(0, gaps))

    # Bounds t on the size of each jump make the problem smooth.
    def jumps(free):
        return np.diff(np.diff(free[:9]) / gaps)

    def loss(free):
        return 0.5 * masses @ (free[:9] - y) ** 2 + weight * free[9:].sum()

    bounds = [{"type": "ineq", "fun": lambda free, s=s: free[9:] + s * jumps(free)} for s in (-1, 1)]
    start = np.append(y, np.abs(jumps(y)))
    expected = minimize(loss, start, method="SLSQP", constraints=bounds, options={"ftol": 1e-14, "maxiter": 500}).x[:9]
    points, slopes = TotalVariation(weight)(times, y[:, None])
    # The duality gap of 1e-8 bounds the square of the path's error.
    np.testing.assert_allclose(slopes[:, 0], np.diff(expected) / gaps, atol=1e-4)
    np.testing.assert_allclose(points[:, 0], 0.5 * (expected[1:] + expected[:-1]), atol=1e-4)


def test_total_variation_has_its_limits():
    """A vanishing weight gives the differences of the readings, a large one a straight line; lines stay as they are."""
    y = YS + 0.1 * np.random.default_rng(4).normal(size=YS.shape)
    np.testing.assert_allclose(TotalVariation(1e-12)(TIMES, y)[1], np.diff(y, axis=0) / DT, atol=1e-6)
    slopes = TotalVariation(100.0)(TIMES, y)[1]
    masses = np.where((TIMES == 0) | (TIMES == TIMES[-1]), 0.5, 1.0)
    lines = np.polyfit(TIMES, y, 1, w=np.sqrt(masses))[0]
    np.testing.assert_allclose(slopes, np.tile(lines, (N, 1)), atol=1e-4)  # the duality gap
    for line in (np.zeros(3), 2 - 3 * TIMES[:3], 1e6 + TIMES):
        straight = TotalVariation(0.1)(TIMES[: len(line)], line[:, None])[1]
        np.testing.assert_allclose(straight, np.diff(line)[:, None] / DT, atol=1e-8)


def test_total_variation_is_for_noisy_readings():
    """With errors of 0.1 its slopes err five times less than differences, and thresholding finds the equations."""
    times = 0.01 * np.arange(2001)
    exact = solved(van_der_pol, [0.0, 2.0], times)
    noisy = exact + 0.1 * np.random.default_rng(5).normal(size=exact.shape)
    truth = np.array(van_der_pol(0, (0.5 * (exact[1:] + exact[:-1])).T)).T
    smoothed = TotalVariation(4e-4)
    errors = [
        np.sqrt(np.mean((slopes - truth) ** 2)) for slopes in (smoothed(times, noisy)[1], np.diff(noisy, axis=0) / 0.01)
    ]
    assert errors[0] < 0.05 * errors[1]
    model = sindy(series(times, noisy), CUBIC, SequentialThresholding(0.3), smoothed)
    names = [
        [term for term, number in zip(model.terms, column, strict=True) if number] for column in model.coefficients.T
    ]
    assert names == [["x1"], ["x0", "x1", "x0^2 x1"]]


def test_the_library_is_what_it_prints():
    """Features are the monomials in the order of their names, and a model prints as its equations."""
    assert CUBIC.terms == ("1", "x0", "x1", "x0^2", "x0 x1", "x1^2", "x0^3", "x0^2 x1", "x0 x1^2", "x1^3")
    np.testing.assert_allclose(jax.vmap(CUBIC)(jnp.asarray(YS)), monomials(YS), rtol=1e-14)  # round-off
    assert PolynomialLibrary(1, 2).terms == ("1", "x", "x^2")
    assert len(PolynomialLibrary(3, 4).terms) == 35
    theta = np.zeros((10, 2))
    theta[2, 0], theta[[0, 1, 7], 1] = 1.0, (0.25, -1.0, -3.0)
    assert str(SparseModel(jnp.asarray(theta), CUBIC)) == "x0' = +1 x1\nx1' = +0.25 -1 x0 -3 x0^2 x1"
    assert str(SparseModel(jnp.zeros((3, 1)), PolynomialLibrary(1, 2))) == "x' = 0"


def test_a_library_may_be_any_function():
    """The pendulum is found in a library of sines, with names or without."""
    times = 0.01 * np.arange(1001)
    swing = series(times, solved(lambda t, x: [x[1], -np.sin(x[0])], [2.0, 0.0], times))

    def sines(x):
        return jnp.array([x[0], x[1], jnp.sin(x[0]), jnp.cos(x[0])])

    penalty, slopes = SequentialThresholding(0.05), CentralDifference()
    model = sindy(swing, sines, penalty, slopes)
    # Slopes err by dt^2 / 6.
    np.testing.assert_allclose(model.coefficients, [[0, 0], [1, 0], [0, -1], [0, 0]], atol=1e-4)
    assert str(model).startswith("x0' = +0.9999") and "f2(x)" in str(model)
    sines.terms = ("q", "p", "sin q", "cos q")
    assert str(sindy(swing, sines, penalty, slopes)).endswith(" sin q")


def test_forward_euler_steps_the_field():
    """`ForwardEuler` is x + dt f(x), repeated over the substeps, and differentiates in reverse."""
    theta = np.random.default_rng(6).normal(size=(10, 2))
    span = Interval(jnp.asarray(1.0), jnp.asarray(1.3))

    def stepped(x, substeps):
        for _ in range(substeps):
            x = x + 0.3 / substeps * (monomials(x[None]) @ theta)[0]
        return x

    x = np.array([0.3, -0.2])
    for substeps in (1, 3):
        step = ForwardEuler(SparseModel(jnp.asarray(theta), CUBIC), substeps)
        np.testing.assert_allclose(step(jnp.asarray(x), span), stepped(x, substeps), rtol=1e-13)  # round-off
    # Central differences at 1e-5: truncation 1e-10, round-off 1e-11.
    central = [(stepped(x + h, 3) - stepped(x - h, 3)) / 2e-5 for h in 1e-5 * np.eye(2)]
    slope = jax.jit(jax.jacrev(lambda x: step(x, span)))(jnp.asarray(x))
    np.testing.assert_allclose(slope, np.array(central).T, atol=1e-8)
    with pytest.raises(InputError, match="`substeps` of at least 1"):
        ForwardEuler(step.field, 0)


def test_missing_rows_and_several_recordings_are_pooled():
    """What is left of a recording with holes is what its whole parts give, with each derivative."""
    holes = YS.copy()
    holes[7, 1] = np.nan
    parts = [series(TIMES[:7], YS[:7]), series(TIMES[8:], YS[8:])]
    expected = sindy(parts, CUBIC, Lasso(0.1)).coefficients
    np.testing.assert_allclose(sindy(series(TIMES, holes), CUBIC, Lasso(0.1)).coefficients, expected, atol=1e-9)
    # A parabola needs both neighbours; a smoothed path bridges the hole.
    assert np.isfinite(CentralDifference()(TIMES, holes)[1]).all(axis=1).sum() == N + 1 - 3
    assert TotalVariation(0.01)(TIMES, holes)[1].shape == (N - 1, 2)
    for derivative in (CentralDifference(), TotalVariation(0.01)):
        assert np.isfinite(sindy(series(TIMES, holes), CUBIC, Lasso(0.1), derivative).coefficients).all()


def unbounded(x):
    return jnp.array([x[0], 1 / x[0]])


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((series(TIMES, YS), PolynomialLibrary(3, 2), Lasso(0.1)), "for 3 variables, but the recording has 2 channels"),
        ((series(TIMES, YS), lambda x: x[0], Lasso(0.1)), "must give features of shape"),
        ((series(TIMES, YS), unbounded, Lasso(0.1)), "Term 1 of the library is inf at x = "),
        ((series(TIMES, YS, np.ones((N + 1, 1))), CUBIC, Lasso(0.1)), "has inputs, which"),
        ((series(TIMES, np.full((N + 1, 2), np.nan)), CUBIC, Lasso(0.1)), "leave no slope known"),
        (([series(TIMES, YS), series(TIMES, YS[:, :1])], CUBIC, Lasso(0.1)), "different numbers of channels"),
        ((series(TIMES[:5], YS[:5]), CUBIC, SequentialThresholding(0.1)), "10 terms, but the data tell only 4 of them"),
        ((series(TIMES[:2], YS[:2]), CUBIC, Lasso(0.1), CentralDifference()), "at least three complete rows"),
        ((series(TIMES[:2], YS[:2]), CUBIC, Lasso(0.1), TotalVariation(0.1)), "at least three complete rows"),
        ((series(TIMES, YS), CUBIC, Lasso(0.1), TotalVariation(1e20)), "did not settle in .* choose a smaller one"),
    ],
)
def test_what_cannot_be_identified_is_refused(arguments, sentence):
    """Libraries and recordings that do not fit, and data that do not determine the answer, are refused."""
    with pytest.raises(InputError, match=sentence):
        sindy(*arguments)


def test_bad_options_are_refused():
    """Negative weights, thresholds and ridges, and a total variation of weight 0 or NaN, are refused."""
    for make, sentence in (
        (lambda: Lasso(-1.0), "weight of at least 0"),
        (lambda: SequentialThresholding(-0.1), "threshold and a ridge of at least 0"),
        (lambda: SequentialThresholding(0.1, -1.0), "threshold and a ridge of at least 0"),
        (lambda: TotalVariation(0.0), "positive weight"),
        (lambda: TotalVariation(float("nan")), "positive weight"),
    ):
        with pytest.raises(InputError, match=sentence):
            make()
