"""Objectives made for Hamiltonian systems: least squares of the equations of motion, and the L1 of neural networks.

Dissertation (5.12)-(5.15), with the signs and brackets of specification E37 and E38. Both read the `FullState`.
"""

import abc
import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

import integrators as ig

from ._counts import refuse_count
from ._errors import InputError
from ._guard import guard
from ._model import FullState, Propagator, StateSpaceModel
from ._objectives import AbstractObjective, TimeSeries, as_recordings
from ._parameters import require, resolve
from ._suitability import refuse_other_dimension, refuse_wrong_state
from ._trajectory_objectives import bounded

# Singular values below this share of the largest are round-off of features that are dependent.
_DEPENDENT = 1e-12


class AbstractDerivative(eqx.Module):
    """How rates are made of readings."""

    @abc.abstractmethod
    def __call__(
        self, times: Float[Array, " time"], readings: Float[Array, "time channel"]
    ) -> Float[Array, "time channel"]:
        """d reading / dt at every time, NaN where a reading that is needed is missing."""


class SecondOrderDifferences(AbstractDerivative):
    """The slope of the parabola through a reading and its neighbours, or through the three at an end.

    Order 2 for uneven times as well. **Raises:** `InputError` for fewer than three readings.
    """

    def __call__(
        self, times: Float[Array, " time"], readings: Float[Array, "time channel"]
    ) -> Float[Array, "time channel"]:
        if times.shape[0] < 3:
            raise InputError(f"Second-order differences need at least 3 readings, but there are {times.shape[0]}.")
        h, slopes = jnp.diff(times)[:, None], jnp.diff(readings, axis=0) / jnp.diff(times)[:, None]
        before, after = h[:-1], h[1:]
        middle = (after * slopes[:-1] + before * slopes[1:]) / (before + after)
        # The parabola's slope is linear in time: twice the secant minus the slope at the other end of it.
        first, last = 2 * slopes[:1] - middle[:1], 2 * slopes[-1:] - middle[-1:]
        return jnp.concatenate([first, middle, last])


DIFFERENCES = SecondOrderDifferences()


class HamiltonianLeastSquares(AbstractObjective):
    """Minus sum_k log N([-pdot_k; qdot_k]; grad H(q_k, p_k), variance I), rates by differences. (5.12)-(5.14), E37.

    The model's dynamics is a `Propagator`, of which only the system counts: no trajectory is simulated, and the noises
    play no part. With forces, pdot is compared with -dH/dq plus the forces. What is missing is left out. A gradient
    that is not finite scores 1e15 nats.

    **Arguments:** `variance` - of the errors of the rates, known, one number or one for each of [-pdot; qdot];
    `derivative` - how rates are made.

    **Raises:** `InputError` where the dynamics is no `Propagator` or the reading not the `FullState`.
    """

    variance: Any = eqx.field(converter=lambda variance: jnp.asarray(variance, dtype=float))
    derivative: AbstractDerivative = DIFFERENCES

    def __check_init__(self):
        require(self.variance > 0, "`HamiltonianLeastSquares` needs positive variances of the rates.")

    def score(self, model: StateSpaceModel, series: TimeSeries) -> Float[Array, ""]:
        system = _propagator(resolve(guard(model)), series).system
        targets = _targets(self.derivative, series)
        gradients = jax.vmap(lambda x, t: _gradient(guard(system), guard(x), t))(_points(series), series.times)
        seen = ~jnp.isnan(targets)
        r = jnp.where(seen, targets - gradients, 0.0)
        density = -0.5 * (r**2 / self.variance + jnp.log(2 * math.pi * self.variance))
        return bounded(-jnp.sum(jnp.where(seen, density, 0.0)), jnp.asarray(True))


def hamiltonian_least_squares(
    hamiltonian: Any, recordings: Any, derivative: AbstractDerivative = DIFFERENCES
) -> ig.AbstractHamiltonian:
    """The minimiser of `HamiltonianLeastSquares` in closed form, for a Hamiltonian linear in its `coefficients`.

    (5.12)-(5.14) as least squares of the stacked gradients, whose condition number is the root of that of the normal
    equations as printed. `hamiltonian` is a `Polynomial`, a `PolynomialPotential` or another with an array of
    `coefficients`; `recordings` is one or several, of the full state [q, p].

    **Raises:** `InputError` where the recordings do not determine all coefficients.
    """
    flat, several = resolve(hamiltonian), as_recordings(recordings)
    for one in several:
        refuse_other_dimension(flat, one.readings.shape[1])
    parts = [_equations(flat, one, derivative) for one in several]
    features, rates = (np.concatenate([np.asarray(part[i]) for part in parts]) for i in (0, 1))
    keep = ~np.isnan(rates)
    # Columns of unit length: the rank is then that of the terms, whatever their units.
    scales = np.linalg.norm(features[keep], axis=0)
    scales = np.where(scales > 0, scales, 1.0)
    solution, _, rank, _ = np.linalg.lstsq(features[keep] / scales, rates[keep], rcond=_DEPENDENT)
    if rank < scales.size:
        raise InputError(
            f"The recordings determine {rank} of the Hamiltonian's {scales.size} coefficients; lower the degree, or "
            "record more of the phase space."
        )
    return eqx.tree_at(lambda h: h.coefficients, hamiltonian, jnp.asarray(solution / scales))


class MiniBatch(eqx.Module):
    """Some data intervals of all, drawn by `key` without replacement, weighed so that the score is unbiased.

    Give another key at each step of training: `eqx.tree_at(lambda o: o.batch.key, objective, key)` compiles nothing.
    """

    size: int = eqx.field(static=True, converter=lambda size: int(size) if isinstance(size, np.integer) else size)
    key: PRNGKeyArray | Array

    def __check_init__(self):
        refuse_count("MiniBatch", "size", self.size)


class OneStepL1(AbstractObjective):
    """Minus the log Laplace density of one-step errors, in all copies of the phase point that the integrator holds.

    For Tao's method these are the four blocks of (5.15): q and p, and the auxiliary outputs, compared with the same
    readings; for others q and p alone. With n intervals of d degrees of freedom and c copies the score is
    (n / scale) times the mean (5.15) plus 2 d c n log(2 scale), in nats. Each interval starts at its reading, lifted.
    An interval with a missing start is left out, and a missing target. What leaves the reals scores 1e15 nats.

    **Arguments:** `scale` - of the Laplace density, known, in units of the state; `batch` - None for all intervals,
    or a `MiniBatch`.

    **Raises:** `InputError` where the dynamics is no `Propagator`, the reading not the `FullState`, or a batch is
    larger than the recordings.
    """

    scale: Any = eqx.field(converter=lambda scale: jnp.asarray(scale, dtype=float))
    batch: MiniBatch | None = None

    def __check_init__(self):
        require(self.scale > 0, "`OneStepL1` needs a positive scale of its Laplace density.")

    def __call__(self, model: StateSpaceModel, recording: Any) -> Float[Array, ""]:
        """Minus the log density; a batch is drawn from the intervals of all recordings together."""
        model, recordings = resolve(guard(model)), as_recordings(recording)
        propagator = _propagator(model, recordings[0])
        parts = [_Steps(one.times[:-1], one.times[1:], one.readings[:-1], one.readings[1:]) for one in recordings]
        steps = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
        count, weight = len(steps.start), 1.0
        if self.batch is not None:
            chosen, weight = self._drawn(self.batch, count), count / self.batch.size
            steps = jax.tree.map(lambda leaf: leaf[chosen], steps)
        return bounded(weight * jnp.sum(jax.vmap(lambda step: self._error(propagator, step))(steps)), jnp.asarray(True))

    def score(self, model: StateSpaceModel, series: TimeSeries) -> Float[Array, ""]:
        return self(model, series)

    def _drawn(self, batch: MiniBatch, count: int) -> Array:
        if not 1 <= batch.size <= count:
            raise InputError(f"A batch of {batch.size} was asked for, but there are {count} data intervals.")
        return jax.random.choice(batch.key, count, (batch.size,), replace=False)

    def _error(self, propagator: Propagator, step: "_Steps") -> Array:
        """Minus the log density of one interval."""
        known = ~jnp.any(jnp.isnan(step.before))
        propagator, x = guard((propagator, jnp.where(known, step.before, 0.0)))
        integrator = propagator.integrator
        lifted, span = integrator.lift(x), (step.start, step.end)
        ends = ig.advance(propagator.system, integrator, lifted, *span, propagator.substeps)
        targets = jnp.tile(jnp.where(known, step.after, jnp.nan), integrator.copies)
        errors = jnp.abs(jnp.where(jnp.isnan(targets), 0.0, targets - ends))
        return jnp.sum(jnp.where(jnp.isnan(targets), 0.0, errors / self.scale + jnp.log(2 * self.scale)))


class _Steps(NamedTuple):
    """Data intervals: their ends in time, and the readings there."""

    start: Array
    end: Array
    before: Array
    after: Array


def _propagator(model: StateSpaceModel, series: TimeSeries) -> Propagator:
    """The propagator of a model that reads its full state [q, p]."""
    if not isinstance(model.dynamics, Propagator):
        raise InputError(
            f"This objective is for a Hamiltonian system, a `Propagator`, but the dynamics is "
            f"`{type(model.dynamics).__name__}`."
        )
    if not isinstance(model.observation, FullState) or series.readings.shape[1] % 2:
        raise InputError(
            f"This objective needs readings of the whole phase point [q, p], but the model reads "
            f"`{type(model.observation).__name__}` in {series.readings.shape[1]} channels; use `MarginalLikelihood`."
        )
    refuse_wrong_state(model, series.readings.shape[1])
    return model.dynamics


def _targets(derivative: AbstractDerivative, series: TimeSeries) -> Array:
    """[-pdot; qdot] (time, 2d); NaN where it, or the point of the phase space, is not known."""
    qdot, pdot = jnp.split(derivative(series.times, series.readings), 2, axis=1)
    complete = ~jnp.any(jnp.isnan(series.readings), axis=1, keepdims=True)
    return jnp.where(complete, jnp.concatenate([-pdot, qdot], axis=1), jnp.nan)


def _points(series: TimeSeries) -> Array:
    """The phase points; where one is incomplete, its target is NaN, and any will do."""
    return jnp.where(jnp.isnan(series.readings), 0.0, series.readings)


def _gradient(system: Any, x: Array, t: Array) -> Array:
    """What [-pdot; qdot] should be: [dH/dq; dH/dp], less the forces."""
    field = system.vector_field(x, t) if isinstance(system, ig.Forced) else system.at(t).vector_field(x)
    v, force = jnp.split(field, 2)
    return jnp.concatenate([-force, v])


@eqx.filter_jit
def _equations(hamiltonian: Any, series: TimeSeries, derivative: AbstractDerivative) -> tuple[Array, Array]:
    """grad Phi' stacked over the readings (equation, term), and what is to equal its product with the coefficients."""

    def gradient(coefficients, x, t):
        return _gradient(eqx.tree_at(lambda h: h.coefficients, hamiltonian, coefficients), x, t)

    zero = jnp.zeros_like(hamiltonian.coefficients)
    features = jax.vmap(lambda x, t: jax.jacfwd(gradient)(zero, x, t))(_points(series), series.times)
    known = jax.vmap(lambda x, t: gradient(zero, x, t))(_points(series), series.times)
    return features.reshape(-1, zero.size), (_targets(derivative, series) - known).reshape(-1)
