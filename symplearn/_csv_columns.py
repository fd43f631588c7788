"""Columns of a CSV file, read strictly and in chunks.

No word but the empty cell and `nan` means missing, `#` is a comment only where the line starts with it,
and no path or address is handed to a library that might follow it.
"""

import csv
import gzip
import io
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from operator import itemgetter
from pathlib import Path

import numpy as np

from ._errors import InputError, nearest, shown

_LONGEST_LINE = 1_000_000  # characters
_MOST_ROWS = 20_000_000
_CHUNK = 2_000  # rows at once; with many more the garbage collector takes most of the time
_GZIP = "\x1f\udc8b"  # as it begins, its second byte being no UTF-8
_NUMERIC = frozenset("0123456789+-.eE \t")


@dataclass(frozen=True)
class Columns:
    """The used columns of one file, each `(rows,)`; NaN in `numbers` is a missing value."""

    numbers: Mapping[str, np.ndarray]
    texts: Mapping[str, np.ndarray]
    lines: np.ndarray  # line of the file, counted from 1


def read_columns(
    path: str | Path,
    *,
    numbers: Sequence[str],
    texts: Sequence[str] = (),
    where: Mapping[str, str | float] | None = None,
) -> Columns:
    """The named columns of the CSV file (`.gz`: compressed) at `path`.

    **Arguments:**

    - `numbers`: columns of numbers; an empty cell and `nan` (any case) are NaN.
    - `texts`: columns kept as text, stripped.
    - `where`: only rows with these values are read; a number matches a cell of equal value.

    **Raises** `InputError` naming file, line and column.
    """
    name = shown(path, 200)[1:-1]
    try:
        reader = _Reader(name, numbers, texts, where or {})
        with _opened(path) as stream:
            return reader.columns(stream)
    except csv.Error as error:
        raise InputError(
            f"{name}, line {reader.line}: is not CSV ({error}); give cells with commas between them"
        ) from None
    except IsADirectoryError:
        raise InputError(f"{name}: is a directory; give the recording (CSV) itself") from None
    except FileNotFoundError:
        raise InputError(f"{name}: no such file; give the path of a recording (CSV)") from None
    except (gzip.BadGzipFile, EOFError, zlib.error):
        raise InputError(f"{name}: is not a complete gzip file; compress it again or give the CSV itself") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{name}: cannot be read ({reason}); give the path of a recording (CSV)") from None


def _opened(path: str | Path) -> io.TextIOWrapper:
    # Foreign bytes outside the used columns do no harm, so they are carried along instead of refused.
    binary = gzip.open(path, "rb") if str(path).endswith(".gz") else open(path, "rb")
    return io.TextIOWrapper(binary, encoding="utf-8-sig", errors="surrogateescape", newline="")


class _Reader:
    """Reads one file."""

    def __init__(self, name: str, numbers: Sequence[str], texts: Sequence[str], where: Mapping[str, str | float]):
        self.name, self.where = name, where
        self.numbers, self.texts = list(dict.fromkeys(numbers)), list(dict.fromkeys(texts))
        self.line = 0

    def columns(self, stream: io.TextIOWrapper) -> Columns:
        rows = csv.reader(self.lines(stream), strict=True, skipinitialspace=True)
        header = self.header(rows)
        index = {name: header.index(name) for name in [*self.numbers, *self.texts, *self.where]}
        numbers: dict[str, list[np.ndarray]] = {name: [] for name in self.numbers}
        texts: dict[str, list[np.ndarray]] = {name: [] for name in self.texts}
        lines: list[np.ndarray] = []
        count = 0
        for chunk, chunk_lines in self.chunks(rows, len(header)):
            chunk, kept = self.chosen(chunk, np.asarray(chunk_lines), index)
            lines.append(kept)
            for name in self.numbers:
                numbers[name].append(self.converted(list(map(itemgetter(index[name]), chunk)), name, kept))
            for name in self.texts:
                texts[name].append(np.array([row[index[name]].strip() for row in chunk], dtype=object))
            count += len(kept)
            if count > _MOST_ROWS:
                raise InputError(f"{self.name}: has more than {_MOST_ROWS:,} rows; thin the recording")
        return Columns(_joined(numbers, float), _joined(texts, object), _joined({"": lines}, int)[""])

    def lines(self, stream: io.TextIOWrapper) -> Iterator[str]:
        """The lines that are not comments; `self.line` counts them all."""
        while line := stream.readline(_LONGEST_LINE + 1):
            self.line += 1
            if self.line == 1 and line.startswith(_GZIP):
                raise InputError(f"{self.name}: is compressed by gzip; give its name the ending .csv.gz")
            if len(line) > _LONGEST_LINE:
                raise InputError(
                    f"{self.name}, line {self.line}: is longer than {_LONGEST_LINE:,} characters; is it CSV?"
                )
            if line[0] != "#":
                yield line

    def header(self, rows: Iterator[list[str]]) -> list[str]:
        header = next((row for row in rows if _is_filled(row)), None)
        if header is None:
            raise InputError(f"{self.name}: is empty; a recording needs a header line, then rows of numbers")
        header = [cell.strip() for cell in header]
        if any("\0" in cell for cell in header):
            raise InputError(f"{self.name}: is not UTF-8 text; save the recording as CSV in UTF-8")
        for needed in [*self.numbers, *self.texts, *self.where]:
            if header.count(needed) > 1:
                raise InputError(
                    f"{self.name}, line {self.line}: two columns are called {shown(needed)}; "
                    "give every column its own name"
                )
            if needed not in header:
                raise InputError(
                    f"{self.name}, line {self.line}: no column {shown(needed)}; {self.advice(needed, header)}"
                )
        return header

    def advice(self, needed: str, header: list[str]) -> str:
        for separator, word in ((";", "semicolons"), ("\t", "tabs")):
            if any(separator in cell for cell in header):
                return f"cells seem to be separated by {word}; use commas between cells and a point in numbers"
        return nearest(needed, [cell for cell in header if cell])

    def chunks(self, rows: Iterator[list[str]], width: int) -> Iterator[tuple[list[list[str]], list[int]]]:
        numbered = ((row, self.line) for row in rows)
        while part := list(islice(numbered, _CHUNK)):
            part = [
                (row, line)
                for row, line in part
                if (len(row) == width and row[0] != "") or self.is_counted(row, line, width)
            ]
            yield [row for row, _ in part], [line for _, line in part]

    def is_counted(self, row: list[str], line: int, width: int) -> bool:
        """False for a row of empty cells only; a row of another length than the header is refused."""
        if not _is_filled(row):
            return False
        if len(row) == width:
            return True
        advice = "is a comma used as the decimal mark?" if len(row) > width else "an empty cell still needs its comma"
        cells = f"{len(row)} cell{'s' if len(row) != 1 else ''}"
        raise InputError(f"{self.name}, line {line}: {cells} where the header has {width}; {advice}")

    def chosen(
        self, rows: list[list[str]], lines: np.ndarray, index: Mapping[str, int]
    ) -> tuple[list[list[str]], np.ndarray]:
        """The rows with the values that `where` asks for."""
        for column, wanted in self.where.items():
            cells = [row[index[column]] for row in rows]
            fits = {cell: matches(cell.strip(), wanted) for cell in set(cells)}
            keep = [fits[cell] for cell in cells]
            rows = [row for row, kept in zip(rows, keep, strict=True) if kept]
            lines = lines[np.asarray(keep, dtype=bool)]
        return rows, lines

    def converted(self, cells: list[str], column: str, lines: np.ndarray) -> np.ndarray:
        """Cells as numbers: at once where all look like numbers, one by one where some do not."""
        if frozenset("".join(cells)) <= _NUMERIC:
            try:
                return self.finite(np.array([float(c) if c else np.nan for c in cells]), cells, column, lines)
            except ValueError:
                pass  # such as `1e` or `--`: found below
        values = np.array(
            [self.number(cell, column, int(line)) for cell, line in zip(cells, lines, strict=True)], dtype=float
        )
        return self.finite(values, cells, column, lines)

    def number(self, cell: str, column: str, line: int) -> float:
        text = cell.strip()
        if text == "" or text.lower() == "nan":
            return np.nan
        if frozenset(text) <= _NUMERIC:
            try:
                return float(text)
            except ValueError:
                pass
        raise self.refusal(cell, column, line)

    def finite(self, values: np.ndarray, cells: list[str], column: str, lines: np.ndarray) -> np.ndarray:
        infinite = np.isinf(values)
        if infinite.any():
            first = int(np.argmax(infinite))
            raise self.refusal(cells[first], column, int(lines[first]))
        return values

    def refusal(self, cell: str, column: str, line: int) -> InputError:
        """What is wrong with a cell that is no finite number."""
        text = cell.strip()
        advice = "give a number (a missing reading is an empty cell)"
        if text.lower().lstrip("+-") in ("inf", "infinity") or frozenset(text) <= _NUMERIC and _is_float(text):
            what = "is not finite"
        else:
            what = "is not a number"
            if "," in text:
                advice = "write the decimal mark as a point"
        return InputError(f"{self.name}, line {line}, column {shown(column)}: {shown(text)} {what}; {advice}")


def matches(cell: str, wanted: str | float) -> bool:
    """Whether a cell has the value wanted: the same text, or a number of the same value."""
    return cell == wanted or (_is_float(cell) and _is_float(wanted) and float(cell) == float(wanted))


def _is_float(text: str | float) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _is_filled(row: list[str]) -> bool:
    return any(cell.strip() for cell in row)


def _joined(parts: Mapping[str, list[np.ndarray]], dtype: type) -> dict[str, np.ndarray]:
    return {name: np.concatenate(a) if a else np.zeros(0, dtype) for name, a in parts.items()}
