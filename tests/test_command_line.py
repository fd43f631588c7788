"""`symplearn diagnose` keeps the contract: its files, its exit codes, its streams and its options."""

import csv
import gzip
import json
import os
import stat

import numpy as np
import pytest
from command_line_cases import DEMO, ONE_EFFECT, SIMULATION, csv_text, damped, run_apart, run_here, write_case
from contract import check_document, strict_json

from symplearn._simulation_file import read_simulation


@pytest.fixture(scope="session")
def demo(tmp_path_factory):
    """One run of the case that ships with the package, in a process and a home of its own: (run, folder, home)."""
    home = tmp_path_factory.mktemp("home")
    work = home / "work"
    work.mkdir()
    files = DEMO / "simulation.toml", DEMO / "recording.csv"
    # The shared cache of compiled programs stays in use: the run is then seconds, not minutes.
    cache = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    ran = run_apart(
        "diagnose", *files, "--out", "out", "--forecast-until", "22", "--forecast-step", "0.5", "--fail-on-mismatch",
        cwd=work, HOME=str(home), XDG_CACHE_HOME=cache, PYTHONDONTWRITEBYTECODE="1",
    )  # fmt: skip
    return ran, work / "out", home


@pytest.fixture(scope="session")
def small(tmp_path_factory):
    """One run on the small case, in a process of its own: (run, its files, folder)."""
    folder = tmp_path_factory.mktemp("small")
    case = write_case(folder)
    return run_apart("diagnose", *case, "--out", folder / "out", *ONE_EFFECT), case, folder / "out"


@pytest.fixture
def command(capsys, monkeypatch):
    """The command in this process."""
    return lambda *arguments: run_here(capsys, monkeypatch, *arguments)


def read(folder):
    """The diagnosis in a folder."""
    return strict_json((folder / "diagnosis.json").read_text(encoding="utf-8"))


def without_seconds(folder):
    """The diagnosis as text, but for the one key that may differ."""
    return json.dumps(read(folder) | {"seconds": 0})


def test_demo_names_the_concealed_effect(demo):
    """The case inside the package: viscous damping found with certainty, its value right, its rivals rejected."""
    ran, out, _ = demo
    document = read(out)
    check_document(document, ["angle_rad"], ["p_theta"], recordings=3)
    assert document["verdict"] == "mismatch"
    assert [(f["effect"], f["target"]) for f in document["findings"]] == [("viscous_damping", "theta")]
    assert document["probability"] > 0.75  # 0.89 when the case was made
    low, high = document["findings"][0]["coefficients"]["c"]["interval95"]
    assert low < 0.0015 < high  # experiments/demo_case.py
    before, after = (document["fit"][w]["holdout_rmse"]["angle_rad"] for w in ("before", "after"))
    assert after < 0.08 * 1.1 and before > 2 * after  # the noise is 0.08: nothing but it is left
    # A remainder may be ahead of white noise by chance, and is then none.
    assert not [one for one in document["warnings"] if "left beside the findings" in one]


def test_demo_streams_and_exit_code(demo):
    """The finding stands on stdout, the progress on stderr, and --fail-on-mismatch exits with 3."""
    ran, out, _ = demo
    assert ran.code == 3
    assert "viscous damping" in ran.out and "report.html" in ran.out and "weighing" not in ran.out
    assert "weighing" in ran.err and "viscous" not in ran.err
    assert "Traceback" not in ran.err and "Warning" not in ran.err


def test_demo_writes_its_files_and_nothing_else(demo):
    """Four files under their names, nothing beside them, and nothing anywhere else in the home."""
    _, out, home = demo
    names = {"diagnosis.json", "report.html", "augmented.toml", "forecast.csv"}
    assert {path.name for path in out.iterdir()} == names
    assert {path for path in home.rglob("*") if path.is_file()} == {out / name for name in names}
    assert read_simulation(out / "augmented.toml").terms


def test_forecast_has_the_rows_and_columns_of_the_contract(demo):
    """Rows run from the last observed time + DT to T; the expected readings are finite, their sd positive."""
    _, out, _ = demo
    with open(out / "forecast.csv", newline="") as file:
        header, *rows = csv.reader(file)
    kinds = ("before", "before_sd", "after", "after_sd")
    assert header == ["t", *(f"angle_rad_{kind}" for kind in kinds)]
    values = np.array(rows, float)
    assert np.allclose(values[:, 0], [20.5, 21.0, 21.5, 22.0])
    assert np.isfinite(values).all() and (values[:, [2, 4]] > 0).all()


def mentioned(document):
    """Every effect in findings and alternatives."""
    rows = [document, *document["alternatives"]]
    return {one["effect"] for row in rows for one in row["findings"]}


def test_small_case_keeps_the_contract(small):
    """A one-effect search gives every key of section 4, exit code 0, no other effect, and the closed form's damping."""
    ran, _, out = small
    document = read(out)
    assert ran.code == 0
    check_document(document, ["x_m"], ["p"])
    low, high = document["findings"][0]["coefficients"]["c"]["interval95"]
    assert low < 0.1 < high
    assert mentioned(document) == {"viscous_damping"}
    assert not (out / "forecast.csv").exists()


def test_same_files_give_the_same_answer(small, command, tmp_path):
    """Same seed, same files: the same answer but for `seconds`, in another process and with other --jobs."""
    _, case, out = small
    command("diagnose", *case, "--out", tmp_path, *ONE_EFFECT, "--jobs", "1")
    assert without_seconds(tmp_path) == without_seconds(out)
    assert (tmp_path / "augmented.toml").read_text() == (out / "augmented.toml").read_text()


@pytest.mark.slow
def test_nothing_held_out_is_null(command, tmp_path):
    """--holdout 0 fits every row: the held-out keys are null, all others as ever."""
    ran = command("diagnose", *write_case(tmp_path), "--out", tmp_path / "out", *ONE_EFFECT, "--holdout", "0")
    assert ran.code == 0
    check_document(read(tmp_path / "out"), ["x_m"], ["p"], held_out=False)


@pytest.mark.slow
def test_effects_can_be_restricted(small, command, tmp_path):
    """--sensor-only and --dynamics-only keep every other effect out of findings and alternatives."""
    _, case, _ = small
    assert command("diagnose", *case, "--out", tmp_path, "--sensor-only").code == 0
    document = read(tmp_path)
    check_document(document, ["x_m"], ["p"])
    # No noise is given, so that none can be wrong.
    assert mentioned(document) <= {"sensor_bias", "sensor_gain", "sensor_drift", "sensor_delay", "sensor_outliers"}
    options = ("--dynamics-only", "--effects", "viscous_damping, sensor_bias")
    assert command("diagnose", *case, "--out", tmp_path, *options).code == 0
    assert mentioned(read(tmp_path)) == {"viscous_damping"}


@pytest.mark.slow
def test_compressed_files_read_the_same(small, command, tmp_path):
    """A .csv.gz gives the answer of its .csv."""
    _, (simulation, recording), out = small
    packed = tmp_path / "recording.csv.gz"
    with open(recording, "rb") as file:
        packed.write_bytes(gzip.compress(file.read()))
    command("diagnose", simulation, packed, "--out", tmp_path, *ONE_EFFECT)
    assert without_seconds(tmp_path) == without_seconds(out)


@pytest.mark.slow
def test_several_files_and_groups_are_several_recordings(command, tmp_path):
    """Two files, or two groups in one, are the same two recordings: numbered, with their own windows and start."""
    first, second = damped(seed=1), damped(start=0.5, seed=2)
    (tmp_path / "simulation.toml").write_text(SIMULATION)
    (tmp_path / "grouped.toml").write_text(SIMULATION.replace('time = "t"', 'time = "t"\ngroup = "run"'))
    (tmp_path / "1.csv").write_text(csv_text(*first))
    (tmp_path / "2.csv").write_text(csv_text(*second))
    rows = [
        f"{t!r},{run},{x!r}"
        for run, pair in (("b", first), ("a", second))
        for t, x in zip(*(a.tolist() for a in pair), strict=True)
    ]
    (tmp_path / "both.csv").write_text("t,run,x_m\n" + "\n".join(rows))
    files, grouped = tmp_path / "files", tmp_path / "groups"
    command(
        "diagnose", tmp_path / "simulation.toml", tmp_path / "1.csv", tmp_path / "2.csv", "--out", files, *ONE_EFFECT
    )
    command("diagnose", tmp_path / "grouped.toml", tmp_path / "both.csv", "--out", grouped, *ONE_EFFECT)
    document = read(files)
    check_document(document, ["x_m"], ["p"], recordings=2)
    assert [window[2] for window in document["location"]["time_windows"]] == [1, 2]
    assert without_seconds(files) == without_seconds(grouped)


def test_nothing_left_out_is_consistent(command, tmp_path):
    """A recording that the simulation explains is `consistent`, also to --fail-on-mismatch."""
    case = write_case(tmp_path, damping=0.0)
    ran = command("diagnose", *case, "--out", tmp_path / "out", *ONE_EFFECT, "--fail-on-mismatch")
    document = read(tmp_path / "out")
    check_document(document, ["x_m"], ["p"])
    assert ran.code == 0 and document["verdict"] == "consistent"


def test_augmented_simulation_is_not_accused_again(small, command, tmp_path):
    """Diagnosing the same recording with augmented.toml never names the same effect and target again."""
    _, (_, recording), out = small
    assert {finding["effect"] for finding in read(out)["findings"]} == {"viscous_damping"}
    options = ("--effects", "viscous_damping,linear_stiffness")
    assert command("diagnose", out / "augmented.toml", recording, "--out", tmp_path, *options).code == 0
    document = read(tmp_path)
    check_document(document, ["x_m"], ["p"])
    assert document["verdict"] in ("consistent", "unexplained") and not document["findings"]


def test_cache_is_private_and_can_be_switched_off(tmp_path):
    """Compiled programs lie in a folder of mode 0700; --no-cache leaves no file, here or among temporary files."""
    case = write_case(tmp_path)
    home, scratch = tmp_path / "home", tmp_path / "scratch"
    home.mkdir()
    scratch.mkdir()
    places = dict(HOME=str(home), XDG_CACHE_HOME=str(home / "cache"), TMPDIR=str(scratch), PYTHONDONTWRITEBYTECODE="1")
    # An unknown effect is refused after the cache was prepared, and long before anything is compiled.
    run_apart("diagnose", *case, "--out", tmp_path / "out", "--effects", "none", "--no-cache", **places)
    assert not list(home.iterdir()) and not list(scratch.iterdir())
    run_apart("diagnose", *case, "--out", tmp_path / "out", "--effects", "none", **places)
    folders = [path for path in (home / "cache").rglob("*") if path.is_dir()]
    assert folders and {stat.S_IMODE(path.stat().st_mode) for path in folders} == {0o700}
