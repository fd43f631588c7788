"""Parts of an experiment done by the workers of a Dask scheduler. Files go with a part, and what it leaves comes back.

The workers run in a checkout of the same version (`dask worker ADDRESS --nthreads 1` in its folder); nothing is shared
with them but what is sent.
"""

import os
import pickle
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax

from symplearn._errors import InputError, shown
from symplearn._places import AbstractPlace, Cluster, Outcome

from ._command import Run, in_double_precision


def elsewhere(
    run: Run, parts: Sequence[Callable[[Run], Any]], files: Sequence[Mapping[str, bytes]] | None = None
) -> Iterator[Any]:
    """What the parts give, in the order in which they end; what they leave in `run.out` is put there before.

    `files`, one mapping for each part, are what it finds there, by their paths under `run.out`.

    **Raises:** `InputError`, after all others have ended, where a part failed.
    """
    if not parts:
        return
    assert run.scheduler is not None
    sent = files or [{}] * len(parts)
    there = run._replace(scheduler=None, out=Path())
    cases = [(pickle.dumps(part), there, each) for part, each in zip(parts, sent, strict=True)]
    failed: list[Outcome] = []
    with Cluster(run.scheduler, _tell) as cluster:
        for k, outcome in enumerate(_brought(cluster, cases, run.out), 1):
            _tell(f"parts on the cluster: {k} of {len(parts)}")
            if outcome.failure is not None:
                failed.append(outcome)
            else:
                yield outcome.value
    if failed:
        raise InputError(
            f"{len(failed)} of {len(parts)} parts failed, the first as {failed[0].failure}; what is done is kept, and "
            "the same command tries them again"
        )


def _tell(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _brought(place: AbstractPlace, cases: Sequence[tuple[Any, ...]], out: Path) -> Iterator[Outcome]:
    for outcome in place.outcomes(apart, cases):
        if outcome.failure is None:
            value, files = outcome.value
            put_all(out, files)
            outcome = outcome._replace(value=value)
        yield outcome


def apart(part: bytes, run: Run, files: Mapping[str, bytes]) -> tuple[Any, dict[str, bytes]]:
    """What a pickled part gives in a folder of its own with these files, and the files that it left there."""
    # As where it comes from: an experiment is imported before it turns to double precision, and its constants stay so.
    with jax.enable_x64(False):
        work: Callable[[Run], Any] = pickle.loads(part)
    in_double_precision()
    with tempfile.TemporaryDirectory(prefix="symplearn-part-") as folder:
        put_all(Path(folder), files)
        return work(run._replace(out=Path(folder))), files_in(Path(folder))


def files_in(folder: Path) -> dict[str, bytes]:
    """Every file under a folder, by its path there."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def put_all(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files under a folder, each whole or not at all."""
    for name, content in files.items():
        path = folder / name
        if not path.resolve().is_relative_to(folder.resolve()):
            raise InputError(f"{shown(name)}, which a worker sent, does not lie in {folder}")
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = path.with_name(f".{path.name}.{os.getpid()}")
        unfinished.write_bytes(content)
        os.replace(unfinished, path)
