"""Long series -> the points that a picture can show."""

import numpy as np
from jaxtyping import Float, Int

BINS = 600  # about the width of a panel in pixels


def envelope(values: Float[np.ndarray, " time"], bins: int = BINS) -> Int[np.ndarray, " kept"]:
    """Indices of the least and the greatest value of each of `bins` equal stretches; all of a short series.

    They are in order. A line through them covers the same pixels. A stretch of NaN keeps one of them: a gap
    stays a gap.
    """
    rows = len(values)
    if rows <= 2 * bins:
        return np.arange(rows)
    kept = {0, rows - 1}
    for stretch in np.array_split(np.arange(rows), bins):
        part = values[stretch]
        lows, highs = np.where(np.isnan(part), np.inf, part), np.where(np.isnan(part), -np.inf, part)
        kept |= {int(stretch[lows.argmin()]), int(stretch[highs.argmax()])}
    return np.array(sorted(kept))


def evenly(rows: int, most: int = 2 * BINS) -> Int[np.ndarray, " kept"]:
    """Indices of at most `most` of the rows, evenly spread."""
    return np.linspace(0, max(rows - 1, 0), min(rows, most)).astype(int)
