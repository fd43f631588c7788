"""`diagnose-each` answers for every recording what `diagnose` answers of it alone, and keeps what is done."""

import json

import pytest
from command_line_cases import ONE_EFFECT, csv_text, damped, run_here, write_case

from symplearn._errors import InputError
from symplearn._places import Cluster


@pytest.fixture
def command(capsys, monkeypatch):
    """The command in this process."""
    return lambda *arguments: run_here(capsys, monkeypatch, *arguments)


def answer(folder):
    document = json.loads((folder / "diagnosis.json").read_text())
    return document["verdict"], document["probability"], document["findings"], document["fit"]


@pytest.mark.slow
def test_each_is_answered_as_alone_and_kept(command, tmp_path):
    """Two recordings get their own reports, a broken one its sentence; again, only the broken one is read."""
    simulation, damped_one = write_case(tmp_path)
    (tmp_path / "free.csv").write_text(csv_text(*damped(damping=0.0, seed=1)))
    (tmp_path / "broken.csv").write_text("t,x_m\n0.0,1.0\n0.1,one\n")
    each = [damped_one, tmp_path / "broken.csv", tmp_path / "free.csv"]
    asked = ("diagnose-each", simulation, *each, "--out", tmp_path / "each", *ONE_EFFECT)
    ran = command(*asked)
    assert ran.code == 1 and "1 of 3 recordings could not be diagnosed" in ran.err
    lines = ran.out.splitlines()
    assert [line.split(": ")[0] for line in lines] == ["recording", "broken", "free"]
    assert lines[1].startswith("broken: failed: broken.csv") and "one" in lines[1] and str(tmp_path) not in lines[1]
    assert command("diagnose", simulation, damped_one, "--out", tmp_path / "alone", *ONE_EFFECT).code == 0
    assert answer(tmp_path / "each" / "recording") == answer(tmp_path / "alone")
    assert answer(tmp_path / "each" / "recording")[0] == "mismatch"
    assert answer(tmp_path / "each" / "free")[0] == "consistent"
    left = {path.name for path in (tmp_path / "each" / "free").iterdir()}
    assert left == {"diagnosis.json", "report.html", "augmented.toml", "question.sha256"}
    again = command(*asked)
    assert again.code == 1
    assert sorted(again.out.splitlines()) == sorted([lines[1], "recording: kept from before", "free: kept from before"])


def test_another_question_is_no_kept_answer(command, tmp_path, monkeypatch):
    """Another seed, or a recording that has changed, is asked anew; more threads are not."""
    asked = []

    def answered(question):
        asked.append(question.recording)
        return "It is said.", {"diagnosis.json": b"{}"}

    monkeypatch.setattr("symplearn._each_recording.answered", answered)
    simulation, recording = write_case(tmp_path)
    for options in ((), (), ("--jobs", "3"), ("--seed", "1"), ("--seed", "1")):
        assert command("diagnose-each", simulation, recording, "--out", tmp_path / "out", *options).code == 0
    assert len(asked) == 2
    (tmp_path / "recording.csv").write_text(csv_text(*damped(seed=2)))
    ran = command("diagnose-each", simulation, recording, "--out", tmp_path / "out", "--seed", "1")
    assert ran.out == "recording: It is said.\n" and len(asked) == 3 and asked[2] != asked[1]


def test_a_failure_says_that_the_report_is_an_earlier_one(command, tmp_path, monkeypatch):
    """A recording that fails now and was answered before keeps that report, and its line says that it is earlier."""
    monkeypatch.setattr("symplearn._each_recording.answered", lambda question: ("Said.", {"diagnosis.json": b"{}"}))
    simulation, recording = write_case(tmp_path)
    asked = ("diagnose-each", simulation, recording, "--out", tmp_path / "out")
    assert command(*asked).code == 0

    def fail(question):
        raise InputError("recording.csv: line 3: no number")

    monkeypatch.setattr("symplearn._each_recording.answered", fail)
    (tmp_path / "recording.csv").write_text("t,x_m\n")
    ran = command(*asked)
    assert ran.code == 1
    assert (
        ran.out == "recording: failed: recording.csv: line 3: no number; the report in its folder is an earlier one\n"
    )
    assert (tmp_path / "out" / "recording" / "diagnosis.json").read_bytes() == b"{}"


def refused(scheduler, tell):
    raise InputError("--scheduler: no Dask scheduler answers at `tcp://localhost:1`; start one")


def test_wrong_use_is_one_line(command, tmp_path, monkeypatch):
    """Files of one name, a file that is not there, a wrong simulation or address: exit code 2, nothing diagnosed."""
    simulation, recording = write_case(tmp_path)
    other = tmp_path / "other" / "recording.csv.gz"
    other.parent.mkdir()
    other.write_text("")
    for files, options, said in (
        ((simulation, recording, other), (), "would be in the folder `recording` as another's"),
        ((simulation, tmp_path / "..csv"), (), "..csv`: its name makes no folder for its report; rename it"),
        ((simulation, tmp_path / "none.csv"), (), "none.csv: no such file"),
        ((recording, recording), (), "recording.csv"),
        ((simulation, recording), ("--scheduler", "nonsense"), "--scheduler: `nonsense` is no address"),
        ((simulation, recording), ("--holdout", "1"), "--holdout"),
    ):
        ran = command("diagnose-each", *files, "--out", tmp_path / "out", *options)
        assert ran.code == 2 and ran.out == "" and ran.err.count("\n") == 1 and said in ran.err
    monkeypatch.setattr(Cluster, "__init__", lambda self, address, tell: refused(address, tell))
    ran = command("diagnose-each", simulation, recording, "--out", tmp_path / "out", "--scheduler", "localhost:1")
    assert ran.code == 2 and ran.err.startswith("symplearn: --scheduler: no Dask scheduler answers")
    assert not (tmp_path / "out").exists()
