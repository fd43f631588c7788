"""The pictures of a report, plate by plate."""

from dataclasses import dataclass

from ..diagnosis._record import Diagnosis
from ._force import energy_panels, force_panels, missing
from ._forecast_panel import forecast_panels
from ._motion import channel, motion_panels
from ._panel import Panel

RECORDINGS, COLUMNS, COORDINATES = 6, 3, 3  # most that are drawn
_COLUMNS_LATER = 2  # of the second recording and those after it


@dataclass(frozen=True)
class Plate:
    """Pictures that belong together, with what they show."""

    heading: str
    caption: str
    panels: tuple[Panel, ...]


def plates(diagnosis: Diagnosis) -> list[Plate]:
    """Readings and simulation by recording and column, then forces, energy and forecast; none is empty."""
    drawn = [_motion(diagnosis, i, column) for i, column in _drawn_motions(diagnosis)]
    if diagnosis.series:
        drawn += [_forces(diagnosis, q) for q in diagnosis.coordinates[:COORDINATES]]
        drawn.append(_energy(diagnosis))
    drawn.append(Plate("Forecast", _FORECAST, tuple(forecast_panels(diagnosis, diagnosis.columns[:COLUMNS]))))
    return [plate for plate in drawn if plate.panels]


def not_drawn(diagnosis: Diagnosis) -> list[str]:
    """What the limits left without a picture, in sentences."""
    notes = []
    if (count := len(diagnosis.series)) > RECORDINGS:
        notes.append(f"Pictures are of the first {RECORDINGS} of {count} recordings.")
    if (count := len(diagnosis.columns)) > COLUMNS:
        notes.append(f"Pictures are of the first {COLUMNS} of {count} columns.")
    if len(diagnosis.series) > 1 and len(diagnosis.columns) > _COLUMNS_LATER:
        notes.append(f"From the second recording on, only the first {_COLUMNS_LATER} columns are drawn.")
    if (count := len(diagnosis.coordinates)) > COORDINATES:
        notes.append(f"Forces are drawn for the first {COORDINATES} of {count} coordinates.")
    return notes


_MOTION = (
    "The lines are fitted to the rows before the shaded part; in it they run freely from the last fitted row "
    "and never look at a reading. A line that leaves the readings by far is cut at the edge."
)
_ALL_FITTED = "The lines are fitted to all rows: none was kept from the fits."
_FORCES = (
    "The force that the readings ask for beyond the equations of motion, estimated along the fitted rows. "
    "What is a law of speed is a curve against velocity; what is a law of place, against position."
)
_ENERGY = "The Hamiltonian along the motion. Where no force is known or left out, it is constant."
_FORECAST = "Expected readings after the last observed row, without reading noise."


def _drawn_motions(diagnosis: Diagnosis) -> list[tuple[int, str]]:
    return [
        (i, column)
        for i, series in enumerate(diagnosis.series[:RECORDINGS])
        if series.times.size
        for column in diagnosis.columns[: COLUMNS if i == 0 else _COLUMNS_LATER]
    ]


def _motion(diagnosis: Diagnosis, i: int, column: str) -> Plate:
    series = diagnosis.series[i]
    several = len(diagnosis.series) > 1
    heading = f"{column}, recording {i + 1} ({series.name})" if several else column
    one = channel(diagnosis, series, column)
    panels = motion_panels(one, detail=i == 0)
    first = i == 0 and column == diagnosis.columns[0]
    return Plate(heading, (_MOTION if one.held_out else _ALL_FITTED) if first else "", tuple(panels))


def _told(diagnosis: Diagnosis) -> tuple[int, str]:
    """The first recording that something is missing in, counted from 1, and how a heading says so among several."""
    number = min(diagnosis.document["location"]["recordings"], default=1)
    return number, f" in recording {number}" if len(diagnosis.series) > 1 else ""


def _forces(diagnosis: Diagnosis, coordinate: str) -> Plate:
    number, where = _told(diagnosis)
    one = missing(diagnosis, diagnosis.series[number - 1], number, coordinate)
    return Plate(f"Missing force on {coordinate}{where}", _FORCES, tuple(force_panels(one, coordinate)))


def _energy(diagnosis: Diagnosis) -> Plate:
    number, where = _told(diagnosis)
    return Plate(f"Energy{where}", _ENERGY, tuple(energy_panels(diagnosis, diagnosis.series[number - 1])))
