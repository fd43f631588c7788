"""Results of the gallery's diagnoses: made in a process of their own, and kept, so that a stopped run goes on.

The process is one here, or one of a worker of a Dask cluster, which is sent the files and sends back what it left.
"""

import hashlib
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from symplearn._places import AbstractPlace

from ._cluster import files_in, put_all
from ._gallery_page_file import Case, Page, simulation_text
from ._gallery_prepare import prepared

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class Result:
    """What came of a case: `document` is its diagnosis.json, `series` the arrays of series.npz.

    Where the diagnosis failed, `failure` is the sentence that it gave, and the others are empty.
    """

    case: Case
    simulation: str
    document: Mapping[str, Any]
    series: Mapping[str, np.ndarray]
    failure: str = ""


@dataclass(frozen=True)
class Source:
    """Where recordings lie, where results are kept, and whether those of another version of the program will do."""

    recordings: Path
    kept: Path
    any_version: bool = False


class Question(NamedTuple):
    """A case with its simulation and its recordings; `settings` are what its result in `place` is to be of."""

    text: str
    files: list[Path]
    settings: dict[str, str]
    place: Path


def question(page: Page, case: Case, source: Source) -> Question:
    """What is asked of a case."""
    text = simulation_text(page.name, case, source.recordings)
    files = [source.recordings / page.name / name for name in case.recordings]
    return Question(text, files, fingerprint(text, files, case), source.kept / page.name / case.name)


def result(page: Page, case: Case, source: Source, failures: Mapping[Path, str] | None = None) -> Result:
    """The kept result of a case where nothing has changed since, otherwise a new one.

    `failures` are those of the workers that were asked before, by place; then nothing is made here.
    """
    text, files, settings, place = question(page, case, source)
    if not is_kept(place, settings, source.any_version):
        failure = _made(case, text, files, place) if failures is None else failures[place]
        if failure:
            return Result(case, text, {}, {}, failure)
        _put(place / "kept.json", json.dumps(settings))
    document = json.loads((place / "diagnosis.json").read_text(encoding="utf-8"))
    with np.load(place / "series.npz") as series:
        return Result(case, text, document, dict(series))


def made_at(
    workers: AbstractPlace, pages: Sequence[Page], source: Source, tell: Callable[[str], None]
) -> dict[Path, str]:
    """Have what is not kept made by the workers, and keep it as soon as it comes. **Returns** how some failed."""
    every = [(case, question(page, case, source)) for page in pages for case in page.cases]
    todo = [(case, asked) for case, asked in every if not is_kept(asked.place, asked.settings, source.any_version)]
    sent = [(case, asked.text, [file.read_bytes() for file in asked.files]) for case, asked in todo]
    failures = {}
    for k, outcome in enumerate(workers.outcomes(apart, sent), 1):
        place = todo[outcome.number][1].place
        failure, left = (outcome.failure, {}) if outcome.failure else outcome.value
        if failure:
            failures[place] = failure
        else:
            shutil.rmtree(place, ignore_errors=True)
            put_all(place, left)
            _put(place / "kept.json", json.dumps(todo[outcome.number][1].settings))
        tell(f"diagnosed {k} of {len(todo)} ({place.parent.name}: {place.name}){': ' if failure else ''}{failure}")
    return failures


def apart(case: Case, text: str, recordings: Sequence[bytes]) -> tuple[str, dict[str, bytes]]:
    """A diagnosis in folders of its own, on one core: how it failed, or nothing, and the files that it left."""
    with tempfile.TemporaryDirectory(prefix="symplearn-gallery-") as name:
        given, left = Path(name) / "given", Path(name) / "left"
        put_all(given, dict(zip(case.recordings, recordings, strict=True)))
        failure = _made(case, text, [given / one for one in case.recordings], left, jobs=1)
        return failure, files_in(left)


def is_kept(place: Path, settings: Mapping[str, str], any_version: bool) -> bool:
    """Whether the result in `place` was made of these settings."""
    try:
        found = json.loads((place / "kept.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return all(found.get(key) == value for key, value in settings.items() if not (any_version and key == "program"))


def fingerprint(text: str, files: Sequence[Path], case: Case) -> dict[str, str]:
    """What an answer depends on: the question (simulation, recordings, options) and the program."""
    options = repr((case.holdout, case.limit, dict(case.prepare)))
    question = [text.encode(), options.encode(), *(file.read_bytes() for file in files)]
    return {"question": _digest(question), "program": _program()}


@cache
def _program() -> str:
    sources = [path for name in ("symplearn", "integrators") for path in sorted((ROOT / name).rglob("*.py"))]
    return _digest([path.read_bytes() for path in sources])


def _digest(parts: Sequence[bytes]) -> str:
    return hashlib.sha256(b"\0".join(hashlib.sha256(part).digest() for part in parts)).hexdigest()


def _made(case: Case, text: str, files: Sequence[Path], place: Path, jobs: int | None = None) -> str:
    """Diagnose into `place`, on so many threads. The sentence with which it failed, or nothing."""
    shutil.rmtree(place, ignore_errors=True)
    with tempfile.TemporaryDirectory(prefix="symplearn-gallery-") as name:
        folder = Path(name)
        simulation, data = folder / "simulation.toml", folder / "data"
        simulation.write_text(text, encoding="utf-8")
        data.mkdir()
        words = [str(simulation), *map(str, prepared(files, case.prepare, data))]
        words += ["--out", str(place), "--holdout", str(case.holdout)]
        words += ["--time-limit", str(case.limit)] if case.limit else []
        words += ["--jobs", str(jobs)] if jobs else []
        return _run([sys.executable, "-m", "experiments._gallery_diagnose", *words])


def _run(command: Sequence[str]) -> str:
    """Run with progress on stderr; the last line of a run that failed."""
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:
        last = "it ended without a word"
        try:
            for line in process.stderr or ():
                last = line.strip() or last
                print(line, end="", file=sys.stderr, flush=True)
        except BaseException:
            process.kill()
            raise
    return "" if process.returncode == 0 else f"{last} (exit code {process.returncode})"


def _put(path: Path, text: str) -> None:
    unfinished = path.with_suffix(".part")
    unfinished.write_text(text, encoding="utf-8")
    unfinished.replace(path)  # whole or not at all
