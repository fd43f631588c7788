"""Learning starts itself: no initial value of the caller's decides where it ends."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.stats import chi2

import integrators as ig
from symplearn._errors import InputError
from symplearn._evidence import laplace_evidence
from symplearn._hamiltonians import Legendre, Polynomial, PolynomialPotential
from symplearn._learn import learn
from symplearn._log_posterior import negative_log_posterior
from symplearn._model import Coordinates, FullState, Gaussian, LinearDynamics, Propagator, StateSpaceModel
from symplearn._noise import AdditiveGaussian, Diagonal, LogVariance, ScaledIdentity, StandardDeviation, WienerIncrement
from symplearn._objectives import MARGINAL_LIKELIHOOD, TimeSeries
from symplearn._parameters import Frozen, Learnt, Positive, flatten, resolve
from symplearn._prior import Flat, HalfNormal, Laplace, Normal, Prior
from symplearn._starts import harmonic, scales, with_variances

# H = p^2/2 + 0.1 q + 0.6 q^2 + 0.25 q^3 + 0.4 q^4, read in q and p every 0.4 with noise of sd 0.02.
TRUTH = np.array([0.1, 0.6, 0.25, 0.4])
TIMES, SD = 0.4 * np.arange(26), 0.02
PRIOR = Prior({"dynamics": Laplace(0.3), "process_noise": HalfNormal(1.0), "measurement_noise": HalfNormal(1.0)})


def swing(seed, start=(1.0, 0.2), times=TIMES):
    """Readings of the anharmonic oscillator, by SciPy."""

    def motion(t, x):
        return [x[1], -(TRUTH * np.arange(1, 5)) @ x[0] ** np.arange(4)]

    found = solve_ivp(motion, (0, times[-1]), start, method="DOP853", rtol=1e-11, atol=1e-12, t_eval=times)
    return TimeSeries(times, found.y.T + SD * np.random.default_rng(seed).normal(size=(len(times), 2)))


def oscillator(coefficients=None, process=1e-3, measurement=1e-3, degree=4, dim=1):
    """A quartic potential, and two variances to learn; no initial distribution: the first reading is conditioned on."""
    return StateSpaceModel(
        Propagator(PolynomialPotential(dim, degree, coefficients), ig.Leapfrog(), 4),
        FullState(),
        AdditiveGaussian(ScaledIdentity(Positive(process), 2)),
        AdditiveGaussian(ScaledIdentity(Positive(measurement), 2)),
    )


@pytest.fixture(scope="module")
def plain():
    """Learnt from zero coefficients."""
    return learn(oscillator(), swing(0), prior=PRIOR, key=jax.random.key(0))


def test_the_truth_is_found_from_nothing(plain):
    """From zero coefficients learning converges, and the truth lies within the deviations that it states."""
    assert plain.converged and len(plain.attempts) == 10
    found, covariance = plain.values()["dynamics.system.coefficients"], laplace_evidence(plain).covariance[:4, :4]
    distance = (found - TRUTH) @ np.linalg.solve(covariance, found - TRUTH)
    # One draw in a thousand lies farther out.
    assert distance < chi2(4).ppf(0.999)


@pytest.mark.parametrize(("coefficients", "process", "measurement"), [
    (TRUTH, 1e-9, 1e-9),
    ([3.0, -1.0, 0.5, 0.1], 1e2, 1e-12),  # fits nothing
    ([0.0, 0.0, 0.0, -1e3], 1e-3, 1e-3),
])  # fmt: skip
def test_the_start_does_not_matter(plain, coefficients, process, measurement):
    """Wild coefficients and noises wrong by powers of ten end in the same optimum; what escapes is passed over."""
    other = learn(oscillator(coefficients, process, measurement), swing(0), prior=PRIOR, key=jax.random.key(1))
    # Each descent ends within 1e-5 nats by its own count.
    assert other.converged and other.log_posterior == pytest.approx(plain.log_posterior, abs=1e-3)
    escaped = [one for one in other.attempts if one.log_posterior is None]
    assert {one.coefficients for one in escaped} <= {"as given", "disturbed"}
    if coefficients[-1] < 0:
        assert escaped and "impossible" in str(other)


def test_the_record_tells_who_won(plain):
    """The attempts stand in order, the first is the estimate, and all are printed."""
    ended = [one.log_posterior for one in plain.attempts if one.log_posterior is not None]
    assert ended[0] == plain.log_posterior and ended == sorted(ended, reverse=True)
    assert "10 starts:" in str(plain) and str(plain).count("below the best") == len(ended)


def test_a_coefficient_at_a_kink_is_zero_exactly():
    """Under a Laplace prior a term that is not there is learnt as 0, and the slope of the likelihood there is less than
    the kink's: the optimum of a penalty of absolute values (Tibshirani 1996)."""
    strong = Prior(PRIOR.densities | {"dynamics": Laplace(1e-3)})
    estimate = learn(oscillator(), swing(0), prior=strong, key=jax.random.key(0))
    free, rebuild = flatten(estimate.model)
    zero = np.flatnonzero(np.asarray(free) == 0.0)
    assert estimate.converged and len(zero) > 0

    def score(free):
        return negative_log_posterior(rebuild(free), estimate.recording, MARGINAL_LIKELIHOOD, strong)

    aside = jnp.concatenate([free + 1e-4 * row * sign for row in jnp.eye(free.size)[zero] for sign in (1, -1)])
    assert jnp.all(jax.jit(jax.vmap(score))(aside.reshape(-1, free.size)) > -estimate.log_posterior)


@pytest.mark.slow
def test_two_recordings_and_known_noise_and_legendre():
    """Several recordings, a known process noise, standard deviations and another basis are learnt without a hand."""
    model = StateSpaceModel(
        Propagator(PolynomialPotential(1, 4, basis=Legendre(1.5)), ig.Leapfrog(), 4),
        FullState(),
        AdditiveGaussian(ScaledIdentity(1e-8, 2)),
        AdditiveGaussian(Diagonal(StandardDeviation(Positive([1.0, 1.0])))),
    )
    both = [swing(1), swing(2, (0.5, -0.8))]
    prior = Prior({"dynamics": Normal(0.0, 10.0), "measurement_noise": HalfNormal(1.0)})
    estimate = learn(model, both, prior=prior, key=jax.random.key(0))
    assert estimate.converged
    assert float(estimate.model.process_noise.structure.variance) == 1e-8
    sds = estimate.values()["measurement_noise.structure.variances.sd"]
    # 52 readings a channel: a standard deviation is known to 10 %; four of these.
    np.testing.assert_allclose(sds, SD, rtol=0.4)
    q = np.linspace(-1.0, 1.0, 9)
    force = jax.vmap(lambda q: estimate.model.dynamics.system.slope(q[None], q[None])[0])(q)
    # Prediction errors of a few per cent of the largest force, 3.5: readings are 2 % of the motion.
    np.testing.assert_allclose(force, [(TRUTH * np.arange(1, 5)) @ x ** np.arange(4) for x in q], atol=0.2)


class Duffing(ig.AbstractSeparableHamiltonian):
    """A user's own module: stiffness and hardening, both positive."""

    stiffness: Positive
    hardening: Positive

    def kinetic(self, p):
        return 0.5 * p @ p

    def potential(self, q):
        return 0.5 * self.stiffness * q @ q + 0.25 * self.hardening * (q @ q) ** 2


def of_a_user(stiffness):
    """Only q is read; the start is known roughly."""
    return StateSpaceModel(
        Propagator(Duffing(Positive(stiffness), Positive(1.0)), ig.Leapfrog(), 4),
        Coordinates((0,)),
        AdditiveGaussian(ScaledIdentity(LogVariance(Learnt(-9.0)), 2)),
        AdditiveGaussian(ScaledIdentity(Positive(1e-4), 1)),
        Gaussian(jnp.array([1.0, 0.0]), 0.1 * jnp.eye(2)),
    )


@pytest.mark.slow
def test_a_module_of_the_user_is_learnt():
    """A Hamiltonian that is no polynomial of ours, read in one coordinate, is learnt from a start that is far off."""

    def motion(t, x):
        return [x[1], -1.5 * x[0] - 0.8 * x[0] ** 3]

    y = solve_ivp(motion, (0, TIMES[-1]), (1.1, 0.1), rtol=1e-10, atol=1e-12, t_eval=TIMES).y[:1].T
    series = TimeSeries(TIMES, y + SD * np.random.default_rng(3).normal(size=y.shape))
    prior = Prior({"dynamics": HalfNormal(100.0), "process_noise": Normal(-12.0, 16.0), "measurement_noise": Flat()})
    estimate = learn(of_a_user(0.2), series, prior=prior, key=jax.random.key(0))
    assert estimate.converged and {one.coefficients for one in estimate.attempts} == {"as given", "disturbed"}
    # The period is known to about 0.3 %, so the stiffnesses together to 1 %, each to a few.
    assert estimate.values()["dynamics.system.stiffness"] == pytest.approx(1.5, rel=0.15)
    with pytest.raises(InputError, match="None of 4 starts has a finite score"):
        learn(of_a_user(1e250), series, prior=prior, key=jax.random.key(0))


def test_scales_are_those_of_the_readings():
    """A ramp with white noise has the ramp's variance, and the noise's from neighbours, at most a hundredth of it."""
    times = np.linspace(0.0, 10.0, 2001)
    y = np.stack([3 * times + 0.1 * np.random.default_rng(0).normal(size=times.size), 0 * times + times], axis=1)
    found = scales(oscillator(), (TimeSeries(times, y),))
    np.testing.assert_allclose(found.readings, np.var(y, axis=0), rtol=1e-12)
    # The variance of 2000 squares: 3 % to one deviation, and neighbours share errors.
    assert found.noise[0] == pytest.approx(0.01, rel=0.15)
    assert 0 < found.noise[1] < 1e-8


def test_missing_readings_spoil_no_scale():
    """A channel that is never read, or every other reading of one, leaves finite scales and frequencies."""
    y = np.stack([np.cos(TIMES), np.full(len(TIMES), np.nan)], axis=1)
    y[::2, 0] = np.nan
    found = scales(oscillator(), (TimeSeries(TIMES, y),))
    assert all(np.all(np.isfinite(part) & (part > 0)) for part in (found.readings, found.noise, found.state))
    system = oscillator().dynamics.system
    assert np.all(np.isfinite(harmonic(system, oscillator(), (TimeSeries(TIMES, y),))))


def test_variances_are_set_as_they_are_written():
    """Whatever way a noise's numbers are written, its covariance becomes what was asked for; frozen ones stay."""
    asked = np.array([4e-4, 9e-4])
    for written in (Positive([1.0, 2.0]), StandardDeviation(Positive([1.0, 2.0])), LogVariance(Learnt([0.0, 1.0]))):
        found = with_variances(AdditiveGaussian(Diagonal(written)), asked).structure
        np.testing.assert_allclose(np.diag(resolve(found).matrix), asked, rtol=1e-12)
    per_time = with_variances(WienerIncrement(Diagonal(Positive([1.0, 1.0]))), asked, interval=0.5)
    np.testing.assert_allclose(per_time.structure.variances.value, 2 * asked, rtol=1e-12)
    frozen = AdditiveGaussian(Diagonal(Frozen(jnp.ones(2))))
    assert with_variances(frozen, asked).structure.variances.value.tolist() == [1.0, 1.0]


@pytest.mark.parametrize("basis", [ig, Legendre(2.0)])
def test_harmonic_coefficients_are_a_harmonic_oscillator(basis):
    """The slope of the harmonic start is omega^2 q, and omega^2 is what the readings' sizes say."""
    given = {} if basis is ig else {"basis": basis}
    times = np.linspace(0.0, 40.0, 401)
    y = np.stack([np.cos(1.7 * times), -1.7 * np.sin(1.7 * times)], axis=1)
    for cls in (PolynomialPotential, Polynomial):
        hamiltonian = cls(1, 3, **given)
        model = eqx.tree_at(lambda m: m.dynamics.system, oscillator(), hamiltonian)
        found = cls(1, 3, harmonic(hamiltonian, model, (TimeSeries(times, y),)), **given)
        q, p = jnp.array([0.7]), jnp.array([-0.4])
        # Eleven periods, of which the last is cut: the mean squares are those of the oscillator to about 2 %.
        np.testing.assert_allclose(found.slope(q, p), 1.7**2 * q, rtol=0.04)
        np.testing.assert_allclose(found.velocity(q, p), p, rtol=1e-12)


def known():
    """The oscillator with nothing to learn."""
    model = oscillator(TRUTH)
    frozen = Frozen(model.dynamics), Frozen(model.process_noise), Frozen(model.measurement_noise)
    return eqx.tree_at(lambda m: (m.dynamics, m.process_noise, m.measurement_noise), model, frozen)


UNEVEN = TimeSeries(np.array([0.0, 0.1, 0.3, 0.4]), np.random.default_rng(0).normal(size=(4, 2)))
STILL = TimeSeries(np.arange(9.0), np.ones((9, 2)))


@pytest.mark.parametrize(("model", "series", "sentence"), [
    (oscillator(degree=80), swing(0), "degree 80 has 80 terms, but there are only 52 readings; lower the degree"),
    (oscillator(dim=2), swing(0), "2 degrees of freedom, so a phase point has 4 numbers, but the state has 2"),
    (oscillator(), UNEVEN, "time step changes from 0.1 to 0.2, .* use `WienerIncrement`"),
    (oscillator(), STILL, "no motion to learn from"),
    (oscillator(), TimeSeries(np.arange(9.0), np.full((9, 2), np.nan)), "Every reading is missing"),
    (known(), swing(0), "Nothing in the model learns"),
])  # fmt: skip
def test_wrong_input_is_one_sentence(model, series, sentence):
    """What cannot be learnt is named: what was given, and what to do."""
    with pytest.raises(InputError, match=sentence):
        learn(model, series, prior=PRIOR)


def cherry(coefficients=None):
    """All 34 cubic terms in [q, p], by Tao's method."""
    return StateSpaceModel(
        Propagator(Polynomial(2, 3, coefficients), ig.Tao(20.0), 4),
        FullState(),
        AdditiveGaussian(ScaledIdentity(Positive(1e-6), 4)),
        AdditiveGaussian(ScaledIdentity(Positive(1e-6), 4)),
    )


def explosive(seed):
    """Cherry's problem (5.23) by SciPy, 21 readings times uniform factors of 0.9 to 1.1, about the printed start."""

    def motion(t, x):
        q1, q2, p1, p2 = x
        p_dot = [-(q1 - q1 * p2 - q2 * p1), 2 * q2 + q1 * p1]
        return [p1 + p1 * p2 - q1 * q2, -2 * p2 + 0.5 * (p1**2 - q1**2), *p_dot]

    rng, times = np.random.default_rng(seed), 0.4 * np.arange(21)
    start = np.array([0.15, 0.1, -0.05, 0.1]) + 0.02 * rng.normal(size=4)
    true = solve_ivp(motion, (0, 8), start, method="DOP853", rtol=1e-10, atol=1e-12, t_eval=times).y.T
    return TimeSeries(times, true * rng.uniform(0.9, 1.1, size=true.shape))


@pytest.mark.slow
def test_not_all_noise_is_booked_as_process_noise():
    """On Cherry's problem zero coefficients and the truth end in one optimum, whose measurement noise is the true one.

    The mode to avoid has none, and lies a hundred nats higher (performance.md, C).
    """
    recordings = [explosive(0), explosive(1)]
    truth = dict.fromkeys(cherry().dynamics.system.terms, 0.0)
    truth |= {"q0^2": 0.5, "p0^2": 0.5, "q1^2": -1.0, "p1^2": -1.0, "p0^2 p1": 0.5, "q0^2 p1": -0.5, "q0 q1 p0": -1.0}
    prior = Prior(PRIOR.densities | {"dynamics": Laplace(0.1)})
    found = learn(cherry(), recordings, prior=prior)
    known = learn(cherry(list(truth.values())), recordings, prior=prior)
    assert found.converged and found.log_posterior > known.log_posterior - 0.5
    # Uniform factors have the variance 0.1^2 / 3; readings are missing nothing. Half to twice the deviation is allowed.
    expected = 0.01 / 3 * np.mean([np.square(one.readings).mean() for one in recordings])
    assert 0.25 < found.values()["measurement_noise.structure.variance"] / expected < 4.0


@pytest.mark.slow
def test_a_linear_map_starts_at_the_rows():
    """Of nearly exact readings of the linear pendulum, `learn` from A = 0 finds what a start at the truth finds."""
    times = np.linspace(0.0, 4.0, 25)
    rates = np.array([[0.0, 1.0], [-9.81, 0.0]])
    true = np.array([expm(rates * t) @ [0.1, -0.5] for t in times])
    prior = Prior({"dynamics": Laplace(10.0), "process_noise": HalfNormal(1.0), "measurement_noise": HalfNormal(1.0)})

    def model(matrix):
        noises = (AdditiveGaussian(ScaledIdentity(Positive(1e-6), 2)) for _ in range(2))
        known = Gaussian(jnp.array([0.1, -0.5]), 1e-10 * jnp.eye(2))
        return StateSpaceModel(LinearDynamics(Learnt(jnp.asarray(matrix))), FullState(), *noises, known)

    for seed in range(4):
        series = TimeSeries(times, true + 1e-3 * np.random.default_rng(seed).normal(size=true.shape))
        found = learn(model(np.zeros((2, 2))), series, prior=prior)
        best = learn(model(expm(rates / 6.0)), series, prior=prior)
        assert any(one.coefficients == "dynamic mode decomposition" for one in found.attempts)
        # Half a nat of the best known, as everywhere.
        assert found.log_posterior > best.log_posterior - 0.5
