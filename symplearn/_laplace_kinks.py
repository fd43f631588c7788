"""Descents under Laplace priors, whose kinks a smooth method cannot see: rounded off on the way, exact at the end."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from ._descent import Place, descend
from ._objectives import AbstractObjective, TimeSeries
from ._parameters import Learnt, named_parameters
from ._prior import Laplace, Prior

# Nats by which a kink is rounded off until the end, and how far from it, in widths, a coefficient is set to zero.
ROUNDING, _SNAP = 0.01, 3.0
# Evaluations of a descent at a time.
EVALUATIONS = 150


class Task(NamedTuple):
    """What is scored, and how it is told."""

    series: TimeSeries | tuple[TimeSeries, ...]
    objective: AbstractObjective
    prior: Prior | None
    kinks: Array
    tolerance: float

    def descend(self, models: Any, places: Place, moves: Array, rounding: float, steps: int, left: float) -> Place:
        """All lanes side by side; the compiled program is the same for every stage."""
        return descend(
            models,
            places,
            moves,
            jnp.full(len(moves), rounding),
            self.kinks,
            self.series,
            self.objective,
            self.prior,
            jnp.asarray(steps),
            jnp.asarray(left),
        )


def end_at_kinks(models: Any, places: Place, task: Task) -> tuple[Place, Array]:
    """Descents ended with the kinks as sharp as they are, and what moved there at last (lane, parameter).

    A coefficient that ended at a kink is zero and held there, as long as the slope does not exceed the kink's.
    """
    width = _SNAP * ROUNDING / jnp.where(task.kinks > 0, task.kinks, 1.0)
    zero = (task.kinks > 0) & (jnp.abs(places.free) < width)
    for _ in range(3):
        # Of the places' type, not a weak one: a weak one compiles the descent anew.
        moves = jnp.where(zero, 0.0, jnp.ones_like(places.free))
        places = places._replace(free=jnp.where(zero, 0.0, places.free))
        places = task.descend(models, places, moves, 0.0, EVALUATIONS, task.tolerance)
        loose = zero & (jnp.abs(places.slope) > task.kinks)
        stuck = (task.kinks > 0) & (jnp.abs(places.free) < 1e-3 * width)
        if not bool(jnp.any(loose | (stuck & ~zero))):
            break
        places = places._replace(free=jnp.where(loose, -jnp.sign(places.slope) * 0.1 * width, places.free))
        zero = (zero | stuck) & ~loose
    return places, moves


def kinks_of(model: Any, prior: Prior) -> Array:
    """1 / scale at the free coordinates under a Laplace prior, else 0."""
    parts = []
    for name, leaf in named_parameters(model).items():
        bare, density = isinstance(leaf, Learnt) or eqx.is_array(leaf), prior.density_of(name)
        size = getattr(leaf, "free", leaf)
        kink = 1.0 / density.scale if bare and isinstance(density, Laplace) else 0.0
        parts.append(jnp.ravel(jnp.broadcast_to(kink, size.shape)))
    return jnp.concatenate(parts)
