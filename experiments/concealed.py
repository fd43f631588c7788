"""The concealed trial: nature hides physics in recordings, seals the answers, and every diagnosis is scored.

    python -m experiments.concealed [--cases N] [--seed S] [--quick] [--out DIR] [--jobs N] [--no-oracle] [--no-today]
                                    [--scheduler ADDRESS]

Nature (`_concealed_nature.py`) draws systems, effects and ways of hiding them, verifies each hiding by computation, and
writes two public files for each case; it shares no code with symplearn. The answers are sealed by SHA-256 before the
first diagnosis. Each diagnosis is a process that is given the two files in a fresh folder. What is done is kept, and a
run that was stopped goes on where it was. `docs/concealed.md` tells what the tables mean.
"""

import argparse
import json
import os
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from symplearn._errors import InputError
from symplearn._places import AbstractPlace, place

from ._command import SCHEDULER, Run
from ._concealed_figures import confusion, reliability, strength
from ._concealed_files import answer, recording_file, simulation_file
from ._concealed_nature import drawn
from ._concealed_plan import Plan, plan
from ._concealed_results import metrics, report, table_of_cases
from ._concealed_run import PUBLIC, every, every_at
from ._concealed_score import row
from ._concealed_seal import BrokenSeal, canonical, opened, put, seal
from ._concealed_workers import cores, each, tell

FULL, QUICK = 120, 24
VERSION = 2  # of nature: other draws for the same seed need another number


def named(number: int) -> str:
    """A case's neutral name."""
    return f"case_{number:03d}"


def draw(out: Path, cases: int, seed: int) -> list[str]:
    """Public files and answers of all cases; those that are there are kept."""
    items = plan(cases, seed)
    each("nature has drawn", _draw_one, [(out, item, seed) for item in items], cores())
    return [named(item.number) for item in items]


def _draw_one(out: Path, item: Plan, seed: int) -> None:
    folder, hidden = out / "public" / named(item.number), out / "sealed"
    if (hidden / f"{named(item.number)}.json").exists() and all((folder / name).exists() for name in PUBLIC):
        return
    case = drawn(item, seed)
    put(folder / PUBLIC[0], simulation_file(case).encode())
    put(folder / PUBLIC[1], recording_file(case).encode())
    put(hidden / f"{named(item.number)}.json", canonical(answer(case)))


def sealed(out: Path, names: Sequence[str], settings: dict[str, Any]) -> None:
    """Hash the answers, print the hashes, and close the folder to others."""
    (out / "sealed").chmod(0o700)
    found = seal(out / "sealed", list(names), settings)
    print(f"Sealed before the first diagnosis: {len(names)} answers, SHA-256 {found['total']}")
    put(out / "seals.json", canonical(found))


def scored(out: Path, names: Sequence[str], results: Sequence[dict], oracle: bool) -> list[dict[str, Any]]:
    """Open the answers, ask the oracle, and judge."""
    told: list[Any] = [None] * len(names)
    if oracle:
        told = each("the oracle has told", _oracle, [(out, name) for name in names], cores())
    every_one = zip(names, results, told, strict=True)
    return [row(name, opened(out / "sealed", name), result, one) for name, result, one in every_one]


def _oracle(out: Path, name: str) -> dict[str, Any]:
    from ._concealed_oracle import asked  # heavy, and not always wanted

    return asked(out / "oracle" / f"{name}.json", opened(out / "sealed", name), out / "public" / name)


def experiment(given: argparse.Namespace) -> None:
    """Draw, seal, diagnose, score."""
    out, cases = given.out, given.cases or (QUICK if given.quick else FULL)
    settings = {"cases": cases, "seed": given.seed, "version": VERSION}
    with place(given.scheduler, tell) as workers:
        _begun(out, settings)
        _trial(given, workers, settings)


def _trial(given: argparse.Namespace, workers: AbstractPlace, settings: dict[str, Any]) -> None:
    out, cases = given.out, settings["cases"]
    names = draw(out, cases, given.seed)
    sealed(out, names, settings)
    if given.draw_only:
        return
    folders = [out / "public" / name for name in names]
    if given.scheduler is None:
        results = every(folders, out / "diagnosed", given.jobs, given.fresh, tell)
    else:
        results = every_at(workers, folders, out / "diagnosed", given.fresh, tell)
    rows = scored(out, names, results, not given.no_oracle)
    _shown(Run(out, given.seed, given.quick), names, rows, not given.no_today)


def _begun(out: Path, settings: dict[str, Any]) -> None:
    """A folder holds one trial: kept cases of another seed or number are not mixed in."""
    path = out / "trial.json"
    if path.exists() and json.loads(path.read_text(encoding="utf-8")) != settings:
        raise BrokenSeal(f"{out} holds another trial ({path.read_text(encoding='utf-8')}); give another --out")
    put(path, canonical(settings))


def _shown(run: Run, names: Sequence[str], rows: list[dict[str, Any]], today: bool) -> None:
    """Tables, figures and `metrics.json`."""
    found = metrics(rows)
    run.save(confusion(rows), "confusion.png")
    run.save(reliability(found), "reliability.png")
    run.save(strength(rows, found["at_2_percent_alarms"]["threshold"]), "strength.png")
    table_of_cases(rows)
    print()
    report(found)
    if today:
        found["today"] = _today(run.out, names, rows)
    run.write(found | {"rows": json.loads(json.dumps(rows))})


def _today(out: Path, names: Sequence[str], rows: list[dict[str, Any]]) -> dict[str, Any]:
    """The practice of today on the same files, where its packages are there."""
    from ._concealed_today import compared

    return compared(out, names, rows)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="experiments.concealed", description="Diagnose what nature has concealed.")
    parser.add_argument("--out", type=Path, default=Path("out") / "concealed", help="folder to fill (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="seed of nature, 0 or more (0)")
    parser.add_argument("--cases", type=int, help=f"number of cases, 4 or more ({FULL}, quick: {QUICK})")
    parser.add_argument("--quick", action="store_true", help=f"{QUICK} cases: under 20 minutes on two cores")
    parser.add_argument("--jobs", type=int, default=1, help="diagnoses side by side (1, which uses every core)")
    parser.add_argument("--scheduler", metavar="ADDRESS", help=SCHEDULER)
    parser.add_argument("--fresh", action="store_true", help="diagnose again what was diagnosed before")
    parser.add_argument("--draw-only", action="store_true", help="draw and seal the cases, and stop")
    parser.add_argument("--no-oracle", action="store_true", help="score without the oracle's fits")
    parser.add_argument("--no-today", action="store_true", help="leave out today's practice")
    return parser


def _stop(*_: Any) -> None:
    raise KeyboardInterrupt


def main(arguments: Sequence[str] | None = None) -> None:
    """The command; bad input is one sentence, exit 2."""
    parser = _parser()
    given = parser.parse_args(arguments)
    wrong = [n for n, low in (("seed", 0), ("cases", 4), ("jobs", 1)) if (getattr(given, n) or low) < low]
    if wrong:
        parser.exit(2, f"{parser.prog}: --{wrong[0]} is too small; `--help` tells what can be given\n")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    signal.signal(signal.SIGTERM, _stop)
    try:
        experiment(given)
    except (BrokenSeal, InputError, OSError) as error:
        parser.exit(2, f"{parser.prog}: {error}\n")
    except KeyboardInterrupt:
        parser.exit(130, f"{parser.prog}: stopped; the same command goes on from here\n")


if __name__ == "__main__":
    main()
