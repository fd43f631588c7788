"""The readings to come, with two standard deviations."""

import numpy as np
from matplotlib.axes import Axes

from ..diagnosis._record import Diagnosis, Forecast
from ._decimate import evenly
from ._palette import AFTER, BEFORE
from ._panel import Panel, labels, legend, limits, line, panel, with_unit
from ._units import time_unit


def forecast_panels(diagnosis: Diagnosis, columns: tuple[str, ...]) -> list[Panel]:
    """One picture a column; none without a forecast."""
    forecast = diagnosis.forecast
    if forecast is None or not forecast.times.size:
        return []
    return [_column(diagnosis, forecast, name) for name in columns if name in forecast.columns]


def _column(diagnosis: Diagnosis, forecast: Forecast, column: str) -> Panel:
    return panel(lambda axes: _draw(axes, diagnosis, forecast, column), f"Forecast: {column}")


def _draw(axes: Axes, diagnosis: Diagnosis, forecast: Forecast, column: str) -> None:
    t, series = forecast.times, forecast.columns[column]
    axes.set_ylim(limits(series["after"], series["before"], series["after"] + 2 * series["after_sd"]))
    shown = [("before", BEFORE), ("after", AFTER)]
    for kind, colour in shown if diagnosis.document["verdict"] != "consistent" else shown[:1]:
        mean, spread = series[kind], 2 * series[f"{kind}_sd"]
        some = evenly(len(t), 2000)
        low, high = axes.get_ylim()
        band = np.clip([mean - spread, mean + spread], 2 * low - high, 2 * high - low)[:, some]
        axes.fill_between(t[some], *band, color=colour, alpha=0.18, linewidth=0)
        line(axes, t, mean, color=colour, linewidth=1.2, label=f"{kind}, two sd shaded")
    labels(axes, with_unit("time", time_unit(diagnosis)), with_unit(column, diagnosis.units.get(column)))
    legend(axes, columns=2)
