"""Where the real recordings lie, and what the command says about one of them."""

import os
from pathlib import Path
from typing import NoReturn

import pytest

from symplearn._recording import read_recordings
from symplearn._simulation_file import read_simulation
from symplearn.diagnosis import Options, diagnose

FOLDER = Path(os.environ.get("SYMPLEARN_RECORDINGS") or Path(__file__).parents[1] / ".." / "shared" / "recordings")


def real_case(name: str, recording: str = "recording.csv") -> tuple[Path, Path]:
    """Simulation file and recording of one system.

    The test is skipped where they are absent, and fails instead where `SYMPLEARN_REQUIRE_RECORDINGS` is 1.
    """
    paths = FOLDER / name / "simulation.toml", FOLDER / name / recording
    missing = [path for path in paths if not path.is_file()]
    if missing:
        sentence = f"no real recording at {missing[0]}; set SYMPLEARN_RECORDINGS to the folder that holds {name}"
        absent(sentence)
    return paths


def absent(sentence: str) -> NoReturn:
    """Say that a recording is missing: skip the test, or fail where `SYMPLEARN_REQUIRE_RECORDINGS` is 1."""
    if os.environ.get("SYMPLEARN_REQUIRE_RECORDINGS") == "1":
        pytest.fail(sentence)
    pytest.skip(sentence)


def document_of(name: str, recording: str = "recording.csv") -> dict:
    """`diagnosis.json` of one real recording, as the command would write it."""
    simulation, csv = real_case(name, recording)
    file = read_simulation(simulation)
    return dict(diagnose(file, read_recordings(file, [csv]), Options()).document)


def effects(document: dict) -> set[str]:
    """The names of the findings."""
    return {finding["effect"] for finding in document["findings"]}


def rmse(document: dict, when: str) -> float:
    """Held-out rmse of the one recorded column."""
    (value,) = document["fit"][when]["holdout_rmse"].values()
    return value
