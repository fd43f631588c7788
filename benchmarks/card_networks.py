"""The sweep of Tao's example on a graphics card: its 1,760 trainings of a network of width 64 beside each other.

    python -m benchmarks.card_networks quick|whole WAY

An epoch of each objective is timed, in double and in single precision; the published study has 400 of them.
"""

import sys
import time
from functools import partial
from typing import Any

from ._card import PRECISIONS, elsewhere, limits, seconds_of, told
from ._figures import bytes_told, seconds_told
from ._row import Effort, Line

WAYS = {"posterior": "marginal likelihood", "l1": "one-step L1"}


def measure(effort: Effort) -> dict[str, Any]:
    """Both objectives, both precisions."""
    found = {
        way: {precision: elsewhere("card_networks", effort, precision, way) for precision in PRECISIONS} for way in WAYS
    }
    lines = [_line(way, precision, one) for way, both in found.items() for precision, one in both.items()]
    return {"lines": lines, "ways": found}


def _line(way: str, precision: str, found: dict[str, Any]) -> Line:
    seconds = found["epoch_seconds"]
    share = found["operations"] / seconds / found["limits"]["operations_a_second"]
    moved = found["moved_bytes"] / seconds / found["limits"]["bytes_a_second"]
    return Line(
        f"{found['trainings']} trainings of a network by {WAYS[way]}, width {found['width']}, {precision}",
        "none",
        f"{seconds_told(seconds)} an epoch, {seconds_told(found['epochs'] * seconds)} for {found['epochs']}; "
        f"{found['operations'] / seconds / 1e12:.3g} Tflop/s, {100 * share:.2g} % of the card's; products of matrices "
        f"take and give {found['moved_bytes'] / seconds / 1e12:.3g} TB/s, {100 * moved:.2g} % of what a copy moves",
        compiling=seconds_told(found["compiling_seconds"]),
        memory=f"peak {bytes_told(found['peak_bytes'])}",
    )


def _in_process(quick: bool, way: str) -> dict[str, Any]:
    import jax
    import jax.numpy as jnp

    from experiments import tao
    from experiments._ensemble import _advance, _begin
    from symplearn._lane_loops import left_to_xla

    from ._operations import bytes_of_products, operations

    smaller: dict[str, Any] = {"repeats": 1, "width": 8, "cells": ((0.0, 300), (0.1, 300))}
    settings = tao.FULL._replace(**smaller) if quick else tao.FULL
    found: dict[str, float] = dict.fromkeys(
        ("trainings", "epoch_seconds", "compiling_seconds", "operations", "moved_bytes"), 0
    )
    # As the experiment trains them on a card: the likelihood of all n in one program, L1 in one for each n.
    for counts in [settings.counts] if way == tao.POSTERIOR else [[n] for n in settings.counts]:
        rows = settings.rows(way, counts)
        ensemble = tao.ensemble(settings, {way: rows}, 0)
        state, count = _begin(ensemble), jnp.asarray(1)
        began = time.perf_counter()
        jax.block_until_ready(_advance(ensemble, state, count))
        first = time.perf_counter() - began
        seconds = seconds_of(partial(_advance, ensemble, state, count), 1 if quick else 3)
        found["trainings"] += len(rows)
        found["epoch_seconds"] += seconds
        found["compiling_seconds"] += first - seconds
        jax.clear_caches()  # or the traced loops are those of a processor, where it is one
        with left_to_xla():
            program = partial(_advance, ensemble, count=count)
            found["operations"] += operations(program, state)
            found["moved_bytes"] += bytes_of_products(program, state)
    return found | {
        "width": settings.width,
        "epochs": settings.epochs,
        "limits": limits(),
        "peak_bytes": (jax.local_devices()[0].memory_stats() or {}).get("peak_bytes_in_use"),
    }


if __name__ == "__main__":
    told(_in_process(sys.argv[1] == "quick", sys.argv[2]))
