"""Noise realisations: each leaves a file, so that a run that was stopped goes on, and together they are a spread."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np

from symplearn._errors import InputError

from ._cluster import elsewhere
from ._command import Run, print_table


class NotKept(Exception):
    """A realisation has no file yet."""


def kept(run: Run, name: str, k: int, settings: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Realisation k under `name`: from its file, or made and put there. A file of other `settings` is made anew."""
    # A quick run draws fewer samples, so its files are its own.
    path = run.out / ("quick" if run.quick else "full") / f"seed{run.seed}_{k:02d}_{name}.json"
    if path.exists():
        found = json.loads(path.read_text(encoding="utf-8"))
        if found.get("settings") == settings:
            return found
    if run.looking:
        raise NotKept
    found = make() | {"settings": settings}
    path.parent.mkdir(exist_ok=True)
    unfinished = path.with_suffix(".part")
    unfinished.write_text(json.dumps(found), encoding="utf-8")
    unfinished.replace(path)  # whole or not at all
    return found


def realisations(run: Run, jobs: Sequence[Callable[[Run], dict[str, Any]]], threads: int = 2) -> Iterator[Any]:
    """What the jobs give, in order, each of which is `kept`: in this process, or by the workers of a Dask scheduler."""
    if run.scheduler is None and threads == 1:
        yield from (job(run) for job in jobs)
        return
    if run.scheduler is None:
        yield from _side_by_side([partial(job, run) for job in jobs], threads)
        return
    missing = [job for job in jobs if not _is_kept(run, job)]
    for _ in elsewhere(run, missing):
        pass
    if not all(_is_kept(run, job) for job in missing):
        raise InputError("the workers made results of other settings; start them in a checkout of this version")
    yield from (job(run) for job in jobs)


def _is_kept(run: Run, job: Callable[[Run], dict[str, Any]]) -> bool:
    try:
        job(run._replace(looking=True))
    except NotKept:
        return False
    return True


def _side_by_side(jobs: Sequence[Callable[[], dict[str, Any]]], threads: int) -> Iterator[dict[str, Any]]:
    """A program of small matrices keeps one core busy. Neighbours should be of different kinds, so that nothing is
    compiled twice."""
    with ThreadPoolExecutor(threads) as pool:
        waiting = [pool.submit(job) for job in jobs]
        try:
            for one in waiting:
                yield one.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)  # those under way end, and leave their files


def spread(values: Sequence[float]) -> dict[str, float]:
    """Median, quartiles and extremes."""
    lower, middle, upper = np.quantile(values, [0.25, 0.5, 0.75])
    ends = {"smallest": float(np.min(values)), "largest": float(np.max(values))}
    return {"median": float(middle), "lower_quartile": float(lower), "upper_quartile": float(upper), **ends}


def print_spreads(found: Mapping[str, Any], published: Mapping[str, float]) -> None:
    """A table of the spreads among the metrics, the published numbers beside them."""
    rows: list[Sequence[Any]] = [["quantity", "published (one draw)", "median", "quartiles"]]
    for key in sorted(found):
        if isinstance(found[key], dict) and "median" in found[key]:
            one = found[key]
            quartiles = f"{one['lower_quartile']:.4g} .. {one['upper_quartile']:.4g}"
            rows.append([key, published.get(key, ""), one["median"], quartiles])
    print_table(*rows)
