"""A run that is stopped, at whatever moment, leaves complete files under their final names or none."""

import contextlib
import signal
import subprocess
import time

import pytest
from command_line_cases import COMMAND, ONE_EFFECT, environment, write_case
from contract import check_document, strict_json

from symplearn._progress import Progress
from symplearn.cli import _folder
from symplearn.report import _directory

FILES = {"augmented.toml", "report.html", "diagnosis.json"}


def started(folder, out):
    """The command on the small case, and its stderr to follow."""
    arguments = [*COMMAND, "diagnose", *write_case(folder), "--out", str(out), *ONE_EFFECT]
    return subprocess.Popen(
        arguments, env=environment(PYTHONUNBUFFERED="1"), stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
    )


@pytest.mark.parametrize("blow", [signal.SIGTERM, signal.SIGKILL, signal.SIGINT])
def test_stopped_in_the_middle(blow, tmp_path):
    """Stopped while it searches, it leaves no folder and says so, with code 130 or 143; killed, an empty folder."""
    run = started(tmp_path, tmp_path / "out")
    run.stderr.readline()
    run.send_signal(blow)
    rest = run.communicate(timeout=60)[1]
    if blow == signal.SIGKILL:
        assert run.returncode == -blow and not list((tmp_path / "out").iterdir())
    else:
        assert run.returncode == 128 + blow and rest.endswith("symplearn: stopped; nothing was written\n")
        assert not (tmp_path / "out").exists()
    assert "Traceback" not in rest


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.0, 0.4])
def test_killed_while_it_writes(delay, tmp_path):
    """Killed while the report is drawn or written, every file under a final name is complete."""
    run = started(tmp_path, tmp_path / "out")
    for line in run.stderr:
        if "writing the report" in line:
            break
    time.sleep(delay)
    run.kill()
    run.communicate(timeout=60)
    _check_complete(tmp_path / "out")


def _check_complete(folder):
    names = {path.name for path in folder.iterdir() if not path.name.startswith(".")}
    assert names <= FILES
    if "report.html" in names:
        assert (folder / "report.html").read_text().rstrip().endswith("</html>")
    if "diagnosis.json" in names:
        assert names == FILES  # it comes last: who sees it sees the others
        check_document(strict_json((folder / "diagnosis.json").read_text()), ["x_m"], ["p"])


def test_full_disk_leaves_the_old_answer(tmp_path, monkeypatch):
    """Where one file cannot be written, none is renamed: the old answer stays, and no temporary file does."""
    old = {tmp_path / name: b"old" for name in ("a.txt", "b.txt")}
    _directory.put(old)

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(_directory.os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        _directory.put({path: b"new" for path in old})
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == old


def test_a_folder_that_was_there_stays(tmp_path):
    """A run that is stopped takes away only folders that it has made, and no folder that something lies in."""
    (tmp_path / "mine").mkdir()
    run = started(tmp_path, tmp_path / "mine")
    run.stderr.readline()
    run.send_signal(signal.SIGTERM)
    run.communicate(timeout=60)
    assert run.returncode == 143 and not list((tmp_path / "mine").iterdir())
    with pytest.raises(RuntimeError), _folder(tmp_path / "new" / "deep"):
        (tmp_path / "new" / "note").touch()
        raise RuntimeError
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["note"]


def test_a_stop_that_was_swallowed_is_heard_at_the_next_step():
    """Python drops a Ctrl-C that arrives inside a destructor; the run then stops at its next progress message."""
    for number, told in ((signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit)):
        before = signal.getsignal(number)
        with pytest.raises(told), Progress() as progress:
            progress.say("searching")
            with contextlib.suppress(told):
                signal.raise_signal(number)
            progress.say("writing the report")
        assert signal.getsignal(number) is before
