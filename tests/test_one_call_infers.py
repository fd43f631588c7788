"""One call goes from a recording to a posterior, and the choice between samplers is measured."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from symplearn._compare_samplers import compare_samplers
from symplearn._errors import InputError
from symplearn._importance import AdaptiveImportance
from symplearn._infer import infer
from symplearn._model import FullState, LinearDynamics, StateSpaceModel
from symplearn._noise import AdditiveGaussian, ScaledIdentity
from symplearn._objectives import TimeSeries
from symplearn._prior import Normal, Prior
from symplearn._random_walk import RandomWalk
from symplearn._trajectory_objectives import PropagatorLeastSquares

VARIANCE = 0.04
ENOUGH = AdaptiveImportance(draws=2000, target=1500, batch=500)
TOO_SHORT = RandomWalk(chains=2, steps=40, thin=1, scout=AdaptiveImportance(draws=64, target=16, batch=64))
PRIOR = Prior({"dynamics": Normal(0.0, 1.0)})


def autoregression(n=40):
    """x' = A x + w, read exactly."""
    rng, A, xs = np.random.default_rng(3), np.array([[0.8, 0.3], [-0.2, 0.6]]), [np.ones(2)]
    for _ in range(n):
        xs.append(A @ xs[-1] + np.sqrt(VARIANCE) * rng.normal(size=2))
    return TimeSeries(np.arange(n + 1.0), np.array(xs))


def regression():
    noises = AdditiveGaussian(ScaledIdentity(VARIANCE, 2)), AdditiveGaussian(ScaledIdentity(1e-9, 2))
    return StateSpaceModel(LinearDynamics(jnp.zeros((2, 2))), FullState(), *noises)


def inferred(*samplers):
    return infer(
        regression(), autoregression(), PropagatorLeastSquares(), prior=PRIOR, key=jax.random.key(0), samplers=samplers
    )


@pytest.fixture(scope="module")
def second():
    """By the second sampler, after one that is too short."""
    return inferred(TOO_SHORT, ENOUGH)


def test_the_posterior_is_that_of_the_conjugate_regression(second):
    """Means and deviations are those of a Gaussian prior times a Gaussian likelihood, to four Monte Carlo errors."""
    xs = np.asarray(autoregression().readings)
    X, Y = xs[:-1], xs[1:]
    covariance = np.linalg.inv(X.T @ X / VARIANCE + np.eye(2))
    mean, sd = (covariance @ X.T @ Y / VARIANCE).T, np.sqrt(np.diag(covariance))
    error = sd / np.sqrt(second.diagnostics.least_ess)
    assert second.converged and np.all(np.abs(second.mean()["dynamics.A"] - mean) < 4 * error)
    # The error of a standard deviation is that of a mean over the root of two.
    assert np.all(np.abs(second.sd()["dynamics.A"] - sd) < 4 * error)


def test_a_sampler_that_fails_is_followed_by_the_next(second):
    """The text tells what the first one lacked; the estimate with its starts is in the result."""
    assert "AdaptiveImportance" in second.sampler and "Tried before: RandomWalk" in str(second)
    assert "NOT CONVERGED" in str(second) and second.estimate.attempts


def test_what_never_converged_says_so():
    """With nothing else to try the draws come back, untrusted and with what to do."""
    posterior = inferred(TOO_SHORT)
    assert not posterior.converged and "draw more" in str(posterior)
    with pytest.raises(InputError, match="no samplers"):
        inferred()


def test_the_choice_is_the_fastest_that_can_be_trusted(second):
    """The table has every sampler, the untrusted one is not chosen, and the reason is written below."""
    found = compare_samplers(second.estimate, [TOO_SHORT, ENOUGH], key=jax.random.key(1))
    assert found.best is found.trials[1] and found.trials[1].distance < 0.2
    assert "only one whose draws can be trusted" in str(found) and str(found).count("\n") == 3
