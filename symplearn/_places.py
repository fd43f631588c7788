"""Where many independent cases are worked on: in this process, or by the workers of a Dask cluster.

What a case gives is handed over as soon as it is done, so that whoever asked can keep it. A worker that dies takes no
other case along than the one it was at, and what it gave in the moment before; Dask tries those on other workers as
often as its scheduler allows (`distributed.scheduler.allowed-failures`, 3 times).
"""

import abc
import pickle
import re
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from types import TracebackType
from typing import Any, NamedTuple

from ._errors import InputError, printable, shown

_ADDRESS = re.compile(r"((tcp|tls|ucx|ws|wss)://)?[^\s/]+:(?P<port>[0-9]{1,5})")
_PATIENCE = 10.0  # s for a scheduler to answer
_GLANCE = 5.0  # s after which to see whether any worker is there
_LONGEST = 500  # characters of another program's error


def check_address(address: str) -> None:
    """Raise `InputError` where a scheduler's address is none."""
    found = _ADDRESS.fullmatch(address)
    if not found or int(found["port"]) > 65535:
        raise InputError(f"--scheduler: {shown(address)} is no address; give one as tcp://HOST:8786")


class Outcome(NamedTuple):
    """How case `number` ended: with what its work gave, or with a `failure` in words."""

    number: int
    value: Any = None
    failure: str | None = None


class AbstractPlace(abc.ABC):
    """A place to work on cases, closed at the end of a `with` statement."""

    @abc.abstractmethod
    def outcomes(self, work: Callable[..., Any], cases: Sequence[tuple[Any, ...]]) -> Iterator[Outcome]:
        """How `work(*case)` ended for each of the cases, in the order in which they end."""

    @abc.abstractmethod
    def close(self) -> None:
        """Let go of what is not done."""

    def __enter__(self) -> "AbstractPlace":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class Here(AbstractPlace):
    """This process, one case after another."""

    def close(self) -> None:
        pass

    def outcomes(self, work: Callable[..., Any], cases: Sequence[tuple[Any, ...]]) -> Iterator[Outcome]:
        for number, case in enumerate(cases):
            try:
                outcome = Outcome(number, work(*case))
            except Exception as error:
                outcome = Outcome(number, failure=_in_words(error))
            yield outcome


class Cluster(AbstractPlace):
    """The workers of the Dask scheduler at `address`, as `tcp://HOST:8786`; a case for each of their threads at a time.

    They need what the work is made of: this package, the same version of it. `tell` is given a line where there is no
    worker to wait for.

    **Raises:** `InputError` where the address is none, nobody answers at it, or Dask is not installed here. Where the
    scheduler goes away later, `outcomes` raises `ConnectionError`.
    """

    def __init__(self, address: str, tell: Callable[[str], None] = lambda line: None):
        check_address(address)
        try:
            import cloudpickle
            import distributed
        except ImportError:
            raise InputError(
                "--scheduler: Dask distributed is not installed here; `pip install 'symplearn[cluster]'` installs it"
            ) from None
        self._dask, self._address, self._tell, self._pickled = distributed, address, tell, cloudpickle.dumps
        try:
            self._client = distributed.Client(address, timeout=_PATIENCE, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(
                f"--scheduler: no Dask scheduler answers at {shown(address)} ({_in_words(error)}); start one there "
                "with `dask scheduler`"
            ) from None

    def close(self) -> None:
        self._client.close()

    def outcomes(self, work: Callable[..., Any], cases: Sequence[tuple[Any, ...]]) -> Iterator[Outcome]:
        waiting, running = deque(enumerate(cases)), dict[Any, tuple[int, Any]]()
        try:
            while waiting or running:
                # No more than are begun at once: what only waits at a worker would count as failed when that dies.
                for number, case in [waiting.popleft() for _ in range(min(len(waiting), self._idle(len(running))))]:
                    future = self._client.submit(pickle.loads, self._pickled(_Sealed(work, case)), pure=False)
                    running[future.key] = number, future
                for future in self._ended([future for _, future in running.values()]):
                    yield self._outcome(running.pop(future.key)[0], future)
        except (self._dask.CancelledError, OSError) as error:
            raise ConnectionError(
                f"the scheduler at {self._address} went away; what is done is kept, and the same command goes on"
            ) from error
        finally:
            for _, future in running.values():
                future.release()

    def _idle(self, running: int) -> int:
        """How many more cases to hand over; one waits where there is no worker yet."""
        return max(1, sum(self._client.nthreads().values())) - running

    def _ended(self, futures: list[Any]) -> Sequence[Any]:
        """Those that have ended, once there is one; none after a while, for other workers may have come meanwhile."""
        try:
            with self._client.as_current():
                return list(self._dask.wait(futures, timeout=_GLANCE, return_when="FIRST_COMPLETED").done)
        except self._dask.TimeoutError:
            if not self._client.nthreads():
                self._tell(f"the scheduler at {self._address} has no workers; waiting for one")
            return []

    def _outcome(self, number: int, future: Any) -> Outcome:
        if future.status != "error":
            return Outcome(number, future.result())
        error = future.exception()
        died = isinstance(error, self._dask.KilledWorker)
        return Outcome(number, failure="every worker that was at it died" if died else _in_words(error))


class _Sealed(NamedTuple):
    """Work on a case that is done where its pickle is opened: the scheduler, which has nothing of ours, opens none."""

    work: Callable[..., Any]
    case: tuple[Any, ...]

    def __reduce__(self) -> tuple[Any, ...]:
        return self.work, self.case


def place(scheduler: str | None, tell: Callable[[str], None] = lambda line: None) -> AbstractPlace:
    """This process, or the cluster of the scheduler at an address."""
    return Here() if scheduler is None else Cluster(scheduler, tell)


def _in_words(error: Any) -> str:
    text = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {printable(str(error))}"
    return text[:_LONGEST]
