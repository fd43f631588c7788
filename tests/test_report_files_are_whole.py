"""What a diagnosis leaves in its folder is strict, complete, exact, and there whole or not at all."""

import csv
import json
import os
import tomllib

import numpy as np
import pytest
import report_cases as cases

from symplearn._errors import InputError
from symplearn._simulation_file import read_simulation
from symplearn.report import _write as writing
from symplearn.report import before_after_picture, prepare_directory, write_outputs


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """These tests are about files: the page is one word and a name, without pictures."""
    monkeypatch.setattr(writing, "html_report", lambda diagnosis: f"<!doctype html>{diagnosis.title}")


def refuse(constant):
    raise AssertionError(f"{constant} is not strict JSON")


def test_json_is_the_document(tmp_path):
    """diagnosis.json is strict JSON, the document's keys in its order and its numbers to the last bit."""
    record = cases.damped_pendulum()
    path = write_outputs(record, tmp_path)[0]
    answer = json.loads(path.read_text("utf-8"), parse_constant=refuse)
    assert path.name == "diagnosis.json"
    assert answer == record.document
    assert list(answer) == list(record.document)
    assert list(answer["fit"]["after"]) == list(record.document["fit"]["after"])


def test_a_nan_is_refused_before_anything_is_written(tmp_path):
    """A document with a NaN raises, and the folder stays as it was."""
    record = cases.damped_pendulum(forecast=cases.forecast())
    record.document["fit"]["after"]["holdout_rmse"]["angle_deg"] = float("nan")
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_outputs(record, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_forecast_is_exact(tmp_path):
    """forecast.csv has every number to the last bit, under the right names; no number is an empty cell."""
    forecast = cases.forecast()
    forecast.columns["angle_deg"]["before"][3] = np.inf
    written = write_outputs(cases.damped_pendulum(forecast=forecast), tmp_path)
    assert sorted(p.name for p in written) == sorted(p.name for p in tmp_path.iterdir())
    with open(tmp_path / "forecast.csv", newline="") as file:
        header, *rows = csv.reader(file)
    kinds = ("before", "before_sd", "after", "after_sd")
    assert header == ["t", *(f"angle_deg_{kind}" for kind in kinds)]
    assert rows[3][1] == ""
    read = np.array([[float(cell or "inf") for cell in row] for row in rows])
    expected = np.column_stack([forecast.times, *(forecast.columns["angle_deg"][kind] for kind in kinds)])
    assert np.array_equal(read, expected)


def test_an_old_forecast_goes(tmp_path):
    """A forecast of an earlier run does not stand beside an answer without one."""
    write_outputs(cases.damped_pendulum(forecast=cases.forecast()), tmp_path)
    names = {p.name for p in write_outputs(cases.damped_pendulum(), tmp_path)}
    assert names == {p.name for p in tmp_path.iterdir()}
    assert names == {"diagnosis.json", "report.html", "augmented.toml"}


def test_the_augmented_simulation_reads_back(tmp_path):
    """augmented.toml is TOML, and the simulation read from it equals the record's."""
    record = cases.damped_pendulum()
    write_outputs(record, tmp_path)
    assert tomllib.loads((tmp_path / "augmented.toml").read_text("utf-8"))["title"] == record.augmented.title
    assert read_simulation(tmp_path / "augmented.toml") == record.augmented


@pytest.mark.parametrize("failing", [1, 2, 3, 4])
def test_nothing_is_half_written(tmp_path, monkeypatch, failing):
    """Where writing any of the four files fails, the earlier run's files stand untouched, and no others."""
    write_outputs(cases.damped_pendulum(title="earlier", forecast=cases.forecast()), tmp_path)
    earlier = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    later, calls = cases.damped_pendulum(forecast=cases.forecast()), []
    later.document["seed"] = 7

    def full_disk(descriptor):
        calls.append(descriptor)
        if len(calls) == failing:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(OSError, match="No space left"):
        write_outputs(later, tmp_path)
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == earlier


def test_a_stopped_run_leaves_no_temporary_file(tmp_path, monkeypatch):
    """An interrupt between two files leaves the folder empty."""

    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_outputs(cases.damped_pendulum(), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_files_have_the_usual_mode(tmp_path):
    """Outputs are as readable as any file the user makes."""
    (tmp_path / "mine").write_text("")
    paths = write_outputs(cases.damped_pendulum(), tmp_path)
    assert {p.stat().st_mode for p in paths} == {(tmp_path / "mine").stat().st_mode}


def test_the_folder_is_made_and_left_empty(tmp_path):
    """A folder that does not exist is made with its parents; trying it leaves nothing in it."""
    made = prepare_directory(tmp_path / "a" / "b")
    assert made.is_dir() and list(made.iterdir()) == []
    assert prepare_directory(made) == made


def test_a_folder_that_cannot_be_written_is_one_sentence(tmp_path):
    """A file, a path through a file, a place where nobody may write: one sentence with the remedy."""
    file = tmp_path / "file"
    file.write_text("mine")
    (tmp_path / "taken" / "report.html").mkdir(parents=True)
    # Root may write everywhere but into a file and into /proc.
    for path in (
        file,
        file / "below",
        "/proc/symplearn",
        "/proc",
        tmp_path / ("x" * 300),
        tmp_path / "taken",
        "a\0b",
    ):
        with pytest.raises(InputError, match="^output folder `.*--out$") as caught:
            prepare_directory(path)
        assert "\n" not in str(caught.value)
    assert file.read_text() == "mine"


def test_the_picture_is_a_png_of_its_size(tmp_path):
    """The before-and-after picture is a PNG of 900 x 420 pixels; an unknown column is refused by name."""
    path = before_after_picture(cases.damped_pendulum(), tmp_path / "picture.png")
    content = path.read_bytes()
    assert content[:8] == b"\x89PNG\r\n\x1a\n"
    # Width and height stand in the first chunk of every PNG.
    assert (int.from_bytes(content[16:20]), int.from_bytes(content[20:24])) == (900, 420)
    with pytest.raises(ValueError, match="expected a recorded column, one of angle_deg"):
        before_after_picture(cases.damped_pendulum(), tmp_path / "none.png", column="speed")
    assert [p.name for p in tmp_path.iterdir()] == ["picture.png"]
