"""Whether a recording suits a model: what the model would get wrong of it, or ignore, is refused in a sentence."""

from typing import Any

import jax
import numpy as np
from jaxtyping import Float

import integrators as ig

from ._errors import InputError
from ._model import Coordinates, FullState, LinearDynamics, LinearObservation, Propagator
from ._noise import Additive, AdditiveGaussian, Multiplicative, WienerIncrement

# Rounded time stamps are uneven by less than this share of the spacing; a row that is left out by far more.
_UNEVEN = 0.05
_WITHOUT_RECORD = FullState | Coordinates | AdditiveGaussian | WienerIncrement | Additive


def refuse_unsuited(model: Any, recordings: tuple[Any, ...]) -> None:
    """Refuses recordings whose times or inputs the model's parts leave out of account.

    **Raises:** `InputError` where data intervals differ under `LinearDynamics`, which is one step per interval whatever
    its length, and where there are inputs and nothing in the model is known to take them.
    """
    _refuse_uneven(model, recordings)
    parts = [getattr(model, name, None) for name in ("dynamics", "observation", "process_noise", "measurement_noise")]
    if any(series.inputs is not None for series in recordings) and all(map(_ignores_inputs, parts)):
        raise InputError(
            f"The recording has inputs, which `{type(parts[0]).__name__}` and the rest of the model would ignore; give "
            "it without them, or a model that takes them, as `LinearDynamics(A, B)`."
        )


def _refuse_uneven(model: Any, recordings: tuple[Any, ...]) -> None:
    is_known = not any(isinstance(series.times, jax.core.Tracer) for series in recordings)
    if not isinstance(getattr(model, "dynamics", None), LinearDynamics) or not is_known:
        return
    spans = np.concatenate([np.diff(np.asarray(series.times)) for series in recordings])
    if is_uneven(spans):
        raise InputError(
            f"A is per data interval, so all intervals must be equal, but they last from {spans.min():.6g} to "
            f"{spans.max():.6g}; give rows of NaN where readings are missing, or dynamics that take the interval."
        )


def is_uneven(spans: Float[np.ndarray, " interval"]) -> bool:
    """Whether data intervals differ by more than rounded time stamps do."""
    usual = np.median(spans)
    return bool(np.max(np.abs(spans - usual)) > _UNEVEN * usual)


def _ignores_inputs(part: Any) -> bool:
    """Whether a part surely does: a map of one's own, a force and a system that changes with time may know them."""
    if isinstance(part, Propagator):
        return isinstance(part.system, ig.AbstractHamiltonian) and part.system.stands_still
    if isinstance(part, LinearDynamics):
        return part.B is None
    if isinstance(part, LinearObservation):
        return part.feedthrough is None
    if isinstance(part, Multiplicative):
        return part.additive is None or _ignores_inputs(part.additive)
    return isinstance(part, _WITHOUT_RECORD)


def refuse_wrong_state(model: Any, size: int) -> None:
    """Refuses, with `InputError`, a state whose size is not that of the Hamiltonian's phase points."""
    dynamics = getattr(model, "dynamics", None)
    if not isinstance(dynamics, Propagator):
        return
    refuse_other_dimension(getattr(dynamics.system, "hamiltonian", dynamics.system), size)
    if size % 2:
        raise InputError(
            f"The size of the state is {size}, but a phase point has a momentum for each coordinate; where only some "
            "are read, say so by `observation=Coordinates(...)` and give `initial=Gaussian(mean, covariance)` of all."
        )


def refuse_other_dimension(hamiltonian: Any, size: int) -> None:
    """Refuses, with `InputError`, a state whose size is not twice the Hamiltonian's `dim`, where that is known."""
    dim = getattr(hamiltonian, "dim", None)
    if isinstance(dim, int) and size != 2 * dim:
        raise InputError(
            f"The Hamiltonian is of {dim} degrees of freedom, so a phase point has {2 * dim} numbers, but the state "
            f"has {size}; make `dim` half of it."
        )
