"""Long computations in blocks: told on stderr, kept in a file, and stopped by Ctrl-C between two of them."""

import math
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ._checkpoint import Checkpoint
from ._errors import InputError, shown

# Seconds that a block is to take and, in between two checkpoints, at least: those of much work are large.
PAUSE, BETWEEN_FILES = 2.0, 60.0


class Course:
    """How a long computation is told and kept: a line on stderr after two seconds and then every ten, and a file.

    `what` opens each line. With `catches`, Ctrl-C ends the computation with what it has, and `interrupted` says so;
    without, it is raised once that is saved.
    """

    def __init__(self, what: str, checkpoint: Checkpoint | None = None, catches: bool = False):
        self.what, self.checkpoint, self.catches, self.interrupted = what, checkpoint, catches, False
        self._saved = time.monotonic()
        self._due = self._saved + PAUSE

    def resumed(self, like: Callable[[], Any]) -> Any:
        """The state in the file, in the shape of `like()`; None where there is none.

        **Raises:** `InputError` where the file is damaged or of another computation, or there is no folder for it.
        """
        if self.checkpoint is None:
            return None
        if not self.checkpoint.path.parent.is_dir():
            raise InputError(f"There is no folder for the checkpoint {shown(self.checkpoint.path)}; make it first.")
        if not self.checkpoint.path.exists():
            return None
        return self.checkpoint.load(like())

    def passed(self, state: Any, line: Callable[[Any], str]) -> None:
        """One block is over, and this is its state."""
        now = time.monotonic()
        if now - self._saved > BETWEEN_FILES:
            self.save(state)
        if now > self._due:
            self._due = now + 5.0 * PAUSE
            print(f"{self.what}: {line(state)}", file=sys.stderr, flush=True)

    def save(self, state: Any) -> None:
        """Write the file, where there is to be one."""
        if self.checkpoint is not None:
            self.checkpoint.save(state)
            self._saved = time.monotonic()


def run_blocks(
    course: Course,
    advance: Callable[[Any, Array], Any],
    state: Any,
    done: Callable[[Any], int],
    total: int,
    line: Callable[[Any], str],
    *,
    deadline: Callable[[], float] = lambda: math.inf,
) -> Any:
    """The state after `total` steps, of which `done` tells how many it has; `advance` takes it some steps further.

    It stops early where the next block would end after the `deadline` of `time.monotonic`, which is asked each time,
    and at Ctrl-C where the course catches it. However it ends, the state is saved.
    """
    count, each = 1, 0.0
    try:
        while (at := done(state)) < total:
            began, count = time.monotonic(), min(count, total - at)
            if began + count * each > deadline():
                break
            state = jax.block_until_ready(advance(state, jnp.asarray(count)))
            each = (time.monotonic() - began) / count
            course.passed(state, line)
            # The first block holds the compilation: by and by more steps fill the pause.
            count = max(1, min(4 * count, int(PAUSE / max(each, 1e-6))))
    except KeyboardInterrupt:
        if not course.catches:
            raise
        course.interrupted = done(state) < total
    finally:
        course.save(state)
    return state
