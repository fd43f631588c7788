"""Tao's integrator filters on the doubled state too, and only there it is symplectic. (5.18), E40."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from estimation_cases import Conditioned, kalman_log_likelihood
from scipy.integrate import solve_ivp

import integrators as ig

# What `doubled` and its docstring speak of is public.
from symplearn import (
    DoubledPropagator,
    IndependentDraws,
    SharedDraw,
    doubled,
    doubled_observation,
    doubled_transform,
    simulate,
)
from symplearn._distributions import Uniform
from symplearn._doubled import AffineDoubledObservation, DoubledNoise, DoubledObservation
from symplearn._errors import InputError
from symplearn._filter import log_likelihood, unscented_filter
from symplearn._model import Coordinates, FullState, Gaussian, Interval, Propagator, StateSpaceModel, intervals_between
from symplearn._noise import Additive, AdditiveGaussian, Dense, Diagonal, Multiplicative, ScaledIdentity
from symplearn._objectives import MarginalLikelihood, TimeSeries
from symplearn._parameters import Learnt, flatten
from symplearn._simulate import draw_noise
from symplearn._smoother import smooth
from symplearn._transforms import Taylor, UnscentedTransform

TAO = ig.problems.TaoExample()
OMEGA, DT = 20.0, 0.01
FIRST, MEAN = ig.Tao(OMEGA, ig.FirstCopy()), ig.Tao(OMEGA, ig.MeanOfCopies())
TIMES = np.arange(21) * 0.1
INTERVALS = intervals_between(jnp.asarray(TIMES))


def _model(system, integrator, dim, observation=None, initial=None, variance=1e-4):
    noises = AdditiveGaussian(ScaledIdentity(variance, dim)), AdditiveGaussian(ScaledIdentity(0.01, dim))
    start = Gaussian(system.initial, 0.01 * jnp.eye(dim)) if initial is None else initial
    return StateSpaceModel(Propagator(system, integrator), observation or FullState(), *noises, start)


@eqx.filter_jit
def _jacobian(dynamics, x, dt):
    return jax.jacfwd(lambda x: dynamics(x, Interval(0.0 * dt, dt)))(x)


def _defect(dynamics, x, dt):
    """max |J'SJ - S| with S written out in numpy, one block for each copy."""
    J = np.asarray(_jacobian(dynamics, jnp.asarray(x), jnp.asarray(dt)))
    d = len(TAO.initial) // 2
    S = scipy.linalg.block_diag(*[np.kron([[0, 1], [-1, 0]], np.eye(d))] * (len(x) // (2 * d)))
    return np.abs(J.T @ S @ J - S).max()


def test_the_doubled_propagator_is_symplectic():
    """J'SJ = S for the doubled propagator, at equal and at parted copies, for steps of 0.01 and 0.1."""
    step = DoubledPropagator(TAO, MEAN)
    for state in ([0.0, -3.0, 0.0, -3.0], [0.3, -1.0, 0.25, -1.1]):
        for dt in (0.01, 0.1):
            # Round-off of products of matrices with entries up to 10.
            assert _defect(step, state, dt) < 1e-12


def test_the_projected_propagators_are_not():
    """First copy: a defect between 1e-7 and 1e-4 at dt = 0.01, of order 3; mean of copies: of order 6. E40."""
    x, coarse, fine = [1.0, 0.5], (0.02, 0.01, 0.005), (0.004, 0.002, 0.001)
    assert 1e-7 < _defect(Propagator(TAO, FIRST), [0.0, -3.0], DT) < 1e-4
    first = [_defect(Propagator(TAO, FIRST), x, dt) for dt in fine]
    mean = [_defect(Propagator(TAO, MEAN), x, dt) for dt in coarse]
    # The leading term is (omega dt)^3 relative to (omega dt)^5: at omega dt = 0.08 and less within a tenth.
    np.testing.assert_allclose(np.log2(np.divide(first[:-1], first[1:])), 3.0, atol=0.1)
    # For the mean the steps may be larger, and must be: at 0.001 the defect is round-off.
    np.testing.assert_allclose(np.log2(np.divide(mean[:-1], mean[1:])), 6.0, atol=0.1)


class Quadratic(ig.AbstractHamiltonian):
    """H = p^2/2 + q^2 + 0.3 q p: not separable, and its flow is linear."""

    @property
    def initial(self):
        return jnp.array([1.0, -0.5])

    def energy(self, q, p):
        return 0.5 * p @ p + q @ q + 0.3 * q @ p


def _tao_matrix(omega, dt):
    """One step of Tao's method for `Quadratic` as a matrix on (q, p, x, y), from exponentials of its three parts."""
    h = np.array([[2.0, 0.3], [0.3, 1.0]])  # Hessian of H
    S = np.kron(np.eye(2), [[0.0, 1.0], [-1.0, 0.0]])
    q, p, x, y = np.eye(4)

    def flow(hessian, time):
        return scipy.linalg.expm(time * S @ hessian)

    A = np.stack([q, y]).T @ h @ np.stack([q, y])
    B = np.stack([x, p]).T @ h @ np.stack([x, p])
    C = omega * (np.outer(q - x, q - x) + np.outer(p - y, p - y))
    half_a, half_b = flow(A, dt / 2), flow(B, dt / 2)
    return half_a @ half_b @ flow(C, dt) @ half_b @ half_a


def _linear_case(projection, draws):
    Q, R, P0 = np.array([[0.02, 0.01], [0.01, 0.03]]), np.array([[0.05]]), np.array([[0.3, 0.1], [0.1, 0.2]])
    noises = AdditiveGaussian(Dense(jnp.asarray(Q))), AdditiveGaussian(Dense(jnp.asarray(R)))
    start = Gaussian(Quadratic().initial, jnp.asarray(P0))
    model = StateSpaceModel(Propagator(Quadratic(), ig.Tao(3.0)), Coordinates((0,)), *noises, start)
    read = np.array([[0.5, 0, 0.5, 0]]) if isinstance(projection, ig.MeanOfCopies) else np.array([[1.0, 0, 0, 0]])
    noise = np.kron(np.eye(2) if isinstance(draws, IndependentDraws) else np.ones((2, 2)), Q)
    matrices = _tao_matrix(3.0, 0.1), read, noise, R, np.array([1, -0.5, 1, -0.5]), np.kron(np.ones((2, 2)), P0)
    return doubled(model, projection, draws), matrices


@pytest.mark.parametrize(
    ("projection", "draws"),
    [pytest.param(ig.MeanOfCopies(), None, marks=pytest.mark.slow), (ig.FirstCopy(), IndependentDraws())],
    ids=["mean-shared", "first-independent"],
)
def test_on_a_linear_system_it_is_the_kalman_filter_of_the_doubled_matrices(projection, draws):
    """Likelihood, filtered and smoothed moments are those of textbook linear algebra, singular covariances included."""
    twin, matrices = _linear_case(projection, draws)
    ys = np.random.default_rng(3).normal(size=(len(TIMES), 1))
    ys[7] = np.nan
    value, m, P = kalman_log_likelihood(*matrices, ys)
    filtered, smoothed = _smoothed(twin, jnp.asarray(ys))
    # Some 20 steps of round-off in numbers of order 1 to 100.
    np.testing.assert_allclose(filtered.log_likelihood, value, rtol=0, atol=1e-9)
    np.testing.assert_allclose(filtered.filtered_means[-1], m, rtol=0, atol=1e-9)
    np.testing.assert_allclose(filtered.filtered_covariances[-1], P, rtol=0, atol=1e-9)
    with np.errstate(divide="ignore", invalid="ignore"):  # its standardised noises, which singular Q leaves undefined
        exact = Conditioned(*matrices, ys)
    # The smoother divides by nearly singular roots; its nudge of 1e-5 leaves some 1e-16 / 1e-5 per step.
    np.testing.assert_allclose(smoothed.means, exact.means, rtol=0, atol=1e-8)
    np.testing.assert_allclose(smoothed.covariances, exact.covariances, rtol=0, atol=1e-8)


@eqx.filter_jit
def _smoothed(model, ys):
    filtered = unscented_filter(model, ys, INTERVALS, None, Taylor())
    return filtered, smooth(model, filtered, INTERVALS, None, Taylor())


def test_without_noise_it_reads_a_free_run_lifted_once():
    """Equal copies at the start, no process noise, exact start: the predictions are `integrate`'s trajectory."""
    model = _model(TAO, MEAN, 2, initial=Gaussian(TAO.initial, jnp.zeros((2, 2))), variance=0.0)
    twin = doubled(model)
    filtered = _filtered(twin, jnp.zeros((len(TIMES), 2)), doubled_transform(UnscentedTransform()))
    read = jax.vmap(twin.observation)(filtered.predicted_means)
    free = ig.integrate(TAO, MEAN, TAO.initial, TIMES).xs
    # Round-off over 20 steps.
    np.testing.assert_allclose(read, free, rtol=0, atol=1e-12)
    # dt = 0.1 is coarse: projecting at every step is another trajectory, so that the agreement says something.
    projected, step = TAO.initial, eqx.filter_jit(model.dynamics)
    for k in range(len(TIMES) - 1):
        projected = step(projected, jax.tree.map(lambda leaf: leaf[k], INTERVALS))  # noqa: B023
    assert np.abs(projected - free[-1]).max() > 1e-3


@eqx.filter_jit
def _filtered(model, ys, transform):
    return unscented_filter(model, ys, INTERVALS, None, transform)


def test_energy_of_a_doubled_propagation_is_bounded_and_of_a_projected_one_drifts():
    """Over 20,000 intervals the energy drifts with the first copy, less with the mean, and not on the doubled space."""
    first, mean = (_energy_error(Propagator(TAO, method), TAO.initial) for method in (FIRST, MEAN))
    lifted = _energy_error(DoubledPropagator(TAO, MEAN), jnp.tile(TAO.initial, 2))
    slopes = [abs(np.polyfit(0.02 * np.arange(len(error)), error, 1)[0]) for error in (first, mean, lifted)]
    # Measured 9e-4, 2e-5 and 1e-9 per unit of time.
    assert slopes[0] > 10.0 * slopes[1] > 1000.0 * slopes[2]
    for error, grows in ((first, True), (mean, True), (lifted, False)):
        early, late = np.abs(error[:2000]).max(), np.abs(error[-2000:]).max()
        # A drift would be tenfold on top of an oscillation; a bounded error meets its worst in the first tenth.
        assert late > 1.5 * early if grows else late < 1.01 * early


def _energy_error(dynamics, state):
    """H by hand, minus its start, of 20,000 intervals of 0.02; a doubled state is read by the mean of its copies."""

    @jax.jit
    def run(state):
        def step(state, t):
            after = dynamics(state, Interval(t, t + 0.02))
            return after, after.reshape(-1, 2).mean(axis=0)

        return jax.lax.scan(step, state, 0.02 * jnp.arange(20_000))[1]

    q, p = np.asarray(run(state)).T
    return 0.5 * (q**2 + 1) * (p**2 + 1) - 5.0


def test_both_ways_agree_as_the_step_goes_to_zero():
    """On data of SciPy's, 20 intervals of one step each, the two log likelihoods come together at order 3 or more."""
    model, gaps = _model(TAO, MEAN, 2), []
    scores = _score(doubled_transform(UnscentedTransform())), _score(UnscentedTransform())
    for dt in (0.04, 0.02, 0.01):
        times = dt * np.arange(21)
        truth = solve_ivp(_field, (0, 1), [0, -3], "DOP853", times, rtol=1e-10, atol=1e-12).y.T
        ys = jnp.asarray(truth + 0.1 * np.random.default_rng(1).normal(size=truth.shape))
        intervals = intervals_between(jnp.asarray(times))
        gaps.append(abs(float(scores[0](doubled(model), ys, intervals) - scores[1](model, ys, intervals))))
    # The local error of a step is of order 3 and their number is fixed; the first gap is far above round-off.
    assert gaps[0] > 1e-4 and gaps[1] < gaps[0] / 8.0 and gaps[2] < gaps[1] / 8.0


def _field(t, x):
    return [x[1] * (x[0] ** 2 + 1), -x[0] * (x[1] ** 2 + 1)]


def _score(transform):
    return eqx.filter_jit(lambda model, ys, intervals: log_likelihood(model, ys, intervals, None, transform))


def test_the_doubled_transform_moves_no_sigma_point():
    """From equal copies the doubled moments, projected, are the projected model's; the same alpha would move them."""
    model = _model(TAO, MEAN, 2)
    twin, transform = doubled(model), UnscentedTransform(0.9, 2.0, 0.5)
    interval = Interval(jnp.asarray(0.0), jnp.asarray(0.1))
    once = model.predict(transform, model.initial.mean, model.initial.root, interval)
    read = 0.5 * np.array([[1, 0, 1, 0], [0, 1, 0, 1]])
    gaps = []
    for rule in (doubled_transform(transform), transform):
        moments = twin.predict(rule, twin.initial.mean, twin.initial.root, interval)
        mean, covariance = read @ moments.mean - once.mean, read @ moments.covariance @ read.T - once.covariance
        gaps.append(max(np.abs(mean).max(), np.abs(covariance).max()))
    # Round-off of numbers up to 3, against a fourth-order moment of a spread of 0.1.
    assert gaps[0] < 1e-13 and gaps[1] > 1e-6


class Nonlinear(ig.AbstractProjection):
    """A projection that is not linear."""

    def __call__(self, copies):
        return copies[0] * copies[1]


def test_only_affine_parts_are_declared_affine():
    """A linear reading through a linear projection is affine, with the slope of its own Jacobian; others are not."""
    state = jnp.arange(4.0)
    for projection in (ig.FirstCopy(), ig.MeanOfCopies()):
        read = doubled_observation(Coordinates((1,)), projection)
        assert isinstance(read, AffineDoubledObservation)
        np.testing.assert_array_equal(read.slope(state), jax.jacfwd(read)(state))
    for read in (doubled_observation(Coordinates((1,)), Nonlinear()), doubled_observation(jnp.sin, ig.FirstCopy())):
        assert isinstance(read, DoubledObservation)
    with pytest.raises(InputError, match="doubled_observation"):
        AffineDoubledObservation(FullState(), Nonlinear())


def test_what_learns_in_a_model_learns_in_its_twin():
    """The free vector is the same, and the objective has finite derivatives by it, singular covariances and all."""
    start = Gaussian(Learnt([0.0, -3.0]), 0.01 * jnp.eye(2))
    noises = AdditiveGaussian(ScaledIdentity(1e-4, 2)), AdditiveGaussian(Diagonal([0.01, 0.02]))
    model = StateSpaceModel(Propagator(TAO, MEAN), FullState(), *noises, start)
    twin = doubled(model)
    np.testing.assert_array_equal(flatten(twin)[0], flatten(model)[0])
    free, rebuild = flatten(twin)
    series = TimeSeries(jnp.asarray(TIMES), jnp.tile(jnp.array([0.1, -2.9]), (len(TIMES), 1)))
    objective = MarginalLikelihood(doubled_transform(UnscentedTransform()))
    score = jax.jit(jax.value_and_grad(lambda v: objective(rebuild(v), series)))
    differences = [(score(free + e)[0] - score(free - e)[0]) / 2e-5 for e in 1e-5 * jnp.eye(2)]
    # Central differences of 1e-5: truncation and round-off of some 1e-6 relative.
    np.testing.assert_allclose(score(free)[1], differences, rtol=1e-5)


def test_a_noise_with_a_mean_shifts_both_copies():
    """The mean of an added noise enters both copies, its covariance both blocks and those between them."""
    noise = DoubledNoise(Additive(_Shifted()))
    start = doubled(_model(TAO, MEAN, 2)).initial
    moments = UnscentedTransform()(lambda x: x, start.mean, start.root)
    after = noise.enter(moments)
    np.testing.assert_allclose(after.mean - moments.mean, [1.0, 2.0, 1.0, 2.0], rtol=0, atol=1e-14)
    expected = np.kron(np.ones((2, 2)), np.diag([0.3, 0.4]))
    np.testing.assert_allclose(after.covariance - moments.covariance, expected, rtol=0, atol=1e-14)


class _Shifted(eqx.Module):
    """A distribution by its first two moments."""

    @property
    def mean(self):
        return jnp.array([1.0, 2.0])

    @property
    def structure(self):
        return Diagonal([0.3, 0.4])


def test_what_has_no_doubled_twin_is_refused_in_a_sentence():
    """Leapfrog, a model that is no propagator's, no initial distribution, multiplied noise, no substep."""
    leapfrog = _model(ig.problems.Pendulum(), ig.Leapfrog(), 2)
    with pytest.raises(InputError, match="`Leapfrog` has no doubled space"):
        doubled(leapfrog)
    with pytest.raises(InputError, match="`Leapfrog` has no doubled space"):
        DoubledPropagator(ig.problems.Pendulum(), ig.Leapfrog())
    with pytest.raises(InputError, match="found `FullState`"):
        doubled(eqx.tree_at(lambda m: m.dynamics, leapfrog, FullState()))
    model = _model(TAO, MEAN, 2)
    with pytest.raises(InputError, match="`initial` distribution"):
        doubled(StateSpaceModel(model.dynamics, FullState(), model.process_noise, model.measurement_noise))
    with pytest.raises(InputError, match="`Multiplicative`"):
        DoubledNoise(Multiplicative(_Shifted()))
    with pytest.raises(InputError, match="`substeps` of at least 1"):
        DoubledPropagator(TAO, MEAN, 0)


def test_a_composition_reads_as_its_base_and_several_recordings_keep_their_starts():
    """A composition of Tao's method has a twin too, and a tuple of initial distributions stays one."""
    model = _model(TAO, ig.suzuki4(FIRST), 2, initial=(Gaussian(TAO.initial, jnp.eye(2)),) * 2)
    twin = doubled(model)
    assert isinstance(twin.observation.projection, ig.FirstCopy)
    np.testing.assert_array_equal(twin.initial[1].covariance, np.kron(np.ones((2, 2)), np.eye(2)))


@pytest.mark.parametrize("draws", [SharedDraw(), IndependentDraws()])
def test_added_noise_of_any_distribution_is_drawn_in_both_copies(draws):
    """Of a uniform process noise both copies have one draw, or each its own: bounds, mean and covariance, and a model
    with it is simulated."""
    lower, upper = jnp.array([-0.1, 0.0]), jnp.array([0.3, 0.2])
    noise = Additive(Uniform(lower, upper))
    keys = jax.random.split(jax.random.key(2), 10_000)
    found = np.asarray(jax.vmap(lambda key: draw_noise(DoubledNoise(noise, draws), jnp.zeros(4), None, key))(keys))
    assert np.all(found >= np.tile(lower, 2)) and np.all(found <= np.tile(upper, 2))
    Q = np.diag((upper - lower) ** 2 / 12)
    off = Q if isinstance(draws, SharedDraw) else 0 * Q
    # Three standard errors: sd / 100 of a mean, and 1.4 % of the largest variance.
    np.testing.assert_allclose(found.mean(axis=0), np.tile(0.5 * (lower + upper), 2), atol=3 * 0.12 / 100)
    np.testing.assert_allclose(np.cov(found.T), np.block([[Q, off], [off, Q]]), atol=3 * 0.014 * Q.max())
    plain = eqx.tree_at(lambda m: m.process_noise, _model(TAO, MEAN, 2), noise)
    states = simulate(doubled(plain, draws=draws), TIMES, jax.random.key(3))[1]
    assert states.shape == (len(TIMES), 4)
