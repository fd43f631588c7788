"""What a recording says of one number when all others follow it: the profile likelihood."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from ._convergence import labels
from ._descent import Place, stacked, start
from ._errors import InputError
from ._faults import IMPOSSIBLE
from ._fit import Estimate
from ._lane_loops import with_lane_loops
from ._laplace_kinks import EVALUATIONS, Task
from ._parameters import flatten, named_parameters, value_of

# Half the 95 % quantile of chi-square with one degree of freedom: the nats that bound the interval.
DROP = 1.9207
# How far the number is moved, as multiples of its conditional width; the far ones look for an open side.
_REACH = np.array([0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 8.0, 16.0, 32.0])
_LANES = 2 * len(_REACH) + 1
# Passes in which a lane may start from its neighbour's end, and what counts as the same optimum, in nats.
_PASSES, _SAME = 2, 1e-3


class Profile(eqx.Module):
    """The profile likelihood of one number, `label`: at each of `values` (point,), the largest log likelihood over all
    others, in nats below the largest of all (`drop`, from 0 up; inf where none is possible).

    `lower` and `upper` bound the 95 % interval, where the drop is 1.92 nats (Wilks); None where the likelihood does not
    fall that far on that side: the recording does not bound it there. `settled` (point,) tells which of the fits came
    to an end; an unsettled one gives an upper bound of its drop.
    """

    label: str = eqx.field(static=True)
    values: np.ndarray
    drop: np.ndarray
    settled: Bool[np.ndarray, " point"]
    lower: float | None
    upper: float | None

    @property
    def identifiable(self) -> bool:
        """Whether the recording bounds the number on both sides."""
        return self.lower is not None and self.upper is not None

    def __str__(self) -> str:
        best = float(self.values[int(np.argmin(self.drop))])
        said = f"Profile likelihood of {self.label}: best {best:.4g}"
        if self.lower is not None and self.upper is not None:
            return f"{said}, 95 % between {self.lower:.4g} and {self.upper:.4g}."
        if self.upper is not None:
            return f"{said}, 95 % below {self.upper:.4g}; NOT bounded from below by the recording."
        if self.lower is not None:
            return f"{said}, 95 % above {self.lower:.4g}; NOT bounded from above by the recording."
        return f"{said}; the recording does NOT bound it on either side."


def profile_likelihood(estimate: Estimate, label: str) -> Profile:
    """The profile likelihood of one learnt number, without its prior or any other. Raue et al. (2009).

    The number is moved to both sides of the estimate, all others descend after it, side by side in one program. It is
    moved in its free coordinate, so a positive number by factors, up to 32 of its conditional widths.

    **Arguments:** `label` - a name of `estimate.values()`, with its place where it is an array: `"dynamics.mass"`,
    `"dynamics.system.coefficients[3]"`.

    **Raises:** `InputError` where the model has no such number, or the likelihood at the estimate is impossible.
    """
    k = _place_of(estimate, label)
    free, rebuild = flatten(estimate.model)
    task = Task(estimate.recording, estimate.objective, None, jnp.zeros(free.size), 1e-4)
    centre = _centre(estimate, task)
    offsets = np.concatenate([-_REACH[::-1], [0.0], _REACH]) * _width(centre, k, estimate, task)
    lanes = jnp.tile(centre.free, (len(offsets), 1)).at[:, k].add(jnp.asarray(offsets))
    places = _profiled(estimate, task, lanes, k)
    values = np.asarray(jax.vmap(lambda x: _entry(rebuild(x), k))(places.free))
    score = np.asarray(places.score)
    drop = np.where(score < -0.5 * IMPOSSIBLE, score - score.min(), np.inf)
    moves = jnp.ones_like(places.free).at[:, k].set(0.0)
    settled = np.asarray(jax.vmap(Place.promised)(places, moves)) < 0.1 * DROP
    order = np.argsort(values)
    values, drop, settled, at = values[order], drop[order], settled[order], np.asarray(places.free)[order, k]
    lower, upper = _bounds(at, drop)
    back = [None if x is None else float(_entry(rebuild(centre.free.at[k].set(x)), k)) for x in (lower, upper)]
    if back[0] is not None and back[1] is not None and back[0] > back[1]:
        back.reverse()
    return Profile(label, values, drop, settled, *back)


def _place_of(estimate: Estimate, label: str) -> int:
    """Where the number is in the vector of free coordinates: one for one with the values, as only such can be named."""
    leaves = named_parameters(estimate.model)
    known: list[str] = []
    for name, leaf in leaves.items():
        if np.shape(getattr(leaf, "free", leaf)) != np.shape(value_of(leaf)):
            if label.startswith(name):
                raise InputError(f"{name} is a matrix that learns as a whole: its entries cannot be moved one by one.")
            known += [""] * int(np.size(leaf.free))
        else:
            known += labels({name: value_of(leaf)})
    if label not in known or not label:
        some = ", ".join(name for name in known if name)
        raise InputError(f"The model learns no {label!r}; it learns {some}.")
    return known.index(label)


def _entry(model: Any, k: int) -> Array:
    """The value of free coordinate k, of a leaf whose entries are one for one with its coordinates."""
    offset = 0
    for leaf in named_parameters(model).values():
        size = int(np.size(getattr(leaf, "free", leaf)))
        if k < offset + size:
            return jnp.ravel(value_of(leaf))[k - offset]
        offset += size
    raise IndexError(k)


def _centre(estimate: Estimate, task: Task) -> Place:
    """The maximum of the likelihood next to the estimate; in as many lanes as the profile, so that they share one
    compiled program."""
    models = stacked([estimate.model] * _LANES)
    places = start(models)
    places = task.descend(models, places, jnp.ones_like(places.free), 0.0, EVALUATIONS, task.tolerance)
    place = jax.tree.map(lambda leaf: leaf[0], places)
    if float(place.score) >= -0.5 * IMPOSSIBLE:
        raise InputError("The likelihood at the estimate is impossible; there is nothing to profile.")
    return place


def _width(centre: Place, k: int, estimate: Estimate, task: Task) -> float:
    """How far the coordinate moves alone, the others held, until half a nat is lost; found by doubling."""
    trials = 1e-4 * 2.0 ** np.arange(21)
    moved = jnp.tile(centre.free, (2, len(trials), 1)).at[:, :, k].add(jnp.asarray([-trials, trials]))
    lost = np.asarray(_scores(estimate.model, moved, task.series, task.objective)).min(axis=0) - float(centre.score)
    beyond = np.flatnonzero(~(lost < 0.5))
    return float(trials[beyond[0]] if beyond.size else 1.0)


@eqx.filter_jit
def _scores(model: Any, free: Array, series: Any, objective: Any) -> Array:
    """Minus the log likelihood at many free coordinates, (side, trial, parameter)."""
    rebuild = flatten(model)[1]
    return jax.lax.map(jax.vmap(with_lane_loops(lambda x: objective(rebuild(x), series))), free)


def _profiled(estimate: Estimate, task: Task, lanes: Array, k: int) -> Place:
    """Every lane at its optimum with coordinate k held; then once more from a neighbour's, where that is better."""
    models = stacked([estimate.model] * len(lanes))
    moves = jnp.ones_like(lanes).at[:, k].set(0.0)
    places = start(models)._replace(free=lanes)
    places = task.descend(models, places, moves, 0.0, EVALUATIONS, task.tolerance)
    for _ in range(_PASSES):
        inward = _inward(len(lanes))
        begun = places.free[inward].at[:, k].set(lanes[:, k])
        again = task.descend(models, start(models)._replace(free=begun), moves, 0.0, EVALUATIONS, task.tolerance)
        better = again.score < places.score - _SAME
        if not bool(jnp.any(better)):
            break
        places = _either(better, again, places)
    return places


def _either(which: Array, some: Place, others: Place) -> Place:
    """Lane by lane, one place or the other."""
    chosen = [jnp.where(which.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in zip(some, others, strict=True)]
    return Place(*chosen)


def _inward(count: int) -> np.ndarray:
    """Each lane's neighbour towards the middle."""
    middle, at = count // 2, np.arange(count)
    return at - np.sign(at - middle)


def _bounds(at: np.ndarray, drop: np.ndarray) -> tuple[float | None, float | None]:
    """Where the drop crosses `DROP` on each side of its minimum, its square root taken as straight between points."""
    order = np.argsort(at)
    at, root = at[order], np.sqrt(np.minimum(drop[order], 1e6))
    best, level = int(np.argmin(root)), np.sqrt(DROP)
    left = next((i for i in range(best, 0, -1) if root[i - 1] > level), None)
    right = next((i for i in range(best, len(at) - 1) if root[i + 1] > level), None)

    def crossing(i: int, j: int) -> float:
        return float(at[i] + (level - root[i]) / (root[j] - root[i]) * (at[j] - at[i]))

    return None if left is None else crossing(left, left - 1), None if right is None else crossing(right, right + 1)
