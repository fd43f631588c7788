"""A diagnosis -> its files."""

import csv
import io
import json
import math
from pathlib import Path

from .._simulation_text import simulation_text
from ..diagnosis._record import Diagnosis, Forecast
from ._directory import put
from ._html import html_report

_SERIES = ("before", "before_sd", "after", "after_sd")


def write_outputs(diagnosis: Diagnosis, directory: Path) -> list[Path]:
    """Writes `diagnosis.json`, `report.html`, `augmented.toml` and, where there is one, `forecast.csv`.

    All are made before the first is written, written under temporary names, and renamed with the JSON last:
    who sees it sees the others. A forecast of an earlier run is removed where there is none now.

    **Arguments:** - `directory`: an existing folder, as `prepare_directory` returns it.

    **Returns:** the paths written, `diagnosis.json` first.

    **Raises:** `OSError` where a file cannot be written, `ValueError` where the document has a number that is
    not finite.
    """
    texts = {"augmented.toml": simulation_text(diagnosis.augmented), "report.html": html_report(diagnosis)}
    if diagnosis.forecast is not None:
        texts = {"forecast.csv": _forecast_text(diagnosis.forecast)} | texts
    texts["diagnosis.json"] = _json_text(diagnosis)
    put({directory / name: text.encode("utf-8") for name, text in texts.items()})
    if diagnosis.forecast is None:
        (directory / "forecast.csv").unlink(missing_ok=True)
    return [directory / name for name in reversed(texts)]


def _json_text(diagnosis: Diagnosis) -> str:
    """Strict JSON, in the document's own order."""
    return json.dumps(dict(diagnosis.document), indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def _forecast_text(forecast: Forecast) -> str:
    """`forecast.csv`; numbers are exact (repr), and a cell is empty where a number is not finite."""
    names = [f"{column}_{kind}" for column in forecast.columns for kind in _SERIES]
    values = [forecast.times, *(series[kind] for series in forecast.columns.values() for kind in _SERIES)]
    file = io.StringIO()
    table = csv.writer(file, lineterminator="\n")
    table.writerow(["t", *names])
    table.writerows([_cell(value) for value in row] for row in zip(*values, strict=True))
    return file.getvalue()


def _cell(value: float) -> str:
    return repr(float(value)) if math.isfinite(value) else ""
