"""A recording laid out for stepping: thinned rows, spans between them, inputs averaged over every substep."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ._augmented_flow import Span
from ._thinning import Thinned, thin, thinning_width

# A gap this much wider than the usual one is bridged by rows without readings, so that one substep fits all spans.
_WIDE = 1.5
# Pieces of the time before a row of which it is told the inputs' means.
_PIECES = 20
# Fitted rows of one recording beyond which the first ones are left out; the last ones lead up to the held-out part.
_LONGEST = 15_000


@runtime_checkable
class HasRows(Protocol):
    """What is asked of a recording: times (n,), readings (n, m) with NaN for missing, inputs or None."""

    @property
    def times(self) -> np.ndarray: ...
    @property
    def readings(self) -> np.ndarray: ...
    @property
    def inputs(self) -> Any: ...


@dataclass(frozen=True)
class Rows:
    """One recording ready to be stepped through.

    `readings` (n, m) are NaN where there is none; `counts` (n, m) tell how many original readings each one averages.
    The first `fitted` rows are for fitting, the others are held out. `spans` has n - 1 entries. `inputs` are what is
    known of the inputs at each row, as `known_inputs` has them.
    """

    times: Float[np.ndarray, " time"]
    readings: Float[np.ndarray, "time channel"]
    counts: Float[np.ndarray, "time channel"]
    spans: Span
    inputs: Float[np.ndarray, "time known"]
    fitted: int
    given: int  # rows before thinning
    used: int  # rows after thinning, without those that bridge gaps
    boundary: float  # time of the last fitted row of the recording

    @property
    def contexts(self) -> tuple[Any, Any]:
        """What the observation is given besides the state, row by row."""
        return jnp.asarray(self.times), jnp.asarray(self.inputs)


def lay_out(
    recordings: Sequence[HasRows], holdout: float, width: float, substep: float, is_begun: bool = True,
    past: float | None = None,
) -> list[Rows]:  # fmt: skip
    """Thin recordings into bins of `width`, split off the held-out parts, and lay spans of at most `substep`.

    All recordings get the same number of substeps per span, so that one compiled function serves them all. Where the
    state at the first row is known (`is_begun`), that row stays as it is; where not, the first rows of a recording that
    holds more than can be fitted in minutes, even after thinning, are left out. Every row knows the inputs of the time
    `past` before it, which a sensor that is late shows.
    """
    thinned = [_thinned(recording, holdout, width, is_begun) for recording in recordings]
    pieces = max(math.ceil(np.median(np.diff(rows.times)) / substep - 1e-9) for rows, _ in thinned)
    return [
        _one(recording, rows, first, max(1, pieces), holdout, past)
        for recording, (rows, first) in zip(recordings, thinned, strict=True)
    ]


def fitted_count(n: int, holdout: float) -> int:
    """How many of so many rows are fitted."""
    return max(n - math.floor(n * holdout + 1e-9), 2)


def _thinned(recording: HasRows, holdout: float, width: float, is_begun: bool) -> tuple[Thinned, int]:
    """Fitted and held-out rows thinned apart, end to end, and how many of them are fitted."""
    n = len(recording.times)
    keep = fitted_count(n, holdout)
    begin = [0, 1, keep] if is_begun else [0, keep]
    parts = [thin(recording.times[a:b], recording.readings[a:b], width) for a, b in pairwise([*begin, n]) if b > a]
    fitted = sum(len(part.times) for part in parts[: len(begin) - 1])
    late = 0 if is_begun else max(0, fitted - _LONGEST)
    joined = (np.concatenate([getattr(part, f) for part in parts])[late:] for f in ("times", "readings", "counts"))
    return Thinned(*joined), fitted - late


def _one(
    recording: HasRows, rows: Thinned, first: int, pieces: int, holdout: float, past: float | None
) -> Rows:  # fmt: skip
    places, times = _bridged(rows.times, float(np.median(np.diff(rows.times))))
    readings, counts = (np.full((len(times), rows.readings.shape[1]), fill) for fill in (np.nan, 0.0))
    readings[places], counts[places] = rows.readings, rows.counts
    return Rows(
        times=times,
        readings=readings,
        counts=counts,
        spans=spans_between(times, pieces, recording.inputs),
        inputs=known_inputs(recording.inputs, times, past),
        fitted=int(places[first - 1]) + 1,
        given=len(recording.times),
        used=len(rows.times),
        boundary=float(recording.times[fitted_count(len(recording.times), holdout) - 1]),
    )


def bin_width(recordings: Sequence[HasRows]) -> float:
    """One width for all recordings: the narrowest that any of them that needs thinning asks for; 0 for none."""
    widths = [thinning_width(r.times, r.readings) for r in recordings]
    return min((w for w in widths if w > 0), default=0.0)


def _bridged(times: np.ndarray, usual: float) -> tuple[Int[np.ndarray, " row"], np.ndarray]:
    """Times with wide gaps filled, and where the rows stand in them."""
    pieces = np.maximum(1, np.ceil(np.diff(times) / (_WIDE * usual) - 1e-9)).astype(int)
    places = np.concatenate([[0], np.cumsum(pieces)])
    return places, np.interp(np.arange(places[-1] + 1), places, times)


def spans_between(times: Float[np.ndarray, " time"], pieces: int, inputs: Any) -> Span:
    """Spans of `pieces` substeps between consecutive times. `InputError` where inputs are not known that far."""
    step = np.diff(times) / pieces
    edges = times[:-1, None] + step[:, None] * np.arange(pieces + 1)
    if inputs is None:
        values = np.zeros((len(step), 1, 0))
    else:
        flat = inputs.mean_over(edges[:, :-1].ravel(), edges[:, 1:].ravel())
        values = flat.reshape(len(step), pieces, -1)
    return Span(
        jnp.asarray(times[:-1]), jnp.asarray(step), jnp.asarray(values), jnp.asarray(np.full(len(step), pieces))
    )


def known_inputs(inputs: Any, times: Float[np.ndarray, " time"], past: float | None) -> Float[np.ndarray, "time known"]:
    """What a row knows of the inputs: how they stand, and of the time before, over `past`, the length of each of twenty
    pieces of it and their means in them, the latest first. Before they are known they stand as they begin."""
    if inputs is None:
        return np.zeros((len(times), 0))
    now = np.asarray(inputs.at(times))
    if past is None:
        return now
    edges = np.maximum(times[:, None] - past / _PIECES * np.arange(_PIECES + 1), min(inputs.times[0], times[0]))
    means = inputs.mean_over(edges[:, 1:].ravel(), edges[:, :-1].ravel())
    return np.concatenate([now, np.full((len(times), 1), past / _PIECES), means.reshape(len(times), -1)], axis=1)


def past_of(known: Float[np.ndarray, "time known"], inputs: int) -> float | None:
    """Over which time before it a row knows its inputs; None where it does not."""
    return float(_PIECES * known[0, inputs]) if known.shape[1] > inputs else None
