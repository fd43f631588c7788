"""Constrained multiple shooting: the most probable model whose segments join exactly. Dissertation sec. 4.1.2."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.optimize
from jaxtyping import Array, Float

from ._counts import refuse_count
from ._errors import InputError
from ._faults import IMPOSSIBLE
from ._fit import Estimate
from ._log_posterior import negative_log_posterior
from ._model import StateSpaceModel
from ._objectives import as_recordings
from ._parameters import flatten, named_parameters
from ._prior import AbstractDensity, Prior
from ._trajectory_objectives import MultipleShooting

# SLSQP's own accuracy, in nats and in units of the state: far below what is promised, above round-off.
_ACCURACY = 1e-12


class ConstrainedEstimate(eqx.Module):
    """A fit with exact continuity, and how exact it is.

    `estimate` is as from `fit`; its `gradient_norm` and `promised` are along the constraint, where alone the model
    can move, so `laplace_evidence`, which knows no constraint, is not for it. `largest_violation` is the largest gap
    left between two segments, in units of the state; `multipliers` (gap, state) are Lagrange's, in nats per unit.
    """

    estimate: Estimate
    largest_violation: float
    multipliers: Float[Array, "gap state"]

    def __str__(self) -> str:
        return f"{self.estimate}\nlargest gap between segments {self.largest_violation:.3g}"


def fit_constrained(
    model: StateSpaceModel,
    recording: Any,
    objective: MultipleShooting,
    *,
    prior: Prior | AbstractDensity,
    tolerance: float = 1e-5,
    violation: float = 1e-8,
    max_steps: int = 500,
) -> ConstrainedEstimate:
    """The maximum a posteriori model under x_{l_{i+1}} = Psi^{dl_i}(x_{l_i}), by SciPy's SLSQP in free coordinates.

    The segments' starts must learn: put `segment_starts(model, recording, segments)` in as the model's `initial`.

    **Arguments:** `recording` - one, or a list; `prior` - as for `fit`; `tolerance` - nats that a quadratic model may
    still promise along the constraint; `violation` - the largest gap allowed, in units of the state; `max_steps` - of
    SLSQP. Where one of the three is missed, `estimate.converged` is False.

    **Raises:** `InputError` where the gaps cannot be closed because no start learns, a leaf has no prior, or a
    trajectory leaves the reals at the start.
    """
    refuse_count("fit_constrained", "max_steps", max_steps)
    problem = _Problem(model, recording, objective, prior if isinstance(prior, Prior) else Prior(prior))
    gaps = {"type": "eq", "fun": problem.gaps, "jac": problem.gap_slopes}
    options = {"maxiter": max_steps, "ftol": _ACCURACY}
    found = scipy.optimize.minimize(
        problem.score, problem.start, jac=problem.slope, constraints=gaps, method="SLSQP", options=options
    )
    return problem.judged(found.x, int(found.nit), tolerance, violation)


class _Problem:
    """The score, the gaps and their slopes at a free vector, as SciPy asks for them, each point computed once."""

    def __init__(self, model: StateSpaceModel, recording: Any, objective: MultipleShooting, prior: Prior):
        self.series, self.objective, self.prior = as_recordings(recording), objective, prior
        vector, self.rebuild = flatten(model)
        self.start, self._last = np.asarray(vector, dtype=float), np.full(vector.size, np.nan)
        self._values: tuple[np.ndarray, ...] = ()
        if not self.score(self.start) < -IMPOSSIBLE:
            raise InputError(
                "The model has no finite score at its start, because a trajectory leaves the reals or a noise is not "
                "positive; start from smaller coefficients or more segments."
            )
        learning = [name for name in named_parameters(model) if name.split(".")[0] == "initial"]
        count = int(np.size(self.gaps(self.start)))
        if count and (not learning or np.linalg.matrix_rank(self.gap_slopes(self.start)) < count):
            raise InputError(
                "The gaps between segments cannot be closed, because the segments' start states do not learn; give the "
                "model `initial=segment_starts(model, recording, segments)`."
            )

    def values(self, free: np.ndarray) -> tuple[np.ndarray, ...]:
        if not np.array_equal(free, self._last):
            numbers = _values(self.rebuild(jnp.asarray(free)), self.series, self.objective, self.prior)
            self._last, self._values = np.array(free), tuple(np.asarray(number, dtype=float) for number in numbers)
        return self._values

    def score(self, free: np.ndarray) -> float:
        return float(self.values(free)[0])

    def slope(self, free: np.ndarray) -> np.ndarray:
        return self.values(free)[1]

    def gaps(self, free: np.ndarray) -> np.ndarray:
        return self.values(free)[2].reshape(-1)

    def gap_slopes(self, free: np.ndarray) -> np.ndarray:
        return self.values(free)[3].reshape(-1, free.size)

    def judged(self, free: np.ndarray, steps: int, tolerance: float, violation: float) -> ConstrainedEstimate:
        """The estimate at the end, with what the solver may have left undone."""
        gaps, slope, J = self.gaps(free), self.slope(free), self.gap_slopes(free)
        multipliers = -np.linalg.lstsq(J.T, slope, rcond=None)[0]
        largest = float(np.abs(gaps).max(initial=0.0))
        tangent, promised = self._promised(free, slope, J, multipliers)
        model = self.rebuild(jnp.asarray(free))
        estimate = Estimate(
            model,
            self.series if len(self.series) > 1 else self.series[0],
            self.objective,
            self.prior,
            log_posterior=-self.score(free),
            log_likelihood=-self.score(free) - float(self.prior.log_density(model)),
            gradient_norm=float(np.abs(tangent).max(initial=0.0)),
            promised=promised,
            converged=promised <= tolerance and largest <= violation,
            steps=steps,
        )
        return ConstrainedEstimate(estimate, largest, jnp.asarray(multipliers.reshape(self.values(free)[2].shape)))

    def _promised(self, free, slope, J, multipliers) -> tuple[np.ndarray, float]:
        """The slope along the constraint, and the nats that a quadratic model of the Lagrangian expects there."""
        Z = scipy.linalg.null_space(J) if J.size else np.eye(free.size)
        tangent = Z.T @ slope
        model = self.rebuild(jnp.asarray(free))
        rows = _curvature(model, self.series, self.objective, self.prior, jnp.asarray(multipliers), jnp.asarray(Z.T))
        values, vectors = np.linalg.eigh(0.5 * (Z.T @ np.asarray(rows).T + np.asarray(rows) @ Z))
        # A direction that bends down leads on from here; a flat one has no nats to give but round-off.
        if values.size and values[0] < -1e-8 * np.abs(values).max():
            return tangent, np.inf
        floor = 1e-10 * np.abs(values).max(initial=1e-300)
        return tangent, float(0.5 * np.sum((vectors.T @ tangent) ** 2 / np.maximum(values, floor)))


@eqx.filter_jit
def _values(model, series, objective, prior):
    """Score, its slope, the gaps, and their slopes."""
    free, rebuild = flatten(model)
    score, slope = jax.value_and_grad(lambda free: negative_log_posterior(rebuild(free), series, objective, prior))(
        free
    )
    gaps = objective.gaps(model, series)
    return score, slope, gaps, jax.jacfwd(lambda free: objective.gaps(rebuild(free), series))(free)


@eqx.filter_jit
def _curvature(model, series, objective, prior, multipliers, directions):
    """The Hessian of the Lagrangian times each direction."""
    free, rebuild = flatten(model)

    def lagrangian(free):
        at = rebuild(free)
        return negative_log_posterior(at, series, objective, prior) + multipliers @ objective.gaps(at, series).ravel()

    return jax.vmap(lambda z: jax.jvp(jax.grad(lagrangian), (free,), (z,))[1])(directions)
