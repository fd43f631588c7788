"""Recordings: what was measured, when, and with which inputs (contract, section 2)."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ._csv_columns import Columns, matches, read_columns
from ._errors import InputError, nearest, shown
from ._inputs import Inputs
from ._recording_checks import check_recordings, check_times
from ._simulation_records import SimulationFile


@dataclass(frozen=True, eq=False)
class Recording:
    """The used rows of one recording.

    **Fields:**

    - `number`: counted from 1 over all files and groups.
    - `name`: file and group, for sentences.
    - `times`: `(n,)`, strictly increasing.
    - `readings`: `(n, m)`, in the order of `columns`; NaN where a reading is missing. Rows after the last
        reading are not among the used ones.
    - `lines`: `(n,)`, lines of the file, counted from 1.
    - `inputs`: of all rows of the recording that have them, used or not; `None` without input columns.
    """

    number: int
    name: str
    columns: tuple[str, ...]
    times: np.ndarray
    readings: np.ndarray
    lines: np.ndarray
    inputs: Inputs | None = None

    def __repr__(self) -> str:
        return (
            f"Recording {self.number}: {self.name}, {len(self.times)} rows "
            f"from {self.times[0]:g} to {self.times[-1]:g}, readings of {', '.join(self.columns)}"
        )


def read_recordings(simulation: SimulationFile, paths: str | Path | Sequence[str | Path]) -> list[Recording]:
    """The recordings of the CSV files `paths`, or of one: files in the order given, then groups in the order met.

    **Raises** `InputError` in one sentence naming file, line and column.
    """
    paths = [paths] if isinstance(paths, str | Path) else paths
    if not paths:
        raise InputError(f"{simulation.name}: no recording was given; give at least one CSV file")
    plain = [Path(path).name for path in paths]
    names = [str(path) if plain.count(name) > 1 else name for path, name in zip(paths, plain, strict=True)]
    parts = [part for path, name in zip(paths, names, strict=True) for part in _parts(simulation, path, name)]
    _check_bounds(simulation, paths, parts)
    recordings = [_recording(simulation, part, number) for number, part in enumerate(parts, start=1)]
    check_recordings(simulation, recordings)
    return recordings


@dataclass(frozen=True)
class _Part:
    """All rows of one recording in one file."""

    name: str
    group: tuple[str, ...]
    columns: Columns
    rows: np.ndarray


def _parts(simulation: SimulationFile, path: str | Path, called: str) -> Iterator[_Part]:
    section = simulation.recording
    numbers = [section.time, *section.observe, *section.inputs]
    columns = read_columns(path, numbers=numbers, texts=section.group, where=section.where)
    name = shown(called, 200)[1:-1]
    if len(columns.lines) == 0:
        wanted = ", ".join(f"{column} = {value}" for column, value in section.where.items())
        advice = f"none has {shown(wanted)}; correct `where`" if wanted else "give rows of numbers below the header"
        raise InputError(f"{name}: has no rows that are used; {advice}")
    for group, rows in _groups(section.group, columns, name):
        told = ", ".join(f"{column} {value}" for column, value in zip(section.group, group, strict=True))
        yield _Part(f"{name} ({shown(told, 80)[1:-1]})" if told else name, group, columns, rows)


def _groups(names: Sequence[str], columns: Columns, file: str) -> Iterator[tuple[tuple[str, ...], np.ndarray]]:
    """Group values in the order met, with the rows of each."""
    if not names:
        yield (), np.arange(len(columns.lines))
        return
    cells = list(zip(*(columns.texts[name] for name in names), strict=True))
    codes: dict[tuple[str, ...], int] = {}
    of_row = np.array([codes.setdefault(cell, len(codes)) for cell in cells])
    for group, code in codes.items():
        rows = np.flatnonzero(of_row == code)
        empty = next((name for name, cell in zip(names, group, strict=True) if cell.lower() in ("", "nan")), None)
        if empty is not None:
            raise InputError(
                f"{file}, line {columns.lines[rows[0]]}, column {shown(empty)}: no group is given; every row needs one"
            )
        yield group, rows


def _spellings(group: tuple[str, ...]) -> list[str]:
    """How the value of several group columns may be written as a key of `start` and `end`."""
    return list(dict.fromkeys(separator.join(group) for separator in (", ", ",", " ", "/", "_", "-")))


def _bound(bound: float | Mapping[str, float] | None, group: tuple[str, ...], default: float) -> float:
    if not isinstance(bound, Mapping):
        return default if bound is None else bound
    exact = [bound[s] for s in _spellings(group) if s in bound]
    alike = [value for key, value in bound.items() if len(group) == 1 and matches(group[0], key)]
    return (exact + alike + [default])[0]


def _check_bounds(simulation: SimulationFile, paths: Sequence[str | Path], parts: Sequence[_Part]) -> None:
    """Every group value of a `start` or `end` table is met in some file, if only in rows that `where` leaves out."""
    bounds = [(key, getattr(simulation.recording, key)) for key in ("start", "end")]
    given = [(key, value) for key, bound in bounds if isinstance(bound, Mapping) for value in bound]
    met = [part.group for part in parts]
    unmet = [one for one in given if not _is_met(one[1], met)]
    beside = _left_out(simulation, paths) if unmet else set()
    for key, value in unmet:
        if not _is_met(value, beside):
            known = dict.fromkeys(", ".join(group) for group in met)
            raise InputError(
                f"{simulation.name}, [recording] {key}: no group has the value {shown(value)}; {nearest(value, known)}"
            )


def _is_met(value: str, groups: Iterable[tuple[str, ...]]) -> bool:
    return not all(np.isnan(_bound({value: 0.0}, group, np.nan)) for group in groups)


def _left_out(simulation: SimulationFile, paths: Sequence[str | Path]) -> set[tuple[str, ...]]:
    """Group values of all rows, where `where` leaves some out; the files are read once more for them."""
    section = simulation.recording
    if not section.where:
        return set()
    every = [read_columns(path, numbers=(), texts=section.group).texts for path in paths]
    return {cells for texts in every for cells in zip(*(texts[name] for name in section.group), strict=True)}


def _recording(simulation: SimulationFile, part: _Part, number: int) -> Recording:
    section, rows, columns = simulation.recording, part.rows, part.columns
    times, lines = columns.numbers[section.time][rows], columns.lines[rows]
    check_times(times, lines, section.time, part.name)
    readings = np.stack([columns.numbers[column][rows] for column in section.observe], axis=1)
    start = _bound(section.start, part.group, -np.inf)
    end = _bound(section.end, part.group, np.inf)
    used = _used(times, readings, start, end, part.name)
    return Recording(
        number=number,
        name=part.name,
        columns=tuple(section.observe),
        times=times[used],
        readings=readings[used],
        lines=lines[used],
        inputs=_inputs(simulation, part, times, used),
    )


def _used(times: np.ndarray, readings: np.ndarray, start: float, end: float, name: str) -> slice:
    """Rows from start to end, up to the last one with a reading: rows beyond it only carry inputs."""
    inside = np.flatnonzero((times >= start) & (times <= end))
    if len(inside) == 0:
        raise InputError(
            f"{name}: no row lies between start = {start:g} and end = {end:g}; "
            f"its times run from {times[0]:.10g} to {times[-1]:.10g}"
        )
    seen = inside[np.isfinite(readings[inside]).any(axis=1)]
    if len(seen) == 0:
        raise InputError(
            f"{name}: all readings of the rows used are missing; give rows with readings, or correct start and end"
        )
    return slice(inside[0], seen[-1] + 1)


def _inputs(simulation: SimulationFile, part: _Part, times: np.ndarray, used: slice) -> Inputs | None:
    section = simulation.recording
    if not section.inputs:
        return None
    values = np.stack([part.columns.numbers[name][part.rows] for name in section.inputs], axis=1)
    missing = np.isnan(values)
    if missing[used].any():
        row, column = np.argwhere(missing[used])[0]
        line = part.columns.lines[part.rows][used][row]
        raise InputError(
            f"{part.name}, line {line}, column {shown(section.inputs[column])}: the input is missing; "
            "give inputs in every row used"
        )
    known = ~missing.any(axis=1)
    return Inputs(times[known], values[known], section.interpolation, part.name, times[~known])
