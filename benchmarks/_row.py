"""What a row of the benchmark is, how hard it is measured, and what it finds."""

import importlib
import importlib.util
import sys
import time
from typing import Any, NamedTuple

from ._machine import card

_BEGAN = time.monotonic()


class Effort(NamedTuple):
    """How hard to measure: `quick` in a minute or two a row, `full` with the largest size as well."""

    quick: bool = False
    full: bool = False

    @property
    def rounds(self) -> int:
        """Interleaved rounds at most."""
        return 5 if self.quick else 31

    @property
    def seconds(self) -> float:
        """Seconds after which the rounds end, once there are enough for a median."""
        return 10.0 if self.quick else 60.0

    @property
    def block(self) -> float:
        """Seconds that one contender runs at least before the next one's turn."""
        return 0.01 if self.quick else 0.03


class Line(NamedTuple):
    """One line of the table: a figure in words, the goal, and whether it is met (None where there is no goal)."""

    work: str
    against: str
    figure: str
    goal: str = ""
    met: bool | None = None
    ours: str = ""
    other: str = ""
    compiling: str = ""
    memory: str = ""


class Row(NamedTuple):
    """A row: its module is `benchmarks.<name>`, whose `measure(effort)` gives figures with a list of `Line`.

    Those `on_card` are of a graphics card, and left out where there is none.
    """

    name: str
    about: str
    peers: tuple[str, ...] = ()
    on_card: bool = False

    @property
    def missing(self) -> list[str]:
        """The peers that are not installed, and a card where it needs one."""
        peers = [f"{peer}, which `make benchmarks` installs in an environment of its own,"
                 for peer in self.peers if importlib.util.find_spec(peer) is None]  # fmt: skip
        return peers + (["a graphics card that JAX computes on"] if self.on_card and card() is None else [])

    def measure(self, effort: Effort) -> dict[str, Any]:
        """Numbers for JSON, with `lines` for the table."""
        return importlib.import_module(f"benchmarks.{self.name}").measure(effort)


class Disagreement(RuntimeError):
    """Two contenders do not give the same value, so that their times are no comparison."""


def tell(text: str) -> None:
    """A line of progress on stderr."""
    print(f"{time.monotonic() - _BEGAN:6.0f} s  {text}", file=sys.stderr, flush=True)
