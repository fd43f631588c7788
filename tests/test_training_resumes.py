"""Stochastic training falls, goes on to the last bit from where it was stopped, and counts the steps that failed."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import integrators as ig
from symplearn import _train
from symplearn._checkpoint import seal_of
from symplearn._errors import InputError
from symplearn._hamiltonian_objectives import MiniBatch, OneStepL1
from symplearn._model import FullState, Gaussian, Propagator, StateSpaceModel
from symplearn._neural_hamiltonian import NSSNN
from symplearn._noise import AdditiveGaussian, ScaledIdentity
from symplearn._objectives import AbstractObjective, MarginalLikelihood, TimeSeries
from symplearn._optimisers import Adam, ByLeaf
from symplearn._parameters import Positive
from symplearn._prior import Flat, HalfNormal, LogDensity, Normal, Prior

N, DT = 24, 0.1
PRIOR = Prior({"dynamics": Normal(0.0, 10.0), "process_noise": HalfNormal(1.0)})
RATES = ByLeaf({"": Adam(0.1, 10, 0.8, clip=1e3), "process_noise": Adam(0.1, betas=(0.1, 0.1))})
KEY = jax.random.key(5)
ALL = OneStepL1(0.1)  # which compiles faster than a likelihood
BATCHES = OneStepL1(0.1, MiniBatch(8, jax.random.key(0)))


def recording():
    """A turning phase point with noise, in closed form."""
    t = DT * np.arange(N)
    ys = np.stack([np.cos(t), -np.sin(t)], axis=1)
    return TimeSeries(t, ys + 0.01 * np.random.default_rng(0).normal(size=ys.shape))


def network(key=0):
    return StateSpaceModel(
        Propagator(NSSNN(1, 6, depth=2, key=jax.random.key(key)), ig.Tao(5.0)),
        FullState(),
        AdditiveGaussian(ScaledIdentity(Positive(1e-2), 2)),
        AdditiveGaussian(ScaledIdentity(1e-4, 2)),
        Gaussian(jnp.array([1.0, 0.0]), 1e-4 * jnp.eye(2)),
    )


def trained(objective, checkpoint=None, epochs=30, key=KEY):
    return _train.train(
        network(), recording(), objective, prior=PRIOR, optimiser=RATES, epochs=epochs, key=key, checkpoint=checkpoint
    )


@functools.cache
def uninterrupted(objective_name):
    return trained({"likelihood": MarginalLikelihood(), "batches": BATCHES}[objective_name])


def same(one, other):
    """Whether all numbers of two records are the same to the last bit."""
    leaves = [jax.tree.leaves((r.model, r.history, r.score, r.failures, r.best_epoch)) for r in (one, other)]
    return all(np.array_equal(a, b, equal_nan=True) for a, b in zip(*leaves, strict=True))


@pytest.mark.parametrize("name", [pytest.param("likelihood", marks=pytest.mark.slow), "batches"])
def test_loss_falls_and_the_record_says_how(name):
    """The score falls by much, the history holds the score of every epoch, and the record calls itself no MAP."""
    found = uninterrupted(name)
    assert found.history.shape == (30,) and np.all(np.isfinite(found.history))
    assert found.score < float(found.history[0]) - 5
    assert found.score <= np.min(found.history) and found.epochs == 30 and found.failures == 0
    objective = MarginalLikelihood() if name == "likelihood" else OneStepL1(0.1)
    plain = float(objective(found.model, recording()) - PRIOR.log_density(found.model))
    # The same sum in another order of summation.
    assert plain == pytest.approx(found.score, abs=1e-9)
    assert "no MAP" in str(found)


@pytest.mark.parametrize("name", [pytest.param("likelihood", marks=pytest.mark.slow), "batches"])
def test_killed_and_resumed_is_uninterrupted(name, tmp_path, monkeypatch):
    """A training that is killed after some epochs and started again ends at the same bits as one that is not."""
    objective = {"likelihood": MarginalLikelihood(), "batches": BATCHES}[name]
    advance, calls = _train._advance, []

    def interrupted(*given):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return advance(*given)

    monkeypatch.setattr(_train, "_advance", interrupted)
    with pytest.raises(KeyboardInterrupt):
        trained(objective, tmp_path / "at.npz")
    monkeypatch.setattr(_train, "_advance", advance)
    assert [path.name for path in tmp_path.iterdir()] == ["at.npz"]
    with np.load(tmp_path / "at.npz", allow_pickle=False) as file:
        counts = [int(file[name]) for name in file.files if file[name].shape == () and file[name].dtype.kind == "i"]
    assert 0 < max(counts) < 30  # epochs done, at the stop
    assert same(trained(objective, tmp_path / "at.npz"), uninterrupted(name))
    # It is done: another call computes no epoch, and says the same.
    monkeypatch.setattr(_train, "_advance", interrupted)
    assert same(trained(objective, tmp_path / "at.npz"), uninterrupted(name)) and len(calls) == 3


def test_a_checkpoint_is_checked(tmp_path):
    """A checkpoint of another training, a damaged one and one with a pickle are refused in one sentence."""
    path = tmp_path / "at.npz"
    trained(MarginalLikelihood(), path)
    with pytest.raises(InputError, match="of another computation"):
        trained(MarginalLikelihood(), path, key=jax.random.key(6))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="is damaged"):
        trained(MarginalLikelihood(), path)
    np.savez(path, seal=np.array([print], dtype=object))
    with pytest.raises(InputError, match="is damaged"):
        trained(MarginalLikelihood(), path)


class Place(eqx.Module):
    """A model of one number."""

    x: jax.Array
    initial: None = None


class Walled(AbstractObjective):
    """(x - 3)^2, impossible beyond x = 1: a training from 0 with large steps meets the wall."""

    def score(self, model, series):
        return jnp.where(model.x > 1.0, 1e15, (model.x - 3.0) ** 2)


@pytest.mark.parametrize(
    "made",
    [
        lambda x: LogDensity(lambda v: -x * v**2),
        lambda x: optax.sgd(x),
        lambda x: optax.chain(optax.clip(1.0), optax.adam(optax.exponential_decay(x, 10, 0.9))),
    ],
    ids=["prior", "optax", "chain and schedule"],
)
def test_functions_are_told_apart_by_what_they_do(made):
    """Two priors or optimisers of one name and other numbers belong to two trainings; the same, made anew, to one."""
    assert seal_of(made(0.1), "") == seal_of(made(0.1), "") != seal_of(made(0.2), "")


@pytest.mark.parametrize("wrapped", [lambda f: f, jax.jit, lambda f: functools.partial(f, 1.0)])
def test_functions_that_call_others_are_told_apart(wrapped):
    """A sine and a cosine have the same instructions, and other names in them."""
    sine, cosine = (wrapped(lambda *v: jnp.sin(v[-1])), wrapped(lambda *v: jnp.cos(v[-1])))
    assert seal_of(sine, "") != seal_of(cosine, "")


def test_failed_steps_are_counted_and_undone():
    """Steps beyond the wall are counted, the model stays before it, and gets nearer than a step to it."""
    found = _train.train(
        Place(jnp.zeros(())), recording(), Walled(), prior=Flat(), optimiser=optax.sgd(0.09), epochs=40, key=KEY
    )
    x = float(found.model.x)
    # By hand: x + 0.18 (3 - x), and half the way back wherever that is beyond 1.
    here, sound, fails = 0.0, 0.0, 0
    for _ in range(40):
        if here > 1.0:
            here, fails = 0.5 * (here + sound), fails + 1
        else:
            here, sound = here + 0.18 * (3.0 - here), here
    assert found.failures == fails > 5
    assert 0.9 < x <= 1.0
    assert found.score == pytest.approx((x - 3.0) ** 2)
    assert np.sum(np.asarray(found.history) == 1e15) == fails


def test_each_leaf_has_its_rate():
    """With a rate for the process noise alone nothing else moves far, and a missing rate is named."""
    rates = ByLeaf({"": Adam(1e-9), "process_noise": Adam(0.5, betas=(0.1, 0.1))})
    given = dict(prior=PRIOR, epochs=30, key=KEY)
    found = _train.train(network(), recording(), ALL, optimiser=rates, **given)
    moved = jnp.abs(found.model.dynamics.system.layers[1].weights - network().dynamics.system.layers[1].weights)
    assert float(moved.max()) < 1e-7  # thirty steps of 1e-9
    variance = float(found.values()["process_noise.structure.variance"])
    assert abs(np.log(variance / 1e-2)) > 0.4
    with pytest.raises(InputError, match="learns but has no optimiser"):
        _train.train(network(), recording(), ALL, optimiser=ByLeaf({"dynamics": Adam()}), **given)


def test_many_models_train_as_one_does():
    """The pure part, mapped over models, gives each what it gets alone."""
    training = _train.Training(ALL, PRIOR, RATES)

    @eqx.filter_jit
    def run(keys):
        def one(key):
            model = eqx.tree_at(lambda m: m.dynamics.system, network(), NSSNN(1, 6, depth=2, key=key))
            state = training.advance(model, recording(), training.begin(model, 30), KEY, 30)
            return training.finish(model, recording(), state).best_score

        return jax.vmap(one)(keys)

    together = run(jnp.stack([jax.random.key(0), jax.random.key(1)]))
    given = dict(prior=PRIOR, optimiser=RATES, epochs=30, key=KEY)
    first, second = (_train.train(network(k), recording(), ALL, **given) for k in (0, 1))
    # A batched program sums in another order, and thirty steps magnify that.
    assert np.allclose(together, [first.score, second.score], rtol=1e-6)
    assert abs(together[0] - together[1]) > 1e-3


def test_bad_input_is_one_sentence():
    """Nothing that learns, no epoch, a start without a score, a rate of 0: each is one sentence."""
    given = dict(prior=Flat(), optimiser=Adam(), key=KEY)
    with pytest.raises(InputError, match="Nothing in the model learns"):
        _train.train(Place(1.0), recording(), Walled(), epochs=1, **given)
    with pytest.raises(InputError, match="`epochs` of at least 1"):
        _train.train(Place(jnp.zeros(())), recording(), Walled(), epochs=0, **given)
    with pytest.raises(InputError, match="No step of the training had a possible score"):
        _train.train(Place(jnp.asarray(2.0)), recording(), Walled(), epochs=2, **given)
    with pytest.raises(InputError, match="`Adam` needs a positive learning rate"):
        Adam(0.0)
