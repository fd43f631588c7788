"""Markov parameters of linear systems, and the marginal likelihood written with them. Dissertation (3.3)-(3.6).

G_0 = D, G_k = H A^(k-1) B. As printed, (3.4) lacks its mean vec(G U) and the covariances across times; both are here.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._counts import is_count
from ._errors import InputError
from ._faults import IMPOSSIBLE
from ._guard import guard
from ._model import Coordinates, FullState, LinearDynamics, LinearObservation, StateSpaceModel, intervals_between
from ._objectives import TimeSeries, as_recordings, one_of
from ._parameters import resolve
from ._suitability import is_uneven

_LINEAR = LinearObservation | FullState | Coordinates


class MarkovParameters(eqx.Module):
    """Responses of the readings to a unit input: `blocks` (lag, channel, input) holds G_0, ..., G_{lag-1} of (3.3)."""

    blocks: Float[Array, "lag channel input"] = eqx.field(converter=jnp.asarray)

    @property
    def lag(self) -> int:
        """How many blocks there are, G_0 included."""
        return self.blocks.shape[0]

    @property
    def matrix(self) -> Float[Array, "channel lag_times_input"]:
        """The blocks side by side, [G_0, ..., G_{lag-1}], as in (3.4)."""
        return jnp.moveaxis(self.blocks, 0, 1).reshape(self.blocks.shape[1], -1)

    def response(self, inputs: Float[Array, "time input"]) -> Float[Array, "time channel"]:
        """G U of (3.4): the readings of a system at rest without noise, the sum of G_i u_{k-i} over i < lag."""
        return jnp.einsum("lci,tli->tc", self.blocks, windows(inputs, self.lag))


def windows(inputs: Any, lag: int) -> Any:
    """u_{k-i} at [k, i] for i < lag, the columns of U in (3.4); 0 before u_0."""
    back = np.arange(inputs.shape[0])[:, None] - np.arange(lag)
    return inputs[np.maximum(back, 0)] * (back >= 0)[..., None]


class _Matrices(NamedTuple):
    A: Array
    B: Array
    H: Array
    D: Array


def impulse_response(
    A: Float[Array, "state state"],
    B: Float[Array, "state input"],
    H: Float[Array, "channel state"],
    D: Float[Array, "channel input"],
    lag: int,
) -> MarkovParameters:
    """The first `lag` Markov parameters of the linear system (3.1): D, H B, H A B, ... (3.3)."""
    check_lag(lag)
    return MarkovParameters(
        _response_blocks(_Matrices(*(jnp.asarray(matrix, dtype=float) for matrix in (A, B, H, D))), lag)
    )


@eqx.filter_jit
def _response_blocks(matrices: _Matrices, lag: int) -> Array:
    def step(column, _):
        return matrices.A @ column, matrices.H @ column

    return jnp.concatenate([matrices.D[None], jax.lax.scan(step, matrices.B, None, length=lag - 1)[1]])


def markov_parameters_of(system: Any, lag: int) -> MarkovParameters:
    """The first `lag` Markov parameters of anything with a `LinearDynamics` and a linear observation.

    **Arguments:** `system` - has `dynamics` and `observation`, as a `StateSpaceModel` or a `Realisation`.

    **Raises:** `InputError` where it is not linear or has no inputs.
    """
    matrices = _matrices(system)
    if matrices.D.shape[1] == 0:
        raise InputError("The system has no input matrix, so it has no Markov parameters; give `LinearDynamics` a `B`.")
    return impulse_response(*matrices, lag=lag)


@eqx.filter_jit
def output_covariances(model: StateSpaceModel, times: Float[Array, " time"]) -> Float[Array, "time channel channel"]:
    """Lambda_k of (3.4), the covariance of each reading: of both noises, and of x_0 where it is not known."""
    H, spreads = _state_covariances(model, times)
    return jnp.einsum("cs,kst,dt->kcd", H, spreads, H) + _measurement_covariance(model)


@eqx.filter_jit
def joint_output_covariance(
    model: StateSpaceModel, times: Float[Array, " time"]
) -> Float[Array, "time channel time channel"]:
    """Lambda of (3.4), the covariance of all readings: H P_j (A^(k-j))' H' for j <= k, and Gamma on the diagonal."""
    H, spreads = _state_covariances(model, times)
    steps = np.arange(len(times))
    lagged = _free_responses(model, len(times))[np.abs(steps - steps[:, None])]
    upper = jnp.einsum("cs,jst,jkdt->jckd", H, spreads, lagged)
    later = (steps >= steps[:, None])[:, None, :, None]
    # The lower half is the transpose; what `upper` holds there belongs to no pair of times.
    return jnp.where(later, upper, jnp.transpose(upper, (2, 3, 0, 1))) + jnp.einsum(
        "jk,cd->jckd", jnp.eye(len(times)), _measurement_covariance(model)
    )


def markov_log_likelihood(model: StateSpaceModel, recording: Any) -> Float[Array, ""]:
    """The log marginal likelihood of a linear model in its Markov form (3.4), in nats: log N(vec(Y); vec(G U), Lambda).

    The same number as the filter's (3.2), for any Gaussian x_0: its mean adds H A^k m_0, its covariance enters Lambda.
    The cost is cubic in the number of readings; the filter's is linear. Missing readings are left out. Works under
    `jit` and `grad`; a Lambda that is not positive definite gives -1e15 nats, as a filter that fails does.

    **Arguments:** `model` - with `LinearDynamics`, a linear observation, additive noises and an `initial` Gaussian;
    `recording` - one or a list, evenly spaced, with inputs where the model has an input matrix.

    **Raises:** `InputError` where any of these is wanting.
    """
    recordings = as_recordings(recording)
    for series in recordings:
        check_spacing(series)
    parts = (_log_density(one_of(model, k, len(recordings)), one) for k, one in enumerate(recordings))
    return sum(parts, jnp.zeros(()))


@eqx.filter_jit
def _log_density(model: StateSpaceModel, series: TimeSeries) -> Array:
    """The log density of one recording under (3.4), missing readings left out."""
    count, readings = len(series.times), series.readings
    mean = impulse_response(*_matrices(model), lag=count).response(_inputs_for(model, series))
    mean += free_mean(model, count)
    seen = ~jnp.isnan(readings).ravel()
    covariance = joint_output_covariance(model, series.times).reshape(readings.size, -1)
    # A missing reading is given variance 1, no correlation and no residual: as if absent.
    covariance = jnp.where(seen[:, None] & seen, covariance, 0.0) + jnp.diag(jnp.where(seen, 0.0, 1.0))
    residual = jnp.where(seen, jnp.nan_to_num(readings).ravel() - mean.ravel(), 0.0)
    factor = jnp.linalg.cholesky(guard(covariance))
    whitened = jax.scipy.linalg.solve_triangular(factor, guard(residual), lower=True)
    constant = 0.5 * np.log(2 * np.pi) * jnp.sum(seen)
    value = -0.5 * whitened @ whitened - jnp.sum(jnp.log(jnp.diagonal(factor))) - constant
    return jnp.where(jnp.isfinite(value), value, IMPOSSIBLE)


def _inputs_for(model: Any, series: TimeSeries) -> Array:
    """The recording's inputs, as many as the model has; none where the model has no input matrix."""
    wanted = _matrices(model).D.shape[1]
    given = jnp.zeros((len(series.times), 0)) if series.inputs is None or wanted == 0 else series.inputs
    if given.shape[1] != wanted:
        raise InputError(
            f"The model has {wanted} inputs, but the recording {given.shape[1]}; give `TimeSeries` its `inputs`."
        )
    return given


def _state_covariances(model: StateSpaceModel, times: Any) -> tuple[Array, Array]:
    """H, and the covariance of the state at each time without its input: P_{k+1} = A P_k A' + Sigma."""
    model, matrices = resolve(model), _matrices(model)
    spans = intervals_between(times)
    process = jax.vmap(lambda span: _covariance(model.process_noise, span))(spans)

    def step(P, Q):
        P = matrices.A @ P @ matrices.A.T + Q
        return P, P

    start = jnp.asarray(_initial(model).covariance, dtype=process.dtype)
    return matrices.H, jnp.concatenate([start[None], jax.lax.scan(step, start, process)[1]])


def _free_responses(model: StateSpaceModel, count: int) -> Array:
    """H A^k for k = 0, ..., count - 1."""
    matrices = _matrices(model)
    return jax.lax.scan(lambda row, _: (row @ matrices.A, row), matrices.H, None, length=count)[1]


@eqx.filter_jit
def free_mean(model: StateSpaceModel, count: int) -> Array:
    return _free_responses(model, count) @ _initial(resolve(model)).mean


def _measurement_covariance(model: StateSpaceModel) -> Array:
    return _covariance(resolve(model).measurement_noise, None)


def _covariance(noise: Any, record: Any) -> Array:
    if not hasattr(noise, "covariance"):
        raise InputError(
            f"The Markov form is for additive Gaussian noise, but the model has `{type(noise).__name__}`; use "
            "`AdditiveGaussian`."
        )
    return noise.covariance(record)


def _initial(model: Any) -> Any:
    if model.initial is None:
        raise InputError("The model has no initial distribution; give it `initial=Gaussian(mean, covariance)`.")
    return model.initial


def _matrices(system: Any) -> _Matrices:
    """A, B, H, D of a linear system; absent input matrices are 0, and have no columns where both are absent."""
    system = resolve(system)
    dynamics, observation = system.dynamics, system.observation
    if not (isinstance(dynamics, LinearDynamics) and isinstance(observation, _LINEAR)):
        raise InputError(
            "Markov parameters are of linear systems, `LinearDynamics` with `LinearObservation`, but were asked of "
            f"`{type(dynamics).__name__}` with `{type(observation).__name__}`."
        )
    A, B, D = jnp.asarray(dynamics.A, dtype=float), dynamics.B, getattr(observation, "feedthrough", None)
    H = observation.slope(jnp.zeros(A.shape[0]))
    inputs = next((np.shape(matrix)[1] for matrix in (B, D) if matrix is not None), 0)
    B = jnp.zeros((A.shape[0], inputs)) if B is None else jnp.asarray(B, dtype=float)
    return _Matrices(A, B, H, jnp.zeros((H.shape[0], inputs)) if D is None else jnp.asarray(D, dtype=float))


def check_lag(lag: int) -> None:
    if not is_count(lag):
        raise InputError(f"The lag is how many Markov parameters there are, at least 1, but is {lag}.")


def check_spacing(series: TimeSeries) -> None:
    if isinstance(series.times, jax.core.Tracer):
        return
    spans = np.diff(np.asarray(series.times))
    if is_uneven(spans):
        raise InputError(
            f"Markov parameters need evenly spaced rows, but the recording's intervals run from {spans.min():.4g} to "
            f"{spans.max():.4g}; put rows with NaN readings where some were left out, or resample."
        )
