"""From Markov parameters to state-space matrices: the eigensystem realisation algorithm, and what starts from it.

Juang and Pappa (1985); dissertation Algorithm 6 and appendix B, corrected (E20, E21); sec. 3.3.3.
"""

import abc
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._errors import InputError
from ._filter import log_likelihood
from ._fit import Estimate, fit
from ._markov_estimators import least_squares_markov
from ._markov_parameters import MarkovParameters, markov_parameters_of
from ._model import Gaussian, LinearDynamics, LinearObservation, StateSpaceModel
from ._noise import AdditiveGaussian, LogVariance, ScaledIdentity
from ._objectives import as_recordings, prepare
from ._parameters import Learnt
from ._prior import AbstractDensity, Flat, Prior

# Shares of the residual variance that a start tries for the measurement noise and, in readings, for the process noise.
_SHARES = 10.0 ** np.array([-6, -4, -3, -2, -1, 0])
_FLAT = Flat()


class AbstractHankel(eqx.Module):
    """Which Markov parameters fill the Hankel matrix of `realise`: `rows` by `columns` blocks.

    The shifted matrix has the same size and starts one block later.
    """

    rows: eqx.AbstractVar[int | None]
    columns: eqx.AbstractVar[int | None]

    @property
    @abc.abstractmethod
    def first(self) -> int:
        """The index of its first block."""

    def pair(self, parameters: MarkovParameters) -> tuple[np.ndarray, np.ndarray]:
        """The matrix and its shifted one, (rows * channel, columns * input).

        **Raises:** `InputError` where `parameters` are too few.
        """
        lag = parameters.lag
        rows = max(lag // 2, 1) if self.rows is None else self.rows
        columns = max(lag - 1 - rows, 1) if self.columns is None else self.columns
        needed = self.first + rows + columns
        if rows < 1 or columns < 1 or needed > lag:
            raise InputError(
                f"A Hankel matrix of {rows} by {columns} blocks from G_{self.first} needs {needed} Markov parameters, "
                f"but there are {lag}; estimate more, or ask for fewer rows and columns (at least 1)."
            )
        index = self.first + np.arange(rows)[:, None] + np.arange(columns)
        blocks = np.asarray(parameters.blocks)
        return _spread(blocks[index]), _spread(blocks[index + 1])


def _spread(blocks: np.ndarray) -> np.ndarray:
    """Blocks (rows, columns, channel, input) as one matrix."""
    rows, columns, channels, inputs = blocks.shape
    return blocks.transpose(0, 2, 1, 3).reshape(rows * channels, columns * inputs)


class CorrectedHankel(AbstractHankel):
    """The Hankel matrix [i, j] = G_{i+j+1} = (H A^i)(A^j B). It needs rows + columns + 1 Markov parameters.

    Sizes that are None are as large as the parameters allow and nearly square: 9 by 8 for a lag of 18.
    """

    rows: int | None = eqx.field(static=True, default=None)
    columns: int | None = eqx.field(static=True, default=None)

    @property
    def first(self) -> int:
        return 1


CORRECTED = CorrectedHankel()


class PrintedHankel(AbstractHankel):
    """[i, j] = G_{i+j}, as the dissertation prints and its code computes (E20): for comparison only.

    G_0 = D is no product of H and B, so even exact parameters give a wrong system. Sizes as in `CorrectedHankel`.
    """

    rows: int | None = eqx.field(static=True, default=None)
    columns: int | None = eqx.field(static=True, default=None)

    @property
    def first(self) -> int:
        return 0


class Realisation(eqx.Module):
    """A linear system with given Markov parameters, in balanced coordinates.

    `singular_values` are all those of the Hankel matrix, falling; a gap after the order says that it was enough.
    """

    dynamics: LinearDynamics
    observation: LinearObservation
    singular_values: Float[Array, " value"]


def realise(parameters: MarkovParameters, order: int, hankel: AbstractHankel = CORRECTED) -> Realisation:
    """The eigensystem realisation algorithm: A, B, H of size `order` from Markov parameters, and D = G_0.

    The Hankel matrix U S V' is cut to `order`: H is the first block row of U sqrt(S), B the first block column of
    sqrt(S) V', A = sqrt(S)^-1 U' (shifted matrix) V sqrt(S)^-1. Algorithm 6, corrected.

    **Raises:** `InputError` where the Hankel matrix is too small, or of too low a rank, for the order.
    """
    matrix, shifted = hankel.pair(parameters)
    left, values, right = np.linalg.svd(matrix, full_matrices=False)
    _check_order(order, matrix, values)
    roots = np.sqrt(values[:order])
    observability, controllability = left[:, :order] * roots, roots[:, None] * right[:order]
    A = (left[:, :order] / roots).T @ shifted @ (right[:order].T / roots)
    _, channels, inputs = parameters.blocks.shape
    return Realisation(
        LinearDynamics(jnp.asarray(A), jnp.asarray(controllability[:, :inputs])),
        LinearObservation(jnp.asarray(observability[:channels]), parameters.blocks[0]),
        jnp.asarray(values),
    )


def _check_order(order: int, matrix: np.ndarray, values: np.ndarray) -> None:
    rank = int(np.sum(values > max(matrix.shape) * np.finfo(float).eps * values[0]))
    if order < 1 or order > rank:
        raise InputError(
            f"The Hankel matrix has size {matrix.shape} and rank {rank}, so it holds orders 1 to {rank}, but order "
            f"{order} was asked for; use a smaller order, or a longer lag."
        )


def realised_model(
    recording: Any,
    lag: int,
    order: int,
    hankel: AbstractHankel = CORRECTED,
    initial: Gaussian | None = None,
) -> StateSpaceModel:
    """A linear model from recordings alone: ERA on least-squares Markov parameters, noise variances by a coarse search.

    The start of `marginal_markov`, or of any fit of a linear model. Both noises are multiples of the identity: the most
    likely pair of 6 by 6 between 1e-6 and 1 of the residuals' variance. They learn by their `LogVariance`: the state's
    unit is free (A, B c, H / c and Sigma c^2 give the same readings), and a prior that is flat over the variance itself
    would have no maximum along c.

    **Arguments:** `recording`, `lag` - as for `least_squares_markov`; `order`, `hankel` - as for `realise`; `initial` -
    of x_0; None means at rest, exactly 0.

    **Raises:** `InputError` as both, or where no pair gives a finite likelihood.
    """
    recordings = as_recordings(recording)
    parameters = least_squares_markov(recordings, lag)
    system = realise(parameters, order, hankel)
    initial = Gaussian(jnp.zeros(order), jnp.zeros((order, order))) if initial is None else initial
    variance = _residual_variance(parameters, recordings)
    gain = float(jnp.mean(jnp.sum(system.observation.matrix**2, axis=1)))
    pairs = np.array([(p, m) for p in _SHARES * variance / gain for m in _SHARES * variance])
    best = pairs[int(np.argmax(_scores(system, initial, recordings, jnp.asarray(pairs))))]
    return _with_noises(system, initial, *(LogVariance(Learnt(np.log(variance))) for variance in best))


def _with_noises(system: Realisation, initial: Gaussian, process: Any, measurement: Any) -> StateSpaceModel:
    channels, order = system.observation.matrix.shape
    return StateSpaceModel(
        dynamics=system.dynamics,
        observation=system.observation,
        process_noise=AdditiveGaussian(ScaledIdentity(process, order)),
        measurement_noise=AdditiveGaussian(ScaledIdentity(measurement, channels)),
        initial=initial,
    )


@eqx.filter_jit
def _scores(system: Realisation, initial: Gaussian, recordings: Any, pairs: Array) -> Array:
    """The log likelihood for each pair of noise variances."""

    def score(pair):
        model = _with_noises(system, initial, pair[0], pair[1])
        return sum(log_likelihood(*prepare(model, series)) for series in recordings)

    return jax.vmap(score)(pairs)


def _residual_variance(parameters: MarkovParameters, recordings: Any) -> float:
    """Mean square of what the parameters leave of the readings, of 1e-12 of the readings' own at least."""
    residuals = [np.asarray(one.readings - parameters.response(one.inputs))[parameters.lag - 1 :] for one in recordings]
    readings = np.concatenate([np.asarray(one.readings) for one in recordings])
    return float(max(np.nanmean(np.concatenate(residuals) ** 2), 1e-12 * np.nanmean(readings**2)))


class MarginalMarkov(NamedTuple):
    """Markov parameters of the most probable linear model, and the `Estimate` that they come from."""

    parameters: MarkovParameters
    estimate: Estimate


def marginal_markov(
    recording: Any,
    lag: int,
    start: StateSpaceModel,
    *,
    prior: Prior | AbstractDensity = _FLAT,
    max_steps: int = 500,
) -> MarginalMarkov:
    """Markov parameters by the marginal likelihood (3.2): a linear model is fitted, and its parameters read off.

    Every reading is used, and only as many numbers are estimated as the model has, however long the lag. With the flat
    prior, over log variances in the start of `realised_model`, it is the maximum of the likelihood.

    **Arguments:** `recording` - one or a list, with inputs; `lag` - how many blocks to give; `start` - a linear model
    with leaves that learn, as `realised_model` makes from the recording; `prior`, `max_steps` - as for `fit`. See
    `estimate.converged`.

    **Raises:** `InputError` as `fit`, or where the model is not linear or has no inputs.
    """
    markov_parameters_of(start, lag)
    estimate = fit(start, recording, prior=prior, max_steps=max_steps)
    return MarginalMarkov(markov_parameters_of(estimate.model, lag), estimate)
