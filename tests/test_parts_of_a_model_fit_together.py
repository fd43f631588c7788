"""What cannot be part of a model, or does not fit the others, is refused in a sentence as soon as it can be known."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

import integrators as ig
import symplearn as sl
from symplearn import InputError

A = np.array([[1.0, 0.2], [-0.5, 0.9]])
ASYMMETRIC = np.array([[1.0, 2.0], [0.0, 5.0]])
RECORDING = sl.TimeSeries(np.arange(5.0), np.zeros((5, 1)))


@pytest.fixture(autouse=True)
def _as_users_have_it(monkeypatch):
    """The tests' own check of annotations, which a user does not have, would speak first."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


def model(dynamics=None, observation=None, noise=None, mean=None, covariance=None):
    """A linear model of two numbers, one of them read, with some part of it in another's place."""
    return sl.StateSpaceModel(
        sl.LinearDynamics(A) if dynamics is None else dynamics,
        sl.Coordinates((0,)) if observation is None else observation,
        sl.AdditiveGaussian(sl.ScaledIdentity(0.1, dim=2)) if noise is None else noise,
        sl.AdditiveGaussian(sl.ScaledIdentity(0.1, dim=1)),
        sl.Gaussian(np.zeros(2) if mean is None else mean, np.eye(2) if covariance is None else covariance),
    )


def two_read(dynamics=None):
    """The linear model with both numbers read."""
    both = sl.AdditiveGaussian(sl.ScaledIdentity(0.1, dim=2))
    return eqx.tree_at(lambda m: m.measurement_noise, model(dynamics, sl.FullState()), both)


def noise(structure):
    """Process noise of that structure."""
    return sl.AdditiveGaussian(structure)


MISFITS = {
    "an entry beyond the state": (lambda: model(observation=sl.Coordinates((2,))), "reads entry 2, .* has 2 numbers"),
    "dynamics of three": (lambda: model(sl.LinearDynamics(np.eye(3))), "dynamics is for 3 numbers, .* has 2"),
    "reading of three": (lambda: model(observation=sl.LinearObservation(np.ones((1, 3)))), "observation is for 3"),
    "identity of one": (lambda: model(noise=noise(sl.ScaledIdentity(0.1, dim=1))), "process noise is for 1 numbers"),
    "three variances": (lambda: model(noise=noise(sl.Diagonal(np.ones(3)))), "process noise is for 3"),
    "wrapped variances": (
        lambda: model(noise=sl.WienerIncrement(sl.Diagonal(sl.StandardDeviation(sl.Positive(np.ones(3)))))),
        "process noise is for 3",
    ),
    "a learnt covariance": (lambda: model(noise=noise(sl.Dense(sl.PositiveDefinite(np.eye(3))))), "noise is for 3"),
    "correlated": (lambda: model(noise=noise(sl.Correlated(np.ones(3), np.eye(3)))), "process noise is for 3"),
    "a longer start": (lambda: model(mean=sl.Learnt(np.zeros(3)), covariance=np.eye(3)), "is for 2 .* has 3"),
}


@pytest.mark.parametrize("build, said", MISFITS.values(), ids=MISFITS.keys())
def test_parts_of_other_sizes(build, said):
    """A part that is for a state of another size than the initial distribution's is named when the model is built."""
    with pytest.raises(InputError, match=said):
        build()


def test_sizes_that_the_recording_tells():
    """Without an initial distribution the state is as large as a reading, and the process noise is held against it."""
    parts = sl.LinearDynamics(A), sl.FullState(), noise(sl.ScaledIdentity(0.1, dim=1))
    open_start = sl.StateSpaceModel(*parts, sl.AdditiveGaussian(sl.ScaledIdentity(0.1, dim=2)))
    with pytest.raises(InputError, match="process noise is for 1 numbers, but the state has 2"):
        sl.MarginalLikelihood()(open_start, sl.TimeSeries(np.arange(5.0), np.zeros((5, 2))))


def test_entries_of_a_state_that_comes_later():
    """Coordinates that are used by themselves are held against the state they are given, under `jit` too."""
    with pytest.raises(InputError, match="reads entry 5"):
        jax.jit(sl.Coordinates((0, 5)))(jnp.zeros(4))
    with pytest.raises(InputError, match="from 0 to 3"):
        sl.Coordinates((4,)).slope(jnp.zeros(4))
    assert sl.Coordinates([1, 3])(jnp.arange(4.0)).tolist() == [1.0, 3.0]


ODD = {
    "negative": (lambda: sl.Coordinates((-1,)), "`indices` of at least 0"),
    "fraction": (lambda: sl.Coordinates((0.5,)), "`indices` of at least 0, a whole number, but was given 0.5"),
    "number": (lambda: sl.Coordinates(0), r"such as \(0,\), but was given 0"),
    "none": (lambda: sl.Coordinates(()), r"such as \(0,\)"),
    "A of two rows": (lambda: sl.LinearDynamics(np.ones((2, 3))), r"square matrix \(d, d\) as its A"),
    "A a vector": (lambda: sl.LinearDynamics(np.ones(2)), "square matrix"),
    "B of three rows": (lambda: sl.LinearDynamics(A, np.ones((3, 1))), "B of as many rows"),
    "D of two rows": (lambda: sl.LinearObservation(np.ones((1, 2)), np.ones((2, 1))), "give feedthrough 1 rows"),
    "H a vector": (lambda: sl.LinearObservation(np.ones(2)), "needs a matrix as its matrix"),
    "variances a number": (lambda: sl.Diagonal(0.1), "vector of variances"),
    "no identity": (lambda: sl.ScaledIdentity(0.1, dim=0), "`dim` of at least 1"),
    "covariance a number": (lambda: sl.Gaussian(np.zeros(2), 2.0), r"square matrix .* shape \(\)"),
    "covariance a vector": (lambda: sl.Gaussian(np.zeros(2), np.ones(2)), "square matrix"),
    "mean of three": (lambda: sl.Gaussian(np.zeros(3), np.eye(2)), r"shapes \(3,\) and \(2, 2\)"),
    "one coefficient short": (lambda: sl.PolynomialPotential(1, 4, np.ones(3)), "4 terms needs as many"),
    "learnt ones short": (lambda: sl.Polynomial(1, 2, sl.Learnt(np.ones(4))), "5 terms needs as many"),
    "degree of zero": (lambda: sl.PolynomialPotential(1, 0), "`degree` of at least 1"),
    "degree below": (lambda: sl.PolynomialPotential(1, -1), "`degree` of at least 1"),
    "no dimension": (lambda: sl.Polynomial(0, 2), "`dim` of at least 1"),
    "not a number": (lambda: sl.Positive(np.nan), "given NaN or infinity"),
    "zero": (lambda: sl.Positive(0.0), "given 0 or less"),
    "half-width of zero": (lambda: sl.Legendre(0.0), "positive half-widths, but was given 0.0"),
    "half-widths of two": (
        lambda: sl.PolynomialPotential(1, 2, basis=sl.Legendre([2.0, 3.0])),
        "2 half-widths, but the polynomial 1 variables",
    ),
    "scale of zero": (lambda: sl.OneStepL1(0.0), "positive scale"),
    "scale that is none": (lambda: sl.OneStepL1(np.nan), "positive scale"),
    "variance of rates": (lambda: sl.HamiltonianLeastSquares(-1.0), "positive variances"),
    "variance of gaps": (lambda: sl.GaussianContinuity(-1.0), "positive variances"),
    "rate that is none": (lambda: sl.Adam(np.nan), "positive learning rate"),
    "a bound at infinity": (lambda: sl.Bounded(1.0, 0.0, np.inf), "needs finite bounds"),
    "a bound that is none": (lambda: sl.Bounded(1.0, np.nan, 2.0), "needs finite bounds"),
    "mean that is none": (lambda: sl.Normal(np.nan), "finite mean"),
}


@pytest.mark.parametrize("build, said", ODD.values(), ids=ODD.keys())
def test_parts_that_are_none(build, said):
    """What can be no part of any model says so when it is made."""
    with pytest.raises(InputError, match=said):
        build()


@pytest.mark.parametrize(
    "build",
    [
        lambda matrix: sl.Gaussian(np.zeros(2), matrix),
        lambda matrix: sl.Gaussian(sl.Learnt(np.zeros(2)), sl.Frozen(matrix)),
        sl.Dense,
        lambda matrix: sl.Correlated(np.ones(2), matrix),
    ],
)
def test_covariances_are_symmetric(build):
    """Of an asymmetric covariance one triangle would be ignored: it is refused; rounding is not."""
    with pytest.raises(InputError, match="2 in row 0, column 1 and 0 across the diagonal"):
        build(ASYMMETRIC)
    root = np.random.default_rng(0).normal(size=(2, 2)).astype(np.float32)
    rounded = root @ np.diag(np.float32([1.0, 1e-3])) @ root.T
    build(rounded + np.float32([[0.0, 1e-7], [0.0, 0.0]]))  # an error of single precision
    build(np.array([[np.nan, 1.0], [1.0, 1.0]]))  # the filter's to tell


@pytest.mark.parametrize(
    "build, said",
    [
        (lambda: sl.ScaledIdentity(-0.1, dim=2), "variance of at least 0, but was given -0.1"),
        (lambda: sl.Diagonal([0.1, -0.2]), "variances of at least 0, but was given -0.2"),
    ],
)
def test_variances_are_no_less_than_zero(build, said):
    """A sign that is wrong is told where it is given, and not by a score that is worst; zero is kept."""
    with pytest.raises(InputError, match=said):
        build()
    assert sl.ScaledIdentity(sl.LogVariance(-2.0), dim=2).size == sl.Diagonal([0.0, 0.0]).size


def test_traced_numbers_are_let_through():
    """Inside a transformation there are shapes to look at and no numbers: parts are built there as before."""

    @jax.jit
    def score(matrix, mean):
        return sl.MarginalLikelihood()(model(sl.LinearDynamics(matrix), mean=mean, covariance=matrix), RECORDING)

    assert np.isfinite(score(np.eye(2), np.ones(2)))
    stacked = eqx.filter_vmap(lambda mean: sl.Gaussian(mean, jnp.eye(2)))(jnp.ones((4, 2)))
    assert stacked.mean.shape == (4, 2) and jax.tree.map(lambda leaf: leaf, stacked).mean.shape == (4, 2)
    with pytest.raises(InputError, match="dynamics is for 3"):
        jax.jit(lambda a: model(sl.LinearDynamics(a)))(np.eye(3))


def potential():
    """A potential to step."""
    return sl.PolynomialPotential(1, 2)


COUNTS = {
    "Propagator": lambda n: sl.Propagator(potential(), ig.Leapfrog(), substeps=n),
    "DoubledPropagator": lambda n: sl.DoubledPropagator(potential(), ig.Tao(1.0), substeps=n),
    "ForwardEuler": lambda n: sl.ForwardEuler(lambda x: x, substeps=n),
    "EverySteps": sl.EverySteps,
    "MiniBatch": lambda n: sl.MiniBatch(n, jax.random.key(0)),
    "Lasso": lambda n: sl.Lasso(0.1, max_sweeps=n),
    "SequentialThresholding": lambda n: sl.SequentialThresholding(0.1, max_steps=n),
    "RandomWalk": lambda n: sl.RandomWalk(thin=n),
    "NUTS": lambda n: sl.NUTS(draws=n),
    "GaussHermite": sl.GaussHermite,
    "NSSNN": lambda n: sl.NSSNN(dim=1, width=n, key=jax.random.key(0)),
}


@pytest.mark.parametrize("given", [2.5, True, "3", 0, None])
@pytest.mark.parametrize("owner", COUNTS)
def test_counts_are_whole_numbers(owner, given):
    """A step that is cut in two and a half integrates over another time: what counts is a whole number."""
    with pytest.raises(InputError, match=f"`{owner}` needs .* whole number, but was given {given!r}"):
        COUNTS[owner](given)


VERBS = {
    "fit": lambda n: sl.fit(None, None, prior=sl.Flat(), max_steps=n),
    "fit_constrained": lambda n: sl.fit_constrained(None, None, None, prior=sl.Flat(), max_steps=n),
    "modes": lambda n: sl.modes(None, draws=n),
    "stochastic_forecast": lambda n: sl.stochastic_forecast(None, draws=n, key=jax.random.key(0)),
}


@pytest.mark.parametrize("given", [2.5, 0])
@pytest.mark.parametrize("verb", VERBS)
def test_verbs_refuse_counts_of_nothing(verb, given):
    """A fit of no step and a forecast of no draw, or of a part of one, are refused before anything is looked at."""
    with pytest.raises(InputError, match=f"`{verb}` needs .* whole number, but was given {given!r}"):
        VERBS[verb](given)


PENDULUM = sl.StateSpaceModel(
    sl.Propagator(sl.PolynomialPotential(1, 2, sl.Learnt(np.ones(2))), ig.Leapfrog()),
    sl.FullState(),
    sl.WienerIncrement(sl.ScaledIdentity(0.1, dim=2)),
    sl.AdditiveGaussian(sl.ScaledIdentity(0.1, dim=2)),
)
WIDE = sl.TimeSeries(np.arange(5.0), np.ones((5, 4)))
UNREAD = sl.TimeSeries(np.arange(5.0), np.array([[np.nan, 1.0], *[[1.0, 1.0]] * 4]))
EMPTY = sl.TimeSeries(np.arange(5.0), np.full((5, 2), np.nan))
GAP = sl.TimeSeries(np.array([0.0, 1.0, 2.0, 4.0]), np.ones((4, 1)))
PUSHED = sl.TimeSeries(np.arange(5.0), np.ones((5, 2)), np.ones((5, 1)))
STARTS = eqx.tree_at(lambda m: m.initial, model(), (sl.Gaussian(np.zeros(2), np.eye(2)),) * 2)
TRAINING = {"prior": sl.Flat(), "epochs": 1, "key": jax.random.key(0)}


RECORDED = {
    "least squares": (lambda: sl.hamiltonian_least_squares(sl.Polynomial(1, 2), WIDE), "1 degrees of freedom"),
    "objective": (lambda: sl.HamiltonianLeastSquares(1.0)(PENDULUM, WIDE), "1 degrees of freedom"),
    "training": (
        lambda: sl.train(PENDULUM, WIDE, sl.OneStepL1(1.0), optimiser=sl.Adam(), **TRAINING),
        "1 degrees of freedom",
    ),
    "no readings": (
        lambda: sl.train(PENDULUM, EMPTY, sl.OneStepL1(1.0), optimiser=sl.Adam(), **TRAINING),
        "Every reading is missing",
    ),
    "a rule's name": (
        lambda: sl.train(PENDULUM, UNREAD, sl.OneStepL1(1.0), optimiser="adam", **TRAINING),
        "needs an optimiser, .* given `adam`",
    ),
    "a start to fit": (lambda: sl.fit(PENDULUM, UNREAD, prior=sl.Flat()), "first row has missing readings"),
    "a start to learn": (lambda: sl.learn(PENDULUM, UNREAD, prior=sl.Flat()), "first row has missing readings"),
    "a start to filter": (lambda: sl.MarginalLikelihood().filter(PENDULUM, UNREAD), "first row has missing readings"),
    "a row left out": (lambda: sl.MarginalLikelihood().filter(model(), GAP), "all intervals must be equal, .* 1 to 2;"),
    "a row left out of a fit": (
        lambda: sl.fit(model(sl.LinearDynamics(sl.Learnt(A))), GAP, prior=sl.Flat()),
        "all intervals must be equal",
    ),
    "a system that is pushed": (
        lambda: sl.MarginalLikelihood().filter(PENDULUM, PUSHED),
        "has inputs, which `Propagator` .* would ignore",
    ),
    "dynamics without B": (
        lambda: sl.fit(model(sl.LinearDynamics(sl.Learnt(A)), sl.FullState()), PUSHED, prior=sl.Flat()),
        "has inputs, which `LinearDynamics` .* would ignore",
    ),
    "readings of one channel more": (
        lambda: sl.kalman_filter(model(), np.ones((5, 2)), sl.intervals_between(np.arange(5.0))),
        "readings have 2 channels, but .* observation gives 1",
    ),
    "of one channel less": (
        lambda: sl.unscented_filter(two_read(), np.ones((5, 1)), sl.intervals_between(np.arange(5.0))),
        "readings have 1 channels, but .* observation gives 2",
    ),
    "several starts": (lambda: sl.MarginalLikelihood().filter(STARTS, RECORDING), "has 2 initial distributions"),
}


@pytest.mark.parametrize("use, said", RECORDED.values(), ids=RECORDED.keys())
def test_recordings_fit_the_model(use, said):
    """A recording of other widths or intervals, with inputs that nothing takes, without a first reading or without any
    is refused before anything is compiled."""
    with pytest.raises(InputError, match=said):
        use()


class Carried(ig.AbstractSeparableHamiltonian):
    """A frame that is moved: a system that changes with time, and may know the inputs."""

    now: float = 0.0

    def kinetic(self, p):
        return 0.5 * p @ p

    def potential(self, q):
        return 0.5 * (q - self.now) @ (q - self.now)

    def at(self, t):
        return Carried(t)


class Pushed(eqx.Module):
    """x' = A x + u: a map of one's own, which takes the interval."""

    def __call__(self, x, interval):
        return A @ x + interval.input


@pytest.mark.parametrize(
    "dynamics", [sl.Propagator(Carried(), ig.Leapfrog()), Pushed(), sl.LinearDynamics(A, np.eye(2, 1))]
)
def test_inputs_that_may_be_known_are_let_through(dynamics):
    """Inputs are no fault where the dynamics takes them, or may: a map of one's own, a system that changes with time;
    nor is a clock that is rounded."""
    times = np.array([0.0, 0.033, 0.067, 0.1, 0.133])  # thirty rows a second, in milliseconds
    pushed = sl.TimeSeries(times, np.ones((5, 2)), np.ones((5, 1)))
    assert bool(sl.MarginalLikelihood().filter(two_read(dynamics), pushed).ok)


def test_strengths_of_binding_are_numbers():
    """Tao's copies are bound by a finite strength, or not at all."""
    with pytest.raises(ValueError, match="`Tao` needs a finite `omega`"):
        ig.Tao(np.nan)
    assert ig.Tao(None).omega is None


def test_integrators_count_whole_substeps():
    """Nor does the mechanics below take a fraction of a step."""
    with pytest.raises(ValueError, match="whole number from 1 up, but is 2.5"):
        ig.propagate(potential(), ig.Leapfrog(), jnp.ones(2), 0.0, 1.0, 2.5)


def test_recordings_keys_and_samplers_are_what_they_are():
    """A bare array, a seed and a sampler's name are told from a recording, a key and a sampler."""
    with pytest.raises(InputError, match="a `ndarray` has none; give `TimeSeries"):
        sl.dmd(np.ones((5, 2)))
    with pytest.raises(InputError, match="`jax.random.key"):
        sl.simulate(model(), np.arange(5.0), 0)
    with pytest.raises(InputError, match="`jax.random.key"):
        sl.sample_density(lambda x: -x @ x, jnp.zeros(1), key=0)
    for wrong in ("NUTS", sl.NUTS):
        with pytest.raises(InputError, match="an object with its options"):
            sl.sample_density(lambda x: -x @ x, jnp.zeros(1), sampler=wrong, key=jax.random.key(0))
    with pytest.raises(InputError, match="`compare_samplers` needs a list"):
        sl.compare_samplers(None, sl.NUTS(), key=jax.random.key(0))
    with pytest.raises(InputError, match="`jax.random.key"):
        sl.compare_samplers(None, [sl.NUTS()], key=0)
