"""Maximum a posteriori: the most probable model given a recording and a prior. Dissertation (2.20)."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ._counts import refuse_count
from ._descent import stacked, start
from ._errors import InputError
from ._faults import IMPOSSIBLE
from ._laplace_kinks import EVALUATIONS, ROUNDING, Task, end_at_kinks, kinks_of
from ._learnable import refuse_unlearnable
from ._log_posterior import guarded, negative_log_posterior
from ._model import AbstractStateSpaceModel
from ._objectives import MARGINAL_LIKELIHOOD, AbstractObjective, TimeSeries, as_recordings
from ._parameters import flatten, named_parameters, value_of
from ._prior import AbstractDensity, Prior

_RESTARTS = 4


class Attempt(NamedTuple):
    """One of the starts of `learn`: its coefficients, its way down, and the log posterior where it ended, in nats.

    None where it was impossible: its trajectory escaped.
    """

    coefficients: str
    way: str
    log_posterior: float | None


class Estimate(eqx.Module):
    """The most probable model, with what was asked of it.

    `log_posterior` is the log likelihood plus the log prior density of the free coordinates, in nats (not
    normalised); `log_likelihood` is the first of them. `gradient_norm` is the largest slope of the log
    posterior along a free coordinate at the end, in nats. `promised` is how many nats a quadratic model
    still expects; `converged` says that it is below the tolerance. Where it is False, the model is the best
    one met.
    """

    model: AbstractStateSpaceModel
    recording: TimeSeries | tuple[TimeSeries, ...]
    objective: AbstractObjective
    prior: Prior
    log_posterior: float
    log_likelihood: float
    gradient_norm: float
    promised: float
    converged: bool
    steps: int
    attempts: tuple[Attempt, ...] = eqx.field(static=True, default=())

    def values(self) -> dict[str, Array]:
        """The values learnt, by name."""
        return {name: value_of(leaf) for name, leaf in named_parameters(self.model).items()}

    def __str__(self) -> str:
        lines = [f"{name} = {value}" for name, value in self.values().items()]
        end = "converged" if self.converged else "NOT CONVERGED: do not use as a MAP"
        score = f"log posterior {self.log_posterior:.3f} nats, {end}, {self.steps} steps"
        return "\n".join(["Estimate (MAP)", *lines, score, *_told(self.attempts)])


def _told(attempts: tuple[Attempt, ...]) -> list[str]:
    """What became of each start, in nats below the best."""
    lines = []
    for coefficients, way, ended in attempts:
        best = attempts[0].log_posterior
        said = "impossible" if ended is None or best is None else f"{best - ended:.3f} nats below the best"
        lines.append(f"  from {coefficients}, {way}: {said}")
    return [f"{len(attempts)} starts:", *lines] if attempts else []


def fit(
    model: AbstractStateSpaceModel,
    recording: Any,
    objective: AbstractObjective = MARGINAL_LIKELIHOOD,
    *,
    prior: Prior | AbstractDensity,
    tolerance: float = 1e-5,
    max_steps: int = 500,
) -> Estimate:
    """The maximum a posteriori model, by BFGS in free coordinates from the model as given.

    **Arguments:** `recording` - times and readings, or a list of such recordings; `prior` - a `Prior`, or one
    density such as `Flat()` for every leaf; `tolerance` - nats that a quadratic model may still promise at the
    end; `max_steps` - of one BFGS run; it is started afresh up to four times.

    Under a `Laplace` prior coefficients may end at exactly 0.

    **Raises:** `InputError` where nothing learns, a leaf has no prior, the start has no finite score, a polynomial has
    more terms than there are readings, the time step changes under process noise or `LinearDynamics`, which are per
    data interval, nothing in the model takes the recording's inputs, or more than 1500 numbers learn.
    """
    refuse_count("fit", "max_steps", max_steps)
    prior = prior if isinstance(prior, Prior) else Prior(prior)
    recordings = as_recordings(recording)
    series = recordings if isinstance(recording, list | tuple) else recordings[0]
    refuse_unlearnable(model, recordings, "fit")
    objective.refuse(model, recordings)
    posterior, likelihood, slope = _at(model, series, objective, prior)
    # Another recording's nats may be added to the impossible one's.
    if not bool(jnp.isfinite(posterior)) or float(likelihood) <= 0.5 * IMPOSSIBLE:
        raise InputError(
            f"The model has no finite score at its start: log likelihood {float(likelihood):.3g} and log "
            f"posterior {float(posterior):.3g} nats; start from smaller coefficients or larger noises."
        )
    steps, promised = 0, float("inf")
    for _ in range(_RESTARTS):
        # The first step of BFGS is the gradient: scaled so that it has length 1 and no trajectory escapes.
        scale = 1.0 / jnp.maximum(jnp.linalg.norm(slope), 1e-12)
        model, inverse, taken = _descend(model, series, objective, prior, scale, max_steps)
        posterior, likelihood, slope = _at(model, series, objective, prior)
        promised = float(0.5 * slope @ inverse @ slope)
        steps += int(taken)
        if promised <= tolerance:
            break
    task = Task(series, objective, prior, kinks_of(model, prior), tolerance)
    if bool(jnp.any(task.kinks > 0)):
        model, slope, left, taken = _kinks_met(model, task)
        posterior, likelihood, _ = _at(model, series, objective, prior)
        steps, promised = steps + int(taken), float(left)
    return Estimate(
        model,
        series,
        objective,
        prior,
        log_posterior=float(posterior),
        log_likelihood=float(likelihood),
        gradient_norm=float(jnp.max(jnp.abs(slope))),
        promised=promised,
        converged=promised <= tolerance,
        steps=steps,
    )


def _kinks_met(model: Any, task: Task) -> tuple[Any, Array, Array, Array]:
    """The optimum at the kinks, where BFGS stalls: the model, the slope of what moved, the nats promised, the steps."""
    models = stacked([model])
    places, moves = start(models), jnp.ones((1, task.kinks.size))
    places = task.descend(models, places, moves, ROUNDING, EVALUATIONS, task.tolerance)
    places, moves = end_at_kinks(models, places, task)
    place = jax.tree.map(lambda leaf: leaf[0], places)
    return flatten(model)[1](place.free), moves[0] * place.slope, place.promised(moves[0]), place.steps


@eqx.filter_jit
def _at(model, series, objective, prior):
    """Log posterior, log likelihood, and the gradient of minus the log posterior in free coordinates."""
    free, rebuild = flatten(model)
    score = guarded(lambda free: negative_log_posterior(rebuild(free), series, objective, prior), free.size)
    likelihood = -objective(model, series)
    return likelihood + prior.log_density(model), likelihood, jax.grad(score)(free)


@eqx.filter_jit
def _descend(model, series, objective, prior, scale, max_steps):
    """One run of BFGS: the best model met, BFGS's own inverse Hessian of the score, the steps."""
    import optimistix as ox  # slow to import, and nothing else here needs it

    begin, rebuild = flatten(model)
    score = guarded(lambda free: negative_log_posterior(rebuild(free), series, objective, prior), begin.size)
    solver: Any = ox.BestSoFarMinimiser(ox.BFGS(rtol=1e-10, atol=1e-10))
    solution: Any = ox.minimise(lambda free, _: scale * score(free), solver, begin, max_steps=max_steps, throw=False)
    inverse = scale * solution.state.state.f_info.hessian_inv.as_matrix()
    return rebuild(solution.value), inverse, solution.stats["num_steps"]
