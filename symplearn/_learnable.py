"""What cannot be learnt is refused before any work, in one sentence."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ._errors import InputError
from ._noise import AdditiveGaussian
from ._objectives import TimeSeries
from ._parameters import named_parameters
from ._starts import polynomial_of
from ._suitability import refuse_wrong_state

# BFGS holds a square matrix of this size for each start.
_MOST_PARAMETERS = 1500
# Clocks jitter: steps that differ by less are one step.
_SAME_STEP = 1.01


def refuse_unlearnable(model: Any, several: Sequence[TimeSeries], verb: str) -> None:
    """Refuses a model of which nothing learns, too much does, or more than the recordings can say.

    **Raises:** `InputError` where nothing learns, more than 1500 numbers do, nothing was read, the state is no phase
    point of the Hamiltonian, a polynomial has more terms than there are readings, or the time step changes under
    process noise that learns and is per data interval.
    """
    leaves = named_parameters(model)
    if not leaves:
        raise InputError("Nothing in the model learns: every number is known or `Frozen`. Wrap one in `Positive`.")
    size = sum(int(np.size(getattr(leaf, "free", leaf))) for leaf in leaves.values())
    if size > _MOST_PARAMETERS:
        raise InputError(
            f"{size} numbers learn, but `{verb}` is for at most {_MOST_PARAMETERS}: it keeps a square matrix of them; "
            "`train` is for networks."
        )
    refuse_empty(several)
    refuse_wrong_state(model, _state_size(model, several))
    _refuse_terms(model, several)
    _refuse_steps(model, several)


def refuse_empty(several: Sequence[TimeSeries]) -> None:
    """Refuses, with `InputError`, recordings in which nothing was read."""
    if all(bool(np.all(np.isnan(np.asarray(one.readings)))) for one in several):
        raise InputError("Every reading is missing; there is nothing to learn from.")


def _state_size(model: Any, several: Sequence[TimeSeries]) -> int:
    """The size of the initial mean, or of the means of segments; without one, the state is what is read."""
    initial = model.initial[0] if isinstance(model.initial, tuple) else model.initial
    if initial is None:
        return several[0].readings.shape[1]
    centre: Any = getattr(initial, "mean", None)
    centre = initial.means if centre is None else centre
    return int(np.shape(getattr(centre, "value", centre))[-1])


def _refuse_terms(model: Any, several: Sequence[TimeSeries]) -> None:
    hamiltonian = polynomial_of(model)
    if hamiltonian is None:
        return
    readings = sum(int(np.sum(~np.isnan(np.asarray(one.readings)))) for one in several)
    if len(hamiltonian.terms) > readings > 0:
        raise InputError(
            f"A Hamiltonian of degree {hamiltonian.degree} has {len(hamiltonian.terms)} terms, but there are only "
            f"{readings} readings; lower the degree."
        )


def _refuse_steps(model: Any, several: Sequence[TimeSeries]) -> None:
    """Process noise per data interval has no meaning where the intervals differ."""
    noise = getattr(model, "process_noise", None)
    if not isinstance(noise, AdditiveGaussian) or not named_parameters(noise):
        return
    steps = np.concatenate([np.diff(np.asarray(one.times)) for one in several])
    if steps.max() > _SAME_STEP * steps.min():
        raise InputError(
            f"The time step changes from {steps.min():.4g} to {steps.max():.4g}, but the variance of "
            "`AdditiveGaussian` process noise is per data interval; use `WienerIncrement`, which is per unit time."
        )
