"""What is written for speed has the value, the slope and the curvature of what it stands for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import integrators as ig
import symplearn as sl
from integrators.problems import HarmonicOscillator, HenonHeiles
from symplearn import _filter
from symplearn._log_posterior import gradient, guarded
from symplearn._model import intervals_between
from symplearn._small_products import SMALL, product


def assert_same_in_value_and_derivatives(fast, plain, at):
    for one, other in ((fast, plain), (jax.jacrev(fast), jax.jacrev(plain)), (jax.hessian(fast), jax.hessian(plain))):
        # Round-off of a few steps; one program each, for operation by operation costs far more to compile.
        np.testing.assert_allclose(jax.jit(one)(at), jax.jit(other)(at), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(
    ("left", "right"),
    [((3,), (3,)), ((2, 3), (3,)), ((2, 3), (3, 4)), ((3,), (3, 2)), ((2, SMALL + 1), (SMALL + 1, 2))],
)
def test_a_small_product_is_the_product(left, right):
    """Of vectors and matrices, on both sides of the size from which on it is the library's."""
    random = np.random.default_rng(0)
    right = jnp.asarray(random.normal(size=right))
    assert_same_in_value_and_derivatives(
        lambda x: product(x, right), lambda x: x @ right, jnp.asarray(random.normal(size=left))
    )


def test_a_batch_of_small_products_is_their_products():
    """Of one side or of both, in forward and in reverse mode, by either side, and a batch of batches."""
    random = np.random.default_rng(0)
    left, right = (jnp.asarray(random.normal(size=shape)) for shape in ((5, 2, 3), (5, 3, 4)))
    for fast, plain in (
        (lambda x: jax.vmap(product)(x, right), lambda x: x @ right),
        (lambda x: jax.vmap(product, (0, None))(x, right[1]), lambda x: x @ right[1]),
        (lambda x: jax.vmap(jax.vmap(product, (None, 0)), (0, None))(x, right), lambda x: x[:, None] @ right),
    ):
        assert_same_in_value_and_derivatives(fast, plain, left)
        # Round-off of three terms, with room for another order of additions; so below.
        np.testing.assert_allclose(jax.jacfwd(fast)(left), jax.jacfwd(plain)(left), rtol=1e-12, atol=1e-12)
    by_right = (jax.jacrev(jax.vmap(f, (None, 0)), 1)(left[0], right) for f in (product, jnp.matmul))
    np.testing.assert_allclose(*by_right, rtol=1e-12, atol=1e-12)


class Driven(ig.AbstractSeparableHamiltonian):
    """A spring whose stiffness grows with time."""

    time: float = 0.0

    def kinetic(self, p):
        return 0.5 * p @ p

    def potential(self, q):
        return 0.5 * (1.0 + self.time) * q @ q

    def at(self, t):
        return Driven(t)


_FORCES = (ig.ViscousDamping(0.3), ig.CoulombFriction(0.1))


@pytest.mark.parametrize(
    ("system", "integrator"),
    [
        pytest.param(HenonHeiles(), ig.Leapfrog(), id="alone"),
        pytest.param(ig.Forced(HenonHeiles()), ig.Leapfrog(), id="without forces"),
        pytest.param(ig.Forced(HenonHeiles(), _FORCES), ig.Leapfrog(), id="with forces"),
        pytest.param(Driven(), ig.Leapfrog(), id="changing in time"),
        pytest.param(HenonHeiles(), ig.Tao(3.0), id="Tao"),
        pytest.param(HenonHeiles(), ig.Tao(None), id="Tao, unbound"),
        pytest.param(ig.Forced(HenonHeiles(), _FORCES[:1]), ig.Tao(3.0), id="Tao, forced", marks=pytest.mark.slow),
    ],
)
def test_many_steps_are_the_steps_one_by_one(system, integrator):
    """What ends a step and what begins the next are done at once, where that is the same: not with friction, nor where
    the system changes."""

    def steps(x):
        x = integrator.lift(x)
        for k in range(3):
            x = integrator.step(system, x, 0.5 + 0.2 * k, 0.2)
        return integrator.project(x)

    start = jnp.array([0.2, -0.25, 0.3, -0.25])
    assert_same_in_value_and_derivatives(lambda x: ig.propagate(system, integrator, x, 0.5, 1.1, 3), steps, start)


@pytest.mark.parametrize(
    ("system", "integrator"),
    [
        (sl.PolynomialPotential(2, 3, 0.1 * np.arange(9.0)), ig.Leapfrog()),
        pytest.param(
            sl.PolynomialPotential(2, 4, 0.1 * np.arange(14.0), sl.Legendre((1.5, 2.0))),
            ig.yoshida4(ig.Leapfrog()),
            marks=pytest.mark.slow,
        ),
        (sl.Polynomial(1, 3, 0.1 * np.sin(np.arange(9.0))), ig.Tao()),
        (sl.Polynomial(1, 2, 0.1 * np.arange(5.0)), ig.Tao(projection=ig.FirstCopy())),
        (HenonHeiles(), ig.RK2()),
        (sl.PolynomialPotential(1, 3, 0.1 * np.arange(3.0)), ig.ImplicitMidpoint()),
    ],
    ids=["leapfrog", "composed, Legendre", "Tao", "Tao, first copy", "a system of one's own", "implicit midpoint"],
)
def test_points_side_by_side_go_where_each_goes_alone(system, integrator):
    """The propagator of many points in columns is that of each."""
    d = 2 if getattr(system, "dim", 2) == 2 else 1
    points = 0.3 * jnp.asarray(np.random.default_rng(1).normal(size=(2 * d, 5)))
    propagator = sl.Propagator(system, integrator, 2)
    interval = sl.Interval(jnp.asarray(0.0), jnp.asarray(0.2))
    assert_same_in_value_and_derivatives(
        lambda x: propagator.side_by_side(x, interval),
        lambda x: jax.vmap(lambda one: propagator(one, interval), in_axes=1, out_axes=1)(x),
        points,
    )


def test_one_reading_is_a_recording():
    """Without a single interval the likelihood is that of the first reading alone."""
    model = sl.StateSpaceModel(
        sl.Propagator(HarmonicOscillator(), ig.Leapfrog()),
        sl.FullState(),
        sl.AdditiveGaussian(sl.ScaledIdentity(1e-2, 2)),
        sl.AdditiveGaussian(sl.ScaledIdentity(1.0, 2)),
        sl.Gaussian(jnp.zeros(2), 3.0 * jnp.eye(2)),
    )
    score = sl.MarginalLikelihood().score(model, sl.TimeSeries(jnp.zeros(1), jnp.array([[1.0, 2.0]])))
    assert float(score) == pytest.approx(np.log(2 * np.pi) + np.log(4.0) + 5.0 / 8.0, rel=1e-12)


@pytest.mark.parametrize(
    "escapes", [pytest.param(False, marks=pytest.mark.slow, id="sound"), pytest.param(True, id="failing")]
)
def test_a_long_recording_in_stretches_is_the_same(monkeypatch, escapes):
    """Whether a gradient keeps the state at every reading or at every sqrt(n)-th one, value and slopes are the same."""
    random = np.random.default_rng(0)
    times, inputs = jnp.arange(23.0) * 0.1, jnp.asarray(random.normal(size=(23, 1)))
    readings = random.normal(size=(23, 2))
    readings[4] = np.nan
    readings[15, 1] = np.nan

    def score(x, readings):
        start = jnp.where(escapes, 1e200, 0.3)
        model = sl.StateSpaceModel(
            sl.Propagator(sl.PolynomialPotential(1, 3, jnp.concatenate([x[:2], x[:1]])), ig.Leapfrog(), 2),
            sl.LinearObservation(jnp.array([[1.0, 0.0], [0.5, 1.0]]), x[2] * jnp.array([[1.0], [0.0]])),
            sl.AdditiveGaussian(sl.ScaledIdentity(jnp.exp(x[3]), 2)),
            sl.AdditiveGaussian(sl.ScaledIdentity(0.5, 2)),
            sl.Gaussian(start * jnp.ones(2), jnp.eye(2)),
        )
        return sl.log_likelihood(model, readings, intervals_between(times, inputs), sl.Instant(times, inputs))

    at = jnp.array([0.3, 0.8, 0.4, -3.0]), jnp.asarray(readings)
    found = []
    for kept in (0, 10**9):
        monkeypatch.setattr(_filter, "_KEPT", kept)
        value, slopes = jax.jit(jax.value_and_grad(lambda *both: score(*both), (0, 1)))(*at)
        # Curvature is compiled long, so only where there is some.
        curvature = () if escapes else (jax.jit(jax.hessian(lambda x: score(x, at[1])))(at[0]),)
        found.append((value, *slopes, *curvature))
    assert (float(found[0][0]) == -1e15) is escapes
    assert escapes or not np.any(np.asarray(found[0][1]) == 0.0)
    for one, other in zip(*found, strict=True):
        # Round-off of 23 filter steps, in another order of additions.
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-10)


def test_forward_and_reverse_mode_agree():
    """The guarded score's slope, by whichever mode, is that of the score."""

    def score(x):
        return jnp.sum(jnp.sin(x) * jnp.arange(1.0, 1.0 + x.size))

    for size in (1, 2, 13):
        at = jnp.linspace(0.1, 1.0, size)
        np.testing.assert_allclose(jax.grad(guarded(score, size))(at), jax.grad(score)(at), rtol=1e-12)  # round-off


def test_a_score_without_a_reverse_has_its_forward_slope():
    """A loop of traced length, which JAX cannot take backwards, is differentiated forwards however many parameters."""

    def score(x):
        turns = jnp.asarray(3 + x.size)
        return jax.lax.fori_loop(0, turns, lambda _, total: total + jnp.sum(jnp.sin(x * total)), jnp.ones(()))

    def unrolled(x):
        total = jnp.ones(())
        for _ in range(3 + x.size):
            total = total + jnp.sum(jnp.sin(x * total))
        return total

    x = jnp.array([0.1, -0.2, 0.4])
    value, slope = jax.value_and_grad(guarded(score, x.size))(x)
    np.testing.assert_allclose(value, unrolled(x), rtol=1e-12)  # round-off
    np.testing.assert_allclose(slope, jax.grad(unrolled)(x), rtol=1e-12)  # round-off
    np.testing.assert_allclose(jax.jit(gradient(score, x.size))(x), slope, rtol=1e-12)  # round-off
