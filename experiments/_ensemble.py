"""Many networks trained at once by one program: what the experiments with the NSSNN share."""

import argparse
import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

import integrators as ig
from symplearn._checkpoint import Checkpoint, seal_of
from symplearn._errors import printable
from symplearn._train import Training, TrainingState, run_epochs


class Weighted(ig.AbstractProjection):
    """`weight` times the first copy plus the rest of the second: 1 is `FirstCopy`, 1/2 is `MeanOfCopies`.

    A number, so that one program filters both ways.
    """

    weight: Array = eqx.field(converter=ig.as_parameter)

    def __call__(self, copies: Array) -> Array:
        return self.weight * copies[0] + (1.0 - self.weight) * copies[1]


class Deadline:
    """The moment, of `time.monotonic`, at which the trainings of all threads stop."""

    def __init__(self, moment: float = math.inf):
        self.moment = moment


def side_by_side(jobs: Sequence[Callable[[], Any]], deadline: Deadline) -> list[Any]:
    """The results of the jobs: two at a time on a processor, for a program of small matrices keeps one core busy."""
    with ThreadPoolExecutor(1 if jax.default_backend() == "gpu" else 2) as pool:
        waiting = [pool.submit(job) for job in jobs]
        try:
            return [each.result() for each in waiting]
        except BaseException:
            # The others stop as well, and save where they are.
            deadline.moment = -math.inf
            raise


class Ensemble(NamedTuple):
    """Models, recordings and keys along one leading axis, and how each is trained for so many epochs."""

    training: Training
    models: Any
    recordings: Any
    keys: Array
    epochs: int

    def run(self, what: str, path: Path, deadline: "Deadline") -> Any | None:
        """The best models, or None where the time was up; `path` then holds where it stopped."""
        state = _begin(self)
        words = f"{what} {self.epochs} {self.training}"
        file = Checkpoint(path, seal_of((self.models, self.recordings, self.keys), words))
        state = run_epochs(
            lambda state, count: _advance(self, state, count), state, file, lambda: deadline.moment, what
        )
        return _best(self, state) if bool(np.all(state.epoch == self.epochs)) else None


@eqx.filter_jit
def _begin(ensemble: Ensemble) -> TrainingState:
    return eqx.filter_vmap(lambda model: ensemble.training.begin(model, ensemble.epochs))(ensemble.models)


@eqx.filter_jit
def _advance(ensemble: Ensemble, state: TrainingState, count: Array) -> TrainingState:
    def one(model: Any, recording: Any, state: TrainingState, key: Array) -> TrainingState:
        return ensemble.training.advance(model, recording, state, key, count)

    return eqx.filter_vmap(one)(ensemble.models, ensemble.recordings, state, ensemble.keys)


@eqx.filter_jit
def _best(ensemble: Ensemble, state: TrainingState) -> Any:
    def one(model: Any, recording: Any, state: TrainingState) -> Any:
        return ensemble.training.best(model, ensemble.training.finish(model, recording, state))

    return eqx.filter_vmap(one)(ensemble.models, ensemble.recordings, state)


# The rates fall 20 times, so there are at least so many epochs.
_LEAST = {"width": 1, "epochs": 20, "repeats": 1}


def options(name: str, arguments: Sequence[str]) -> tuple[Deadline, dict[str, int], list[str]]:
    """When to stop, by `--minutes M`; settings given by `--width`, `--epochs` and
    `--repeats`, for a smaller study; and the other arguments."""
    parser = _Parser(prog=f"experiments.{name}", add_help=False, allow_abbrev=False)
    parser.add_argument("--minutes", type=float, default=float("inf"))
    for size in _LEAST:
        parser.add_argument(f"--{size}", type=int)
    known, others = parser.parse_known_args(arguments)
    given = vars(known)
    deadline = given.pop("minutes")
    if not deadline > 0:
        parser.error(f"--minutes is {deadline}, but must be above 0")
    sizes = {size: number for size, number in given.items() if number is not None}
    for size, number in sizes.items():
        if number < _LEAST[size]:
            parser.error(f"--{size} is {number}, but must be at least {_LEAST[size]}")
    return Deadline(time.monotonic() + 60.0 * deadline), sizes, others


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {printable(message)}; `--help` tells what can be given\n")
