"""Which machine code a loop has, and the name by which XLA knows it."""

import hashlib
from functools import lru_cache
from threading import Lock
from typing import Any

import numpy as np

from ._foreign_call import registered
from ._machine_arithmetic import Unsupported
from ._machine_lanes import lane_loop
from ._native import compiled
from ._scan_sizes import ScanSizes


class Known:
    """Arrays by their place among what a loop is given; two of the same numbers are the same."""

    def __init__(self, arrays: dict[int, np.ndarray]):
        self.arrays = arrays
        self.key = tuple((k, one.shape, str(one.dtype), one.tobytes()) for k, one in arrays.items())

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Known) and self.key == other.key


class Loop:
    """A loop's parameters, to be found again by the traced function that it repeats."""

    def __init__(self, p: Any):
        self.p, self.key = p, (p["length"], p["reverse"], *ScanSizes.of(p), p["known"])

    def __hash__(self) -> int:
        return hash((id(self.p["jaxpr"]), self.key))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Loop) and self.p["jaxpr"] is other.p["jaxpr"] and self.key == other.key


# What was written, by its name to XLA, which knows each once; threads may trace at the same time.
_engines: dict[str, Any] = {}
_lock = Lock()


@lru_cache(maxsize=64)
def code_of(loop: Loop, beside: tuple[bool, ...], lanes: int) -> str | None:
    """The name by which XLA knows a loop's machine code; None where there is none."""
    try:
        module = lane_loop(loop.p, loop.p["known"].arrays, beside, lanes)
    except Unsupported:
        return None
    text = str(module)
    name = f"symplearn_lanes_{hashlib.sha256(text.encode()).hexdigest()[:24]}"
    with _lock:
        if name not in _engines:
            _engines[name] = compiled(module)
            registered(_engines[name].get_function_address("called"), name)
    return name
