"""The MAP lies where the truth is, within the deviation that Laplace's approximation states."""

from types import SimpleNamespace
from typing import ClassVar

import equinox as eqx
import estimation_cases as cases
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import norm

import integrators as ig
from symplearn._errors import InputError
from symplearn._evidence import laplace_evidence
from symplearn._fit import fit
from symplearn._model import Coordinates, FullState, Gaussian, Propagator, StateSpaceModel
from symplearn._noise import AdditiveGaussian, ScaledIdentity
from symplearn._objectives import MarginalLikelihood, TimeSeries
from symplearn._parameters import Frozen, Learnt, Positive
from symplearn._prior import Flat, HalfNormal, Laplace, Normal, Prior

N = 40
TIMES = np.linspace(0.0, 9.75, N)
SD = 0.05


def swing(seed, gravity=9.0):
    """A pendulum by SciPy's DOP853, its angle and momentum read with noise of 0.05."""
    path = solve_ivp(
        lambda t, x: [x[1], -gravity * np.sin(x[0])], (0.0, 9.75), [1.0, 0.0],
        t_eval=TIMES, method="DOP853", rtol=1e-10, atol=1e-12,
    ).y.T  # fmt: skip
    return SimpleNamespace(times=TIMES, readings=path + SD * np.random.default_rng(seed).normal(size=path.shape))


def pendulum(gravity=8.5):
    return StateSpaceModel(
        dynamics=Propagator(ig.problems.Pendulum(Frozen(1.0), Frozen(1.0), gravity), ig.Leapfrog(), substeps=10),
        observation=FullState(),
        process_noise=AdditiveGaussian(ScaledIdentity(1e-6, dim=2)),
        measurement_noise=AdditiveGaussian(ScaledIdentity(Positive(1e-2), dim=2)),
    )


PRIOR = Prior({"dynamics": Normal(9.0, 100.0), "measurement_noise": HalfNormal(1.0)})


@pytest.mark.slow
def test_the_truth_lies_in_the_interval_as_often_as_stated():
    """Over 20 recordings gravity and noise are within 2 sd of the truth about 95 times in a hundred."""
    inside = []
    for seed in range(20):
        estimate = fit(pendulum(), swing(seed), prior=PRIOR)
        assert estimate.converged
        sds = laplace_evidence(estimate).sds
        gravity = estimate.values()["dynamics.system.gravity"] - 9.0
        noise = estimate.values()["measurement_noise.structure.variance"] - SD**2
        deviations = jnp.array([gravity / sds["dynamics.system.gravity"],
                                noise / sds["measurement_noise.structure.variance"]])  # fmt: skip
        inside.append(np.abs(deviations) < 2.0)
    # Binomial(40, 0.954): fewer than 34 has probability 0.004.
    assert np.sum(inside) >= 34
    # And the deviation is no more than it must be: 1 % of gravity.
    assert float(sds["dynamics.system.gravity"]) < 0.1


def linear_with_unknown_start(prior_variance):
    """A scalar model and ten readings of it from a start that the prior draws."""
    A, H, Q, R, P0 = (np.array([[number]]) for number in (0.8, 1.3, 0.3, 0.2, 0.5))
    rng, m0 = np.random.default_rng(7), np.array([0.4])
    start = m0 + prior_variance**0.5 * rng.normal(size=1)
    ys = cases.simulate(A, H, Q, R, start, P0, 10, rng)[1]
    system = A, H, Q, R, m0, P0
    known = Frozen(jnp.asarray(A)), Frozen(jnp.asarray(H)), Gaussian(Learnt(m0), jnp.asarray(P0))
    model = eqx.tree_at(lambda m: (m.dynamics.A, m.observation.matrix, m.initial), cases.as_model(*system), known)
    return system, model, TimeSeries(jnp.arange(10.0), jnp.asarray(ys))


def test_laplace_evidence_is_exact_for_a_gaussian_posterior():
    """With a normal prior on the initial mean, the evidence is a Kalman filter's with the wider start."""
    (A, H, Q, R, m0, P0), model, series = linear_with_unknown_start(2.0)
    prior = Prior({"initial": Normal(m0, 2.0)})
    estimate = fit(model, series, prior=prior)
    laplace = laplace_evidence(estimate)
    expected, _, _ = cases.kalman_log_likelihood(A, H, Q, R, m0, P0 + 2.0, np.asarray(series.readings))
    assert laplace.valid
    # The Hessian comes by differences with a relative error of about 1e-7.
    assert laplace.log_evidence == pytest.approx(expected, abs=1e-5)
    # And the log posterior is likelihood plus prior.
    density = norm(0.4, 2.0**0.5).logpdf(estimate.values()["initial.mean"][0])
    assert estimate.log_posterior == pytest.approx(estimate.log_likelihood + density, abs=1e-12)


def test_evidence_is_refused_where_it_does_not_hold():
    """On a ridge, unconverged, or at the kink of a Laplace prior there is a sentence and no number."""
    _, model, series = linear_with_unknown_start(2.0)
    blind = eqx.tree_at(lambda m: m.observation.matrix.value, model, jnp.zeros((1, 1)))
    ridge = laplace_evidence(fit(blind, series, prior=Prior(Flat())))
    assert not ridge.valid and ridge.sds is None and "not positive definite" in str(ridge)
    estimate = fit(model, series, prior=Prior(Flat()))
    assert "improper flat prior of initial.mean" in laplace_evidence(estimate).statement
    unfinished = eqx.tree_at(lambda e: e.converged, estimate, False)
    assert "did not converge" in laplace_evidence(unfinished).statement
    held = eqx.tree_at(lambda e: e.prior, estimate, Prior(Laplace(1e9)))
    assert "kink" in laplace_evidence(held).statement


def test_a_fit_that_did_not_converge_says_so():
    """One step of BFGS at a time is not enough, and the estimate says it in words."""
    _, model, series = linear_with_unknown_start(2.0)
    far = eqx.tree_at(lambda m: m.initial.mean, model, Learnt(np.array([1e4])))
    estimate = fit(far, series, prior=Prior(Flat()), max_steps=1)
    assert not estimate.converged and estimate.promised > 1e-5
    assert "NOT CONVERGED" in str(estimate)


class Counting(MarginalLikelihood):
    """Counts how often it is traced."""

    traced: ClassVar[list[int]] = []

    def __call__(self, model, recording):
        self.traced.append(1)
        return super().__call__(model, recording)


def test_the_same_structure_compiles_once():
    """Another recording of the same length, and other starting values, reuse the compiled objective."""
    _, model, series = linear_with_unknown_start(2.0)
    fit(model, series, Counting(), prior=Prior(Flat()))
    first = len(Counting.traced)
    other = eqx.tree_at(lambda m: m.initial.mean, model, Learnt(np.array([3.0])))
    fit(other, TimeSeries(series.times, 2.0 * series.readings), Counting(), prior=Prior(Flat()))
    assert first > 0 and len(Counting.traced) == first


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda m, r: (eqx.tree_at(lambda m: m.observation, m, Coordinates((0,))), r), "channels|initial"),
        (lambda m, r: (m, SimpleNamespace(times=r.times[::-1], readings=r.readings)), "strictly increasing"),
        (lambda m, r: (m, SimpleNamespace(times=r.times, readings=r.readings[:, :1])), "size of the state is 1"),
        (lambda m, r: (m, SimpleNamespace(times=r.times[:1], readings=r.readings[:1])), "at least 2"),
        (lambda m, r: (m, SimpleNamespace(times=r.times, readings=np.full((N, 2), np.inf))), "infinite"),
        (lambda m, r: (pendulum(1e200), r), "no finite score at its start"),
    ],
)  # fmt: skip
def test_wrong_input_is_one_clear_sentence(change, sentence):
    """What cannot be fitted is refused with what was given and what to do."""
    model, recording = change(pendulum(), swing(0))
    with pytest.raises(InputError, match=sentence):
        fit(model, recording, prior=PRIOR)


def test_nothing_to_learn_is_refused():
    """A model in which every number is known cannot be fitted."""
    model = pendulum()
    frozen = Frozen(model.dynamics), Frozen(model.measurement_noise)
    known = eqx.tree_at(lambda m: (m.dynamics, m.measurement_noise), model, frozen)
    with pytest.raises(InputError, match="Nothing in the model learns"):
        fit(known, swing(0), prior=Flat())
