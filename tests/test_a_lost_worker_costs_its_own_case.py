"""Cases run here or on a Dask cluster: a worker that dies costs its own case a second try, and nothing else."""

import contextlib
import importlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter

import distributed
import pytest

from symplearn._errors import InputError
from symplearn._places import Cluster, Here, Outcome, place


def divided(a, b):
    return divmod(a, b)


def test_every_case_ends_with_a_value_or_a_failure():
    """In this process: outcomes as they end, each with its number; a case that fails does not stop the next."""
    with place(None) as here:
        found = list(here.outcomes(divided, [(7, 2), (1, 0), (9, 4)]))
    assert [one.number for one in found] == [0, 1, 2]
    assert found[0] == Outcome(0, (3, 1)) and found[2] == Outcome(2, (2, 1))
    assert found[1].value is None and found[1].failure.startswith("ZeroDivisionError: ")
    assert isinstance(here, Here)


@pytest.mark.parametrize("address", ["", "nonsense", "tcp://host", "tcp://host:99999", "ftp://host:8786", "a b:1"])
def test_an_address_that_is_none_is_refused(address):
    """One sentence says what an address looks like, before anything is asked of a network."""
    with pytest.raises(InputError, match="is no address; give one as tcp://HOST:8786"):
        place(address)


def test_a_missing_extra_is_named(monkeypatch):
    """Without Dask the sentence says how to install it."""
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match="pip install 'symplearn.cluster.'"):
        Cluster("tcp://localhost:8786")


def test_a_scheduler_that_does_not_answer_is_named(monkeypatch):
    """Nobody listens at port 1: one sentence, soon."""
    monkeypatch.setattr("symplearn._places._PATIENCE", 0.5)
    with pytest.raises(InputError, match="no Dask scheduler answers at `tcp://localhost:1`"):
        Cluster("tcp://localhost:1")


def until(what, seconds=60.0):
    """What is not None, once it is there."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if (found := what()) is not None:
            return found
        time.sleep(0.02)
    raise AssertionError("it did not happen")


def dask(log, *words, **environment):
    """A process of Dask's own, which lives in the folder of its log."""
    command = [sys.executable, "-m", "dask", *words]
    with log.open("w") as said:
        return subprocess.Popen(command, stdout=said, stderr=said, cwd=log.parent, env=os.environ | environment)


@contextlib.contextmanager
def cluster(folder, workers, **environment):
    """A scheduler that gives a case up at its second death, with so many worker processes: address and process."""
    words = ("--host", "localhost", "--port", "0", "--no-dashboard", "--scheduler-file", "scheduler.json")
    processes = [dask(folder / "scheduler", "scheduler", *words, DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES="1")]
    try:
        address = until(lambda: address_in(folder / "scheduler.json"))
        words = (address, "--nthreads", "1", "--no-nanny", "--no-dashboard")
        processes += [dask(folder / f"worker{k}", "worker", *words, **environment) for k in range(workers)]
        with distributed.Client(address, set_as_default=False) as client:
            client.wait_for_workers(workers, timeout=60)
        yield address, processes[0]
    finally:
        for process in processes:
            process.kill()
            process.wait()


def address_in(file):
    try:
        return json.loads(file.read_text())["address"]
    except (OSError, ValueError):
        return None


def test_a_killed_worker_costs_its_own_case(tmp_path):
    """Of two processes one is killed at its case: the other tries that again, and runs every other case once.

    Killed once all others are handed over: what lay at the dead worker still would be worked out again.
    """
    log, held, found = tmp_path / "log", tmp_path / "held", []

    # Inside the test, so that the worker is sent the function itself and imports nothing of ours.
    def work(number, log=str(log), held=str(held)):
        import os
        import time

        with open(log, "a") as file:
            file.write(f"{number} {os.getpid()}\n")
        while number == 2 and os.path.exists(held):
            time.sleep(0.02)
        return number**2

    def kill():
        until(lambda: True if len(found) == 7 else None)
        os.kill(next(pid for number, pid in lines(log) if number == 2), signal.SIGKILL)
        held.unlink()

    held.touch()
    killer = threading.Thread(target=kill)
    killer.start()
    with cluster(tmp_path, 2) as (address, _), place(address) as workers:
        for outcome in workers.outcomes(work, [(k,) for k in range(8)]):
            found.append(outcome)
    killer.join()
    assert sorted(found) == [Outcome(k, k**2) for k in range(8)]
    runs = lines(log)
    assert Counter(number for number, _ in runs) == Counter([*range(8), 2])
    first, second = (pid for number, pid in runs if number == 2)
    assert first != second


def lines(log):
    """Which case was begun by which process."""
    written = log.read_text().splitlines(keepends=True) if log.exists() else []
    return [tuple(map(int, line.split())) for line in written if line.endswith("\n")]


def test_a_case_that_kills_every_worker_is_a_failure(tmp_path):
    """It is given up at the second death, told in words, and the other cases have their values."""

    def work(number):
        import os
        import signal

        if number == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return number if number != 1 else 1 // 0

    with cluster(tmp_path, 3) as (address, _), place(address) as workers:
        found = sorted(workers.outcomes(work, [(k,) for k in range(5)]))
    assert found[0] == Outcome(0, failure="every worker that was at it died")
    assert found[1].failure.startswith("ZeroDivisionError: ")
    assert found[2:] == [Outcome(k, k) for k in range(2, 5)]


def test_the_scheduler_needs_nothing_of_the_work(tmp_path, monkeypatch):
    """A module that the workers have and the scheduler has not is enough; one that they lack is told by its name."""
    for folder, name in (("theirs", "halving"), ("ours", "thirding")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / f"{name}.py").write_text("def work(number):\n    return number / 2\n")
        monkeypatch.syspath_prepend(tmp_path / folder)
    works = [importlib.import_module(name).work for name in ("halving", "thirding")]
    with cluster(tmp_path, 1, PYTHONPATH=str(tmp_path / "theirs")) as (address, _), place(address) as workers:
        (found,), (lost,) = (list(workers.outcomes(work, [(3,)])) for work in works)
    assert found == Outcome(0, 1.5)
    assert lost.failure == "ModuleNotFoundError: No module named 'thirding'"


def test_a_scheduler_that_goes_away_is_told(tmp_path):
    """What was done before has been handed over; then comes one sentence."""

    def work(number):
        import time

        time.sleep(60.0 * number)
        return number

    with cluster(tmp_path, 1) as (address, scheduler), place(address) as workers:
        outcomes = workers.outcomes(work, [(0,), (1,)])
        assert next(outcomes) == Outcome(0, 0)
        scheduler.kill()
        with pytest.raises(ConnectionError, match="went away; what is done is kept"):
            next(outcomes)
