"""Work on a graphics card, each precision in a process of its own, beside what the card can do at most.

Two limits are measured with the work: the operations of a large product of matrices, and copying what no cache holds.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

from ._process import ROOT
from ._row import Effort, tell

PRECISIONS = {"float64": "1", "float32": "0"}
# The side of a matrix, and bytes that are copied.
_SIDE, _COPIED = 8192, 1 << 30


def _environment(precision: str, platform: str = "") -> dict[str, str]:
    chosen = {"JAX_ENABLE_X64": PRECISIONS[precision], "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    return os.environ | chosen | ({"JAX_PLATFORMS": platform} if platform else {})


def elsewhere(
    module: str, effort: Effort, precision: str, *arguments: str, platform: str = "", limit: float = 550.0
) -> dict[str, Any]:
    """What `python -m benchmarks.MODULE EFFORT ARGUMENTS` prints as JSON, on the card or another platform.

    **Raises:** `RuntimeError` where it fails, or takes longer than `limit` seconds.
    """
    tell(f"{module}: {' '.join((precision, *arguments))}{f' on the {platform}' if platform else ''}")
    command = [sys.executable, "-m", f"benchmarks.{module}", "quick" if effort.quick else "whole", *arguments]
    try:
        found = subprocess.run(
            command, stdout=subprocess.PIPE, text=True, cwd=ROOT, env=_environment(precision, platform), timeout=limit
        )
    except subprocess.TimeoutExpired:
        raise RuntimeError(f"it took longer than {limit:g} s ({' '.join(command[1:])})") from None
    if found.returncode != 0:
        raise RuntimeError(f"`{' '.join(command[1:])}` ended with {found.returncode}")
    return json.loads(found.stdout.splitlines()[-1])


def told(found: dict[str, Any]) -> None:
    """The other side: the answer, as the last line."""
    print(json.dumps(found, allow_nan=False), flush=True)


def seconds_of(call: Callable[[], Any], rounds: int) -> float:
    """The median of so many calls that have been waited for, after one that is not counted."""
    import jax
    import numpy as np

    jax.block_until_ready(call())
    times = []
    for _ in range(rounds):
        began = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - began)
    return float(np.median(times))


def limits(rounds: int = 10) -> dict[str, float]:
    """Operations and bytes a second that this card reaches in the precision of this process: in a large product of
    matrices, without numbers of lower precision within, and in a copy. Nothing where there is no card."""
    import jax
    import jax.numpy as jnp

    if jax.default_backend() != "gpu":
        return {}
    large = jnp.zeros(_COPIED // jnp.zeros(()).dtype.itemsize) + 1.0
    matrix = jax.random.normal(jax.random.key(0), (_SIDE, _SIDE))
    product = jax.jit(lambda one: jnp.matmul(one, one, precision="highest"))
    copy = jax.jit(lambda one: one + 1.0)
    return {
        "operations_a_second": 2.0 * _SIDE**3 / seconds_of(lambda: product(matrix), rounds),
        "bytes_a_second": 2.0 * _COPIED / seconds_of(lambda: copy(large), rounds),
    }
