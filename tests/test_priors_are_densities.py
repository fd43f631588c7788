"""Priors are densities in nats over what a model learns, and nothing learns without one."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

import integrators as ig
from symplearn._errors import InputError
from symplearn._hamiltonians import Polynomial, PolynomialPotential
from symplearn._model import FullState, Gaussian, Interval, Propagator, StateSpaceModel
from symplearn._noise import AdditiveGaussian, Diagonal, ScaledIdentity, WienerIncrement
from symplearn._parameters import (
    Bounded,
    Frozen,
    Learnt,
    Positive,
    flatten,
    named_parameters,
    partition,
    resolve,
)
from symplearn._prior import Flat, HalfNormal, Laplace, Normal, Prior


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
    """Normal and half-normal take variances, Laplace a scale; each is SciPy's density."""
    x = jnp.array([0.0, 0.2, 1.7, 5.0])
    np.testing.assert_allclose(density.log_density(x), oracle.logpdf(x), rtol=1e-13)


def test_a_half_normal_has_nothing_below_zero():
    """The density of a negative number is zero."""
    assert float(HalfNormal(1.0).log_density(jnp.array(-0.1))) == -np.inf


@pytest.mark.parametrize("leaf", [Positive(0.5), Bounded(0.5, 0.2, 3.0), Learnt(0.5)])
def test_the_prior_of_a_free_coordinate_is_a_density_too(leaf):
    """With its Jacobian a half-normal integrates over the free coordinate to its mass there."""

    def density(free):
        moved = eqx.tree_at(lambda p: p.free, leaf, jnp.asarray(free))
        return float(jnp.exp(Prior(HalfNormal(1.0)).log_density(moved)))

    low, high = (0.2, 3.0) if isinstance(leaf, Bounded) else (0.0, np.inf)
    mass = stats.halfnorm.cdf(high) - stats.halfnorm.cdf(low)
    # Beyond +-40 less than e-40 is left; SciPy's quad is asked for 1e-7.
    assert integrate.quad(density, -40.0, 40.0, points=[0.0], epsabs=1e-7)[0] == pytest.approx(mass, abs=1e-6)
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


def test_impossible_starts_are_refused():
    """A positive leaf that starts at zero, or a bounded one outside its bounds, is refused."""
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
