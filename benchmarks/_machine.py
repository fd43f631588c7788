"""The machine, the versions, and how busy others kept it."""

import functools
import os
import platform
import resource
import subprocess
import sys
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

_PACKAGES = ("symplearn", "jax", "jaxlib", "numpy", "dynamax", "filterpy")


def machine() -> dict[str, Any]:
    """What a figure hangs on, besides the load."""
    return {
        "processor": _processor(),
        "cores": _cores(),
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "card": card(),
        "system": platform.system(),
        "python": platform.python_version(),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "versions": {name: _version(name) for name in _PACKAGES},
    }


@functools.cache
def card() -> str | None:
    """The name of the graphics card that JAX computes on; None where there is none.

    A process of its own asks, so that this one takes none of the card's memory.
    """
    code = "import jax; print(jax.default_backend(), jax.devices()[0].device_kind, sep='\\n')"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    kind, _, name = found.stdout.strip().partition("\n")
    return name if found.returncode == 0 and kind == "gpu" else None


def _processor() -> str:
    """The processor's name, where the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _cores() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


class Load:
    """How many cores other processes kept busy since it was made, on average; None where the system does not tell."""

    def __init__(self) -> None:
        self._began, self._all, self._own = time.monotonic(), _busy(), _own()

    def others(self) -> float | None:
        """Cores, of all of the machine."""
        now = _busy()
        if self._all is None or now is None:
            return None
        seconds = max(time.monotonic() - self._began, 1e-9)
        return round(max(0.0, (now - self._all) - (_own() - self._own)) / seconds, 2)


def _busy() -> float | None:
    """Seconds of all cores that were not idle."""
    try:
        fields = Path("/proc/stat").read_text(encoding="utf-8").splitlines()[0].split()[1:]
    except OSError:
        return None
    user, nice, system, _, _, irq, soft, stolen = (int(field) for field in fields[:8])
    return (user + nice + system + irq + soft + stolen) / os.sysconf("SC_CLK_TCK")


def _own() -> float:
    """Seconds of this process and of its children that have ended."""
    uses = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(use.ru_utime + use.ru_stime for use in uses)
