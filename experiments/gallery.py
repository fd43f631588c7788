"""The gallery: a page for every real recording, with what is known, what was found, and before and after.

    python -m experiments.gallery [NAME ...] [--out DIR] [--recordings FOLDER] [--kept DIR] [--any-version]
                                  [--scheduler ADDRESS]

The recordings are read where they lie ($SYMPLEARN_RECORDINGS, or ../shared/recordings beside the checkout). Results are
kept by recording, so that a run that was stopped goes on; they are made anew when a recording, its simulation or the
program has changed. With `--scheduler` the workers of a Dask cluster diagnose, a core each, and the pages are written
here.
"""

import argparse
import os
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from symplearn._errors import InputError, nearest, printable
from symplearn._places import place

from ._command import SCHEDULER
from ._gallery_page_file import Page, read_page
from ._gallery_pages import index_rows, write_index, write_page
from ._gallery_results import ROOT, Result, Source, made_at, result


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the pages. Exit code 2 where the input is wrong, 1 where a diagnosis failed; its page says how."""
    given = _parser().parse_args(arguments)
    try:
        names = _names(given.recordings, given.names)
        source = Source(given.recordings, given.kept, given.any_version)
        failures = None if given.scheduler is None else _elsewhere(names, source, given.scheduler)
        given.out.mkdir(parents=True, exist_ok=True)
        failed = [name for name in names if not _page(name, source, given.out, failures)]
    except (InputError, OSError) as error:
        print(f"experiments.gallery: {printable(str(error))}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("experiments.gallery: stopped; what is done is kept, and the same command goes on", file=sys.stderr)
        return 130
    if failed:
        print(f"experiments.gallery: a diagnosis failed for {', '.join(failed)}; its page says how", file=sys.stderr)
    return 1 if failed else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="experiments.gallery", description="Pages of real recordings.")
    parser.add_argument("names", nargs="*", metavar="NAME", help="folders of recordings (default: all)")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "gallery", help="folder of the pages")
    parser.add_argument("--recordings", type=Path, default=_recordings(), help="folder of the recordings")
    parser.add_argument("--kept", type=Path, default=ROOT / "out" / "gallery", help="folder of the kept results")
    parser.add_argument("--any-version", action="store_true", help="kept results of another version will do")
    parser.add_argument("--scheduler", metavar="ADDRESS", help=SCHEDULER)
    return parser


def _recordings() -> Path:
    return Path(os.environ.get("SYMPLEARN_RECORDINGS") or ROOT.parent / "shared" / "recordings")


def _names(folder: Path, wanted: Sequence[str]) -> list[str]:
    """The folders to make pages of."""
    known = sorted(path.name for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []
    if not known:
        raise InputError(f"no recordings lie in {folder}; give their folder with --recordings")
    wrong = next((name for name in wanted if name not in known), None)
    if wrong is not None:
        raise InputError(f"no recording is named {wrong!r} in {folder}; {nearest(wrong, known)}")
    return list(wanted) or known


def _elsewhere(names: Sequence[str], source: Source, scheduler: str) -> dict[Path, str]:
    """Every diagnosis that is not kept, by the workers; how some failed."""
    with place(scheduler, _tell) as workers:
        return made_at(workers, [read_page(name, source.recordings) for name in names], source, _tell)


def _tell(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _page(name: str, source: Source, out: Path, failures: Mapping[Path, str] | None) -> bool:
    """Diagnose, write the page and its line of the index. Whether every diagnosis went through."""
    page = read_page(name, source.recordings)
    results = list(_results(page, source, failures))
    facts = write_page(page, results, out, source)
    write_index(index_rows(page, results, facts), out)
    for _, fact in facts:
        print(f"{name}: {fact.about}: known {fact.expected}, found {fact.found}{'' if fact.agrees else '  <- NO'}")
    return not any(one.failure for one in results)


def _results(page: Page, source: Source, failures: Mapping[Path, str] | None) -> list[Result]:
    made = []
    for case in page.cases:
        begin = time.monotonic()
        _tell(f"{page.name}: {case.label or case.name}")
        made.append(result(page, case, source, failures))
        _tell(f"  done after {time.monotonic() - begin:.0f} s")
    return made


if __name__ == "__main__":
    sys.exit(main())
