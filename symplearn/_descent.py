"""Many descents side by side: BFGS that keeps what it learnt of the curvature, can hold numbers, and rounds off kinks.

BFGS with a bisection to weak Wolfe conditions, which needs no smoothness (Lewis and Overton 2013). The objective and
its gradient stand once in the compiled program, whose lanes are models of one structure: a portfolio compiles once.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from ._guard import guard
from ._log_posterior import HOPELESS, negative_log_posterior
from ._objectives import AbstractObjective, TimeSeries
from ._parameters import flatten, partition
from ._prior import Prior

# Of the weak Wolfe conditions: enough decrease, and enough flattening.
_DECREASE, _FLATTENING = 1e-4, 0.9
# Trials of one line search: 2^-40 of the first step is no step.
_TRIALS = 40


class Place(NamedTuple):
    """Where a descent is: free coordinates, the score there in nats, its slope, and BFGS's inverse Hessian."""

    free: Float[Array, " parameter"]
    score: Float[Array, ""]
    slope: Float[Array, " parameter"]
    inverse: Float[Array, "parameter parameter"]
    steps: Int[Array, ""]

    def promised(self, moves: Float[Array, " parameter"]) -> Float[Array, ""]:
        """The nats that the quadratic model still expects to gain."""
        slope = moves * self.slope
        return 0.5 * slope @ self.inverse @ slope


class _Search(NamedTuple):
    """A line search: its place, the direction, the trial step and its bracket, and how many trials it had."""

    place: Place
    direction: Array
    step: Array
    lower: Array
    upper: Array
    trials: Array
    evaluations: Array
    fresh: Array
    done: Array


@eqx.filter_jit
def descend(
    models: PyTree,
    places: Place,
    moves: Float[Array, "lane parameter"],
    rounding: Float[Array, " lane"],
    kinks: Float[Array, " parameter"],
    series: TimeSeries | tuple[TimeSeries, ...],
    objective: AbstractObjective,
    prior: Prior | None,
    max_steps: Int[Array, ""],
    tolerance: Float[Array, ""],
) -> Place:
    """A descent in each lane from its place, until `tolerance` nats are promised or for `max_steps` evaluations.

    **Arguments:** `models` - models of one structure, stacked; their free coordinates are those of `places`; `moves` -
    1 for a coordinate that moves, 0 for one that is held; `kinks` - half the jump of the score's slope at 0: 1 / scale
    under a Laplace prior, else 0; `rounding` - the nats by which the score may be lowered to round each kink off.
    """

    def lane(model, place, moves, rounding):
        width = rounding / jnp.where(kinks > 0, kinks, 1.0)
        rebuild = flatten(model)[1]

        def score(free):
            free = guard(free)
            nats = negative_log_posterior(rebuild(free), series, objective, prior)
            return nats + jnp.sum(kinks * (_rounded(free, width) - jnp.abs(free)))

        return _descend(score, place, moves, max_steps, tolerance)

    return eqx.filter_vmap(lane, in_axes=(eqx.if_array(0), 0, 0, 0))(models, places, moves, rounding)


def stacked(models: Sequence[Any]) -> PyTree:
    """Models of one structure as one, each array with a leading axis."""
    arrays, rest = zip(*[eqx.partition(model, eqx.is_array) for model in models], strict=True)
    return eqx.combine(jax.tree.map(lambda *leaves: jnp.stack(leaves), *arrays), rest[0])


def start(models: PyTree) -> Place:
    """The places of stacked models, before anything is known of their scores."""

    def one(model):
        free = flatten(model)[0]
        size = free.shape[0]
        # Not weakly typed, as no score is that a descent ends with: else the second descent compiles anew.
        return Place(free, jnp.asarray(jnp.inf, free.dtype), jnp.zeros(size), jnp.eye(size), jnp.asarray(0))

    return eqx.filter_vmap(one)(models)


def put(models: PyTree, free: Float[Array, "lane parameter"]) -> PyTree:
    """The stacked models at other free coordinates."""
    return eqx.filter_vmap(lambda model, free: flatten(model)[1](free))(models, free)


def coordinates(model: PyTree, chosen: Any) -> Float[Array, " parameter"]:
    """1 at the free coordinates of the part of the model that `chosen` picks, else 0."""
    learnt = partition(model)[0]
    marks = jax.tree.map(jnp.zeros_like, learnt)
    ones = jax.tree.map(jnp.ones_like, chosen(learnt))
    return jax.flatten_util.ravel_pytree(eqx.tree_at(chosen, marks, ones, is_leaf=lambda node: node is None))[0]


def _rounded(x: Array, width: Array) -> Array:
    """|x|, its tip rounded off; exactly |x| with derivative 0 at 0 for the width 0."""
    width = jnp.maximum(width, 1e-150)
    return jnp.sqrt(x**2 + width**2) - width


def _descend(score, place, moves, max_steps, tolerance):
    value_and_slope = jax.value_and_grad(score)

    def body(search):
        free = search.place.free + search.step * search.direction
        value, slope = value_and_slope(free)
        sound = jnp.isfinite(value) & (value < 0.5 * HOPELESS)
        slope = jnp.where(sound & jnp.isfinite(slope), slope, 0.0)
        return _judge(search, free, jnp.where(sound, value, HOPELESS), slope, moves, tolerance)

    def going(search):
        return ~search.done & (search.evaluations < max_steps)

    # The first evaluation is at the place itself: nothing is known of it there, or its objective has changed.
    here = place._replace(score=jnp.asarray(jnp.inf))
    search = _search(here, jnp.zeros_like(place.free), jnp.asarray(False))
    return jax.lax.while_loop(going, body, search).place


def _search(place: Place, direction: Array, fresh: Array, evaluations: Any = 0, done: Any = False) -> _Search:
    """A new line search. Without curvature the first step has length 1: no trajectory escapes."""
    length = jnp.linalg.norm(direction)
    step = jnp.where(fresh & (length > 1.0), 1.0 / jnp.maximum(length, 1.0), 1.0)
    zero, none = jnp.zeros(()), jnp.asarray(0)
    return _Search(
        place, direction, step, zero, jnp.asarray(jnp.inf), none, jnp.asarray(evaluations), fresh, jnp.asarray(done)
    )


def _judge(search: _Search, free: Array, value: Array, slope: Array, moves: Array, tolerance: Array) -> _Search:
    """Take the trial point, or narrow the bracket, or give the curvature up."""
    place, direction = search.place, search.direction
    descent, first = direction @ place.slope, ~jnp.isfinite(place.score)
    low = first | (value <= place.score + _DECREASE * search.step * descent)
    flat = first | (direction @ slope >= _FLATTENING * descent)
    spent = search.trials >= _TRIALS
    taken = _take(search, free, value, slope, moves, tolerance)
    narrowed = _narrow(search, low)
    # A search that ends on a kink, or in round-off, starts again from the gradient; twice in a row it is over.
    unknown = place._replace(inverse=jnp.eye(free.size))
    anew = _search(unknown, -moves * place.slope, jnp.asarray(True), search.evaluations + 1, search.fresh)
    chosen = jax.tree.map(lambda a, b: jnp.where(spent, a, b), anew, narrowed)
    return jax.tree.map(lambda a, b: jnp.where(low & (flat | spent), a, b), taken, chosen)


def _narrow(search: _Search, low: Array) -> _Search:
    lower, upper = jnp.where(low, search.step, search.lower), jnp.where(low, search.upper, search.step)
    step = jnp.where(jnp.isfinite(upper), 0.5 * (lower + upper), 2.0 * search.step)
    return search._replace(
        step=step, lower=lower, upper=upper, trials=search.trials + 1, evaluations=search.evaluations + 1
    )


def _take(search: _Search, free: Array, value: Array, slope: Array, moves: Array, tolerance: Array) -> _Search:
    """Go there, with the curvature met on the way."""
    place, first = search.place, ~jnp.isfinite(search.place.score)
    s, y = moves * (free - place.free), moves * (slope - place.slope)
    curved = ~first & (s @ y > 1e-12 * jnp.linalg.norm(s) * jnp.linalg.norm(y))
    inverse = _updated(place.inverse, s, y, search.fresh, curved, moves)
    after = Place(free, value, slope, inverse, place.steps + 1)
    direction = -moves * (inverse @ (moves * slope))
    known = jnp.any(inverse != jnp.eye(free.size))
    done = (~first | known) & (after.promised(moves) <= tolerance)
    return _search(after, direction, ~known, search.evaluations + 1, done | (value >= HOPELESS))


def _updated(H: Array, s: Array, y: Array, fresh: Array, curved: Array, moves: Array) -> Array:
    """The inverse Hessian by (6.17) of Nocedal and Wright (2006); the first one is scaled by (6.20)."""
    sy = jnp.where(curved, s @ y, 1.0)
    scale = jnp.where(fresh & (moves > 0), sy / jnp.maximum(y @ y, 1e-300), 1.0)
    H = H * jnp.where(curved, scale, 1.0)
    Hy = H @ y
    update = (1.0 + y @ Hy / sy) * jnp.outer(s, s) / sy - (jnp.outer(Hy, s) + jnp.outer(s, Hy)) / sy
    return jnp.where(curved, H + update, H)
