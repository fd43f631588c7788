"""A filter that fails says which reading and why, with a finite, very low log density and finite gradients."""

import equinox as eqx
import hypothesis.extra.numpy as hnp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import integrators as ig
from symplearn._faults import SENTENCES, Fault
from symplearn._filter import log_likelihood, unscented_filter
from symplearn._hamiltonians import PolynomialPotential
from symplearn._model import (
    Coordinates,
    Gaussian,
    LinearDynamics,
    LinearObservation,
    Propagator,
    StateSpaceModel,
    intervals_between,
)
from symplearn._noise import AdditiveGaussian, Dense, Diagonal, Multiplicative, ScaledIdentity

N = 6
SPANS = intervals_between(jnp.arange(float(N)))
COUNT = 10_000


class Doubling(eqx.Module):
    """x' = x^2 (elementwise): from above 1 it escapes, doubling its exponent each time."""

    def __call__(self, x, interval):
        return x**2


class Angle(eqx.Module):
    """A nonlinear reading."""

    def __call__(self, x, context):
        return jnp.array([jnp.sin(x[0]) * jnp.exp(x[1])])


class Draws(eqx.Module):
    """A noise distribution given by its moments."""

    mean: jax.Array
    structure: Dense


def noisy(variance, dim):
    return AdditiveGaussian(ScaledIdentity(variance, dim))


def escaping(start=1.5, process=1e-4, measurement=1e-2):
    """A scalar model that leaves the reals."""
    parts = Doubling(), Coordinates((0,)), noisy(process, 1), noisy(measurement, 1)
    return StateSpaceModel(*parts, Gaussian(jnp.array([start]), jnp.zeros((1, 1))))


def filtered(model, ys, spans=SPANS):
    return eqx.filter_jit(unscented_filter)(model, jnp.asarray(ys), spans)


def test_an_escaping_trajectory_names_the_step():
    """1e40 squared again and again leaves the reals at the fourth reading: STATE, and the step is 3."""
    found = filtered(escaping(1e40), np.full((N, 1), np.nan))
    # 1e40 -> 1e80 -> 1e160 -> not finite.
    assert int(found.fault) == Fault.STATE and int(found.fault_step) == 3 and not bool(found.ok)
    assert float(found.log_likelihood) == -1e15
    assert "FAILED at reading 3: the dynamics gave a state that is not finite" in str(found)


@pytest.mark.slow
def test_a_reading_a_million_standard_deviations_away_is_scored_and_noted():
    """The log density is the Gaussian's own -(1e6)^2 / 2, its gradient finite, and the flag tells the step."""
    still = eqx.tree_at(lambda m: m.dynamics, escaping(0.0, process=0.0), LinearDynamics(jnp.eye(1)))
    ys = np.zeros((N, 1))
    ys[2] = 1e6 * 0.1
    found = filtered(still, ys)
    expected = -0.5e12 - N * (0.5 * np.log(2 * np.pi) + np.log(0.1))
    assert float(found.log_likelihood) == pytest.approx(expected, rel=1e-12)
    assert int(found.fault) == Fault.REMOTE and int(found.fault_step) == 2 and bool(found.ok)
    assert "note at reading 2" in str(found)
    slope = jax.grad(lambda v: log_likelihood(eqx.tree_at(variance, still, v), jnp.asarray(ys), SPANS))(0.01)
    # d/dv of -r^2 / (2 v) - (N / 2) log v.
    assert float(slope) == pytest.approx(1e10 / (2 * 0.01**2) - N / 0.02, rel=1e-9)


def variance(model):
    return model.measurement_noise.structure.variance


def failing():
    """What goes wrong, the model, the readings, and the step where it is met."""
    base, ys = escaping(0.5), np.zeros((N, 1))
    far = ys.copy()
    far[4] = 1e160
    silent = eqx.tree_at(variance, base, 0.0)
    exact = eqx.tree_at(lambda m: m.process_noise.structure.variance, silent, 0.0)
    yield Fault.COVARIANCE, eqx.tree_at(lambda m: m.process_noise.structure.variance, base, -1.0), ys, 1
    yield Fault.READING, eqx.tree_at(variance, base, -1.0), ys, 0
    yield Fault.COVARIANCE, eqx.tree_at(lambda m: m.initial.covariance, base, -jnp.eye(1)), ys, 0
    yield Fault.STATE, eqx.tree_at(lambda m: m.initial.mean, base, jnp.array([jnp.nan])), ys, 0
    yield Fault.SINGULAR, exact, ys, 0
    yield Fault.UNREACHED, base, far, 4


@pytest.mark.parametrize(("fault", "model", "ys", "step"), list(failing()))
def test_each_failure_has_its_name_step_and_sentence(fault, model, ys, step):
    """Every fatal fault is told apart, gives -1e15, and leaves no NaN in the record."""
    found = filtered(model, ys)
    assert Fault(int(found.fault)) == fault and int(found.fault_step) == step
    assert float(found.log_likelihood) == -1e15 and SENTENCES[fault] in str(found)
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(found))


def test_a_healthy_filter_has_no_fault():
    """Where nothing is wrong the fault is NONE, its step -1, and the increments add up."""
    found = filtered(escaping(0.5), np.full((N, 1), 0.1))
    assert int(found.fault) == Fault.NONE and int(found.fault_step) == -1 and "note" not in str(found)
    assert float(jnp.sum(found.increments)) == pytest.approx(float(found.log_likelihood), rel=1e-12)


def test_an_indefinite_covariance_is_not_taken_for_a_singular_one():
    """[[0, 1], [1, 0]] is refused as an initial covariance; [[1, 1], [1, 1]] is a good one."""
    parts = LinearDynamics(jnp.eye(2)), LinearObservation(jnp.eye(1, 2)), noisy(0.1, 2), noisy(0.1, 1)
    ys = np.zeros((N, 1))
    wrong = filtered(StateSpaceModel(*parts, Gaussian(jnp.zeros(2), jnp.array([[0.0, 1.0], [1.0, 0.0]]))), ys)
    right = filtered(StateSpaceModel(*parts, Gaussian(jnp.zeros(2), jnp.ones((2, 2)))), ys)
    assert int(wrong.fault) == Fault.COVARIANCE and int(right.fault) == Fault.NONE


def linear(numbers):
    A, H, Q, R, m, P = jnp.split(numbers, np.cumsum([4, 2, 4, 1, 2]))
    noises = AdditiveGaussian(Dense(Q.reshape(2, 2))), AdditiveGaussian(Diagonal(R))
    initial = Gaussian(m, P.reshape(2, 2))
    return StateSpaceModel(LinearDynamics(A.reshape(2, 2)), LinearObservation(H.reshape(1, 2)), *noises, initial)


def swinging(numbers):
    c, q, r, m, p = jnp.split(numbers, np.cumsum([9, 1, 1, 2]))
    dynamics = Propagator(PolynomialPotential(1, 9, c), ig.Leapfrog(), 3)
    initial = Gaussian(m, p.reshape(2, 2))
    return StateSpaceModel(dynamics, Angle(), noisy(q[0], 2), noisy(r[0], 1), initial)


def multiplied(numbers):
    c, w, Q, v, r, m, p = jnp.split(numbers, np.cumsum([3, 2, 4, 1, 2, 2]))
    dynamics = Propagator(PolynomialPotential(1, 3, c), ig.Tao(omega=5.0), 2)
    process = Multiplicative(Draws(w, Dense(Q.reshape(2, 2))), noisy(r[0], 2))
    reading = Multiplicative(Draws(v, Dense(jnp.eye(1))), noisy(r[1], 1))
    return StateSpaceModel(dynamics, Angle(), process, reading, Gaussian(m, p.reshape(2, 2)))


def checked(build):
    """The value and its derivatives by model and readings, in reverse and in forward mode.

    Each mode gives its own value: where numbers of 1e-132 meet, round-off decides whether a covariance is singular.
    """

    def score(numbers, ys):
        value = log_likelihood(build(numbers), ys, SPANS)
        return value, value

    return jax.jit(lambda *data: (jax.grad(score, has_aux=True)(*data), jax.jacfwd(score, has_aux=True)(*data)))


MODELS = {"linear": (checked(linear), 17), "swinging": (checked(swinging), 17), "multiplied": (checked(multiplied), 18)}
ORDINARY = st.floats(-3.0, 3.0)
WILD = st.floats(allow_nan=True, allow_infinity=True)


def arrays(shape):
    """Numbers of ordinary size, of any size, and the special ones; often equal, so that matrices are singular."""
    wild = hnp.arrays(float, shape, elements=ORDINARY | WILD, fill=ORDINARY)
    return wild | hnp.arrays(float, shape, elements=ORDINARY)


def never_nan(kind, examples):
    run, size = MODELS[kind]

    @settings(max_examples=examples, deadline=None, derandomize=True, database=None)
    @given(arrays(size), arrays((N, 1)))
    def check(numbers, ys):
        for slope, value in run(numbers, ys):
            assert np.isfinite(value) and value >= -1e15 and np.all(np.isfinite(slope))
            assert value > -1e15 or not np.any(slope)

    check()


@pytest.mark.parametrize("kind", ["linear", *(pytest.param(k, marks=pytest.mark.slow) for k in [*MODELS][1:])])
def test_random_models_never_give_nan(kind):
    """Models and recordings of any numbers, infinite ones among them: finite value, finite gradients, or a fault."""
    never_nan(kind, 150)


@pytest.mark.slow
@pytest.mark.parametrize("kind", MODELS)
def test_ten_thousand_random_models_never_give_nan(kind):
    """The same for ten thousand models of each kind."""
    never_nan(kind, COUNT)
