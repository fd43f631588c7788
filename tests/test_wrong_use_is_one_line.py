"""Whatever is wrong with a command line, the command says so in one line on stderr and leaves with code 2."""

import subprocess
import sys
from importlib.metadata import version

import pytest
from command_line_cases import Ran, environment, run_apart, run_here, write_case


@pytest.fixture
def command(capsys, monkeypatch):
    """The command in this process."""
    return lambda *arguments: run_here(capsys, monkeypatch, *arguments)


def one_line(ran: Ran) -> str:
    """What was said, after checking that it is one line and nothing else was."""
    assert ran.code == 2 and ran.out == ""
    assert ran.err.startswith("symplearn: ") and ran.err.count("\n") == 1 and "Traceback" not in ran.err
    return ran.err


WRONG = {
    "no such option": (("--hold", "0.2"), "--hold"),
    "holdout above one": (("--holdout", "1.5"), "--holdout: is 1.5"),
    "holdout of one": (("--holdout", "1"), "--holdout: is 1.0"),
    "holdout below zero": (("--holdout", "-0.1"), "--holdout"),
    "holdout not a number": (("--holdout", "nan"), "--holdout"),
    "holdout a word": (("--holdout", "half"), "--holdout"),
    "seed a word": (("--seed", "x"), "--seed"),
    "seed without value": (("--seed",), "--seed"),
    "no folder": (("--out", ""), "--out: is empty"),
    "no jobs": (("--jobs", "0"), "--jobs"),
    "no time": (("--time-limit", "0"), "--time-limit"),
    "both restrictions": (("--sensor-only", "--dynamics-only"), "exclude each other"),
    "unknown effect": (("--effects", "vicous_damping"), "did you mean `viscous_damping`?"),
    "empty effects": (("--effects", ","), "--effects"),
    "step without end": (("--forecast-step", "0.1"), "--forecast-until"),
    "step of zero": (("--forecast-until", "30", "--forecast-step", "0"), "--forecast-step"),
    "forecast of the past": (
        ("--forecast-until", "3"),
        "is 3, and the last observed time is 16; give a time at least 0.2",
    ),
    "force without a name read off a sensor": (("--sensor-only", "--effects", "unnamed_force"), "--sensor-only"),
    "endless forecast": (("--forecast-until", "inf"), "--forecast-until"),
    "restrictions that leave nothing": (("--sensor-only", "--effects", "viscous_damping"), "--sensor-only"),
    "seed beyond 64 bits": (("--seed", "9" * 30), "--seed"),
}


@pytest.mark.parametrize("options, said", WRONG.values(), ids=WRONG.keys())
def test_wrong_options(options, said, command, tmp_path):
    """A wrong option is named with what is wrong about it, before any work."""
    ran = command("diagnose", *write_case(tmp_path), "--out", tmp_path / "out", *options)
    assert said in one_line(ran)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("arguments", [("diagnose",), ("diagnose", "only.toml"), ("diagnosis",), ("--fast",)])
def test_wrong_commands(arguments, command):
    """A missing file or an unknown command is one line that says where help is."""
    assert "--help` tells" in one_line(command(*arguments))


def test_wrong_files(command, tmp_path):
    """A file that is not there, not TOML, or a folder is named."""
    simulation, recording = write_case(tmp_path)
    (tmp_path / "not.toml").write_text("this is not TOML")
    for first, second, name in (
        (tmp_path / "none.toml", recording, "none.toml"),
        (tmp_path / "not.toml", recording, "not.toml"),
        (tmp_path, recording, str(tmp_path)),
        (simulation, tmp_path / "none.csv", "none.csv"),
        (simulation, tmp_path, str(tmp_path)),
        (recording, simulation, "recording.csv"),
    ):
        assert name in one_line(command("diagnose", first, second, "--out", tmp_path / "out"))


def test_output_folder_that_is_a_file(command, tmp_path):
    """An output folder that cannot be one is said before the work, and the file in the way stays what it was."""
    (tmp_path / "out").write_text("mine")
    for out in (tmp_path / "out", tmp_path / "out" / "below"):
        assert "--out" in one_line(command("diagnose", *write_case(tmp_path), "--out", out))
    assert (tmp_path / "out").read_text() == "mine"


def test_names_with_control_characters_stay_on_one_line(command, tmp_path):
    """A file name cannot write a second line or an escape sequence to the terminal."""
    said = one_line(command("diagnose", tmp_path / "a\nb\x1b[31m.toml", tmp_path / "c.csv"))
    assert "\x1b" not in said


def test_no_arguments_show_the_help(command):
    """The bare command says what there is."""
    ran = command()
    assert ran.code == 0 and "diagnose" in ran.out and "demo" in ran.out


def test_the_version_is_told(command):
    """`--version` prints the version that `diagnosis.json` has, and does nothing else."""
    ran = command("--version")
    assert ran.code == 0 and ran.out == f"symplearn {version('symplearn')}\n" and ran.err == ""


def test_the_package_is_the_command(tmp_path):
    """`python -m symplearn` is the command, for an environment whose programs are not on the path."""
    done = subprocess.run(
        [sys.executable, "-m", "symplearn", "diagnose", "none.toml", "none.csv"],
        cwd=tmp_path,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 2 and done.stderr.startswith("symplearn: none.toml")


def test_a_failure_is_one_line_and_code_1(command, tmp_path, monkeypatch):
    """What goes wrong inside is one line and exit code 1, without a traceback."""

    def fail(*_):
        raise RuntimeError("first line\nsecond line")

    monkeypatch.setattr("symplearn._recording.read_recordings", fail)
    ran = command("diagnose", *write_case(tmp_path), "--out", tmp_path / "out")
    assert ran.code == 1 and ran.err.count("\n") == 1 and "RuntimeError" in ran.err


def test_a_process_of_its_own_says_the_same(tmp_path):
    """The exit code and the line reach a shell."""
    assert "none.toml" in one_line(run_apart("diagnose", tmp_path / "none.toml", tmp_path / "none.csv", cwd=tmp_path))
    assert not list(tmp_path.iterdir())
