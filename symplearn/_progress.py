"""What a command is doing, told while it does it, until it is told to stop."""

import signal
import time
from types import TracebackType
from typing import Any, NoReturn

from rich.console import Console

STOPPED = 128  # and the number of the signal, as a shell says it: 130 by Ctrl-C, 143 by SIGTERM
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Terminated(SystemExit):
    """SIGTERM's KeyboardInterrupt; typer would take that for a Ctrl-C."""


def interrupt(number: int, frame: Any = None) -> NoReturn:
    """What a signal to stop raises."""
    raise KeyboardInterrupt if number == signal.SIGINT else Terminated(STOPPED + number)


class Progress:
    """What is being done, on stderr, from the second second on."""

    def __init__(self) -> None:
        self._console = Console(stderr=True)
        self._begin = time.monotonic()
        self._status = self._console.status("", spinner="line") if self._console.is_terminal else None
        self._stopped: int | None = None

    def __enter__(self) -> "Progress":
        self._handlers = [signal.signal(number, self._stop) for number in _SIGNALS]
        if self._status:
            self._status.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in zip(_SIGNALS, self._handlers, strict=True):
            signal.signal(number, handler)
        if self._status:
            self._status.stop()

    def _stop(self, number: int, frame: Any) -> NoReturn:
        self._stopped = number
        interrupt(number)

    def say(self, message: str) -> None:
        """Tell what comes next; a signal that a destructor or a callback swallowed is noticed here."""
        if self._stopped is not None:
            interrupt(self._stopped)
        passed = time.monotonic() - self._begin
        if self._status:
            self._status.update(f"{passed:4.0f} s  {message}")
        elif passed > 1.0:
            self._console.print(f"{passed:6.1f} s  {message}", markup=False, highlight=False)

    def notice(self, message: str) -> None:
        """Tell what stays to be read."""
        self._console.print(f"Notice: {message}", markup=False, highlight=False, soft_wrap=True)
