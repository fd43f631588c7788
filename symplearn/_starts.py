"""Where learning starts: coefficients from nothing, from the harmonic oscillator, from rates; noises from the readings.

Only the readings are looked at. The scales need to be right within a few powers of ten, not more.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

import integrators as ig

from ._descent import coordinates
from ._dynamic_modes import dmd
from ._errors import InputError
from ._hamiltonian_objectives import hamiltonian_least_squares
from ._hamiltonians import Polynomial, PolynomialPotential, exponents
from ._model import AbstractAffine, FullState, LinearDynamics, Propagator, StateSpaceModel
from ._noise import (
    AdditiveGaussian,
    Correlated,
    Dense,
    Diagonal,
    LogVariance,
    Multiplicative,
    ScaledIdentity,
    StandardDeviation,
    WienerIncrement,
)
from ._objectives import TimeSeries
from ._parameters import AbstractParameter, Bounded, Frozen, Learnt, Positive, PositiveDefinite, flatten

# A disturbed start moves each coordinate by this share of its size, or of 1 where it is smaller.
_DISTURBANCE = 0.1
# The readings' noise is taken to be at most this share of their variance where they are too far apart to tell.
_MOST_NOISE = 0.01


class Scales(eqx.Module):
    """What the readings say of the sizes of the noises, as variances.

    `readings` (channel,) is the variance of each channel; `noise` (channel,) that of its scatter about the line between
    its neighbours, at most a hundredth of the former; `state` (state,) what the former amounts to in the state.
    """

    readings: np.ndarray
    noise: np.ndarray
    state: np.ndarray


def scales(model: Any, recordings: Sequence[TimeSeries]) -> Scales:
    """The scales of recordings under a model.

    **Raises:** `InputError` where every reading is the same.
    """
    rows = np.concatenate([np.asarray(one.readings) for one in recordings])
    size = _variances(rows)
    if not np.nanmax(size) > 0:
        raise InputError("Every channel stands still: its readings are all the same; there is no motion to learn from.")
    size = np.maximum(np.where(np.isnan(size), _mean_variance(rows), size), 1e-12 * np.nanmax(size))
    scatter = [_scatter(one) for one in recordings if len(one.times) > 2]
    noise = np.ma.masked_invalid(scatter).mean(axis=0).filled(np.nan) if scatter else size
    noise = np.clip(np.where(np.isnan(noise), size, noise), 1e-10 * size, _MOST_NOISE * size)
    return Scales(size, noise, _in_state(model, size))


def _variances(rows: np.ndarray) -> np.ndarray:
    """The variance of each column about its mean, NaN where nothing was read."""
    return np.ma.masked_invalid(rows).var(axis=0).filled(np.nan)


def _mean_variance(rows: np.ndarray) -> float:
    return float(np.ma.filled(np.ma.masked_invalid(_variances(rows)).mean(), np.nan))


def _scatter(series: TimeSeries) -> np.ndarray:
    """The variance of a reading about the line between its neighbours, were the motion straight."""
    times, y = np.asarray(series.times), np.asarray(series.readings)
    share = ((times[1:-1] - times[:-2]) / (times[2:] - times[:-2]))[:, None]
    r = y[1:-1] - (1 - share) * y[:-2] - share * y[2:]
    squares = r**2 / (1 + share**2 + (1 - share) ** 2)
    counted = ~np.isnan(squares)
    return np.where(counted, squares, 0.0).sum(axis=0) / np.where(counted.any(axis=0), counted.sum(axis=0), np.nan)


def _in_state(model: Any, size: np.ndarray) -> np.ndarray:
    """The variance of each entry of the state: of what reads it, or the mean where nothing does."""
    observation, initial = getattr(model, "observation", None), model.initial
    first = initial[0] if isinstance(initial, tuple) else initial
    state = len(size) if first is None else jnp.asarray(getattr(first.mean, "value", first.mean)).shape[0]
    if isinstance(observation, FullState):
        return size
    if not isinstance(observation, AbstractAffine):
        return np.full(state, size.mean())
    back = np.linalg.pinv(np.asarray(observation.slope(jnp.zeros(state)), dtype=float)) ** 2 @ size
    return np.where(back > 0, back, back.max())


def with_variances(noise: Any, variances: np.ndarray, interval: float = 1.0, known: bool = True) -> Any:
    """The noise with its variances set, in whatever they are written; `known` ones too. What is `Frozen` stays.

    `interval` is the length of a data interval, for a noise per unit time.
    """
    if isinstance(noise, Multiplicative):
        return eqx.tree_at(
            lambda n: n.additive, noise, with_variances(noise.additive, variances, interval, known), is_leaf=_is_none
        )
    if not isinstance(noise, AdditiveGaussian | WienerIncrement):
        return noise
    share = interval if isinstance(noise, WienerIncrement) else 1.0
    return eqx.tree_at(lambda n: n.structure, noise, _structure(noise.structure, variances / share, known))


def _is_none(node: Any) -> bool:
    return node is None


def _structure(structure: Any, variances: np.ndarray, known: bool) -> Any:
    if isinstance(structure, ScaledIdentity):
        return eqx.tree_at(lambda s: s.variance, structure, _set(structure.variance, np.mean(variances), known))
    if isinstance(structure, Diagonal | Correlated):
        return eqx.tree_at(lambda s: s.variances, structure, _set(structure.variances, variances, known))
    if isinstance(structure, Dense):
        covariance = structure.covariance
        if isinstance(covariance, PositiveDefinite):
            return Dense(PositiveDefinite(np.diag(variances)))
        return structure if isinstance(covariance, Frozen) or not known else Dense(np.diag(variances))
    return structure


def _set(number: Any, value: Any, known: bool) -> Any:
    """A number of a noise with another value, written as it was."""
    if isinstance(number, StandardDeviation):
        return StandardDeviation(_set(number.sd, np.sqrt(value), known))
    if isinstance(number, LogVariance):
        return LogVariance(_set(number.log_variance, np.log(value), known))
    if isinstance(number, Positive | Learnt):
        return type(number)(np.broadcast_to(value, number.free.shape))
    if isinstance(number, Bounded):
        margin = 1e-3 * (number.upper - number.lower)
        inside = np.clip(np.broadcast_to(value, number.free.shape), number.lower + margin, number.upper - margin)
        return Bounded(inside, number.lower, number.upper)
    if isinstance(number, AbstractParameter | Frozen) or not known:
        return number
    return jnp.asarray(np.broadcast_to(value, np.shape(number)), dtype=float)


def polynomial_of(model: Any) -> Any:
    """The polynomial Hamiltonian of a model whose coefficients learn, or None."""
    if not (isinstance(model, StateSpaceModel) and isinstance(model.dynamics, Propagator)):
        return None
    found = _hamiltonian(model)
    if not isinstance(found, Polynomial | PolynomialPotential):
        return None
    return found if isinstance(found.coefficients, Learnt) or eqx.is_array(found.coefficients) else None


def _hamiltonian(model: Any) -> Any:
    system = model.dynamics.system
    return system.hamiltonian if isinstance(system, ig.Forced) else system


def coefficient_starts(model: Any, recordings: Sequence[TimeSeries], key: PRNGKeyArray | None) -> dict[str, Any]:
    """Models that differ in what of the dynamics learns, by name: as given, disturbed, three for polynomials, and
    dynamic mode decomposition for a linear map."""
    found = {"as given": model}
    linear = _from_rows(model, recordings)
    if linear is not None:
        found["dynamic mode decomposition"] = linear
    hamiltonian = polynomial_of(model)
    if hamiltonian is not None:
        found["zero"] = _with(model, jnp.zeros(len(hamiltonian.terms)))
        found["harmonic"] = _with(model, harmonic(hamiltonian, model, recordings))
        rates = _from_rates(hamiltonian, model, recordings)
        if rates is not None:
            found["least squares of rates"] = _with(model, rates)
    if key is not None:
        found["disturbed"] = _disturbed(model, key)
    # Nothing is left out for being the same: the number of lanes, and so what is compiled, hangs on the model alone.
    return {name: one for name, one in found.items() if name == "as given" or _is_finite(one)}


def _is_finite(model: Any) -> bool:
    return bool(jnp.all(jnp.isfinite(flatten(model)[0])))


def _with(model: Any, coefficients: Any) -> Any:
    def there(m):
        given = _hamiltonian(m).coefficients
        return given.free if isinstance(given, Learnt) else given

    return eqx.tree_at(there, model, jnp.asarray(coefficients, dtype=float))


def harmonic(hamiltonian: Polynomial | PolynomialPotential, model: Any, recordings: Sequence[TimeSeries]) -> np.ndarray:
    """Coefficients of uncoupled oscillators, p^2 / 2 + omega^2 q^2 / 2, each as fast as its coordinate was seen to be.

    omega^2 is the mean square of p over that of q where both are read, else of the slope of a channel over that of it.
    """
    squares = _squared_frequencies(hamiltonian.dim, model, recordings)
    powers = exponents(hamiltonian.dim * (1 if isinstance(hamiltonian, PolynomialPotential) else 2), hamiltonian.degree)
    coefficients = np.zeros(len(powers))
    if hamiltonian.degree < 2:
        return coefficients
    curvatures = np.concatenate([squares, np.ones(hamiltonian.dim)])[: powers.shape[1]]
    slopes, boxes = hamiltonian.basis.slopes(2), np.asarray(hamiltonian.basis.scales(powers.shape[1]))
    for i, curvature in enumerate(curvatures):
        at = np.flatnonzero((powers[:, i] == 2) & (powers.sum(axis=1) == 2))
        # The second derivative of B_2(z / box), a constant.
        coefficients[at] = curvature * boxes[i] ** 2 / (slopes[2, 1] * slopes[1, 0])
    return coefficients


def _squared_frequencies(dim: int, model: Any, recordings: Sequence[TimeSeries]) -> np.ndarray:
    rows = np.concatenate([np.asarray(one.readings) for one in recordings])
    if isinstance(model.observation, FullState) and rows.shape[1] == 2 * dim:
        spread = _variances(rows)
        ratio = spread[dim:] / np.where(spread[:dim] > 0, spread[:dim], 1.0)
    else:
        slopes = [np.diff(one.readings, axis=0) / np.diff(one.times)[:, None] for one in recordings]
        ratio = np.full(dim, _mean_variance(np.concatenate(slopes)) / _mean_variance(rows))
    return np.where(np.isfinite(ratio) & (ratio > 0), ratio, 1.0)


def _from_rates(hamiltonian: Any, model: Any, recordings: Sequence[TimeSeries]) -> Any:
    """Hamiltonian least squares, where the whole state is read and the readings determine every coefficient."""
    if not isinstance(model.observation, FullState) or isinstance(model.dynamics.system, ig.Forced):
        return None
    try:
        found: Any = hamiltonian_least_squares(hamiltonian, tuple(recordings))
    except InputError:
        return None
    return found.coefficients


def _from_rows(model: Any, recordings: Sequence[TimeSeries]) -> Any:
    """The model with the linear map from each row of readings to the next, where the whole state is read."""
    dynamics = getattr(model, "dynamics", None)
    if not (isinstance(dynamics, LinearDynamics) and isinstance(model.observation, FullState)):
        return None
    matrix = dynamics.A.free if isinstance(dynamics.A, Learnt) else dynamics.A
    if dynamics.B is not None or not eqx.is_array(matrix):
        return None
    try:
        found = dmd(list(recordings)).A
    except InputError:
        return None
    return eqx.tree_at(lambda m: getattr(m.dynamics.A, "free", m.dynamics.A), model, jnp.asarray(found, dtype=float))


def _disturbed(model: Any, key: PRNGKeyArray) -> Any:
    free, rebuild = flatten(model)
    moved = coordinates(model, lambda m: m.dynamics) if hasattr(model, "dynamics") else jnp.ones_like(free)
    noise = jax.random.normal(key, free.shape) * jnp.maximum(jnp.abs(free), 1.0)
    return rebuild(free + _DISTURBANCE * moved * noise)
