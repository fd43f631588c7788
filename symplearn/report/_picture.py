"""One before-and-after picture as a file."""

from pathlib import Path

from matplotlib.figure import Figure

from ..diagnosis._record import Diagnosis
from ._directory import put
from ._motion import Channel, channel, close_up, overview
from ._panel import render


def before_after_picture(diagnosis: Diagnosis, path: Path, column: str | None = None) -> Path:
    """Writes a PNG of 900 x 420 pixels: the first recording as a whole, and its held-out part from close.

    **Arguments:** - `column`: which observed column; the first by default.

    **Raises:** `ValueError` where there is no such column, or no recording.
    """
    column = diagnosis.columns[0] if column is None else column
    if column not in diagnosis.columns or not diagnosis.series:
        known = ", ".join(diagnosis.columns)
        raise ValueError(f"no picture of {column!r}: expected a recorded column, one of {known}")
    one = channel(diagnosis, diagnosis.series[0], column)
    png = render(lambda figure: _draw(figure, one), (9.0, 4.2), dpi=100)
    put({Path(path): png})
    return Path(path)


def _draw(figure: Figure, one: Channel) -> None:
    whole, near = figure.subplots(1, 2, width_ratios=(3, 2))
    overview(whole, one)
    close_up(near, one)
    near.get_legend().remove()
    near.set_ylabel("")
    near.set_title("held-out rows, from close" if one.held_out else "from close", fontsize=9, loc="left")
