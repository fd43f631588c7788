"""Sampling that was killed goes on to the last bit, Ctrl-C leaves the draws so far, and no other file is taken."""

import functools
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from estimation_cases import linear_system, simulate

from symplearn import _blocks, _chains, _importance
from symplearn._checkpoint import Checkpoint
from symplearn._dram import DRAM
from symplearn._errors import InputError
from symplearn._fit import Estimate
from symplearn._importance import AdaptiveImportance
from symplearn._mclmc import MCLMC
from symplearn._model import Gaussian, LinearDynamics, LinearObservation, StateSpaceModel
from symplearn._noise import AdditiveGaussian, Dense
from symplearn._nuts import NUTS
from symplearn._objectives import MarginalLikelihood, TimeSeries
from symplearn._parameters import Frozen, Learnt
from symplearn._pathfinder import Pathfinder
from symplearn._posterior import load_posterior
from symplearn._prior import Normal, Prior
from symplearn._random_walk import RandomWalk
from symplearn._sample import sample, sample_density
from symplearn._sampler import AbstractSampler, Drawn
from symplearn._tempered_smc import TemperedSMC
from symplearn._variational import VariationalInference

SCOUT = AdaptiveImportance(batch=50, target=20, rounds=4)
WALK = RandomWalk(chains=4, steps=120, thin=3, scout=SCOUT)
SAMPLERS = {
    "importance": AdaptiveImportance(draws=80, batch=50, target=1000, rounds=10),
    "random walk": WALK,
    "NUTS": NUTS(chains=2, draws=40, warm_up=30, doublings=3, scout=SCOUT),
    "DRAM": DRAM(blocks=((0,), (1,)), chains=2, steps=120, thin=3, patience=10, scout=SCOUT),
    "MCLMC": MCLMC(chains=2, draws=40, warm_up=30, scout=SCOUT),
    "tempering": TemperedSMC(runs=2, lines=4, length=10),
    "paths": Pathfinder(draws=80, paths=8),
    "variational": VariationalInference(draws=80, steps=200),
}
KEY = jax.random.key(3)


class Bent(eqx.Module):
    """x0 ~ N(0, 1) and x1 ~ N(x0^2 - 1, width^2) given x0."""

    width: jax.Array

    def __call__(self, x):
        return -0.5 * (x[0] ** 2 + ((x[1] - x[0] ** 2 + 1) / self.width) ** 2)


def drawn(sampler, checkpoint=None, key=KEY, width=1.0):
    return sample_density(Bent(jnp.asarray(width)), [0.5, -0.5], sampler=sampler, key=key, checkpoint=checkpoint)


@functools.cache
def uninterrupted(name):
    return drawn(SAMPLERS[name])


def same(one, other):
    """Whether all that two posteriors know of their draws is the same to the last bit."""
    # The words, which are leaves too, are in the text.
    leaves = [jax.tree.leaves(eqx.filter(p.drawn, eqx.is_array_like)) for p in (one, other)]
    return str(one) == str(other) and all(np.array_equal(a, b, equal_nan=True) for a, b in zip(*leaves, strict=True))


@pytest.fixture
def every_block(monkeypatch):
    """Files are written after every block, not every minute."""
    monkeypatch.setattr(_blocks, "BETWEEN_FILES", -1.0)


# The others are driven in the same ways.
FAST = ("importance", "random walk")
FAST_FIRST = [*FAST, *(pytest.param(name, marks=pytest.mark.slow) for name in SAMPLERS if name not in FAST)]


@pytest.mark.parametrize("name", FAST_FIRST)
def test_resumed_from_every_file_is_uninterrupted(name, tmp_path, monkeypatch, every_block):
    """From any of the files that a run leaves behind, whenever it is killed, the same call ends at the same bits."""
    save, files = Checkpoint.save, []

    def kept(self, state):
        save(self, state)
        files.append(shutil.copy(self.path, tmp_path / f"{len(files)}.npz"))

    monkeypatch.setattr(Checkpoint, "save", kept)
    assert same(drawn(SAMPLERS[name], tmp_path / "at.npz"), uninterrupted(name))
    monkeypatch.setattr(Checkpoint, "save", save)
    assert len(files) >= 3  # one to begin from, one in the middle, the last: tempering takes three steps here
    for path in files[:: len(files) // 3]:
        assert same(drawn(SAMPLERS[name], path), uninterrupted(name))


SCRIPT = """
import os, signal, sys
import conftest, test_sampling_resumes as cases
from symplearn import _blocks
from symplearn._checkpoint import Checkpoint

_blocks.BETWEEN_FILES = -1.0
save, calls = Checkpoint.save, []

def last(self, state):
    save(self, state)
    calls.append(1)
    if len(calls) == 3:
        os.kill(os.getpid(), signal.SIGKILL)

Checkpoint.save = last
cases.drawn(cases.WALK, sys.argv[1])
"""


def test_killed_process_is_resumed(tmp_path):
    """A process that SIGKILL ended amid its run leaves one whole file, from which another process ends as if alone."""
    places = [str(Path(__file__).parent), str(Path(__file__).parents[1])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(places)}
    found = subprocess.run(
        [sys.executable, "-c", SCRIPT, tmp_path / "at.npz"], env=environment, capture_output=True, text=True
    )
    assert found.returncode == -signal.SIGKILL, found.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["at.npz"]
    with np.load(tmp_path / "at.npz", allow_pickle=False) as file:
        steps = [int(file[name]) for name in file.files if file[name].shape == () and file[name].dtype.kind == "i"]
    assert 0 < steps[-1] < 150  # of 30 of warm-up and 120
    assert same(drawn(WALK, tmp_path / "at.npz"), uninterrupted("random walk"))


def interrupted_at(call, function):
    """The function, at whose given call somebody presses Ctrl-C."""
    calls = []

    def interrupted(*given):
        calls.append(1)
        if len(calls) == call:
            raise KeyboardInterrupt
        return function(*given)

    return interrupted


def test_a_stopped_walk_keeps_its_draws(tmp_path, monkeypatch):
    """Ctrl-C gives back the draws so far, which say so, also from their file; the same call then ends as if alone."""
    monkeypatch.setattr(_chains, "_advance", interrupted_at(5, _chains._advance))  # after 1 + 4 + 16 + 64 steps
    posterior = drawn(WALK, tmp_path / "at.npz")
    assert posterior.stopped and "Stopped by Ctrl-C after 18 of 40 draws of each chain" in str(posterior)
    np.testing.assert_array_equal(posterior.free, uninterrupted("random walk").free[:, :18])
    posterior.save(tmp_path / "draws.nc")
    assert load_posterior(tmp_path / "draws.nc").stopped and not uninterrupted("random walk").stopped
    assert str(load_posterior(tmp_path / "draws.nc")) == str(posterior)
    assert same(drawn(WALK, tmp_path / "at.npz"), uninterrupted("random walk"))


def test_stopped_rounds_keep_their_draws(tmp_path, monkeypatch):
    """So does Ctrl-C in the rounds of importance sampling, once there are fresh ones."""
    sampler = SAMPLERS["importance"]
    monkeypatch.setattr(_importance, "densities", interrupted_at(8, _importance.densities))
    posterior = drawn(sampler, tmp_path / "at.npz")
    assert posterior.stopped and "Stopped by Ctrl-C after 7 of at most 10 rounds" in str(posterior)
    assert posterior.drawn.evaluations == 7 * sampler.batch
    assert same(drawn(sampler, tmp_path / "at.npz"), uninterrupted("importance"))


def test_a_stop_before_any_draw_is_raised(tmp_path, monkeypatch):
    """Where there is no draw yet, Ctrl-C is raised, after the state was saved."""
    monkeypatch.setattr(_chains, "_advance", interrupted_at(3, _chains._advance))
    with pytest.raises(KeyboardInterrupt):
        drawn(WALK, tmp_path / "at.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["at.npz"]
    monkeypatch.setattr(_importance, "densities", interrupted_at(2, _importance.densities))
    with pytest.raises(KeyboardInterrupt):
        drawn(SAMPLERS["importance"], tmp_path / "rounds.npz")
    assert same(drawn(SAMPLERS["importance"], tmp_path / "rounds.npz"), uninterrupted("importance"))


def estimate(reading=0.0, process_noise=1.0):
    """An estimate of a linear model, which nobody fitted: sampling needs no mode."""
    A, H, Q, R, m0, P0 = linear_system()
    ys = simulate(A, H, Q, R, m0, P0, 4, np.random.default_rng(3))[1]
    noises = AdditiveGaussian(Dense(process_noise * Q)), AdditiveGaussian(Dense(R))
    parts = LinearDynamics(Frozen(jnp.asarray(A))), LinearObservation(Frozen(jnp.asarray(H)))
    model = StateSpaceModel(*parts, *noises, Gaussian(Learnt(jnp.zeros(3)), jnp.asarray(P0)))
    series = TimeSeries(np.arange(4.0), ys + reading)
    return Estimate(model, series, MarginalLikelihood(), Prior(Normal(0.0, 4.0)), *[0.0] * 4, True, 1)


def test_another_run_is_refused(tmp_path):
    """A file of another key, sampler, density, recording or model is refused in one sentence; so is a damaged one,
    and one that could not be written."""
    path, rounds = tmp_path / "at.npz", SAMPLERS["importance"]
    drawn(rounds, path)
    others = dict(key=jax.random.key(4)), dict(width=2.0), dict(sampler=eqx.tree_at(lambda s: s.target, rounds, 999))
    for other in others:
        with pytest.raises(InputError, match="of another computation"):
            drawn(**dict(sampler=rounds, checkpoint=path) | other)
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(InputError, match="is damaged"):
        drawn(rounds, path)
    with pytest.raises(InputError, match="no folder for the checkpoint"):
        drawn(rounds, tmp_path / "absent" / "at.npz")
    of_model = tmp_path / "model.npz"
    sample(estimate(), sampler=rounds, key=KEY, checkpoint=of_model)
    for other in (dict(reading=1e-9), dict(process_noise=2.0)):
        with pytest.raises(InputError, match="of another computation"):
            sample(estimate(**other), sampler=rounds, key=KEY, checkpoint=of_model)


class AtOnce(AbstractSampler):
    """A sampler without blocks."""

    def draw(self, density, start, key):
        z = jax.random.normal(key, (2, 8, start.centre.size))
        return Drawn(start.free(z), jnp.zeros((2, 8)), evaluations=0)


def test_a_sampler_without_blocks_keeps_no_file(tmp_path):
    """A sampler that draws all at once says that it keeps no checkpoint, rather than to take one and write nothing."""
    with pytest.raises(InputError, match="`AtOnce` draws all at once and keeps no checkpoint"):
        drawn(AtOnce(), tmp_path / "at.npz")
    assert drawn(AtOnce()).free.shape == (2, 8, 2)


def test_progress_comes_after_two_seconds_and_then_every_ten(monkeypatch, capsys):
    """Of a run of blocks of a second there is a line after two seconds and then one in ten; of a short run, none."""
    clock = iter(np.arange(0.0, 1000.0, 0.5))
    monkeypatch.setattr(_blocks.time, "monotonic", lambda: float(next(clock)))
    course = _blocks.Course("sample")
    for k in range(40):  # each block asks for the time once: 0.5 s
        course.passed(k, lambda k: f"block {k}")
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["sample: block 4", "sample: block 25"]
