"""The gallery writes a page from a diagnosis alone, goes on where it was stopped, and says what falls short."""

import json
import shutil

import numpy as np
import pytest
from report_cases import SIMULATION, consistent, damped_pendulum, document

from experiments import _gallery_figures as figures
from experiments import _gallery_page_file as page_file
from experiments import _gallery_results as results
from experiments import gallery
from experiments._cluster import files_in
from experiments._gallery_diagnose import write_series
from experiments._gallery_known import compared
from symplearn._places import Here

NAME = "pendulum"
PAGE = """
title = "A damped pendulum"
known = "It is damped."
source = "A pen."
given = "No friction."
[[cases]]
name = "first"
holdout = 0.25
[[cases.known]]
about = "a loss is certain"
family = "dissipation"
[[cases.known]]
about = "its coefficient"
coefficient = "viscous_damping.c"
value = 0.0009
[[cases.known]]
about = "its law is open"
open = "dissipation"
[[cases.known]]
about = "held-out error"
column = "angle_deg"
value = 0.3
[[cases.known]]
about = "dry friction too"
effects = ["viscous_damping", "coulomb_friction"]
all = true
"""


@pytest.fixture
def place(drawn, monkeypatch):
    """The same without pictures, which take a second each."""
    for name in ("write_motion", "write_force"):
        monkeypatch.setattr(figures, name, lambda results, path: None)
    return drawn


@pytest.fixture
def drawn(tmp_path, monkeypatch):
    """A recording, a page for it, and a diagnosis that is made by hand and counted."""
    recordings, pages, made = tmp_path / "recordings", tmp_path / "pages", []
    for folder in (recordings / NAME, pages / NAME):
        folder.mkdir(parents=True)
    (recordings / NAME / "recording.csv").write_text("t_s,angle_deg\n0,1\n1,2\n")
    (recordings / NAME / "simulation.toml").write_text(SIMULATION)
    (pages / NAME / "page.toml").write_text(PAGE)

    def run(command):
        made.append(command)
        return leave(damped_pendulum(), command)

    monkeypatch.setattr(page_file, "PAGES", pages)
    monkeypatch.setattr(results, "_run", run)
    return tmp_path, made


def leave(diagnosis, command):
    """Leave what the pages read of a diagnosis where the command would."""
    folder = results.Path(command[command.index("--out") + 1])
    folder.mkdir(parents=True)
    (folder / "diagnosis.json").write_text(json.dumps(dict(diagnosis.document)))
    write_series(diagnosis, folder / "series.npz")
    return ""


def make(folder, *names):
    """Run the command; its exit code."""
    options = [f"--{name}={folder / name}" for name in ("out", "recordings", "kept")]
    return gallery.main([*names, *options])


def test_page_holds_what_the_diagnosis_says(drawn):
    """Verdict, finding, coefficient, alternatives and held-out errors stand on the page as in diagnosis.json."""
    folder, made = drawn
    assert make(folder) == 0 and len(made) == 1
    text = (folder / "out" / f"{NAME}.md").read_text()
    for words in ("# A damped pendulum", "It is damped.", "A pen.", "**mismatch**, probability 0.931", "0.0009032",
                  "between 0.00086 and 0.00094", "quadratic_drag(theta) and coulomb_friction(theta) | 0.051",
                  "14.5 | 0.612 | 23.7 × smaller", "+453.2", "python -m experiments.gallery pendulum"):  # fmt: skip
        assert words in text, words
    for picture in ("motion", "force"):
        png = (folder / "out" / f"{NAME}-{picture}.png").read_bytes()
        assert png.startswith(b"\x89PNG") and len(png) < 120_000
        assert f"({NAME}-{picture}.png)" in text
    assert "[A damped pendulum](pendulum.md)" in (folder / "out" / "README.md").read_text()


def test_page_says_what_falls_short(place):
    """Facts that the finding meets are counted, and each that it does not meet is named."""
    folder, _ = place
    make(folder)
    text = (folder / "out" / f"{NAME}.md").read_text()
    short = text.split("## What falls short")[1].split("##")[0]
    assert "held-out error." in short and "dry friction too." in short
    assert "a loss is certain" not in short and "its coefficient" not in short and "law is open" not in short
    assert "a factor of 2.04 | **no**" in text  # 0.61234 by 0.3
    assert "| 3 of 5 |" in (folder / "out" / "README.md").read_text()


@pytest.mark.parametrize(
    ("fact", "agrees"),
    [
        ({"verdict": "mismatch"}, True),
        ({"verdict": "not consistent"}, True),
        ({"verdict": "not mismatch"}, False),
        ({"family": "dissipation"}, True),
        ({"family": "sensor"}, False),
        ({"family": "sensor", "absent": True}, True),
        ({"effects": ("quadratic_drag", "viscous_damping(theta)")}, True),
        ({"effects": ("quadratic_drag", "viscous_damping(theta)"), "all": True}, False),
        ({"only": ("unnamed_force",)}, False),
        ({"only": ("viscous_damping",)}, True),
        ({"moment": 12.0, "value": 20.0}, True),
        ({"moment": 12.0, "value": 19.0}, False),
        ({"moment": 21.0, "value": 20.0}, False),
        ({"coefficient": "viscous_damping.c", "value": 0.00095}, False),
        ({"coefficient": "viscous_damping(theta).c", "value": 0.0007, "upper": 0.00087}, True),
        ({"coefficient": "coulomb_friction.f", "value": 0.1}, False),
        ({"parameter": "F", "value": 0.1508}, True),
        ({"parameter": "F", "value": 0.1512}, False),
        ({"parameter": "J", "value": 0.006}, False),
        ({"column": "angle_deg", "value": 0.41}, True),
        ({"column": "angle_deg", "value": 0.41, "factor": 1.2}, False),
    ],
)
def test_facts_are_held_against_the_diagnosis(fact, agrees):
    """Each way of asking a fact says yes and no where the damped pendulum's document does."""
    assert compared(page_file.Known("a fact", **fact), document()).agrees is agrees


def test_stopped_run_goes_on(place):
    """A kept result is taken as it is, and made anew where the recording has changed."""
    folder, made = place
    make(folder)
    make(folder)
    assert len(made) == 1
    with (folder / "recordings" / NAME / "recording.csv").open("a") as stream:
        stream.write("2,3\n")
    make(folder)
    assert len(made) == 2


def test_result_of_another_program_is_made_anew(place):
    """A result that an older version of the program left is kept only where that is asked for."""
    folder, made = place
    make(folder)
    path = folder / "kept" / NAME / "first" / "kept.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"program": "older"}))
    make(folder, "--any-version")
    assert len(made) == 1
    make(folder)
    assert len(made) == 2


def test_recordings_are_not_copied(place):
    """No rows of a recording lie among pages and kept results, not even of one that was cut for the diagnosis."""
    folder, made = place
    page = folder / "pages" / NAME / "page.toml"
    page.write_text(PAGE.replace("holdout = 0.25", 'prepare = { how = "chosen", column = "t_s", values = [1] }'))
    make(folder)
    given = made[0][made[0].index("experiments._gallery_diagnose") + 2]
    assert given.endswith("recording.csv") and not given.startswith(str(folder))
    assert not results.Path(given).exists()
    assert not [path for name in ("out", "kept") for path in (folder / name).rglob("*.csv")]


def test_failed_diagnosis_has_a_page(place, monkeypatch, capsys):
    """Where a diagnosis fails the page says how, the others are made, and the exit code is 1."""
    folder, _ = place
    monkeypatch.setattr(results, "_run", lambda command: "the fit fell over (exit code 1)")
    assert make(folder) == 1
    assert "The diagnosis failed: the fit fell over (exit code 1)." in (folder / "out" / f"{NAME}.md").read_text()
    assert NAME in capsys.readouterr().err


def test_workers_make_what_is_not_kept(place, monkeypatch):
    """Sent the files alone, they leave the results and the page of here; a second run asks them nothing."""
    folder, made = place
    make(folder)
    found = {name: files_in(folder / name) for name in ("out", "kept")}
    for name in found:
        shutil.rmtree(folder / name)
    monkeypatch.setattr(gallery, "place", lambda address, tell: Here())
    for _ in range(2):
        assert make(folder, "--scheduler=tcp://HOST:8786") == 0 and len(made) == 2
        assert {name: files_in(folder / name) for name in found} == found
    assert made[1][-2:] == ["--jobs", "1"] and not any(str(folder) in word for word in made[1])


def test_what_failed_at_a_worker_is_not_made_here(place, monkeypatch):
    """Its page says how, the exit code is 1, and the next run asks a worker again."""
    folder, made = place
    monkeypatch.setattr(gallery, "place", lambda address, tell: Here())
    monkeypatch.setattr(results, "_run", lambda command: made.append(command) or "the fit fell over (exit code 1)")
    for count in (1, 2):
        assert make(folder, "--scheduler=tcp://HOST:8786") == 1 and len(made) == count
        assert "The diagnosis failed: the fit fell over (exit code 1)." in (folder / "out" / f"{NAME}.md").read_text()


def test_recording_that_nobody_wrote_about(place):
    """A folder without a page of its own gets a plain one, diagnosed where a simulation lies in it."""
    folder, made = place
    (folder / "pages" / NAME / "page.toml").unlink()
    (folder / "recordings" / "lonely").mkdir()
    assert make(folder) == 0 and len(made) == 1
    assert "**mismatch**" in (folder / "out" / f"{NAME}.md").read_text()
    assert "nothing was diagnosed" in (folder / "out" / "lonely.md").read_text()
    assert "(lonely.md) | not diagnosed" in (folder / "out" / "README.md").read_text()


def test_index_keeps_other_pages(place):
    """Making one page leaves the lines of the others in the index."""
    folder, _ = place
    (folder / "recordings" / "lonely").mkdir()
    make(folder)
    make(folder, "lonely")
    index = (folder / "out" / "README.md").read_text()
    assert "(lonely.md)" in index and "23.7 ×" in index


def test_consistent_has_a_page(place, monkeypatch):
    """Nothing found and nothing held out is told without numbers that are not there."""
    folder, _ = place
    monkeypatch.setattr(results, "_run", lambda command: leave(consistent(), command))
    assert make(folder) == 0
    text = (folder / "out" / f"{NAME}.md").read_text()
    assert "**consistent**, probability 0.988" in text and "None" not in text and "nan" not in text


def test_wrong_use_is_one_sentence(place, capsys):
    """An absent folder, an unknown name and an unknown key each give one sentence and exit code 2."""
    folder, _ = place
    assert make(folder / "nowhere") == 2
    assert "no recordings lie in" in capsys.readouterr().err
    assert make(folder, "pendulun") == 2
    assert "`pendulum`" in capsys.readouterr().err
    assert make(folder, "--scheduler=nonsense") == 2 and not (folder / "out").exists()
    assert capsys.readouterr().err.startswith("experiments.gallery: --scheduler: `nonsense` is no address")
    with (folder / "pages" / NAME / "page.toml").open("a") as stream:
        stream.write("certain = true\n")
    assert make(folder) == 2
    said = capsys.readouterr().err
    assert "'certain'" in said and said.count("\n") == 1


def test_series_come_back_whole(tmp_path):
    """The arrays behind the pictures are those of the diagnosis."""
    diagnosis = damped_pendulum()
    write_series(diagnosis, tmp_path / "series.npz")
    with np.load(tmp_path / "series.npz") as kept:
        for name in ("times", "readings", "before", "after", "force_before", "velocity"):
            np.testing.assert_array_equal(kept[f"1/{name}"], getattr(diagnosis.series[0], name))
        assert kept["1/boundary"] == diagnosis.series[0].boundary
