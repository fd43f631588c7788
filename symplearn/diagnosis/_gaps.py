"""Fits across gaps in which the motion goes round often.

What the rows before a gap leave open of the motion's pace may be several swings behind it, and a fit that goes on with
the rows there is caught at the swing that is nearest. So many are drawn of what the rows before leave open, and those
go on that follow the next rows best.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from ._calibrate import calibrate
from ._drawn import around
from ._problem import Combination, Problem
from ._score import Start
from ._start import likelihood, ranked
from ._weigher import Weigher

# Rows that were left empty one after the other, as many as make a gap.
_LONG = 10
# Draws, and those that are fitted.
_DRAWN, _KEPT = 128, 8
# Rows behind a gap that draws are to follow; the share of the readings' spread by which draws scatter there from which
# on they may be swings apart.
_NEXT, _OPEN = 16, 0.3
_STEPS = 20


def across_gaps(weigher: Weigher, combination: Combination) -> Start | None:
    """Where a fit of a combination begins that was found gap by gap, None where no gap leaves a swing open."""
    problem, white = weigher.problem, weigher.found.of(combination, "white")
    if white is None or not np.isfinite(white.log_evidence):
        return None
    z, is_open = white.z, False
    for r, end, begin, later in _gaps(problem, weigher.rows):
        rows = [end if k == r else n for k, n in enumerate(weigher.rows)]
        before = calibrate(weigher.stepper, z[None], [combination], weigher.found.priors, rows, _STEPS)
        drawn = around(problem, before, np.zeros(1, int), weigher.found.priors, rows, _DRAWN)
        more = [min(begin + _NEXT, later) if k == r else n for k, n in enumerate(weigher.rows)]
        predictions = weigher.stepper.predict(drawn, [combination] * len(drawn), more)
        if not _scatter(problem, r, weigher.rows[r], predictions[r].readings[:, begin : more[r]]) > _OPEN:
            continue
        is_open = True
        misfit = sum(value for _, value in ranked(problem, predictions, more))
        some = drawn[np.argsort(misfit)[:_KEPT]]
        # As far as to the next gap: beyond it swings are open again.
        window = [later if k == r else n for k, n in enumerate(weigher.rows)]
        for part in (more, window):
            fits = calibrate(weigher.stepper, some, [combination] * len(some), weigher.found.priors, part, _STEPS)
            some = fits.z
        z = fits.z[likelihood(problem, fits, window).argmin()]
    return Start(combination, z, 0.0) if is_open else None


def _scatter(problem: Problem, r: int, rows: int, behind: Float[np.ndarray, "lane row channel"]) -> float:
    """How far draws that stay finite lie apart, by the spread of what was read of a recording; the most of any
    column."""
    some, found = behind[np.isfinite(behind).all((1, 2))], [0.0]
    for j, column in enumerate(problem.rows[r].readings[:rows].T):
        spread = float(np.std(column[np.isfinite(column)])) if np.isfinite(column).any() else 0.0
        if spread > 0 and len(some) > 1:
            found.append(float(np.std(some[..., j], axis=0).max()) / spread)
    return max(found)


def _gaps(problem: Problem, rows: list[int]) -> Iterator[tuple[int, int, int, int]]:
    """Recordings with the rows at which a gap begins and ends, and at which the next one begins."""
    for r, (one, n) in enumerate(zip(problem.rows, rows, strict=True)):
        seen = np.flatnonzero((one.counts[:n] > 0).any(1))
        wide = np.flatnonzero(np.diff(seen) > _LONG)
        ends = [*(int(seen[k]) + 1 for k in wide), n]
        for k, (end, later) in zip(wide, zip(ends[:-1], ends[1:], strict=True), strict=True):
            yield r, end, int(seen[k + 1]), later
