"""One diagnosis in a process of its own, as `symplearn diagnose` makes it, with the series behind its pictures.

    python -m experiments._gallery_diagnose SIMULATION RECORDING ... --out DIR [--holdout FRACTION] [--jobs THREADS]

Leaves what the command leaves, and `series.npz`: every array of recording k under `k/NAME`.
"""

import argparse
import dataclasses
import sys
import time
from pathlib import Path

import jax
import numpy as np

from symplearn._errors import InputError
from symplearn._recording import read_recordings
from symplearn._simulation_file import read_simulation
from symplearn.diagnosis import Diagnosis, Options, diagnose
from symplearn.report import prepare_directory, write_outputs


def main() -> int:
    """Diagnose; exit code 2 with one sentence where the input is wrong."""
    parser = argparse.ArgumentParser(description="One diagnosis of the gallery.")
    parser.add_argument("simulation", type=Path)
    parser.add_argument("recordings", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--holdout", type=float, default=0.25)
    parser.add_argument("--time-limit", type=float, default=float("inf"))
    parser.add_argument("--jobs", type=int, default=Options.jobs)
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if jax.config.jax_compilation_cache_dir is None:  # type: ignore[attr-defined]
        jax.config.update("jax_compilation_cache_dir", str(Path(__file__).parents[1] / ".cache" / "jax"))
    try:
        file = read_simulation(given.simulation)
        read = read_recordings(file, given.recordings)
        options = Options(given.holdout, jobs=given.jobs, time_limit=given.time_limit, progress=_Progress().say)
        found = diagnose(file, read, options)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    folder = prepare_directory(given.out)
    write_outputs(found, folder)
    write_series(found, folder / "series.npz")
    return 0


def write_series(found: Diagnosis, path: Path) -> None:
    """All arrays of all recordings, with the names that the pictures need."""
    arrays: dict[str, np.ndarray] = {"columns": np.array(found.columns), "coordinates": np.array(found.coordinates)}
    for k, series in enumerate(found.series, 1):
        for one in dataclasses.fields(series):
            value = getattr(series, one.name)
            if isinstance(value, np.ndarray | float | str):
                arrays[f"{k}/{one.name}"] = np.asarray(value)
    np.savez_compressed(path, **arrays)


class _Progress:
    """What is being done, on stderr, from the second second on."""

    def __init__(self) -> None:
        self.begin = time.monotonic()

    def say(self, message: str) -> None:
        passed = time.monotonic() - self.begin
        if passed > 1.0:
            print(f"  {passed:6.1f} s  {message}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
