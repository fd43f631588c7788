"""The command `python -m benchmarks`."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from symplearn._errors import InputError, nearest, printable, shown

from ._machine import card
from ._results import Results, put
from ._row import Effort, Row, tell
from ._rows import ROWS, row_of
from ._table import markdown, placed, show

_STOPPED = 130


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {printable(message)}; `--help` tells what can be given\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="benchmarks", description="How fast symplearn is, against other packages on the same work.")
    parser.add_argument("names", nargs="*", metavar="NAME", help="rows to measure (all that FILE does not have yet)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="keep results here, after every row; go on from them")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the table here, between the page's marks")
    parser.add_argument("--quick", action="store_true", help="few rounds and smaller sizes")
    parser.add_argument("--full", action="store_true", help="a state of 402 numbers, too")
    parser.add_argument("--list", action="store_true", help="tell the rows and stop")
    return parser


def main(arguments: Sequence[str] | None = None) -> None:
    """The command; bad input is one sentence and exit code 2, a row that fails one sentence and exit code 1."""
    parser = _parser()
    given = parser.parse_args(arguments)
    if given.list:
        print("\n".join(f"{row.name:24}{row.about}" for row in ROWS))
        return
    effort = Effort(given.quick, given.full)
    try:
        chosen = _chosen(given.names)
        for path in filter(None, (given.json, given.markdown)):
            if not path.absolute().parent.is_dir():
                raise InputError(f"there is no folder for {shown(path)}; make it, or name another file")
        results = Results(given.json, effort)
        code = _measure([row for row in chosen if given.names or results.rows[row.name] is None], results, effort)
        show(results)
        if given.markdown:
            page = given.markdown.read_text(encoding="utf-8") if given.markdown.exists() else ""
            put(given.markdown, placed(page, markdown(results)))
    except (InputError, OSError) as error:
        parser.error(str(error).rstrip("."))
    if code == _STOPPED:
        kept = f"what was measured is in {given.json}" if given.json else "with --json FILE it would go on from here"
        print(f"{parser.prog}: stopped; {kept}", file=sys.stderr)
    sys.exit(code)


def _chosen(names: Sequence[str]) -> list[Row]:
    """The rows of these names, or all that this machine may have: those of a graphics card where there is one.

    **Raises:** `InputError` where there is no such row.
    """
    for name in names:
        if row_of(name) is None:
            raise InputError(f"there is no row {shown(name)}; {nearest(name, [row.name for row in ROWS])}")
    if names:
        return [row for row in ROWS if row.name in names]
    return [row for row in ROWS if not row.on_card or card() is not None]


def _measure(rows: Sequence[Row], results: Results, effort: Effort) -> int:
    """Measure every row that can be; the exit code."""
    _prepare()
    code = 0
    for row in rows:
        if row.missing:
            print(f"benchmarks: {row.name} needs {' and '.join(row.missing).rstrip(',')}", file=sys.stderr)
            code = max(code, 2)
            continue
        tell(f"{row.name}: {row.about}")
        try:
            results.measure(row, effort)
        except RuntimeError as error:
            print(f"benchmarks: {row.name} is not measured: {printable(str(error))[:500]}", file=sys.stderr)
            code = max(code, 1)
        except KeyboardInterrupt:
            return _STOPPED
    return code


def _prepare() -> None:
    """Double precision, and every program compiled anew."""
    import jax  # after the arguments: it takes seconds

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_enable_compilation_cache", False)
