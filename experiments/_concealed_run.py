"""Diagnosing the cases: a process for each, in a fresh folder that holds its two public files and no more."""

import csv
import hashlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from symplearn._places import AbstractPlace

from ._concealed_seal import put

PUBLIC = ("simulation.toml", "recording.csv")
TIMEOUT = 1800.0  # s; then the case counts as failed
_ALIVE: set[subprocess.Popen] = set()
_STOPPING = threading.Event()


def command_line() -> list[str]:
    """The program that a user runs, beside this Python."""
    program = Path(sys.executable).with_name("symplearn")
    return [str(program)] if program.exists() else [sys.executable, "-c", "from symplearn.cli import main; main()"]


def fingerprint(case: Path) -> str:
    """Of the public files; a kept diagnosis of other files is made anew."""
    return hashlib.sha256(b"".join(public(case).values())).hexdigest()


# A forecast has so many rows for each of the recording. The true times lie between its rows where readings are uneven,
# and a spline through four rows a swing is off by a hundredth of it, ten times a good forecast's error.
_CLOSER = 4


def horizon(recording: Path) -> tuple[float, float]:
    """From the public recording alone: the time a quarter of the first recording beyond its last reading, its step."""
    rows = list(csv.DictReader(recording.read_text(encoding="utf-8").splitlines()))
    first = [r for r in rows if r.get("run") == rows[0].get("run")]
    columns = [c for c in rows[0] if c not in ("run", "t_s", "u")]
    times = [float(r["t_s"]) for r in first if any(r[c] for c in columns)]
    steps = sorted(b - a for a, b in zip(times[:-1], times[1:], strict=True))
    step = steps[len(steps) // 2]
    return times[-1] + step * (len(times) // 4), step


def diagnosed(case: Path, kept: Path, jobs: int, fresh: bool = False) -> dict[str, Any]:
    """What the diagnosis of a case said: from its file, or from a new process."""
    mark = fingerprint(case)
    if not fresh and (found := _kept(kept, mark)):
        return found
    found = apart(public(case), jobs) | {"files": mark}
    put(kept, json.dumps(found).encode())
    return found


def public(case: Path) -> dict[str, bytes]:
    """The two files of a case."""
    return {name: (case / name).read_bytes() for name in PUBLIC}


def apart(files: Mapping[str, bytes], jobs: int) -> dict[str, Any]:
    """What a new process, of so many threads, says of a fresh folder with these files."""
    with tempfile.TemporaryDirectory(prefix="concealed-") as folder:
        for name in PUBLIC:
            (Path(folder) / name).write_bytes(files[name])
        return _run(Path(folder), jobs)


def _kept(path: Path, mark: str) -> dict[str, Any] | None:
    found = json.loads(path.read_text(encoding="utf-8")) if path.exists() else None
    return found if found and found["files"] == mark else None


def _run(folder: Path, jobs: int) -> dict[str, Any]:
    """One process; what it wrote, how long it took, and whether it crashed or was stopped by the clock."""
    until, step = horizon(folder / PUBLIC[1])
    words = [*command_line(), "diagnose", *PUBLIC, "--out", "diagnosis"]
    words += ["--forecast-until", repr(until), "--forecast-step", repr(step / _CLOSER)]
    begun = time.monotonic()
    process = subprocess.Popen(
        [*words, "--jobs", str(jobs)], cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        errors="replace", start_new_session=True,
    )  # fmt: skip
    _ALIVE.add(process)
    try:
        told = process.communicate(timeout=TIMEOUT)[1]
        status = "done" if process.returncode == 0 else "crashed"
    except subprocess.TimeoutExpired:
        told, status = f"stopped after {TIMEOUT:g} s", "late"
    finally:
        _ALIVE.discard(process)
        _kill(process)
        process.stderr.close()  # type: ignore[union-attr]
    if _STOPPING.is_set():
        raise KeyboardInterrupt
    found: dict[str, Any] = {"status": status, "seconds": time.monotonic() - begun, "document": None, "forecast": None}
    if status == "done":
        found["document"] = json.loads((folder / "diagnosis" / "diagnosis.json").read_text(encoding="utf-8"))
        found["forecast"] = _columns(folder / "diagnosis" / "forecast.csv")
    else:
        found["told"] = told[-2000:]
    return found


def _kill(process: subprocess.Popen) -> None:
    if process.poll() is None:  # late, or the experiment itself was stopped
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _columns(path: Path) -> dict[str, list[float]] | None:
    """A table's columns; None where there is none or it holds anything but numbers."""
    if not path.exists():
        return None
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    try:
        return {name: [float(row[name]) for row in rows] for name in rows[0]} if rows else None
    except ValueError:
        return None


def every(
    cases: Sequence[Path], folder: Path, jobs: int, fresh: bool, tell: Callable[[str], None]
) -> list[dict[str, Any]]:
    """All cases, `jobs` processes side by side, progress told after each. Ctrl-C keeps what is done."""
    cores = max(1, (os.cpu_count() or 1) // jobs)
    found: dict[str, dict[str, Any]] = {}
    begun = time.monotonic()
    _STOPPING.clear()

    def one(case: Path) -> dict[str, Any]:
        return diagnosed(case, folder / f"{case.name}.json", cores, fresh)

    with ThreadPoolExecutor(jobs) as pool:
        waiting = [(case, pool.submit(one, case)) for case in cases]
        try:
            for k, (case, future) in enumerate(waiting, 1):
                found[case.name] = future.result()
                went = time.monotonic() - begun
                tell(f"diagnosed {k} of {len(cases)} ({case.name}: {found[case.name]['status']}), {went:.0f} s")
        except BaseException:
            _STOPPING.set()
            pool.shutdown(wait=False, cancel_futures=True)
            for process in tuple(_ALIVE):
                _kill(process)
            raise
    return [found[case.name] for case in cases]


def every_at(
    place: AbstractPlace, cases: Sequence[Path], folder: Path, fresh: bool, tell: Callable[[str], None]
) -> list[dict[str, Any]]:
    """All cases on the workers of a cluster, a core each. One whose workers died is not kept, and counts as crashed."""
    marks = {case: fingerprint(case) for case in cases}
    found = {case: None if fresh else _kept(folder / f"{case.name}.json", marks[case]) for case in cases}
    missing = [case for case in cases if found[case] is None]
    begun = time.monotonic()
    for k, outcome in enumerate(place.outcomes(apart, [(public(case), 1) for case in missing]), 1):
        case = missing[outcome.number]
        if outcome.failure is None:
            found[case] = outcome.value | {"files": marks[case]}
            put(folder / f"{case.name}.json", json.dumps(found[case]).encode())
        else:
            lost = {"status": "crashed", "seconds": 0.0, "document": None, "forecast": None}
            found[case] = lost | {"told": outcome.failure, "files": marks[case]}
        went = time.monotonic() - begun
        why = "" if outcome.failure is None else f": {outcome.failure}"
        tell(f"diagnosed {k} of {len(missing)} ({case.name}: {found[case]['status']}{why}), {went:.0f} s")
    return [found[case] for case in cases]
