"""A page of the gallery and the index: what is known, what was given, what was found, what falls short."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from . import _gallery_figures as figures
from ._gallery_known import Compared, compared
from ._gallery_page_file import Case, Page
from ._gallery_results import Result, Source
from ._gallery_uranus import uranus_section
from ._gallery_words import before_after, error_cells, findings_line, found_section, summary_cells, table

MANY = 4  # results from which on errors are drawn line by line
ROWS = 3  # of the picture of the motion
_EXTRA: dict[str, Callable[[Page, Result, Source, Path], str]] = {"uranus": uranus_section}
_SUMMARY = ["recording", "verdict", "found", "error before", "after", "smaller by", "seconds"]


Facts = Sequence[tuple[Result, Compared]]


def write_page(page: Page, results: Sequence[Result], out: Path, source: Source) -> Facts:
    """Write `NAME.md` with its pictures into `out`. **Returns** what is known of it held against what was found."""
    good = [result for result in results if not result.failure]
    facts = [(r, compared(one, r.document)) for r in good for one in r.case.known]
    parts = [f"# {page.title}", page.known, f"Source: {page.source}" if page.source else "", "## What was given"]
    parts += [page.given, *_simulations(good)]
    if results:
        parts += ["## What was found", *_found(results, out, page)]
    if good and page.extra:
        parts.append(_EXTRA[page.extra](page, good[0], source, out))
    parts += [*_against(page, results, facts), "## The command", _command(page, results)]
    _put(out / f"{page.name}.md", "\n\n".join(part.strip("\n") for part in parts if part) + "\n")
    return facts


def _simulations(results: Sequence[Result]) -> list[str]:
    """The simulation files, each once."""
    texts = {result.case.simulation: result.simulation for result in reversed(results)}
    return [
        f"<details><summary>{name}</summary>\n\n```toml\n{text.strip()}\n```\n\n</details>"
        for name, text in reversed(texts.items())
    ]


def _found(results: Sequence[Result], out: Path, page: Page) -> list[str]:
    """A table where there are several results, pictures, and a section for each result that is not brief."""
    parts = []
    if len(results) > 1:
        parts.append(table(_SUMMARY, [[_label(r.case), *summary_cells(r)] for r in results]))
    good = [result for result in results if not result.failure]
    told = [result for result in results if not result.case.brief]
    parts += _pictures([r for r in told if not r.failure], good, out, page)
    for result in told:
        if len(results) > 1:
            parts.append(f"### {_label(result.case)}")
        parts += _one(result)
    return parts


def _one(result: Result) -> list[str]:
    if result.failure:
        return [f"The diagnosis failed: {result.failure}."]
    document = result.document
    used = f"{document['thinning']['used']} of {document['thinning']['rows']} rows after averaging"
    note = f"{used}; the last {result.case.holdout:.0%} of each recording were held out; "
    note += f"{document['seconds']:.0f} s, symplearn {document['version']}."
    return [found_section(result), "Before and after:", before_after(result), note]


def _pictures(told: Sequence[Result], good: Sequence[Result], out: Path, page: Page) -> list[str]:
    """At most two pictures: the motion, then errors where there are many results, else the missing force."""
    if not told:
        return []
    figures.write_motion(told[:ROWS], out / f"{page.name}-motion.png")
    parts = [
        f"![Readings, and the simulation before and after]({page.name}-motion.png)",
        "*Lines are fitted to the rows before the shaded part and run freely in it.*",
    ]
    if len(good) >= MANY:
        figures.write_errors(good, out / f"{page.name}-errors.png")
        parts.append(f"![Held-out errors before and after]({page.name}-errors.png)")
    elif figures.has_force(told[0]) and not page.extra:
        figures.write_force(told[0], out / f"{page.name}-force.png")
        parts.append(f"![The missing force over time and against velocity]({page.name}-force.png)")
        parts.append("*The force that the readings ask for beyond the equations of motion, without and with what was "
                     "found.*")  # fmt: skip
    return parts


def _against(page: Page, results: Sequence[Result], facts: Facts) -> list[str]:
    """What is known beside what was found, and what falls short."""
    parts = []
    if facts:
        several = len(results) > 1
        rows = [
            [f"{_label(r.case)}: {fact.about}" if several else fact.about, fact.expected, fact.found, _yes(fact.agrees)]
            for r, fact in facts
        ]
        parts = ["## Held against what is known", table(["", "known", "found", "agrees"], rows)]
    short = [f"{_label(r.case)}: {fact.about}" for r, fact in facts if not fact.agrees]
    short += [f"{_label(r.case)}: the diagnosis failed" for r in results if r.failure]
    words = "\n".join(f"* {line}." for line in short) or ("Nothing that is known." if facts else "")
    if words or page.open:
        parts += ["## What falls short", words, page.open]
    return parts


def _yes(agrees: bool) -> str:
    return "yes" if agrees else "**no**"


def _label(case: Case) -> str:
    return case.label or case.name


def _command(page: Page, results: Sequence[Result]) -> str:
    """The command that makes the page, and the plain ones behind it where the files are given as they lie."""
    lines = [f"python -m experiments.gallery {page.name}"]
    lines += [_plain(page, r.case) for r in results if not (r.case.prepare or r.case.replace)]
    return "```sh\n" + "\n".join(lines) + "\n```"


def _plain(page: Page, case: Case) -> str:
    there = f"../shared/recordings/{page.name}"
    beside = Path(__file__).parent / "gallery" / page.name / case.simulation
    simulation = f"experiments/gallery/{page.name}" if beside.is_file() else there
    files = " ".join(f"{there}/{name}" for name in case.recordings)
    limit = f" --time-limit {case.limit:g}" if case.limit else ""
    return f"symplearn diagnose {simulation}/{case.simulation} {files} --holdout {case.holdout:g}{limit}"


def index_rows(page: Page, results: Sequence[Result], facts: Facts) -> list[str]:
    """The page's lines of the index, one for every result that is not brief."""
    link = f"[{page.title}]({page.name}.md)"
    told = [result for result in results if not (result.case.brief or result.failure)]
    if not told:
        return [f"| {link} | {'the diagnosis failed' if results else 'not diagnosed'} | | | | |"]
    labels = [f"{link}: {_label(result.case)}" if len(results) > 1 else link for result in told]
    return [f"| {label} | {_index_cells(result, facts)} |" for label, result in zip(labels, told, strict=True)]


def _index_cells(result: Result, facts: Facts) -> str:
    document = result.document
    mine = [fact for one, fact in facts if one is result]
    agree = f"{sum(fact.agrees for fact in mine)} of {len(mine)}" if mine else "–"
    found = f"`{document['verdict']}`" + (f": {findings_line(document)}" if document["findings"] else "")
    return " | ".join([found, *error_cells(document), agree])


_INDEX = """\
# Gallery: real recordings, and what their simulations left out

Every page is written by `make gallery` (`python -m experiments.gallery`), which diagnoses the recordings of
`../shared/recordings`. What is known of a recording stands in `experiments/gallery`; every number of a finding comes
from the `diagnosis.json` of the run. Errors are of the free run over the held-out rows, in the columns' unit.

| recording | found | error before | after | smaller by | agrees with what is known |
| --- | --- | --- | --- | --- | --- |
"""


def write_index(rows: Sequence[str], out: Path) -> None:
    """`README.md` of the gallery; lines of pages that were not made now stay as they are."""
    path = out / "README.md"
    old = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    made = {_page_of(row) for row in rows}
    lines = [*rows, *(line for line in old if _page_of(line) not in made)]
    kept = [line for line in lines if _page_of(line) and (out / _page_of(line)).is_file()]
    _put(path, _INDEX + "\n".join(sorted(kept, key=_page_of)) + "\n")


def _page_of(line: str) -> str:
    """The file that a line of the index links to."""
    found = re.match(r"\| \[[^\]]*\]\(([\w.-]+\.md)\)", line)
    return found.group(1) if found else ""


def _put(path: Path, text: str) -> None:
    unfinished = path.with_suffix(".part")
    unfinished.write_text(text, encoding="utf-8")
    unfinished.replace(path)  # whole or not at all
