"""Markov parameters from recordings by least squares, weighted or not. Dissertation (3.10)-(3.15).

Slips of the printed text that are right here: (3.13) pairs G_i with u_{k-i}; each channel needs nbar d_u rows (E18).
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.linalg

from ._errors import InputError
from ._markov_parameters import (
    MarkovParameters,
    check_lag,
    check_spacing,
    free_mean,
    joint_output_covariance,
    output_covariances,
    windows,
)
from ._model import StateSpaceModel
from ._objectives import TimeSeries, as_recordings, one_of


def least_squares_markov(recording: Any, lag: int, *, printed_start: bool = False) -> MarkovParameters:
    """Markov parameters by least squares from one rollout or several (3.13), each channel by itself.

    Rows k = lag-1, ..., n are used, where all of u_k, ..., u_{k-lag+1} are known; rows with a missing reading are left
    out.

    **Arguments:** `recording` - one or a list, evenly spaced, with inputs; `lag` - how many blocks, nbar;
    `printed_start` - start at k = nbar as (3.13) prints, one row later than needed.

    **Raises:** `InputError` where inputs are missing, times are uneven, fewer rows remain than nbar d_u, or the inputs
    are not persistently exciting.
    """
    parts = _parts(as_recordings(recording), lag, printed_start)
    readings, inputs = (np.concatenate([part[k] for part in parts]) for k in (1, 2))
    _check_count(readings, inputs.shape[1])
    seen = ~np.isnan(readings)
    rows = [_solve(inputs[seen[:, c]], readings[seen[:, c], c]) for c in range(readings.shape[1])]
    return _as_blocks(np.array(rows), (len(rows), lag))


def generalised_least_squares_markov(
    recording: Any, lag: int, model: StateSpaceModel, *, printed_start: bool = False
) -> MarkovParameters:
    """Markov parameters by least squares with weight Lambda_k^-1 for row k, covariances across rows ignored (3.15).

    **Arguments:** as for `least_squares_markov`; `model` - gives the weights by its A, H, Sigma, Gamma and `initial`;
    its B and D are not used.

    **Raises:** `InputError` as `least_squares_markov`, or where a Lambda_k is not positive definite.
    """
    recordings = as_recordings(recording)
    parts = _parts(recordings, lag, printed_start)
    _check_count(np.concatenate([part.readings for part in parts]), parts[0].inputs.shape[1])
    pairs = [
        _row_weighted(one_of(model, k, len(parts)), series, part)
        for k, (series, part) in enumerate(zip(recordings, parts, strict=True))
    ]
    return _solve_pairs(pairs, (parts[0].readings.shape[1], lag), least_norm=False)


def full_information_markov(
    recording: Any, lag: int, model: StateSpaceModel, *, cross_covariances: bool = True
) -> MarkovParameters:
    """Markov parameters by generalised least squares on all rows with the whole Lambda (3.10), the maximum of (3.4).

    Nothing acted before u_0. Parameters after `lag` are taken as 0. Where the readings leave a direction open (always
    with lag = n + 1 and several inputs) the solution of least norm is given, as the pseudo-inverse of (3.10) does.

    **Arguments:** as for `generalised_least_squares_markov`; `cross_covariances` - False leaves the blocks of Lambda on
    its diagonal only, the estimator of Proposition 1.

    **Raises:** `InputError` as there, or where `lag` is longer than the longest recording.
    """
    recordings = as_recordings(recording)
    longest = max(len(series.times) for series in recordings)
    if lag > longest:
        raise InputError(f"A lag of {lag} is longer than the recording's {longest} rows; ask for fewer blocks.")
    pairs = [
        _jointly_weighted(one_of(model, k, len(recordings)), series, lag, cross_covariances)
        for k, series in enumerate(recordings)
    ]
    return _solve_pairs(pairs, (recordings[0].readings.shape[1], lag), least_norm=True)


class _Part(NamedTuple):
    """The rows of one recording that an estimator uses: readings (row, channel), inputs (row, lag times input)."""

    first: int
    readings: np.ndarray
    inputs: np.ndarray


def _parts(recordings: tuple[TimeSeries, ...], lag: int, printed_start: bool) -> list[_Part]:
    first = lag if printed_start else lag - 1
    return [_Part(first, np.asarray(one.readings)[first:], _regressors(one, lag)[first:]) for one in recordings]


def _regressors(series: TimeSeries, lag: int) -> np.ndarray:
    """The columns of U in (3.14) as rows: u_k, u_{k-1}, ..., u_{k-lag+1} side by side, 0 before u_0."""
    check_lag(lag)
    check_spacing(series)
    if series.inputs is None:
        raise InputError("Markov parameters are responses to inputs, but the recording has none; give its `inputs`.")
    return windows(np.asarray(series.inputs), lag).reshape(len(series.times), -1)


def _row_weighted(model: StateSpaceModel, series: TimeSeries, part: _Part) -> tuple[np.ndarray, np.ndarray]:
    """Design and target of (3.15), whitened row by row; the unknowns are vec(G') (channel by channel)."""
    seen = ~np.isnan(part.readings)
    pairs = seen[:, :, None] & seen[:, None, :]
    covariances = np.asarray(output_covariances(model, series.times))[part.first :]
    # A missing channel is given variance 1 and no correlation, and its row is 0: as if absent.
    inverse = np.linalg.inv(_cholesky(np.where(pairs, covariances, 0.0) + _diagonals(~seen))) * seen[:, :, None]
    residuals = np.where(seen, part.readings - np.asarray(free_mean(model, len(series.times)))[part.first :], 0.0)
    design = np.einsum("kac,km->kacm", inverse, part.inputs)
    return design.reshape(seen.size, -1), np.einsum("kac,kc->ka", inverse, residuals).ravel()


def _diagonals(flags: np.ndarray) -> np.ndarray:
    return flags[:, :, None] * np.eye(flags.shape[1])


def _jointly_weighted(
    model: StateSpaceModel, series: TimeSeries, lag: int, cross_covariances: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Design and target of (3.10), whitened by the Cholesky factor of Lambda; missing readings left out."""
    readings = np.asarray(series.readings)
    inputs, seen = _regressors(series, lag), ~np.isnan(readings).ravel()
    covariance = np.asarray(joint_output_covariance(model, series.times))
    if not cross_covariances:
        covariance = covariance * np.eye(len(readings))[:, None, :, None]
    factor = _cholesky(covariance.reshape(readings.size, -1)[np.ix_(seen, seen)])
    residuals = (readings - np.asarray(free_mean(model, len(readings)))).ravel()[seen]
    design = np.einsum("ac,km->kacm", np.eye(readings.shape[1]), inputs).reshape(readings.size, -1)[seen]
    design, target = (scipy.linalg.solve_triangular(factor, right, lower=True) for right in (design, residuals))
    return design, target


def _cholesky(covariance: np.ndarray) -> np.ndarray:
    try:
        factor = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        factor = np.full(1, np.nan)
    if not np.all(np.isfinite(factor)):
        raise InputError(
            "The weights' covariance Lambda is not finite and positive definite; give the model a measurement noise "
            "above 0, and an A that does not overflow over the recording."
        )
    return factor


def _solve_pairs(
    pairs: list[tuple[np.ndarray, np.ndarray]], shape: tuple[int, int], least_norm: bool
) -> MarkovParameters:
    design, target = (np.concatenate(part) for part in zip(*pairs, strict=True))
    return _as_blocks(_solve(design, target, least_norm), shape)


def _solve(design: np.ndarray, target: np.ndarray, least_norm: bool = False) -> np.ndarray:
    """Least squares by a QR factorisation with pivoting; one that is short of rank is refused unless `least_norm`."""
    cond = max(design.shape) * np.finfo(float).eps
    solution, _, rank, _ = scipy.linalg.lstsq(design, target, cond=cond, lapack_driver="gelsy")
    if rank < design.shape[1] and not least_norm:
        raise InputError(
            f"The inputs are not persistently exciting: the equations for {design.shape[1]} unknowns have rank {rank}; "
            "use a shorter lag or inputs that vary more."
        )
    return solution


def _as_blocks(solution: np.ndarray, shape: tuple[int, int]) -> MarkovParameters:
    """From [G_0, ..., G_{lag-1}], channel by channel, to the record; `shape` is (channels, lag)."""
    return MarkovParameters(jnp.moveaxis(jnp.asarray(solution).reshape(*shape, -1), 1, 0))


def _check_count(readings: np.ndarray, unknowns: int) -> None:
    """K >= nbar d_u (E18)."""
    for channel, count in enumerate(np.sum(~np.isnan(readings), axis=0)):
        if count < unknowns:
            raise InputError(
                f"Channel {channel} has {count} readings with a full window of inputs, but lag times inputs makes "
                f"{unknowns} unknowns; give a longer recording or a shorter lag."
            )
