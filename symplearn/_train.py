"""Stochastic training: Adam and its kin on any objective, for models too large for BFGS. Dissertation sec. 5.4.3.

What it finds is the best model met, not a maximum a posteriori. `Training` holds pure functions that `jax.vmap` maps
over many models; `train` drives one of them with progress and a checkpoint.
"""

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from ._blocks import Course, run_blocks
from ._checkpoint import Checkpoint, seal_of
from ._counts import refuse_count
from ._errors import InputError, shown
from ._faults import IMPOSSIBLE
from ._keys import refuse_key
from ._learnable import refuse_empty
from ._objectives import AbstractObjective, TimeSeries, as_recordings
from ._optimisers import AbstractOptimiser
from ._parameters import named_parameters, partition, value_of
from ._prior import AbstractDensity, Prior

# Another recording's nats may be added to the impossible one's.
_HOPELESS = -0.5 * IMPOSSIBLE


class TrainingState(eqx.Module):
    """Where a training stands: what learns now (`learnt`), at its last possible score, and at its best one.

    `history` (epoch,) holds the score, in nats, of the model that enters an epoch, NaN for those to come.
    `epoch` counts those done, `failures` the steps that led to an impossible score.
    """

    learnt: PyTree
    sound: PyTree
    best: PyTree
    best_score: Float[Array, ""]
    best_epoch: Int[Array, ""]
    optimiser: PyTree
    history: Float[Array, " epoch"]
    epoch: Int[Array, ""]
    failures: Int[Array, ""]


class Training(eqx.Module):
    """What is minimised and how: the pure part of `train`, to be mapped over models, recordings and keys.

    **Arguments:** `objective`; `prior` - a `Prior`; `optimiser` - an `AbstractOptimiser`, or a gradient transformation
    of optax, whose schedule then counts steps; `steps` - an epoch's, as `steps_of` says.
    """

    objective: AbstractObjective
    prior: Prior
    optimiser: Any
    steps: int = eqx.field(static=True, default=1)

    def begin(self, model: Any, epochs: int) -> TrainingState:
        """The state before the first of at most `epochs` epochs."""
        learnt = partition(model)[0]
        # Strong types: with weak ones a state from a file would compile anew.
        none, history = jnp.zeros((), int), jnp.full(epochs, jnp.nan, float)
        hopeless = jnp.full((), -IMPOSSIBLE, float)
        rule = self._rule.init(learnt)
        return TrainingState(learnt, learnt, learnt, hopeless, none, rule, history, none, jnp.zeros_like(none))

    def advance(
        self, model: Any, recordings: Any, state: TrainingState, key: PRNGKeyArray, count: Int[Array, ""] | int
    ) -> TrainingState:
        """The state after `count` more epochs. Not jitted; `count` may be traced. The epochs' draws depend on `key` and
        on the epoch's number alone, so two calls of one epoch are one call of two, to the last bit."""
        rest = partition(model)[1]

        def epoch(_: Any, state: TrainingState) -> TrainingState:
            return self._epoch(rest, recordings, state, jax.random.fold_in(key, state.epoch))

        return jax.lax.fori_loop(0, count, epoch, state)

    def finish(self, model: Any, recordings: Any, state: TrainingState) -> TrainingState:
        """The state with the model that left the last epoch judged as well. Not jitted."""
        score = self._score(partition(model)[1], recordings, self._whole, state.learnt)
        return _judged(state, score, state.epoch)

    def best(self, model: Any, state: TrainingState) -> Any:
        """The model of the best score."""
        return eqx.combine(state.best, partition(model)[1])

    @property
    def _rule(self) -> optax.GradientTransformation:
        given = isinstance(self.optimiser, AbstractOptimiser)
        return self.optimiser.transformation(self.steps) if given else self.optimiser

    @property
    def _whole(self) -> AbstractObjective:
        """The objective without mini-batches."""
        return eqx.tree_at(lambda o: o.batch, self.objective, None) if _draws(self.objective) else self.objective

    def _score(self, rest: Any, recordings: Any, objective: AbstractObjective, learnt: PyTree) -> Array:
        model = eqx.combine(learnt, rest)
        return objective(model, recordings) - self.prior.log_density(model)

    def _epoch(self, rest: Any, recordings: Any, state: TrainingState, key: Array) -> TrainingState:
        if not _draws(self.objective):
            state, score = self._step(rest, recordings, state, self.objective)
            history = state.history.at[state.epoch].set(score)
            return eqx.tree_at(lambda s: (s.history, s.epoch), state, (history, state.epoch + 1))
        score = self._score(rest, recordings, self._whole, state.learnt)
        state = _judged(state, score, state.epoch)

        def step(state: TrainingState, key: Array) -> tuple[TrainingState, None]:
            drawn = eqx.tree_at(lambda o: o.batch.key, self.objective, key)
            return self._step(rest, recordings, state, drawn)[0], None

        state, _ = jax.lax.scan(step, state, jax.random.split(key, self.steps))
        history = state.history.at[state.epoch].set(score)
        return eqx.tree_at(lambda s: (s.history, s.epoch), state, (history, state.epoch + 1))

    def _step(
        self, rest: Any, recordings: Any, state: TrainingState, objective: AbstractObjective
    ) -> tuple[TrainingState, Array]:
        """One step of the optimiser; from an impossible score instead half the way back to where it was possible."""
        score, slope = jax.value_and_grad(lambda learnt: self._score(rest, recordings, objective, learnt))(state.learnt)
        sound = _possible(score) & jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(slope)]))
        if not _draws(self.objective):
            state = _judged(state, score, state.epoch)
        updates, optimiser = self._rule.update(slope, state.optimiser, state.learnt)
        onwards = optax.apply_updates(state.learnt, updates)
        back = jax.tree.map(lambda here, there: 0.5 * (here + there), state.learnt, state.sound)
        after = TrainingState(
            _either(sound, onwards, back),
            _either(sound, state.learnt, state.sound),
            state.best,
            state.best_score,
            state.best_epoch,
            _either(sound, optimiser, state.optimiser),
            state.history,
            state.epoch,
            state.failures + ~sound,
        )
        return after, score


def _either(which: Array, one: PyTree, other: PyTree) -> PyTree:
    return jax.tree.map(lambda a, b: jnp.where(which, a, b), one, other)


def _possible(score: Array) -> Array:
    return jnp.isfinite(score) & (score < _HOPELESS)


def _judged(state: TrainingState, score: Array, epoch: Array) -> TrainingState:
    """The state with the present model as the best one, if its score is."""
    better = _possible(score) & (score < state.best_score)
    best = _either(better, (state.learnt, score, epoch), (state.best, state.best_score, state.best_epoch))
    return eqx.tree_at(lambda s: (s.best, s.best_score, s.best_epoch), state, best, is_leaf=lambda x: x is None)


def _draws(objective: AbstractObjective) -> bool:
    """Whether the objective draws mini-batches."""
    return getattr(objective, "batch", None) is not None


def steps_of(objective: AbstractObjective, recordings: Any) -> int:
    """The steps of one epoch: as many mini-batches as cover the data intervals, or one."""
    if not _draws(objective):
        return 1
    size: int = objective.batch.size  # type: ignore[attr-defined]
    return math.ceil(sum(len(one.times) - 1 for one in as_recordings(recordings)) / size)


class Trained(eqx.Module):
    """The best model that a training met. It is no MAP: nothing says that a better one is not near.

    `score` is its negative log posterior, of free coordinates, in nats; it entered epoch `best_epoch` of `epochs`.
    `history` (epoch,) are the scores of the models that entered the epochs, `failures` the steps to an impossible
    score. `gradient_norm` is the largest slope along a free coordinate at the best model, in nats, and `last_gain` the
    nats that the best score fell in the last tenth of the epochs: what is far from 0 says train on.
    """

    model: Any
    recording: TimeSeries | tuple[TimeSeries, ...]
    objective: AbstractObjective
    prior: Prior
    score: float
    history: Float[Array, " epoch"]
    best_epoch: int
    epochs: int
    failures: int
    gradient_norm: float
    last_gain: float

    def values(self) -> dict[str, Array]:
        """The values learnt, by name."""
        return {name: value_of(leaf) for name, leaf in named_parameters(self.model).items()}

    def __str__(self) -> str:
        return (
            f"Trained (no MAP): {self.score:.6g} nats at epoch {self.best_epoch} of {self.epochs}, largest slope "
            f"{self.gradient_norm:.3g} nats, {self.last_gain:.3g} nats gained in the last tenth, {self.failures} "
            "failed steps"
        )


def train(
    model: Any,
    recordings: Any,
    objective: AbstractObjective,
    *,
    prior: Prior | AbstractDensity,
    optimiser: Any,
    epochs: int,
    key: PRNGKeyArray,
    checkpoint: str | os.PathLike | None = None,
) -> Trained:
    """Train a model on recordings by steps along the gradient of its negative log posterior, in free coordinates.

    An objective with a `MiniBatch` is drawn anew at every step, as many steps an epoch as cover the recordings; others
    step once an epoch. From a step to an impossible score the model goes half the way back to where it was, and the
    step is counted. Beyond two seconds progress is told on stderr, every ten.

    **Arguments:** `recordings` - one, or a list; `prior` - a `Prior` or one density for every leaf, such as `Flat()`;
    `optimiser` - `Adam(...)`, `ByLeaf({...})` for other rates of other leaves, or a gradient transformation of optax;
    `epochs`; `key` - of the mini-batches; `checkpoint` - a file that is written every minute and at the end, also one
    by an exception, whole or not at all. Where it exists, training goes on from it and ends at the same numbers, to
    the last bit, as without the stop.

    **Raises:** `InputError` where nothing learns, the start has no possible score, or the checkpoint is damaged or of
    another training.
    """
    prior = prior if isinstance(prior, Prior) else Prior(prior)
    series = as_recordings(recordings)
    several = isinstance(recordings, list | tuple)
    if not named_parameters(model):
        raise InputError("Nothing in the model learns: every number is known or `Frozen`. Wrap one in `Positive`.")
    refuse_count("train", "epochs", epochs)
    refuse_key(key)
    if not isinstance(optimiser, AbstractOptimiser | optax.GradientTransformation):
        raise InputError(
            f"`train` needs an optimiser, such as `Adam(0.05)` or a gradient transformation of optax, but was given "
            f"{shown(optimiser)}."
        )
    refuse_empty(series)
    objective.refuse(model, series)
    given = series if several else series[0]
    training = Training(objective, prior, optimiser, steps_of(objective, series))
    file = None
    if checkpoint is not None:
        seal = seal_of((model, given, objective, prior, key, optimiser), f"{epochs}")
        file = Checkpoint(Path(checkpoint), seal)
    state = run_epochs(
        lambda state, count: _advance(training, model, given, state, key, count), training.begin(model, epochs), file
    )
    if not float(state.best_score) < _HOPELESS:
        raise InputError("No step of the training had a possible score; start from smaller weights or larger noises.")
    return _trained(training, model, given, state)


def run_epochs(
    advance: Callable[[TrainingState, Array], TrainingState],
    state: TrainingState,
    checkpoint: Checkpoint | None = None,
    deadline: Callable[[], float] = lambda: math.inf,
    what: str = "train",
) -> TrainingState:
    """All epochs of a state, or of many with a leading axis, a few seconds of them at a time.

    From the checkpoint, where there is one. It stops early, at a state whose `epoch` says so, where the next epochs
    would end after the `deadline` of `time.monotonic`, which is asked each time.
    """
    course = Course(what, checkpoint)
    found = course.resumed(lambda: state)
    epochs = state.history.shape[-1]
    return run_blocks(
        course,
        advance,
        state if found is None else found,
        lambda state: int(np.max(state.epoch)),
        epochs,
        lambda state: (
            f"epoch {int(np.max(state.epoch))} of {epochs}, best {float(np.median(state.best_score)):.6g} nats"
        ),
        deadline=deadline,
    )


@eqx.filter_jit
def _advance(training, model, series, state, key, count):
    return training.advance(model, series, state, key, count)


@eqx.filter_jit
def _end(training, model, series, state):
    state = training.finish(model, series, state)
    rest = partition(model)[1]
    slope = jax.grad(lambda learnt: training._score(rest, series, training._whole, learnt))(state.best)
    return state, jnp.max(jnp.stack([jnp.max(jnp.abs(leaf)) for leaf in jax.tree.leaves(slope)]))


def _trained(training: Training, model: Any, series: Any, state: TrainingState) -> Trained:
    state, slope = _end(training, model, series, state)
    epochs, score = int(state.epoch), float(state.best_score)
    before = float(jnp.nanmin(state.history[: max(1, epochs - epochs // 10)]))
    return Trained(
        training.best(model, state),
        series,
        training.objective,
        training.prior,
        score=score,
        history=state.history,
        best_epoch=int(state.best_epoch),
        epochs=epochs,
        failures=int(state.failures),
        gradient_norm=float(slope),
        last_gain=before - score,
    )
