"""One picture: its look, its labels and limits, and its bytes."""

import base64
import io
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from ._decimate import envelope, evenly
from ._palette import AFTER, BEFORE, GRID, in_palette
from ._words import plain

STYLE: dict[Any, Any] = {
    "text.usetex": False,
    "text.parse_math": False,  # a dollar sign of a file is a dollar sign
    "legend.markerscale": 2.0,
    "axes.xmargin": 0.01,
    "font.family": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": GRID,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
}
_LARGEST = 1e300  # beyond it, differences overflow


@dataclass(frozen=True)
class Panel:
    """A finished picture with the words for who cannot see it."""

    alt: str
    png: bytes

    @property
    def uri(self) -> str:
        """The picture as an address that holds it."""
        return "data:image/png;base64," + base64.b64encode(self.png).decode("ascii")


def panel(draw: Callable[[Axes], None], alt: str) -> Panel:
    """The picture that `draw` makes of empty axes, 480 x 300 pixels at 1.6 times their density."""
    return Panel(alt, render(lambda figure: draw(figure.add_subplot()), (4.8, 3.0), dpi=160))


def render(draw: Callable[[Figure], None], size: tuple[float, float], dpi: int) -> bytes:
    """PNG of a figure."""
    with matplotlib.rc_context(STYLE), warnings.catch_warnings():
        # A name of a file may hold letters that the font has not.
        warnings.filterwarnings("ignore", message="Glyph .* missing")
        figure = Figure(figsize=size, dpi=dpi, layout="constrained")
        canvas = FigureCanvasAgg(figure)
        draw(figure)
        canvas.draw()
        if any([_factor_beside_its_label(axes) for axes in figure.axes]):
            canvas.draw()
        image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    file = io.BytesIO()
    in_palette(image).save(file, "PNG")
    return file.getvalue()


def _factor_beside_its_label(axes: Axes) -> bool:
    """Move the common factor of the vertical axis, which only drawing finds, from where the legend is to the label."""
    factor = axes.yaxis.get_offset_text()
    if not (text := factor.get_text()):
        return False
    axes.set_ylabel(f"{axes.get_ylabel()} × {text}")
    factor.set_visible(False)
    return True


def labels(axes: Axes, x: str, y: str) -> None:
    """Axis labels."""
    axes.set_xlabel(x)
    axes.set_ylabel(y)


def with_unit(name: str, unit: str | None) -> str:
    """`name [unit]`, cut to what fits beside an axis."""
    name, unit = plain(name), plain(unit or "")
    name = name if len(name) <= 32 else name[:31] + "…"
    return f"{name} [{unit[:16]}]" if unit else name


def legend(axes: Axes, columns: int = 3) -> None:
    """The legend above the axes, where it hides nothing."""
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=columns, borderaxespad=0.2, handlelength=1.6)


def first_look(changed: bool) -> dict[str, Any]:
    """Colour and label of `before`; where nothing was added it is just the simulation."""
    return {"color": BEFORE, "label": "before"} if changed else {"color": AFTER, "label": "simulation"}


def limits(
    anchor: Float[np.ndarray, "..."], *others: Float[np.ndarray, "..."], most: float = 1.0
) -> tuple[float, float]:
    """The range of `anchor`, widened for `others` by no more than `most` times its own size.

    A simulation that diverges then flattens nothing.
    """
    values = finite(anchor)
    if not values.size:
        values = np.concatenate([finite(o) for o in others] + [np.zeros(1)])
    low, high = float(values.min()), float(values.max())
    size = (high - low) or abs(high) or 1.0
    room = most * size
    near = np.concatenate([np.clip(finite(o), low - room, high + room) for o in others] + [values])
    low, high = float(near.min()), float(near.max())
    margin = 0.06 * ((high - low) or size)
    return low - margin, high + margin


def finite(values: Float[np.ndarray, "..."]) -> Float[np.ndarray, " kept"]:
    """The finite values, in one row."""
    return values[np.abs(np.nan_to_num(values, nan=np.inf)) < _LARGEST]


def line(axes: Axes, t: Float[np.ndarray, " time"], y: Float[np.ndarray, " time"], **look: Any) -> None:
    """A line of any length. It is clipped a little outside the limits, which are set before."""
    low, high = axes.get_ylim()
    kept = envelope(y)
    inside = np.clip(y[kept], low - (high - low), high + (high - low))
    axes.plot(t[kept], inside, **look)


def dots(axes: Axes, t: Float[np.ndarray, " time"], y: Float[np.ndarray, " time"], **look: Any) -> None:
    """Readings, smaller where there are many; of a long series a part, evenly spread, and the extremes."""
    read = np.abs(np.nan_to_num(y, nan=np.inf)) < _LARGEST
    t, y = t[read], y[read]
    # The envelope alone would leave the middle of a noisy band empty.
    kept = np.union1d(evenly(len(y), 5000), envelope(y, 100)) if len(y) > 5000 else np.arange(len(y))
    size = 3.0 if len(kept) < 150 else 2.4 if len(kept) < 500 else 1.6
    axes.plot(t[kept], y[kept], linestyle="none", marker="o", markersize=size, markeredgewidth=0, **look)
