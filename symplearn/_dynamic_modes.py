"""Dynamic mode decomposition: the linear map from each reading to the next, in closed form. Dissertation (3.7).

Theorem 3: this is the maximum likelihood of linear dynamics whose whole state is read without error.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ._counts import is_count
from ._errors import InputError
from ._inputs import EVENNESS
from ._model import LinearDynamics
from ._objectives import TimeSeries, as_recordings


def dmd(recordings: Any, *, rank: int | None = None, control: bool = False) -> LinearDynamics:
    """Dynamic mode decomposition: the A that minimises sum_k ||y_k - A y_{k-1}||^2. Dissertation (3.7).

    A = Y_{1:n} Y_{0:n-1}^+, one step per data interval. Errors of the readings pull A towards zero: see
    `total_dmd`. The readings are used as they are; subtract an offset first if they do not decay to zero.

    **Arguments:**
    - `recordings`: one recording, or a list whose pairs of neighbouring rows are pooled. A pair that touches a
      missing reading is dropped.
    - `rank`: of the leading singular directions of the earlier readings that A acts on. None means all of them. Needed
      where there are fewer independent pairs than channels.
    - `control`: learn B of A y_{k-1} + B u_{k-1} too, from the recordings' inputs (Proctor, Brunton and Kutz 2016).
      `rank` is then that of readings and inputs together.

    **Raises:** `InputError` where the times are not evenly spaced, the pairs do not determine A (and B), or recordings
    disagree in channels or inputs, and where they have inputs without `control`, or `control` without inputs.
    """
    before, after = _pairs(recordings, control)
    channels = after.shape[1]
    slopes = _least_squares(before, after, rank)
    B = jnp.asarray(slopes[:, channels:]) if control else None
    return LinearDynamics(jnp.asarray(slopes[:, :channels]), B)


def total_dmd(recordings: Any, *, rank: int | None = None) -> LinearDynamics:
    """Total dynamic mode decomposition: total least squares, for readings with errors. Hemati et al. (2017).

    The pairs are projected on the leading right singular vectors V of [Y_{0:n-1}; Y_{1:n}], then
    A = (Y_{1:n} V) (Y_{0:n-1} V)^+. Unbiased for many readings if all channels have white errors of the same variance
    (scale them so) and the dynamics is exact. With process noise neither it nor `dmd` is.

    **Arguments:** `recordings` - as for `dmd`, without inputs; `rank` - how many singular vectors, by default one for
    each channel.

    **Raises:** `InputError` as `dmd`.
    """
    before, after = _pairs(recordings, control=False)
    kept = before.shape[1] if rank is None else rank
    _require_positive(kept)
    modes = np.linalg.svd(np.hstack([before, after]), full_matrices=False)[0][:, :kept]
    return LinearDynamics(jnp.asarray(_least_squares(modes.T @ before, modes.T @ after, rank)))


def _pairs(
    recordings: Any, control: bool
) -> tuple[Float[np.ndarray, "pair regressor"], Float[np.ndarray, "pair channel"]]:
    """Earlier rows (with their inputs, if `control`) and later rows of all complete pairs of all recordings."""
    several = as_recordings(recordings)
    _check_alike(several, control)
    _check_even(several)
    earlier, later = [], []
    for series in several:
        readings = np.asarray(series.readings)
        earlier.append(np.hstack([readings, np.asarray(series.inputs)])[:-1] if control else readings[:-1])
        later.append(readings[1:])
    before, after = np.concatenate(earlier), np.concatenate(later)
    complete = np.isfinite(before).all(axis=1) & np.isfinite(after).all(axis=1)
    return before[complete], after[complete]


def _check_alike(several: tuple[TimeSeries, ...], control: bool) -> None:
    if len({series.readings.shape[1] for series in several}) > 1:
        raise InputError("The recordings have different numbers of channels; give recordings of the same channels.")
    widths = {0 if series.inputs is None else series.inputs.shape[1] for series in several}
    if len(widths) > 1:
        raise InputError("The recordings have different numbers of inputs; give recordings of the same inputs.")
    if control and widths == {0}:
        raise InputError("`control=True` learns what the inputs do, but the recordings have no inputs; leave it out.")
    if not control and widths != {0}:
        raise InputError(
            "The recordings have inputs, which this decomposition would ignore; use `dmd(..., control=True)`, or give "
            "the recordings without them."
        )


def _check_even(several: tuple[TimeSeries, ...]) -> None:
    grids = [np.linspace(series.times[0], series.times[-1], len(series.times)) for series in several]
    spacings = np.array([grid[1] - grid[0] for grid in grids])
    off = [np.max(np.abs(np.asarray(one.times) - grid)) for one, grid in zip(several, grids, strict=True)]
    # Rounding in the file is allowed, per row; a row left out is half an interval.
    if np.any(off > EVENNESS * spacings) or np.ptp(spacings) > EVENNESS * spacings.max():
        lengths = np.concatenate([np.diff(np.asarray(series.times)) for series in several])
        raise InputError(
            f"A is per data interval, so all intervals must be equal, but they last from {lengths.min():.6g} to "
            f"{lengths.max():.6g}; give rows of NaN where readings are missing, or split the recording at its gaps."
        )


def _least_squares(before: np.ndarray, after: np.ndarray, rank: int | None) -> Float[np.ndarray, "channel regressor"]:
    """The matrix M of least norm that minimises ||after - before M'||, on `rank` singular directions of `before`."""
    U, s, Vt = np.linalg.svd(before, full_matrices=False)
    largest = s[0] if s.size else 0.0
    found = int(np.sum(s > largest * max(before.shape) * np.finfo(before.dtype).eps))
    wanted = before.shape[1] if rank is None else rank
    _require_positive(wanted)
    if wanted > found:
        raise InputError(
            f"The complete pairs of readings span {found} directions, but {wanted} are needed; give more rows, or a "
            f"`rank` of at most {found}."
            if found
            else "The recordings have no complete pair of readings that are not all zero; give more rows."
        )
    return (after.T @ U[:, :wanted] / s[:wanted]) @ Vt[:wanted]


def _require_positive(rank: int) -> None:
    if not is_count(rank):
        raise InputError(f"`rank` counts singular directions and is at least 1, but is {rank}.")
