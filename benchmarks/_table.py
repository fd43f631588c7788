"""The table of what was measured: on the terminal, and as Markdown."""

from collections.abc import Iterator
from typing import Any

from rich.console import Console
from rich.table import Table

from ._results import Results
from ._row import Line

_HEADS = ("work", "against", "found", "goal", "", "symplearn", "other", "compiling", "memory", "others' load")
# Where a page of prose has the table.
_BEGIN, _END = "<!-- the table -->", "<!-- end of the table -->"
_MARKS = {True: "met", False: "MISSED", None: ""}


def lines(results: Results) -> Iterator[tuple[str, ...]]:
    """The cells of every line of every row that was measured."""
    for row in results.rows.values():
        for given in (row or {}).get("lines", []):
            line = Line(**given)
            words = (line.work, line.against, line.figure, line.goal, _MARKS[line.met])
            yield (*words, line.ours, line.other, line.compiling, line.memory, _load(row))


def _load(row: Any) -> str:
    busy = row["others_busy_cores"]
    return "?" if busy is None else f"{busy:.1f} cores"


def show(results: Results) -> None:
    """Print the table, if there is a line in it."""
    if not any(results.rows.values()):
        return
    table = Table(*_HEADS, title=None, header_style="bold", show_lines=False)
    for cells in lines(results):
        table.add_row(*cells)
    console = Console()
    # A terminal folds the cells; anything else is read by a program or an editor.
    Console(width=None if console.is_terminal else 220).print(table)


def placed(page: str, table: str) -> str:
    """The page with the table between its marks, in place of the one that was there; the table alone without marks."""
    before, begin, rest = page.partition(_BEGIN)
    _, end, after = rest.partition(_END)
    return f"{before}{begin}\n\n{table}\n{end}{after}" if begin and end else table


def markdown(results: Results) -> str:
    """The machine, and the table."""
    told: Any = results.settings["machine"]
    versions = ", ".join(f"{name} {one}" for name, one in told["versions"].items() if one)
    flags = f", `XLA_FLAGS={told['xla_flags']}`" if told["xla_flags"] else ""
    missing = [name for name, row in results.rows.items() if row is None]
    head = f"{told['card']}; " if told["card"] else ""
    head += (
        f"{told['processor']}, {told['cores']} of its cores, {told['memory_gib']} GiB, {told['system']}; "
        f"Python {told['python']}, {versions}{flags}."
    )
    if results.settings["quick"]:
        head += " A quick run: few rounds, smaller sizes."
    rows = [_HEADS, ("---",) * len(_HEADS), *lines(results)]
    table = "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |" for cells in rows)
    dates = sorted(row["date"] for row in results.rows.values() if row)
    when = f"Measured {dates[0]} to {dates[-1]}.\n\n" if dates else ""
    left_out = f"\n\nNot measured: {', '.join(missing)}." if missing else ""
    return f"{head}\n{when}{table}{left_out}\n"
