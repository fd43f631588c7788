"""What is stepped together, what is found of it, and on which threads."""

import abc
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from jaxtyping import Float, Int

from ._course import Course
from ._problem import Problem

A = TypeVar("A")
B = TypeVar("B")


@dataclass(frozen=True)
class Lanes:
    """Motions through the first `rows` rows of one recording.

    `z` holds what it depends on (its start, the calibrated values, those of the slots), `hots` which coefficients the
    slots are (`Problem.onehot`), `along` the entries of `z` that slopes are wanted in. With `paths` every row begins
    anew at its own point.
    """

    recording: int
    z: Float[np.ndarray, "lane local"]
    hots: Float[np.ndarray, "lane row coefficient"]
    along: Sequence[Int[np.ndarray, " _"]]
    rows: int
    paths: Float[np.ndarray, "lane time state"] | None = None


@dataclass(frozen=True)
class Found:
    """Readings and phase points of lanes, and by lane their slopes in the entries that were named.

    Where rows begin anew, the phase points are those that arrive from the row before.
    """

    shown: Float[np.ndarray, "lane time shown"]
    slopes: Sequence[Float[np.ndarray, "_ time shown"]]


class AbstractSteps(abc.ABC):
    """How lanes are stepped through the courses of some recordings."""

    courses: Sequence[Course]

    @property
    def is_quick(self) -> bool:
        """Whether stepping takes so little beside the rest that threads of its own would only wait for each other."""
        return False

    @abc.abstractmethod
    def __call__(self, problem: Problem, runs: Sequence[Lanes]) -> list[Found]:
        """What is found of each run."""


class Threads:
    """Work side by side on `jobs` threads; the first of all goes before, or every thread would compile it."""

    def __init__(self, jobs: int):
        self.jobs = max(1, jobs)
        self._pool, self._begun = ThreadPoolExecutor(self.jobs), False

    def each(self, work: Callable[[A], B], items: Sequence[A]) -> Iterator[B]:
        """The work on every item, in order."""
        first = 0 if self._begun else 1
        self._begun = True
        yield from map(work, items[:first])
        rest = items[first:]
        yield from self._pool.map(_as_here(work), rest) if self.jobs > 1 and len(rest) > 1 else map(work, rest)

    def ahead(self, work: Callable[[A], B], items: Sequence[A]) -> Iterator[B]:
        """The work on every item in order, on threads of its own while what comes before is being used."""
        if self.jobs < 2 or len(items) < 2:
            yield from map(work, items)
            return
        with ThreadPoolExecutor(self.jobs) as pool:
            yield from pool.map(_as_here(work), items)


def _as_here(work: Callable[[A], B]) -> Callable[[A], B]:
    """Work that minds floating-point errors on a thread of its own as it would here, which NumPy does not see to."""
    minded = np.geterr()

    def done(item: A) -> B:
        with np.errstate(**minded):
            return work(item)

    return done
