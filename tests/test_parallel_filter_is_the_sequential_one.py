"""The parallel-in-time Kalman filter gives the sequential one's numbers and faults, in a depth that grows as log n."""

from typing import Any, NamedTuple

import equinox as eqx
import estimation_cases as cases
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import ClosedJaxpr, Jaxpr

import integrators as ig
import symplearn as sl

PARALLEL, SEQUENTIAL = sl.ParallelInTime(), sl.Sequential()
RANDOM = np.random.default_rng(0)


class Case(NamedTuple):
    """A linear model by three numbers, and a recording."""

    A: Any
    H: Any
    process: Any
    readings: Any
    start: Any
    times: Any = None
    inputs: Any = None
    B: Any = None
    D: Any = None

    def model(self, x):
        """Slope, process noise and measurement noise are x times what they are."""
        d, channels = len(self.A), len(self.H)
        Gamma = sl.Dense(0.2 * x[2] * (np.eye(channels) + 0.3))
        return sl.StateSpaceModel(
            sl.LinearDynamics(x[0] * jnp.asarray(self.A), self.B),
            sl.LinearObservation(jnp.asarray(self.H), self.D),
            sl.WienerIncrement(sl.Dense(x[1] * jnp.asarray(self.process))),
            sl.Additive(sl.MultivariateNormal(0.1 * np.ones(channels), Gamma)),
            sl.Gaussian(jnp.ones(d), jnp.asarray(self.start)),
        )

    def records(self):
        """Readings, data intervals and instants."""
        times = jnp.arange(float(len(self.readings))) if self.times is None else jnp.asarray(self.times)
        inputs = None if self.inputs is None else jnp.asarray(self.inputs)
        return jnp.asarray(self.readings), sl.intervals_between(times, inputs), sl.Instant(times, inputs)


def readings(n, channels, missing=()):
    ys = RANDOM.normal(size=(n, channels))
    for place in missing:
        ys[place] = np.nan
    return ys


TURN = 0.9 * np.array([[0.8, 0.6], [-0.6, 0.8]])
CASES = {
    "gaps, inputs and uneven times": Case(
        TURN, np.array([[1.0, 0.5], [0.0, 1.0]]), np.diag([0.1, 0.4]), readings(13, 2, [0, 3, 4, (9, 1), (12, 0)]),
        np.eye(2), np.cumsum(RANDOM.uniform(0.5, 2.0, 13)), RANDOM.normal(size=(13, 1)), np.array([[0.0], [1.0]]),
        np.array([[0.3], [-1.0]]),
    ),
}  # fmt: skip
MORE = {
    "a known start, and a state without noise": Case(
        TURN, np.ones((1, 2)), np.diag([0.0, 0.2]), readings(13, 1), np.zeros((2, 2))
    ),
    "one reading": Case(TURN, np.eye(2)[:1], np.eye(2), readings(1, 1), np.eye(2)),
    "two readings": Case(TURN, np.eye(2)[:1], np.eye(2), readings(2, 1), np.eye(2)),
    "more channels than states, growing, of any start": Case(
        np.array([[1.2]]), RANDOM.normal(size=(3, 1)), np.array([[0.5]]), readings(64, 3), np.array([[1e6]])
    ),
    "five states, many readings": Case(
        RANDOM.normal(size=(5, 5)) / 4, RANDOM.normal(size=(2, 5)), np.eye(5), readings(1000, 2), np.eye(5)
    ),
}


def same(found, expected):
    assert bool(found[0].ok)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-10)


def history(case, passage, x):
    """Of the filter, by the three numbers."""
    return sl.kalman_filter(case.model(x), *case.records(), passage)


def scored(case, passage):
    """The history, and the slopes of the score by the three numbers."""

    def score(x):
        filtered = history(case, passage, x)
        return filtered.log_likelihood, filtered

    slopes, filtered = jax.jit(jax.grad(score, has_aux=True))(jnp.array([1.0, 0.8, 1.1]))
    return filtered, slopes


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_score_slopes_and_moments_are_the_sequential_ones(case):
    """To 1e-10: likelihood, gradient, predicted and filtered moments, innovations; with gaps and inputs."""
    same(scored(case, PARALLEL), scored(case, SEQUENTIAL))


@pytest.mark.slow
@pytest.mark.parametrize("case", MORE.values(), ids=MORE)
def test_recordings_of_any_size_are_filtered_alike(case):
    """To 1e-10: likelihood and moments of one reading, two, a thousand; from a start known or all but unknown."""
    found = (jax.jit(lambda x, p=passage: history(case, p, x))(jnp.ones(3)) for passage in (PARALLEL, SEQUENTIAL))
    same(*([one] for one in found))


def test_the_score_is_the_textbook_kalman_filters():
    """An independent filter in NumPy, which cuts rows down to the channels that were read, gives the same."""
    system = cases.linear_system()
    ys = cases.simulate(*system, 29, RANDOM)[1]
    ys[4], ys[7, 0] = np.nan, np.nan
    expected, m, P = cases.kalman_log_likelihood(*system, ys)
    model = eqx.tree_at(lambda m: m.dynamics, cases.as_model(*system), sl.LinearDynamics(system[0]))
    filtered = eqx.filter_jit(sl.kalman_filter)(model, ys, sl.intervals_between(jnp.arange(29.0)), None, PARALLEL)
    # Round-off of 29 steps in another order; so below.
    assert float(filtered.log_likelihood) == pytest.approx(expected, rel=1e-12)
    np.testing.assert_allclose(filtered.filtered_means[-1], m, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(filtered.filtered_covariances[-1], P, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_the_objective_takes_it_as_an_option():
    """Several recordings under `vmap`, a flat prior on the first reading, and a list: all as sequentially."""
    ys = RANDOM.normal(size=(3, 9, 2))
    noises = (sl.AdditiveGaussian(sl.ScaledIdentity(v, 2)) for v in (0.5, 0.1))
    model = sl.StateSpaceModel(sl.LinearDynamics(0.9 * np.eye(2)), sl.FullState(), *noises)
    series = [sl.TimeSeries(np.arange(9.0), y) for y in ys]
    by_passage = []
    for passage in (PARALLEL, SEQUENTIAL):
        objective = sl.MarginalLikelihood(passage=passage)
        many = jax.vmap(lambda y, objective=objective: objective.score(model, sl.TimeSeries(np.arange(9.0), y)))
        one = -objective.filter(model, series[1]).log_likelihood
        by_passage.append((*jax.jit(many)(ys), one, jax.jit(lambda both=objective: both(model, series))()))
    np.testing.assert_allclose(*by_passage, rtol=1e-10)
    assert float(by_passage[0][-1]) == pytest.approx(sum(map(float, by_passage[0][:3])), rel=1e-12)  # round-off


def faulty(x, passage):
    """A system whose slope, measurement variance and fifth reading are given."""
    slope, variance, reading = x
    ys = jnp.zeros((8, 1)).at[4, 0].set(reading).at[6, 0].set(2.0)
    model = sl.StateSpaceModel(
        sl.LinearDynamics(slope * jnp.eye(1)),
        sl.LinearObservation(jnp.eye(1)),
        sl.AdditiveGaussian(sl.ScaledIdentity(0.0, 1)),
        sl.AdditiveGaussian(sl.ScaledIdentity(variance, 1)),
        sl.Gaussian(jnp.ones(1), jnp.eye(1)),
    )
    filtered = sl.unscented_filter(model, ys, sl.intervals_between(jnp.arange(8.0)), passage=passage)
    return filtered.log_likelihood, filtered


@pytest.mark.slow
def test_faults_are_the_sequential_ones():
    """An escape, a negative variance, a singular innovation, readings too far away: same fault, reading, score and
    slopes, those by the readings among them, without NaN."""
    at = jnp.array(
        [[0.9, 0.1, 0.0], [jnp.inf, 0.1, 0.0], [jnp.nan, 0.1, 0.0], [0.9, -1.0, 0.0], [0.9, 0.0, 0.0], [0.9, 0.1, 1e5],
         [0.9, 0.1, 1e9]]
    )  # fmt: skip
    found, expected = (
        jax.jit(jax.vmap(jax.value_and_grad(lambda x, p=passage: faulty(x, p), has_aux=True)))(at)
        for passage in (PARALLEL, SEQUENTIAL)
    )
    (values, filtered), slopes = found
    wanted = [
        sl.Fault.NONE, sl.Fault.STATE, sl.Fault.STATE, sl.Fault.READING, sl.Fault.SINGULAR, sl.Fault.REMOTE,
        sl.Fault.UNREACHED,
    ]  # fmt: skip
    assert filtered.fault.tolist() == wanted
    for field in ("fault", "fault_step", "log_likelihood", "increments"):
        np.testing.assert_allclose(getattr(filtered, field), getattr(expected[0][1], field), rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(slopes, expected[1], rtol=1e-10, atol=1e-10)
    failed = np.asarray(values) == -1e15
    assert failed.tolist() == [False, True, True, True, True, False, True]
    assert not np.any(slopes[failed]) and np.all(np.any(slopes[~failed] != 0.0, axis=1))
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(filtered))


def pendulum():
    noises = (sl.AdditiveGaussian(sl.ScaledIdentity(1e-2, d)) for d in (2, 1))
    dynamics = sl.Propagator(ig.problems.Pendulum(gravity=1.0), ig.Leapfrog())
    return sl.StateSpaceModel(dynamics, sl.Coordinates((0,)), *noises, sl.Gaussian(jnp.ones(2), jnp.eye(2)))


def multiplied():
    noise = sl.Multiplicative(sl.Uniform(0.9, 1.1, dim=2))
    model = eqx.tree_at(lambda m: m.dynamics, pendulum(), sl.LinearDynamics(jnp.eye(2)))
    return eqx.tree_at(lambda m: m.process_noise, model, noise)


def general():
    noise = sl.MultivariateNormal(np.zeros(1), sl.Dense(np.eye(1)))
    start = sl.Gaussian(jnp.ones(1), jnp.eye(1))
    return sl.HiddenMarkovModel(lambda x, w, _: x + w, lambda x, v, _: x + v, noise, noise, start)


@pytest.mark.parametrize(
    ("model", "sentence"),
    [
        (pendulum(), "linear models, but the dynamics is `Propagator`; use `Sequential`"),
        (multiplied(), "noise that is added, but the process noise is `Multiplicative`; use `Sequential`"),
        (general(), "linear `StateSpaceModel`, not `HiddenMarkovModel`; use `Sequential`"),
    ],
    ids=["dynamics", "noise", "model"],
)
def test_what_is_not_linear_is_refused(model, sentence):
    """A nonlinear model, or noise that multiplies, gets one sentence: what it is, and what to use."""
    with pytest.raises(sl.InputError, match=sentence):
        sl.MarginalLikelihood(passage=PARALLEL)(model, sl.TimeSeries(np.arange(4.0), np.zeros((4, 1))))


def depth(program: Jaxpr) -> int:
    """Operations one after another: a loop's body as often as it is run, whatever the size of the arrays."""
    total = 0
    for equation in program.eqns:
        parts = [one for one in jax.tree.leaves(equation.params, is_leaf=is_program) if is_program(one)]
        inner = [depth(part.jaxpr if isinstance(part, ClosedJaxpr) else part) for part in parts]
        total += equation.params.get("length", 1) * sum(inner) if inner else 1
    return total


def is_program(part):
    return isinstance(part, ClosedJaxpr | Jaxpr)


@pytest.mark.slow
def test_depth_grows_as_the_logarithm():
    """Twice the readings take one round more, in value and gradient; sequentially they take twice the operations."""

    def depths(passage):
        score = jax.grad(lambda a, ys: faulty_score(a, ys, passage))
        return [depth(jax.make_jaxpr(score)(0.9, jnp.zeros((n, 1))).jaxpr) for n in (256, 512, 1024, 1000)]

    at_256, at_512, at_1024, at_1000 = depths(PARALLEL)
    assert at_1024 == at_1000
    assert at_1024 - at_512 == at_512 - at_256 > 0
    one_more, twice = at_512 - at_256, depths(SEQUENTIAL)
    # Ten rounds and what is done once.
    assert at_1024 < 12 * one_more and twice[2] > 1.9 * twice[1] > 3.6 * twice[0]


def faulty_score(slope, ys, passage):
    model = sl.StateSpaceModel(
        sl.LinearDynamics(slope * jnp.eye(2)),
        sl.Coordinates((0,)),
        sl.AdditiveGaussian(sl.ScaledIdentity(0.1, 2)),
        sl.AdditiveGaussian(sl.ScaledIdentity(0.1, 1)),
        sl.Gaussian(jnp.ones(2), jnp.eye(2)),
    )
    return sl.log_likelihood(model, ys, sl.intervals_between(jnp.arange(float(len(ys)))), passage=passage)


def test_it_lowers_for_a_gpu():
    """The gradient can be written as a program for CUDA, which needs no GPU."""
    score = jax.jit(jax.grad(lambda a, ys: faulty_score(a, ys, PARALLEL)))
    program = jax.export.export(score, platforms=["cuda"])(0.9, jnp.zeros((16, 1)))
    assert program.platforms == ("cuda",)
