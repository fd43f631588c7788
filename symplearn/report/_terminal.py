"""A diagnosis in a few lines for the terminal."""

from pathlib import Path

from rich.text import Text

from ..diagnosis._record import Diagnosis
from ._verdict import caution, verdict_sentence
from ._words import number, plain, ratio

_COLOURS = {"consistent": "bold green", "mismatch": "bold yellow", "unexplained": "bold red"}


def summary(diagnosis: Diagnosis, directory: Path) -> Text:
    """The finding, what it gained, what to record next, and where the report lies.

    A `Text` shows words of files as they are: markup in them means nothing. Colours vanish where the output
    is no terminal.
    """
    document, text = diagnosis.document, Text()
    colour = _COLOURS["mismatch" if document["all_rows"] else document["verdict"]]
    text.append(verdict_sentence(diagnosis) + "\n", style=colour)
    if careful := caution(document):
        text.append(careful + "\n", style="bold red")
    text.append(f"Where: {plain(document['location']['where'])}\n")
    for finding in document["findings"]:
        text.append(f"  * {plain(finding['sentence'])}\n")
    for line in _held_out(diagnosis):
        text.append(line + "\n")
    if document["next_measurement"]:
        text.append(f"Record next: {plain(document['next_measurement'])}\n")
    for warning in document["warnings"]:
        text.append(f"Warning: {plain(warning)}\n", style="yellow")
    text.append(f"Report: {plain(directory / 'report.html')}")
    return text


def _held_out(diagnosis: Diagnosis) -> list[str]:
    """One line a column: rmse before -> after, and the factor."""
    fit, lines = diagnosis.document["fit"], []
    before, after = (fit[when]["holdout_rmse"] or {} for when in ("before", "after"))
    for column, old in before.items():
        now, unit = after.get(column), plain(diagnosis.units.get(column, ""))
        if old is None:
            continue
        line = f"Held-out rmse of {plain(column)}: {number(old, 3)}"
        if diagnosis.document["verdict"] != "consistent" and now is not None:
            line += f" -> {number(now, 3)}"
            unit += f" ({ratio(old, now)} times smaller)" if 0 < now < old else ""
        lines.append(" ".join(f"{line} {unit}".split()))
    return lines
