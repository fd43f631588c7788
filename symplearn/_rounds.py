"""Rounds of log densities, which a file remembers: a sampler that asks for the same again is answered without work."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._blocks import Course


class Rounds:
    """At most `most` rounds of log densities of a `batch` of draws each.

    What was computed before a stop comes from the file of the `course`. All else in a sampler of rounds is cheap and
    follows from its key, so with these it comes to where it was.
    """

    def __init__(self, compute: Callable[[np.ndarray], np.ndarray], most: int, batch: int, course: Course):
        def empty() -> Any:
            return jnp.full((most, batch), jnp.nan, float), jnp.zeros((), int)

        known = course.resumed(empty)
        values, count = empty() if known is None else known
        self.values, self.known, self.asked = np.array(values), int(count), 0
        self.compute, self.course = compute, course

    def __call__(self, z: Float[np.ndarray, "draw parameter"]) -> Float[np.ndarray, " draw"]:
        """The log densities of the next batch."""
        if self.asked == self.known:
            self.values[self.known] = self.compute(z)
            self.known += 1
            self.course.passed(self.state, lambda _: f"round {self.known} of at most {len(self.values)}")
        self.asked += 1
        return self.values[self.asked - 1].copy()

    @property
    def state(self) -> tuple[Array, Array]:
        """What the file holds: the values, NaN for those to come, and how many rounds there are."""
        return jnp.asarray(self.values), jnp.asarray(self.known)
