"""Priors are densities in nats over what a model learns, and nothing learns without one."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import integrators as ig
from symplearn._errors import InputError
from symplearn._fit import fit
from symplearn._hamiltonians import Polynomial, PolynomialPotential
from symplearn._model import FullState, Gaussian, Interval, LinearDynamics, Propagator, StateSpaceModel
from symplearn._noise import (
    AdditiveGaussian,
    Correlated,
    Dense,
    Diagonal,
    LogVariance,
    ScaledIdentity,
    StandardDeviation,
    WienerIncrement,
)
from symplearn._objectives import TimeSeries
from symplearn._parameters import (
    Bounded,
    Correlation,
    Frozen,
    Learnt,
    Positive,
    PositiveDefinite,
    flatten,
    named_parameters,
    partition,
    resolve,
)
from symplearn._prior import LKJ, Flat, HalfNormal, InverseWishart, Laplace, LogDensity, Normal, Prior

COVARIANCE = np.array([[1.0, 0.4, -0.2], [0.4, 0.5, 0.1], [-0.2, 0.1, 2.0]])
CORRELATION = COVARIANCE / np.sqrt(np.outer(np.diag(COVARIANCE), np.diag(COVARIANCE)))


def model(initial=None, system=None, integrator=None):
    return StateSpaceModel(
        Propagator(system or PolynomialPotential(2, 2), integrator or ig.Leapfrog(), 2),
        FullState(),
        AdditiveGaussian(ScaledIdentity(Positive(1e-4), dim=4)),
        AdditiveGaussian(Diagonal(Positive(np.array([1.0, 2.0, 3.0, 4.0])))),
        initial,
    )


@pytest.mark.parametrize(
    ("density", "oracle"),
    [
        (Normal(0.3, 4.0), stats.norm(0.3, 2.0)),
        (Laplace(0.7), stats.laplace(scale=0.7)),
        (HalfNormal(4.0), stats.halfnorm(scale=2.0)),
    ],
)
def test_densities_are_scipys(density, oracle):
    """Normal and half-normal take variances, Laplace a scale; each is SciPy's density and has the mass one."""
    x = jnp.array([0.0, 0.2, 1.7, 5.0])
    np.testing.assert_allclose(density.log_density(x), oracle.logpdf(x), rtol=1e-13)
    nodes, weights = np.polynomial.legendre.leggauss(100)
    halves = [] if isinstance(density, HalfNormal) else [-20.0]
    masses = [
        20.0 * weights @ np.exp(density.log_density(jnp.asarray(20.0 * (nodes + 1) + 2 * low)))
        for low in [0.0, *halves]
    ]
    # Beyond +-40 Laplace has e-57; on each side of its kink 100 Gauss nodes are exact to 1e-12.
    assert sum(masses) == pytest.approx(1.0, abs=1e-10)


@pytest.mark.parametrize("dim", [1, 3])
def test_an_inverse_wishart_is_scipys(dim):
    """The density of a positive definite matrix is SciPy's, whatever its size, and zero for an indefinite one."""
    scale, dof = COVARIANCE[:dim, :dim], dim + 1.5
    prior = InverseWishart(dof, scale)
    density = jax.jit(lambda S: prior.log_density(S))
    for S in np.reshape(stats.invwishart(dof, scale).rvs(5, random_state=1), (5, dim, dim)):
        ours = float(density(jnp.asarray(S)))
        # Two dozen operations on numbers of order ten.
        assert ours == pytest.approx(stats.invwishart(dof, scale).logpdf(S), abs=1e-11)
    indefinite = jnp.asarray(COVARIANCE[:dim, :dim]).at[0, 0].set(-1.0)
    assert float(density(indefinite)) == -np.inf


def test_an_lkj_density_integrates_to_one():
    """Over correlation matrices of size two and three the density has the mass one; 1 is the uniform density."""

    @jax.jit
    @jax.vmap
    def density(eta, r, s, t):
        two, three = jnp.array([[1.0, r], [r, 1.0]]), jnp.array([[1.0, r, s], [r, 1.0, t], [s, t, 1.0]])
        return jnp.exp(LKJ(eta).log_density(two)), jnp.exp(LKJ(eta).log_density(three))

    nodes, weights = np.polynomial.legendre.leggauss(100)
    s, t = (grid.ravel() for grid in np.meshgrid(nodes, nodes))
    one = np.ones_like(s)
    # (1 - r^2)^1.5 has a kink at the ends: 100 nodes leave 1e-7.
    assert weights @ density(2.5 * one, t, s, s)[0][::100] == pytest.approx(1.0, abs=1e-6)
    # The volume of the correlation matrices of size three is pi^2 / 2 (Rousseeuw and Molenberghs 1994).
    np.testing.assert_allclose(density(one, 0.1 * one, 0.2 * one, 0.3 * one)[1], 2 / np.pi**2, rtol=1e-13)
    # An entry of LKJ(eta) of size d is Beta(eta - 1 + d/2) on (-1, 1): the others are integrated away.
    marginal = stats.beta(2.5, 2.5).pdf((0.3 + 1) / 2) / 2
    # The density vanishes linearly at the border of an ellipse, which the square grid cuts: errors of 1/100^2.
    assert np.outer(weights, weights).ravel() @ density(2 * one, 0.3 * one, s, t)[1] == pytest.approx(
        marginal, rel=1e-3
    )


@eqx.filter_jit
def jacobian(leaf, below):
    """The value, its log Jacobian, and d value / d free over the entries of the value that are free to move."""
    index = np.tril_indices(leaf.dim, -below)
    slopes = jax.jacfwd(lambda free: eqx.tree_at(lambda p: p.free, leaf, free).value[index])(leaf.free)
    return leaf.value, leaf.log_jacobian(), slopes


@pytest.mark.parametrize("dim", [1, 3])
def test_matrices_that_learn_have_exact_jacobians(dim):
    """A matrix is its own start, and the Jacobian of its free coordinates is that of automatic derivatives."""
    rng = np.random.default_rng(2)
    covariance, correlation = PositiveDefinite(COVARIANCE[:dim, :dim]), Correlation(CORRELATION[:dim, :dim])
    # Round-off of a Cholesky factor and its square.
    np.testing.assert_allclose(covariance.value, COVARIANCE[:dim, :dim], atol=1e-14)
    np.testing.assert_allclose(correlation.value, CORRELATION[:dim, :dim], atol=1e-14)
    assert covariance.free.size == dim * (dim + 1) // 2 and correlation.free.size == dim * (dim - 1) // 2
    for leaf, below in ((covariance, 0), (correlation, 1)):
        for _ in range(3):
            moved = eqx.tree_at(lambda p: p.free, leaf, jnp.asarray(rng.normal(size=leaf.free.shape)))
            value, log_jacobian, slopes = jacobian(moved, below)
            assert np.linalg.eigvalsh(value)[0] > 0
            assert float(log_jacobian) == pytest.approx(np.linalg.slogdet(slopes)[1], abs=1e-12)


@pytest.mark.parametrize(
    ("leaf", "density", "reach"),
    [
        (PositiveDefinite(COVARIANCE[:2, :2]), InverseWishart(12.0, 9 * COVARIANCE[:2, :2]), (2.0, 2.0, 3.0)),
        (Correlation(CORRELATION), LKJ(1.5), (6.0, 6.0, 6.0)),
    ],
)
def test_a_matrix_has_the_mass_one_in_free_coordinates(leaf, density, reach):
    """Over all free coordinates of a matrix its density, with the Jacobian, integrates to one."""
    axes = [np.linspace(-width, width, 61) for width in reach]
    grid = jnp.stack([axis.ravel() for axis in jnp.meshgrid(*axes)], axis=1)
    at = jax.jit(jax.vmap(lambda free: Prior(density).log_density(eqx.tree_at(lambda p: p.free, leaf, free))))
    cell = np.prod([axis[1] - axis[0] for axis in axes])
    # The trapezium rule converges faster than any power for a smooth density; e-6 of it lies outside the box.
    assert cell * float(jnp.sum(jnp.exp(at(grid)))) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("leaf", [Positive(0.5), Bounded(0.5, 0.2, 3.0), Learnt(0.5)])
def test_the_prior_of_a_free_coordinate_is_a_density_too(leaf):
    """With its Jacobian a half-normal integrates over the free coordinate to its mass there."""

    @jax.jit
    @jax.vmap
    def density(free):
        return jnp.exp(Prior(HalfNormal(1.0)).log_density(eqx.tree_at(lambda p: p.free, leaf, free)))

    low, high = (0.2, 3.0) if isinstance(leaf, Bounded) else (0.0, np.inf)
    mass = stats.halfnorm.cdf(high) - stats.halfnorm.cdf(low)
    # The midpoint rule over a smooth density, or one of even halves; beyond +-40 less than e-17 is left.
    grid = np.linspace(-39.99, 39.99, 4000)
    assert 0.02 * np.sum(density(grid)) == pytest.approx(mass, abs=1e-12)
    assert float(leaf.value) == pytest.approx(0.5, rel=1e-15)
    slope = jax.grad(lambda free: eqx.tree_at(lambda p: p.free, leaf, free).value)(leaf.free)
    assert float(leaf.log_jacobian()) == pytest.approx(float(jnp.log(slope)), abs=1e-14)


def test_what_learns_is_what_one_would_say():
    """Bare arrays of a system and wrapped numbers learn; those of noises, starts and integrators do not."""
    start = Gaussian(Learnt(np.zeros(4)), np.eye(4))
    everything = model(start, Polynomial(2, 1), ig.Tao(20.0))
    assert set(named_parameters(everything)) == {
        "dynamics.system.coefficients",
        "process_noise.structure.variance",
        "measurement_noise.structure.variances",
        "initial.mean",
    }
    frozen = eqx.tree_at(lambda m: m.dynamics, everything, Frozen(everything.dynamics))
    assert "dynamics.system.coefficients" not in named_parameters(frozen)
    assert all("dynamics" not in name for name in named_parameters(frozen))


def test_resolving_gives_plain_arrays_and_stops_frozen_derivatives():
    """`resolve` replaces leaves by their values, once is enough, and nothing flows into a frozen number."""
    plain = resolve(model())
    np.testing.assert_allclose(plain.measurement_noise.covariance(), np.diag([1.0, 2.0, 3.0, 4.0]), rtol=1e-15)
    assert eqx.tree_equal(plain, resolve(plain))
    held = jax.grad(lambda x: resolve(Frozen(x)) ** 2)(jnp.array(3.0))
    assert float(held) == 0.0


def test_free_coordinates_make_a_round_trip():
    """The vector of free coordinates gives back its model, and has an entry per learnt number."""
    given = model()
    vector, rebuild = flatten(given)
    assert vector.shape == (5 + 1 + 4,)
    assert eqx.tree_equal(rebuild(vector), given)
    assert eqx.tree_equal(eqx.combine(*partition(given)), given)


def test_the_longest_name_wins():
    """A density for the beginning of a name serves all below it, unless one is closer."""
    prior = Prior({"": Flat(), "process_noise": HalfNormal(1.0), "process_noise.structure": Normal(0.0, 1.0)})
    assert isinstance(prior.density_of("process_noise.structure.variance"), Normal)
    assert isinstance(prior.density_of("dynamics.system"), Flat)


def test_a_leaf_without_prior_is_refused_by_name():
    """What learns without a density, or a density for nothing that learns, is an error naming it."""
    with pytest.raises(InputError, match="`measurement_noise.structure.variances` learns but has no prior"):
        Prior({"dynamics": Flat(), "process_noise": Flat()}).log_density(model())
    with pytest.raises(InputError, match="names `proces`"):
        Prior({"": Flat(), "proces": Flat()}).log_density(model())


def test_any_log_density_is_a_prior():
    """A function of a leaf's value, entrywise or whole, counts as given; a logarithm of a negative number is -inf."""
    gamma = LogDensity(lambda v: jax.scipy.stats.gamma.logpdf(v, 2.0, scale=3.0))
    leaf = Positive([0.5, 2.0])
    expected = stats.gamma(2.0, scale=3.0).logpdf([0.5, 2.0]).sum() + np.log([0.5, 2.0]).sum()
    assert float(Prior(gamma).log_density(leaf)) == pytest.approx(expected, abs=1e-13)
    whole = LogDensity(lambda v: -(jnp.sum(v) ** 2))
    assert float(Prior(whole).log_density(leaf)) == pytest.approx(-(2.5**2) + np.log([0.5, 2.0]).sum(), abs=1e-13)
    outside, slope = jax.value_and_grad(lambda v: Prior(LogDensity(lambda v: jnp.log(v - 1.0))).log_density(v))(0.5)
    assert float(outside) == -np.inf and np.isfinite(slope)


def test_a_joint_density_multiplies_those_of_the_leaves():
    """`joint` sees the model in plain arrays: a prior on the ratio of two variances adds its nats, and no Jacobian."""
    given = model()

    def signal_to_noise(plain):
        ratio = plain.process_noise.structure.variance / plain.measurement_noise.structure.variances[0]
        return jax.scipy.stats.norm.logpdf(jnp.log(ratio), -9.0, 0.5)

    added = Prior(Flat(), joint=signal_to_noise).log_density(given) - Prior(Flat()).log_density(given)
    assert float(added) == pytest.approx(stats.norm(-9.0, 0.5).logpdf(np.log(1e-4)), abs=1e-12)
    assert float(Prior(Flat(), joint=lambda _: jnp.log(-1.0)).log_density(given)) == -np.inf
    with pytest.raises(InputError, match="has no prior"):
        Prior({}, joint=signal_to_noise).log_density(given)


@pytest.mark.parametrize(
    ("density", "inside", "outside"),
    [
        (HalfNormal(1.0), 0.0, -0.5),
        (Laplace(1.0), 0.0, None),
        (InverseWishart(4.0, np.eye(2)), np.diag([1e-8, 1.0]), np.diag([-1.0, 1.0])),
        (LKJ(2.0), CORRELATION[:2, :2], np.array([[1.0, 1.5], [1.5, 1.0]])),
    ],
)
def test_derivatives_are_finite_on_both_sides_of_a_border(density, inside, outside):
    """At the border the slope is finite with the value; beyond it the value is -inf and the slope no NaN."""
    for derivative in (jax.grad, jax.jacfwd):
        slope = jax.jit(derivative(lambda v: jnp.sum(density.log_density(v))))
        assert bool(jnp.all(jnp.isfinite(slope(jnp.asarray(inside)))))
        if outside is not None:
            assert float(density.log_density(jnp.asarray(outside))) == -np.inf
            assert bool(jnp.all(jnp.isfinite(slope(jnp.asarray(outside)))))


def linear(measurement, initial=None, process=0.1):
    noises = AdditiveGaussian(ScaledIdentity(process, dim=2)), AdditiveGaussian(measurement)
    return StateSpaceModel(LinearDynamics(Frozen(0.5 * jnp.eye(2))), FullState(), *noises, initial)


@pytest.mark.parametrize(
    ("structure", "name"),
    [
        (ScaledIdentity(Positive(0.2), dim=2), "variance"),
        (ScaledIdentity(StandardDeviation(Positive(0.2)), dim=2), "variance.sd"),
        (ScaledIdentity(LogVariance(Learnt(-5.0)), dim=2), "variance.log_variance"),
        (Diagonal(Positive([0.2, 0.3])), "variances"),
        (Diagonal(StandardDeviation(Positive([0.2, 0.3]))), "variances.sd"),
        (Diagonal(LogVariance(Learnt([-5.0, -4.0]))), "variances.log_variance"),
        (Dense(PositiveDefinite(np.eye(2))), "covariance"),
        (Correlated(LogVariance(Learnt([-5.0, -4.0])), np.eye(2)), "variances.log_variance"),
        (Correlated(np.ones(2), Correlation(np.eye(2))), "correlation"),
    ],
)
def test_every_covariance_has_one_name_and_needs_a_prior(structure, name):
    """However a covariance is given, what learns of it has one name, is refused without prior, and is served by it."""
    given, full = linear(structure), f"measurement_noise.structure.{name}"
    assert list(named_parameters(given)) == [full]
    with pytest.raises(InputError, match=f"`{full}` learns but has no prior"):
        Prior({}).log_density(given)
    assert np.isfinite(Prior({full: Flat()}).log_density(given))


def test_initial_distributions_are_named_in_their_order():
    """Learnt means are `initial.mean`, or `initial.0.mean` and so on, and every one must have a prior."""
    starts = tuple(Gaussian(Learnt(mean), np.eye(2)) for mean in np.eye(2))
    one, two = linear(Diagonal([0.2, 0.3]), starts[0]), linear(Diagonal([0.2, 0.3]), starts)
    assert list(named_parameters(one)) == ["initial.mean"]
    assert list(named_parameters(two)) == ["initial.0.mean", "initial.1.mean"]
    with pytest.raises(InputError, match="`initial.1.mean` learns but has no prior"):
        Prior({"initial.0": Flat()}).log_density(two)
    assert float(Prior({"initial": Flat()}).log_density(two)) == 0.0


def test_a_density_of_another_kind_is_refused():
    """Densities of numbers are refused for a matrix that learns whole, those of matrices for anything else."""
    dense = linear(Dense(PositiveDefinite(np.eye(2))))
    for density in (HalfNormal(1.0), LKJ(1.0), InverseWishart(4.0, np.eye(3))):
        with pytest.raises(InputError, match=r"`measurement_noise.structure.covariance` is a PositiveDefinite"):
            Prior(density).log_density(dense)
    with pytest.raises(InputError, match="`InverseWishart` is no density of it"):
        Prior(InverseWishart(4.0, np.eye(2))).log_density(linear(Diagonal(Positive([0.2, 0.3]))))
    for bad in (lambda: Normal(0.0, -1.0), lambda: HalfNormal(0.0), lambda: Laplace(-1.0), lambda: LKJ(0.0)):
        with pytest.raises(InputError, match="needs a positive"):
            bad()
    with pytest.raises(InputError, match="dof above dim - 1"):
        InverseWishart(0.5, np.eye(2))
    with pytest.raises(InputError, match="shape"):
        InverseWishart(4.0, np.ones(2))


def test_a_density_of_other_entries_is_refused():
    """Three means over two variances would count each entry several times, or fail: one for all, or one for each."""
    two = linear(Diagonal(Positive([0.2, 0.3])))
    for variances in (np.ones(3), np.ones((3, 1)), np.ones((2, 2))):
        with pytest.raises(InputError, match=r"has the shape \(2,\), which the numbers of its `HalfNormal` do not fit"):
            Prior(HalfNormal(variances)).log_density(two)
    each = [float(Prior(HalfNormal(one)).log_density(two)) for one in (2.0, np.array([2.0, 2.0]))]
    assert each[0] == each[1]


@pytest.mark.slow
def test_a_fit_stays_within_the_support():
    """Where BFGS tries values of density zero it turns round; at a border it stops, and says it is no MAP. No NaN."""
    ys = 0.1 * np.random.default_rng(4).normal(size=(30, 2))
    series, density = TimeSeries(jnp.arange(30.0), jnp.asarray(ys)), HalfNormal(0.01)

    def log_posterior(v, r):
        total, m, P = stats.halfnorm(scale=0.1).logpdf(v), ys[0], r
        for y in ys[1:]:
            m, P = 0.5 * m, 0.25 * P + v
            total += stats.norm(m, np.sqrt(P + r)).logpdf(y).sum()
            m, P = m + P / (P + r) * (y - m), P * r / (P + r)
        return total

    # The readings scatter by 0.01: with less from the measurement some is left for the process, with more none.
    for r, converged in ((0.01, True), (0.02, False)):
        # The slope from far away overshoots below zero, where there is no density.
        estimate = fit(linear(ScaledIdentity(r, dim=2), process=Learnt(2.0)), series, prior=density)
        variance = float(estimate.values()["process_noise.structure.variance"])
        assert np.isfinite([variance, estimate.log_posterior, estimate.gradient_norm, estimate.promised]).all()
        assert estimate.converged == converged and variance >= 0.0
        assert estimate.log_posterior == pytest.approx(log_posterior(variance, r), abs=1e-9)
        # The grid's best, and at the border what 1e-10 of a variance costs at 1000 nats per unit.
        assert max(log_posterior(v, r) for v in np.linspace(0.0, 0.1, 201)) <= estimate.log_posterior + 1e-6
    with pytest.raises(InputError, match="no finite score at its start"):
        fit(linear(ScaledIdentity(0.01, dim=2), process=Learnt(-1.0)), series, prior=density)


def test_impossible_starts_are_refused():
    """What starts outside its support is refused: zero, a bound, a matrix that is no covariance or correlation."""
    for bad in (np.diag([1.0, -1.0]), np.array([[1.0, 0.5], [0.2, 1.0]]), np.ones((2, 2))):
        with pytest.raises(InputError, match="symmetric positive definite"):
            PositiveDefinite(bad)
    with pytest.raises(InputError, match="square matrix"):
        PositiveDefinite(np.ones(3))
    with pytest.raises(InputError, match="ones on the diagonal"):
        Correlation(COVARIANCE)
    with pytest.raises(InputError, match="positive numbers"):
        Positive(0.0)
    with pytest.raises(InputError, match="lower < value < upper"):
        Bounded(1.0, 0.0, 1.0)


def test_a_wiener_increment_grows_with_the_interval():
    """Per unit time and per data interval are two noises: only the first knows how long the interval is."""
    interval = Interval(jnp.array(1.0), jnp.array(1.5))
    structure = ScaledIdentity(2.0, dim=2)
    np.testing.assert_allclose(WienerIncrement(structure).covariance(interval), np.eye(2), rtol=1e-15)
    np.testing.assert_allclose(AdditiveGaussian(structure).covariance(interval), 2 * np.eye(2), rtol=1e-15)
