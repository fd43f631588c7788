"""Recordings that are given in another shape than they lie in: merged, chosen or cut, always in a temporary place."""

import csv
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from symplearn._errors import InputError

Table = tuple[list[str], list[list[str]]]  # header and rows, as text: what is copied is copied to the digit


def read_table(path: Path) -> Table:
    """Header and rows of a CSV file; lines that start with `#` are left out."""
    with path.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.reader(line for line in stream if not line.startswith("#")))
    if not rows:
        raise InputError(f"{path.name}: is empty; a header line is needed")
    return rows[0], rows[1:]


def prepared(paths: Sequence[Path], wish: Mapping[str, Any], folder: Path) -> list[Path]:
    """The recordings as `wish` has them: themselves where it is empty, otherwise one new file in `folder`."""
    if not wish:
        return list(paths)
    if wish.get("how") not in _WAYS:
        raise InputError(f"prepare: how = {wish.get('how')!r} is unknown; one of {', '.join(_WAYS)} is needed")
    how = {name: value for name, value in wish.items() if name != "how"}
    header, rows = _WAYS[wish["how"]]([read_table(path) for path in paths], **how)
    out = folder / paths[0].name
    with out.open("w", encoding="utf-8", newline="") as stream:
        csv.writer(stream, lineterminator="\n").writerows([header, *rows])
    return [out]


def merged(tables: Sequence[Table], by: str) -> Table:
    """Tables side by side, row by row, joined where the column `by` holds the same text."""
    (header, rows), *others = tables
    header, rows = list(header), [list(row) for row in rows]
    for names, more in others:
        key, mine = names.index(by), header.index(by)
        lookup = {row[key]: row[:key] + row[key + 1 :] for row in more}
        missing = next((row[mine] for row in rows if row[mine] not in lookup), None)
        if missing is not None:
            raise InputError(f"no row with {by} = {missing} in the table that is merged; the same times are needed")
        rows = [row + lookup[row[mine]] for row in rows]
        header += names[:key] + names[key + 1 :]
    return header, rows


def chosen(tables: Sequence[Table], column: str, values: Sequence[Any]) -> Table:
    """The rows of one table whose `column` holds one of the values."""
    ((header, rows),) = tables
    place, wanted = header.index(column), {str(value) for value in values}
    return header, [row for row in rows if row[place] in wanted]


def windows(tables: Sequence[Table], time: str, starts: Sequence[float], length: float, every: int = 1) -> Table:
    """Windows of `length` cut out at `starts`, numbered from 1 in a new column `window`; one row in `every` is kept."""
    ((header, rows),) = tables
    place = header.index(time)
    times = [float(row[place]) for row in rows]
    return ["window", *header], list(_cut(rows, times, starts, length, every))


def _cut(
    rows: Sequence[list[str]], times: Sequence[float], starts: Sequence[float], length: float, every: int
) -> Iterable[list[str]]:
    for number, start in enumerate(starts, 1):
        inside = [row for row, t in zip(rows, times, strict=True) if start <= t < start + length]
        yield from ([str(number), *row] for row in inside[::every])


_WAYS: dict[str, Callable[..., Table]] = {"merged": merged, "chosen": chosen, "windows": windows}
