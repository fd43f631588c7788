"""The same work for every case, on every core that this process may use; what is done is kept by the work itself."""

import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any


def tell(line: str) -> None:
    """Progress, on stderr."""
    print(line, file=sys.stderr, flush=True)


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def each(what: str, work: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], workers: int) -> list[Any]:
    """What `work` gives for each of the arguments, in order, told every ten seconds."""
    due, found = time.monotonic() + 2.0, []
    for k, one in enumerate(_results(work, arguments, workers), 1):
        found.append(one)
        if time.monotonic() > due or k == len(arguments):
            due = time.monotonic() + 10.0
            tell(f"{what}: {k} of {len(arguments)}")
    return found


def _results(work: Callable[..., Any], arguments: Sequence[tuple[Any, ...]], workers: int) -> Iterator[Any]:
    if workers == 1 or len(arguments) < 2:
        for one in arguments:
            yield work(*one)
        return
    # Spawned, not forked: JAX has threads, which a fork would break.
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        waiting = [pool.submit(work, *one) for one in arguments]
        try:
            for future in waiting:
                yield future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
