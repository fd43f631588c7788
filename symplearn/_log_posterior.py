"""The log posterior as a function of free coordinates that an optimiser can walk on."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._faults import IMPOSSIBLE
from ._lane_loops import with_lane_loops
from ._model import AbstractStateSpaceModel
from ._objectives import AbstractObjective, TimeSeries
from ._prior import Prior

# Stands for an infinite score inside the optimiser, which can compare it but must not subtract infinities.
HOPELESS = -IMPOSSIBLE
# Up to this many parameters forward derivatives are the faster ones: measured on Henon-Heiles with 1, 4 and 11 of them,
# n 20 and n 2000. One by forward mode costs 0.6 and 0.9 of reverse mode, four cost as much and twice as much.
_FORWARD = 1


def negative_log_posterior(
    model: AbstractStateSpaceModel,
    series: TimeSeries | tuple[TimeSeries, ...],
    objective: AbstractObjective,
    prior: Prior | None,
) -> Float[Array, ""]:
    """The score of the model plus minus the log prior density of its free coordinates, in nats; without a prior the
    score alone."""
    score = objective(model, series)
    return score if prior is None else score - prior.log_density(model)


def gradient(score: Callable[[Array], Array], size: int) -> Callable[[Array], Array]:
    """The gradient of a score of `size` parameters: forward for one, reverse for more, if it has a reverse."""
    return lambda free: _value_and_gradient(score, size)(free)[1]


def _value_and_gradient(score: Callable[[Array], Array], size: int) -> Callable[[Array], tuple[Array, Array]]:
    """A score and its gradient, as `gradient` has it."""

    def forward(free):
        slope, value = jax.jacfwd(lambda x: (score(x),) * 2, has_aux=True)(free)
        return value, slope

    def reverse(free):
        try:
            return jax.value_and_grad(score)(free)
        except ValueError as error:
            # A propagator with a loop of traced length has none.
            if "Reverse-mode differentiation" not in str(error):
                raise
            return forward(free)

    return with_lane_loops(forward if size <= _FORWARD else reverse)


def guarded(score: Callable[[Array], Array], size: int) -> Callable[[Array], Array]:
    """`score` with a large finite number for every non-finite one, and with a gradient that is never NaN; it has no
    forward derivative."""

    @jax.custom_vjp
    def safe(free):
        value = with_lane_loops(score)(free)
        return jnp.where(jnp.isfinite(value), value, HOPELESS)

    def forward(free):
        # Value and slope in one pass: XLA does not see that two passes share their scans. As a rule for forward
        # derivatives the same would be linearised by parts, and some of its work be done twice.
        value, slope = _value_and_gradient(score, size)(free)
        return jnp.where(jnp.isfinite(value), value, HOPELESS), jnp.where(jnp.isfinite(slope), slope, 0.0)

    safe.defvjp(forward, lambda slope, cotangent: (cotangent * slope,))
    return safe
