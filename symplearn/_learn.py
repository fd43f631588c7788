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

from ._descent import Place, coordinates, descend, start
from ._errors import InputError
from ._faults import IMPOSSIBLE
from ._fit import Attempt, Estimate
from ._model import AbstractStateSpaceModel, StateSpaceModel
from ._noise import AdditiveGaussian
from ._objectives import MARGINAL_LIKELIHOOD, AbstractObjective, TimeSeries, as_recordings
from ._parameters import Learnt, flatten, named_parameters
from ._prior import AbstractDensity, Laplace, Prior
from ._starts import Scales, coefficient_starts, polynomial_of, scales, with_variances

# The process noise on its way down, as shares of the readings' variance; evaluations at each, and nats left over.
LEVELS = (1.0, 1e-1, 1e-2, 1e-3, 1e-4, 1e-5)
_AT_EACH, _LEFT = 40, 1e-3
# Evaluations of a free descent between two lines of progress, and how many of these there may be.
_FREE, _FREE_RUNS = 150, 6
# Nats by which a kink is rounded off until the end, and how far from it, in widths, a coefficient is set to zero.
_ROUNDING, _SNAP = 0.01, 3.0
# The direct starts' process noise, as a share of the readings' variance.
_DIRECT = 0.1
# BFGS holds a square matrix of this size for each start.
_MOST_PARAMETERS = 1500


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
    `PolynomialPotential` also zero, harmonic oscillators, and Hamiltonian least squares. Each goes down twice:
    straight, and with the process noise lowered step by step while the measurement noise is held. An impossible start,
    whose trajectory escapes, is passed over. The noises as given need no care: their starts are taken from the
    readings.
    `Estimate.attempts` tells how each start ended, and `print(estimate)` too.

    **Arguments:** as for `fit`; `recordings` - one, or a list.

    **Raises:** `InputError` where nothing learns, a leaf has no prior, every start is impossible, a polynomial has more
    terms than there are readings or not the dimension of the state, the time step changes under process noise that is
    per data interval, or more than 1500 numbers learn.
    """
    prior = prior if isinstance(prior, Prior) else Prior(prior)
    several = as_recordings(recordings)
    series = several if isinstance(recordings, list | tuple) else several[0]
    _check(model, several)
    starts = _portfolio(model, several, key)
    places, moves = _run(starts, _Task(series, objective, prior, _kinks(model, prior), tolerance))
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
    return jnp.zeros_like(start(_stack([model])).free[0])


def _noises(model: Any, sizes: Scales, level: float, interval: float, known: bool) -> Any:
    """The model with process noise of a share of the readings' variance; a known one is changed only on the way."""
    process = with_variances(model.process_noise, level * sizes.state, interval, known)
    measurement = with_variances(model.measurement_noise, sizes.noise, known=False)
    return eqx.tree_at(lambda m: (m.process_noise, m.measurement_noise), model, (process, measurement))


def _stack(models: Sequence[Any]) -> Any:
    """Models of one structure as one, each array with a leading axis."""
    arrays, rest = zip(*[eqx.partition(model, eqx.is_array) for model in models], strict=True)
    return eqx.combine(jax.tree.map(lambda *leaves: jnp.stack(leaves), *arrays), rest[0])


class _Task(NamedTuple):
    """What is scored, and how it is told."""

    series: TimeSeries | tuple[TimeSeries, ...]
    objective: AbstractObjective
    prior: Prior
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


def _run(starts: Sequence[_Start], task: _Task) -> tuple[Place, Array]:
    """Down the levels, then free, then exact at the kinks: where every lane ended, and what moved there at last."""
    held = jnp.stack([one.held for one in starts])
    progress = _Progress(len(LEVELS) + _FREE_RUNS + 1)
    places = start(_stack([one.levels[0] for one in starts]))
    for k in range(len(LEVELS)):
        models = _stack([one.levels[min(k, len(one.levels) - 1)] for one in starts])
        places = places._replace(free=jnp.where(held > 0, start(models).free, places.free))
        places = task.descend(models, places, 1.0 - held, _ROUNDING, _AT_EACH, _LEFT)
        progress.tell(places)
    models, moves = _stack([one.final for one in starts]), jnp.ones_like(held)
    for k in range(_FREE_RUNS):
        places = task.descend(models, places, moves, _ROUNDING, _FREE, task.tolerance)
        progress.tell(places)
        open_lanes = ~_settled(places, moves, task.tolerance)
        # Those that lag behind get one more run; after that only the best one is waited for.
        if not bool(jnp.any(open_lanes)) or (k > 0 and not bool(open_lanes[jnp.argmin(places.score)])):
            break
    return _exact(models, places, task)


def _settled(places: Place, moves: Array, tolerance: float) -> Array:
    return (jax.vmap(Place.promised)(places, moves) <= tolerance) | (places.score >= -0.5 * IMPOSSIBLE)


def _exact(models: Any, places: Place, task: _Task) -> tuple[Place, Array]:
    """The descents ended with the kinks as sharp as they are.

    A coefficient that ended at a kink is zero and held there, as long as the slope does not exceed the kink's.
    """
    width = _SNAP * _ROUNDING / jnp.where(task.kinks > 0, task.kinks, 1.0)
    zero = (task.kinks > 0) & (jnp.abs(places.free) < width)
    for _ in range(3):
        moves = jnp.where(zero, 0.0, 1.0)
        places = places._replace(free=jnp.where(zero, 0.0, places.free))
        places = task.descend(models, places, moves, 0.0, _FREE, task.tolerance)
        loose = zero & (jnp.abs(places.slope) > task.kinks)
        stuck = (task.kinks > 0) & (jnp.abs(places.free) < 1e-3 * width)
        if not bool(jnp.any(loose | (stuck & ~zero))):
            break
        places = places._replace(free=jnp.where(loose, -jnp.sign(places.slope) * 0.1 * width, places.free))
        zero = (zero | stuck) & ~loose
    return places, moves


def _kinks(model: Any, prior: Prior) -> Array:
    """1 / scale at the free coordinates under a Laplace prior, else 0."""
    parts = []
    for name, leaf in named_parameters(model).items():
        bare, density = isinstance(leaf, Learnt) or eqx.is_array(leaf), prior.density_of(name)
        size = getattr(leaf, "free", leaf)
        kink = 1.0 / density.scale if bare and isinstance(density, Laplace) else 0.0
        parts.append(jnp.ravel(jnp.broadcast_to(kink, size.shape)))
    return jnp.concatenate(parts)


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


def _check(model: Any, several: Sequence[TimeSeries]) -> None:
    """Refuse what cannot be learnt, in one sentence."""
    leaves = named_parameters(model)
    if not leaves:
        raise InputError("Nothing in the model learns: every number is known or `Frozen`. Wrap one in `Positive`.")
    size = sum(int(np.size(getattr(leaf, "free", leaf))) for leaf in leaves.values())
    if size > _MOST_PARAMETERS:
        raise InputError(
            f"{size} numbers learn, but `learn` is for at most {_MOST_PARAMETERS}: it keeps a square matrix of them."
        )
    _check_polynomial(model, several)
    _check_steps(model, several)


def _check_polynomial(model: Any, several: Sequence[TimeSeries]) -> None:
    hamiltonian = polynomial_of(model)
    if hamiltonian is None:
        return
    readings = sum(int(np.sum(~np.isnan(np.asarray(one.readings)))) for one in several)
    if len(hamiltonian.terms) > readings > 0:
        raise InputError(
            f"A Hamiltonian of degree {hamiltonian.degree} has {len(hamiltonian.terms)} terms, but there are only "
            f"{readings} readings; lower the degree."
        )
    initial = model.initial[0] if isinstance(model.initial, tuple) else model.initial
    if initial is None:
        state = several[0].readings.shape[1]
    else:
        state = jnp.shape(getattr(initial.mean, "value", initial.mean))[0]
    if state != 2 * hamiltonian.dim:
        raise InputError(
            f"The Hamiltonian is of {hamiltonian.dim} degrees of freedom, so a phase point has {2 * hamiltonian.dim} "
            f"numbers, but the state has {state}; make `dim` half of it."
        )


def _check_steps(model: Any, several: Sequence[TimeSeries]) -> None:
    """Process noise per data interval has no meaning where the intervals differ."""
    noise = getattr(model, "process_noise", None)
    if not isinstance(noise, AdditiveGaussian) or not named_parameters(noise):
        return
    steps = np.concatenate([np.diff(one.times) for one in several])
    if steps.max() > 1.01 * steps.min():
        raise InputError(
            f"The time step changes from {steps.min():.4g} to {steps.max():.4g}, but the variance of "
            "`AdditiveGaussian` process noise is per data interval; use `WienerIncrement`, which is per unit time."
        )
