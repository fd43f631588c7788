"""What makes recordings unusable, each told in one sentence."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np

from ._errors import InputError, shown
from ._simulation_records import SimulationFile


@runtime_checkable
class _Rows(Protocol):
    """What is looked at of a recording."""

    @property
    def name(self) -> str: ...
    @property
    def readings(self) -> np.ndarray: ...


def check_times(times: np.ndarray, lines: np.ndarray, column: str, name: str) -> None:
    """Times are given and strictly increasing."""
    missing = np.isnan(times)
    if missing.any():
        line = lines[np.argmax(missing)]
        raise InputError(f"{name}, line {line}, column {shown(column)}: the time is missing; give a time in every row")
    late = np.diff(times) <= 0
    if late.any():
        row = int(np.argmax(late)) + 1
        what = "repeats" if times[row] == times[row - 1] else "goes back"
        raise InputError(
            f"{name}, line {lines[row]}, column {shown(column)}: the time {what} "
            f"({float(times[row])!r} after {float(times[row - 1])!r}); "
            "times must increase within a recording (`group` tells recordings in one file apart)"
        )


def check_recordings(simulation: SimulationFile, recordings: Sequence[_Rows]) -> None:
    """There is enough in the recordings to learn from."""
    _check_numbers(simulation, len(recordings))
    _check_missing(simulation, recordings)
    _check_rows(simulation, recordings)
    if not any(_moves(r.readings) for r in recordings):
        told = ", ".join(map(shown, simulation.recording.observe))
        raise InputError(
            f"{_names(recordings)}: nothing moves, every reading of {told} is constant; give a recording of a motion"
        )


def _names(recordings: Sequence[_Rows]) -> str:
    others = len(recordings) - 1
    return recordings[0].name + (f" and {others} more" if others else "")


def _check_rows(simulation: SimulationFile, recordings: Sequence[_Rows]) -> None:
    rows = sum(int(np.isfinite(r.readings).any(axis=1).sum()) for r in recordings)
    unknown = simulation.unknowns + simulation.unknown_states * len(recordings)
    if rows < max(unknown, 1):
        raise InputError(
            f"{_names(recordings)}: {rows} rows with readings are used, but {simulation.name} leaves "
            f"{unknown} numbers unknown ({simulation.unknowns} parameters, {unknown - simulation.unknowns} "
            "initial states); give more rows"
        )


def _check_numbers(simulation: SimulationFile, count: int) -> None:
    for place, term in enumerate(simulation.terms, start=1):
        beyond = max(term.recordings or (0,))
        if beyond > count:
            raise InputError(
                f"{simulation.name}, [[terms]] {place} recordings: there is no recording {beyond}; "
                f"the recordings given are numbered 1 to {count}"
            )


def _check_missing(simulation: SimulationFile, recordings: Sequence[_Rows]) -> None:
    for i, column in enumerate(simulation.recording.observe):
        if not any(np.isfinite(r.readings[:, i]).any() for r in recordings):
            raise InputError(
                f"{_names(recordings)}, column {shown(column)}: all readings are missing; "
                "give readings or take it out of [recording.observe]"
            )


def _moves(readings: np.ndarray) -> bool:
    """Whether any column takes two values."""
    return any(len(seen) > 0 and seen.min() < seen.max() for seen in (c[np.isfinite(c)] for c in readings.T))
