"""Many networks trained at once by one program: what the experiments with the NSSNN share."""

import argparse
import math
import sys
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

from ._command import Run, command


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

    def left(self) -> float:
        """Seconds until then."""
        return self.moment - time.monotonic()


def side_by_side(jobs: Sequence[Callable[[], Any]], deadline: Deadline) -> list[Any]:
    """The results of the jobs: two at a time on a processor, for a program of small matrices keeps one core busy."""
    with ThreadPoolExecutor(1 if jax.default_backend() == "gpu" else 2) as pool:
        waiting = [pool.submit(job) for job in jobs]
        try:
            return [each.result() for each in waiting]
        except BaseException:
            # The others stop as well, and save where they are; those that wait do not begin.
            deadline.moment = -math.inf
            pool.shutdown(wait=False, cancel_futures=True)
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
        file = self._file(what, path)
        state = run_epochs(
            lambda state, count: _advance(self, state, count), _begin(self), file, lambda: deadline.moment, what
        )
        return _best(self, state) if self._is_over(state) else None

    def is_done(self, what: str, path: Path) -> bool:
        """Whether `path` holds the end of the training."""
        return path.exists() and self._is_over(self._file(what, path).load(_begin(self)))

    def _file(self, what: str, path: Path) -> Checkpoint:
        words = f"{what} {self.epochs} {self.training}"
        return Checkpoint(path, seal_of((self.models, self.recordings, self.keys), words))

    def _is_over(self, state: TrainingState) -> bool:
        return bool(np.all(state.epoch == self.epochs))


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


class Spread(NamedTuple):
    """The median and the 10 % and 90 % quantiles over repeats, which are NumPy's linearly interpolated ones."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Any) -> "Spread":
        low, middle, high = np.quantile(np.asarray(values), (0.1, 0.5, 0.9))
        return cls(float(middle), float(low), float(high))

    def __str__(self) -> str:
        return f"{self.median:.3g} [{self.low:.3g}, {self.high:.3g}]"

    @property
    def verdict(self) -> str:
        """Of how many times an error fell: whether more than nine of ten repeats agree."""
        return "it helps" if self.low > 1.0 else "it hurts" if self.high < 1.0 else "it makes no clear difference"


def plain(metrics: dict[str, Any]) -> dict[str, Any]:
    """Metrics for JSON: a spread is an object with `median`, `low` and `high`."""
    return {name: one._asdict() if isinstance(one, Spread) else one for name, one in metrics.items()}


def smaller(settings: Any, full: Any, **counts: tuple[int, int]) -> str:
    """The first line of a study that is smaller than the published one; empty where it is not.

    Of each setting that is a number, and of `counts`, it says how much of how much.
    """
    if settings == full:
        return ""
    numbers = {name: (each, getattr(full, name)) for name, each in settings._asdict().items() if isinstance(each, int)}
    parts = [
        f"{name.replace('_', ' ')} {own} of {whole}"
        for name, (own, whole) in (counts | numbers).items()
        if own != whole
    ]
    return f"SMALLER than the published study: {', '.join(parts)}. No number is the full run's.\n"


def study_command(
    name: str,
    about: str,
    experiment: Callable[[Any, Deadline, Run], None],
    sizes: Callable[[bool], Any],
    given: Any,
    sweep: bool = False,
) -> None:
    """The command line of a study: `sizes(quick)` are its settings, `given` the arguments, or None for the process's.

    Ctrl-C ends with exit code 130, and the same command goes on from there.
    """
    deadline, chosen_sizes, others = options(name, sys.argv[1:] if given is None else given)

    def chosen(run: Run) -> None:
        try:
            experiment(sizes(run.quick)._replace(**chosen_sizes), deadline, run)
        except KeyboardInterrupt:
            print(f"experiments.{name}: stopped; the same command goes on from here", file=sys.stderr)
            raise SystemExit(130) from None

    more = "--minutes M stops in time; --width, --epochs and --repeats make it smaller."
    command(name, f"{about} {more}", chosen, others, sweep)


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
