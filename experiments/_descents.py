"""Descents on many data sets side by side, in one compiled program; `fit` and `learn` take one data set at a time."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from symplearn._descent import Place, descend
from symplearn._objectives import MARGINAL_LIKELIHOOD, TimeSeries
from symplearn._prior import Prior


class Descents(NamedTuple):
    """How far and how wide: at most `rounds` of `evaluations` for a data set, `width` data sets at a time.

    A data set has settled where a quadratic model promises no more than `tolerance` nats. Those that have make room for
    others, as a program of many waits for the slowest.
    """

    prior: Prior
    evaluations: int = 60
    rounds: int = 8
    width: int = 20
    tolerance: float = 1e-6

    def run(self, models: Any, places: Place, series: TimeSeries) -> Place:
        """Every place taken down on its own data set; models, places and series have the same leading axis."""
        left = np.full(len(places.free), self.rounds)
        for _ in range(self.rounds * len(left)):
            # Whoever has most rounds left comes first; the program's width never changes, so that it compiles once.
            chosen = np.argsort(-left, kind="stable")[: self.width]
            if left[chosen[0]] <= 0:
                break
            picked = jax.tree.map(_rows(chosen), (models, places, series))
            after = _descend(*picked, self.prior, jnp.asarray(self.evaluations), jnp.asarray(self.tolerance))
            places = jax.tree.map(lambda old, new, at=chosen: old.at[at].set(new), places, after)
            left[chosen] = np.where(self.settled(after), 0, left[chosen] - 1)
        return places

    def settled(self, places: Place) -> np.ndarray:
        """Which of the places a quadratic model promises little more of."""
        promised = jax.vmap(lambda place: place.promised(jnp.ones(place.free.size)))(places)
        return np.asarray(promised) <= self.tolerance


def _rows(chosen: np.ndarray) -> Any:
    return lambda leaf: leaf[chosen] if eqx.is_array(leaf) else leaf


def best_of(ended: list[Place]) -> tuple[Place, np.ndarray]:
    """For each data set the place of the lowest score, and which one it was."""
    won = np.argmin([place.score for place in ended], axis=0)
    at = np.arange(len(won))
    return jax.tree.map(lambda *leaves: jnp.stack(leaves)[won, at], *ended), won


@eqx.filter_jit
def _descend(models: Any, places: Place, series: TimeSeries, prior: Prior, steps: Array, tolerance: Array) -> Place:
    """A descent on each data set; `descend` itself has many models on one recording."""

    def one(model, place, series):
        size = place.free.size
        model, place = jax.tree.map(lambda leaf: leaf[None] if eqx.is_array(leaf) else leaf, (model, place))
        moves, rounding, kinks = jnp.ones((1, size)), jnp.zeros(1), jnp.zeros(size)
        after = descend(model, place, moves, rounding, kinks, series, MARGINAL_LIKELIHOOD, prior, steps, tolerance)
        return jax.tree.map(lambda leaf: leaf[0], after)

    return eqx.filter_vmap(one)(models, places, series)
