"""Learning without a hand: a portfolio of starts, each lowered into its optimum, and the best of them kept.

The optimum of a marginal likelihood is easy to miss: with little process noise a wrong trajectory scores so badly that
the valley is a crack. With much process noise each data interval stands for itself and the valley is wide. So half of
the starts lower the process noise from the size of the readings by powers of ten, the measurement noise held, and only
then let everything go. With the measurement noise free on the way down all noise is booked as process noise, and the
descent ends in a mode that is a hundred nats worse on Cherry's problem (performance.md, C).
"""

import sys
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from ._descent import Place, coordinates, stacked, start
from ._errors import InputError
from ._faults import IMPOSSIBLE
from ._fit import Attempt, Estimate
from ._keys import refuse_key
from ._laplace_kinks import EVALUATIONS, ROUNDING, Task, end_at_kinks, kinks_of
from ._learnable import refuse_unlearnable
from ._model import AbstractStateSpaceModel, StateSpaceModel
from ._objectives import MARGINAL_LIKELIHOOD, AbstractObjective, TimeSeries, as_recordings
from ._parameters import flatten
from ._prior import AbstractDensity, Prior
from ._starts import Scales, coefficient_starts, scales, with_variances

# The process noise on its way down, as shares of the readings' variance; evaluations at each, and nats left over.
LEVELS = (1.0, 1e-1, 1e-2, 1e-3, 1e-4, 1e-5)
_AT_EACH, _LEFT = 40, 1e-3
# Free descents, each followed by a line of progress, that there may be.
_FREE_RUNS = 6
# The direct starts' process noise, as a share of the readings' variance.
_DIRECT = 0.1


def learn(
    model: AbstractStateSpaceModel,
    recordings: Any,
    objective: AbstractObjective = MARGINAL_LIKELIHOOD,
    *,
    prior: Prior | AbstractDensity,
    key: PRNGKeyArray | None = None,
    tolerance: float = 1e-5,
) -> Estimate:
    """The maximum a posteriori model, from a portfolio of starts that the readings themselves suggest.

    Starts: what learns of the dynamics as given, disturbed by a tenth (with a `key`), and for `Polynomial` and
    `PolynomialPotential` also zero, harmonic oscillators, and Hamiltonian least squares; for `LinearDynamics` of a
    state that is read, dynamic mode decomposition. Each goes down twice:
    straight, and with the process noise lowered step by step while the measurement noise is held. An impossible start,
    whose trajectory escapes, is passed over. The noises as given need no care: their starts are taken from the
    readings.
    `Estimate.attempts` tells how each start ended, and `print(estimate)` too.

    **Arguments:** as for `fit`; `recordings` - one, or a list.

    **Raises:** `InputError` where nothing learns, a leaf has no prior, every start is impossible, a polynomial has more
    terms than there are readings or not the dimension of the state, the time step changes under process noise or
    `LinearDynamics`, which are per data interval, nothing in the model takes the recording's inputs, or more than 1500
    numbers learn.
    """
    prior = prior if isinstance(prior, Prior) else Prior(prior)
    several = as_recordings(recordings)
    series = several if isinstance(recordings, list | tuple) else several[0]
    refuse_unlearnable(model, several, "learn")
    objective.refuse(model, several)
    if key is not None:
        refuse_key(key)
    starts = _portfolio(model, several, key)
    places, moves = _run(starts, Task(series, objective, prior, kinks_of(model, prior), tolerance))
    return _best(starts, places, moves, series, objective, prior, tolerance)


class _Start(NamedTuple):
    """One start: its names, the model there, the same with the noises of each level, and what is held on the way."""

    coefficients: str
    way: str
    levels: tuple[Any, ...]
    final: Any
    held: Array


def _portfolio(model: Any, several: Sequence[TimeSeries], key: Any) -> list[_Start]:
    sizes = scales(model, several)
    found = coefficient_starts(model, several, key)
    if not isinstance(model, StateSpaceModel):
        return [_Start(name, "straight", (one,), one, _nothing(one)) for name, one in found.items()]
    interval = float(np.mean(np.concatenate([np.diff(one.times) for one in several])))
    starts = []
    for name, one in found.items():
        direct = one if name == "as given" else _noises(one, sizes, _DIRECT, interval, known=False)
        starts.append(_Start(name, "straight", (direct,), direct, _nothing(one)))
        levels = tuple(_noises(one, sizes, level, interval, known=True) for level in LEVELS)
        final = _noises(one, sizes, LEVELS[-1], interval, known=False)
        held = coordinates(one, lambda m: (m.process_noise, m.measurement_noise))
        starts.append(_Start(name, "lowering the process noise", levels, final, held))
    return starts


def _nothing(model: Any) -> Array:
    return jnp.zeros_like(start(stacked([model])).free[0])


def _noises(model: Any, sizes: Scales, level: float, interval: float, known: bool) -> Any:
    """The model with process noise of a share of the readings' variance; a known one is changed only on the way."""
    process = with_variances(model.process_noise, level * sizes.state, interval, known)
    measurement = with_variances(model.measurement_noise, sizes.noise, known=False)
    return eqx.tree_at(lambda m: (m.process_noise, m.measurement_noise), model, (process, measurement))


class _Progress:
    """Lines on stderr, from two seconds on."""

    def __init__(self, stages: int):
        self.began, self.stages, self.stage = time.monotonic(), stages, 0

    def tell(self, places: Place) -> None:
        """One stage is over."""
        self.stage += 1
        if time.monotonic() - self.began > 2.0:
            best = -float(jnp.min(places.score))
            print(
                f"learning: stage {self.stage} of at most {self.stages}, log posterior {best:.2f} nats",
                file=sys.stderr,
                flush=True,
            )


def _run(starts: Sequence[_Start], task: Task) -> tuple[Place, Array]:
    """Down the levels, then free, then exact at the kinks: where every lane ended, and what moved there at last."""
    held = jnp.stack([one.held for one in starts])
    progress = _Progress(len(LEVELS) + _FREE_RUNS + 1)
    places = start(stacked([one.levels[0] for one in starts]))
    for k in range(len(LEVELS)):
        models = stacked([one.levels[min(k, len(one.levels) - 1)] for one in starts])
        places = places._replace(free=jnp.where(held > 0, start(models).free, places.free))
        places = task.descend(models, places, 1.0 - held, ROUNDING, _AT_EACH, _LEFT)
        progress.tell(places)
    models, moves = stacked([one.final for one in starts]), jnp.ones_like(held)
    for k in range(_FREE_RUNS):
        places = task.descend(models, places, moves, ROUNDING, EVALUATIONS, task.tolerance)
        progress.tell(places)
        open_lanes = ~_settled(places, moves, task.tolerance)
        # Those that lag behind get one more run; after that only the best one is waited for.
        if not bool(jnp.any(open_lanes)) or (k > 0 and not bool(open_lanes[jnp.argmin(places.score)])):
            break
    return end_at_kinks(models, places, task)


def _settled(places: Place, moves: Array, tolerance: float) -> Array:
    return (jax.vmap(Place.promised)(places, moves) <= tolerance) | (places.score >= -0.5 * IMPOSSIBLE)


def _best(starts, places, moves, series, objective, prior, tolerance) -> Estimate:
    """The estimate of the lane that ended lowest, with a record of them all."""
    scores = np.asarray(places.score)
    k = int(np.argmin(scores))
    if scores[k] >= -0.5 * IMPOSSIBLE:
        raise InputError(
            f"None of {len(starts)} starts has a finite score: the trajectories escape, or a noise is no covariance; "
            "give smaller coefficients, or more substeps."
        )
    best = jax.tree.map(lambda leaf: leaf[k], places)
    model = flatten(starts[k].final)[1](best.free)
    ended = [
        Attempt(one.coefficients, one.way, None if score >= -0.5 * IMPOSSIBLE else -float(score))
        for one, score in zip(starts, scores, strict=True)
    ]
    promised = float(best.promised(moves[k]))
    return Estimate(
        model,
        series,
        objective,
        prior,
        log_posterior=-float(best.score),
        log_likelihood=-float(best.score) - float(prior.log_density(model)),
        gradient_norm=float(jnp.max(jnp.abs(moves[k] * best.slope))),
        promised=promised,
        converged=promised <= tolerance,
        steps=int(jnp.sum(places.steps)),
        attempts=tuple(sorted(ended, key=lambda one: -np.inf if one.log_posterior is None else one.log_posterior))[
            ::-1
        ],
    )
