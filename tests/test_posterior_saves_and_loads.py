"""A posterior survives its file, and a file is not taken for another posterior's."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from estimation_cases import linear_system, simulate

from symplearn._arviz import arviz
from symplearn._errors import InputError
from symplearn._fit import Estimate
from symplearn._importance import AdaptiveImportance
from symplearn._model import Gaussian, LinearDynamics, LinearObservation, StateSpaceModel
from symplearn._noise import AdditiveGaussian, Dense, Diagonal
from symplearn._objectives import MarginalLikelihood, TimeSeries
from symplearn._parameters import Frozen, Learnt, Positive
from symplearn._posterior import load_posterior, log_posterior_of, posterior_of
from symplearn._predict import posterior_forecast
from symplearn._prior import HalfNormal, Normal, Prior
from symplearn._sample import sample_density
from symplearn._sampler import Drawn

SAMPLER = AdaptiveImportance(draws=200, batch=200, target=100, rounds=4)


@pytest.fixture(scope="module")
def estimate():
    """An estimate that nobody fitted: a posterior's file knows nothing of how good it is."""
    A, H, Q, R, m0, P0 = linear_system()
    ys = simulate(A, H, Q, R, m0, P0, 6, np.random.default_rng(3))[1]
    noises = AdditiveGaussian(Dense(Q)), AdditiveGaussian(Diagonal(Positive(jnp.array([0.2, 0.1]))))
    parts = LinearDynamics(Frozen(jnp.asarray(A))), LinearObservation(Frozen(jnp.asarray(H)))
    model = StateSpaceModel(*parts, *noises, Gaussian(Learnt(jnp.zeros(3)), jnp.asarray(P0)))
    prior = Prior({"initial": Normal(0.0, 4.0), "measurement_noise": HalfNormal(1.0)})
    return Estimate(model, TimeSeries(np.arange(6.0), ys), MarginalLikelihood(), prior, *[0.0] * 4, True, 1)


@pytest.fixture(scope="module")
def posterior(estimate):
    """Draws with everything that one sampler or another tells of them."""
    rng = np.random.default_rng(0)
    free = jnp.asarray(0.1 * rng.normal(size=(4, 50, 5)))
    heights = jax.vmap(jax.vmap(log_posterior_of(estimate)))(free)
    numbers = dict(accepted=0.3, pareto_k=0.25, largest_weight=0.01, log_evidence=-12.3, log_evidence_sd=0.04)
    chains = dict(divergent=jnp.asarray(rng.random((4, 50)) < 0.1), energy=jnp.asarray(rng.normal(size=(4, 50))))
    remarks = ("Stopped by Ctrl-C after 50 of 60 draws of each chain.", "Another remark.")
    drawn = Drawn(free, heights, evaluations=900, gradients=50, **numbers, **chains, stopped=True, remarks=remarks)
    return posterior_of(estimate, drawn, "the test")


def test_what_is_read_is_what_was_written(estimate, posterior, tmp_path):
    """Draws, diagnostics, evidence and the printed table come back from NetCDF to the last digit."""
    posterior.save(tmp_path / "draws.nc")
    assert [path.name for path in tmp_path.iterdir()] == ["draws.nc"]
    back = load_posterior(tmp_path / "draws.nc", estimate)
    np.testing.assert_array_equal(back.free, posterior.free)
    np.testing.assert_array_equal(back.log_posterior, posterior.log_posterior)
    assert str(back) == str(posterior)
    assert back.log_evidence == posterior.log_evidence and back.drawn.evaluations == posterior.drawn.evaluations
    for one, other in zip(jax.tree.leaves(back.drawn), jax.tree.leaves(posterior.drawn), strict=True):
        np.testing.assert_array_equal(one, other)
    assert back.stopped and back.drawn.remarks == posterior.drawn.remarks


def test_arviz_reads_it(posterior, tmp_path):
    """The file is an ordinary ArviZ one: values by name in natural units, the log posterior in `sample_stats`."""
    posterior.save(tmp_path / "draws.nc")
    data = arviz().from_netcdf(str(tmp_path / "draws.nc"))
    variances = data.posterior["measurement_noise.structure.variances"].values
    np.testing.assert_array_equal(variances, posterior.values["measurement_noise.structure.variances"])
    assert np.all(variances > 0)
    np.testing.assert_array_equal(data.sample_stats["lp"].values, posterior.log_posterior)


def test_models_are_the_draws(posterior):
    """`models` are the draws in plain arrays, evenly spaced, and `values` are what is in them."""
    models = posterior.models(10)
    flat = np.asarray(posterior.values["measurement_noise.structure.variances"]).reshape(-1, 2)
    np.testing.assert_allclose(models.measurement_noise.structure.variances, flat[::20], rtol=1e-14)
    assert models.initial.mean.shape == (10, 3)
    with pytest.raises(InputError, match="from 1 to 200"):
        posterior.models(201)


def test_values_come_in_the_models_order(posterior, tmp_path):
    """The model's noise stands before its start, in the draws and in what is read back, and not by the alphabet."""
    posterior.save(tmp_path / "draws.nc")
    for one in (posterior, load_posterior(tmp_path / "draws.nc", posterior.estimate)):
        assert list(one.values) == ["measurement_noise.structure.variances", "initial.mean"]


def test_summaries_are_those_of_the_draws(posterior):
    """Means and quantiles by name are NumPy's of all chains together."""
    flat = np.asarray(posterior.values["initial.mean"]).reshape(-1, 3)
    np.testing.assert_allclose(posterior.mean()["initial.mean"], flat.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(
        posterior.quantiles([0.05, 0.95])["initial.mean"], np.quantile(flat, [0.05, 0.95], axis=0), rtol=1e-12
    )
    np.testing.assert_allclose(posterior.median()["initial.mean"], np.median(flat, axis=0), rtol=1e-12)


def test_another_posterior_is_refused(estimate, posterior, tmp_path):
    """Draws are not turned into models of another prior or another model."""
    posterior.save(tmp_path / "draws.nc")
    wider = dataclasses.replace(estimate, prior=Prior(Normal(0.0, 9.0)))
    with pytest.raises(InputError, match="is of another recording, model or prior"):
        load_posterior(tmp_path / "draws.nc", wider)
    (tmp_path / "text.nc").write_text("no NetCDF")
    for name in ("text.nc", "absent.nc"):
        with pytest.raises(InputError, match="is not a posterior that can be read"):
            load_posterior(tmp_path / name, estimate)


def test_draws_are_loaded_without_their_estimate(posterior, tmp_path):
    """The path alone gives the draws as they were written; what needs the model says what to pass."""
    posterior.save(tmp_path / "draws.nc")
    back = load_posterior(tmp_path / "draws.nc")
    for name, draws in posterior.values.items():
        np.testing.assert_array_equal(back.values[name], draws)
    assert list(back.values) == list(posterior.values) and str(back) == str(posterior)
    for needs_a_model in (back.models, lambda: posterior_forecast(back, until=9.0, key=jax.random.key(0))):
        with pytest.raises(InputError, match=r"`load_posterior\(path, estimate\)`"):
            needs_a_model()


def test_a_density_of_the_users_own_saves(tmp_path):
    """A posterior without a model saves and loads as well, and says that it has no models."""
    posterior = sample_density(lambda x: -0.5 * jnp.sum(x**2), jnp.zeros(2), sampler=SAMPLER, key=jax.random.key(1))
    posterior.save(tmp_path / "own.nc")
    np.testing.assert_array_equal(load_posterior(tmp_path / "own.nc").values["x"], posterior.values["x"])
    with pytest.raises(InputError, match="has no model"):
        posterior.models()


def test_a_folder_that_is_not_there_is_said(posterior, tmp_path):
    """A path without its folder is refused in a sentence, and nothing is made."""
    with pytest.raises(InputError, match="there is no folder .*; make it first"):
        posterior.save(tmp_path / "none" / "posterior.nc")
    assert not list(tmp_path.iterdir())
