"""The case inside the package is what `python -m experiments.demo_case` makes, and it is concealed as it claims."""

import runpy
import subprocess
import sys

import numpy as np
from command_line_cases import DEMO, ROOT

SCRIPT = runpy.run_path(str(ROOT / "experiments" / "demo_case.py"))


def numbers(text):
    """The rows of a recording, without comments and header."""
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    return lines[0], np.array([line.split(",") for line in lines[1:]], float)


def test_script_makes_the_case_again(tmp_path):
    """The same seed gives the same files; the last printed digit of a reading may turn with another SciPy."""
    subprocess.run([sys.executable, "-m", "experiments.demo_case", "--out", tmp_path], cwd=ROOT, check=True)
    assert (tmp_path / "simulation.toml").read_bytes() == (DEMO / "simulation.toml").read_bytes()
    head, made = numbers((tmp_path / "recording.csv").read_text())
    shipped_head, shipped = numbers((DEMO / "recording.csv").read_text())
    assert head == shipped_head and np.array_equal(made[:, :2], shipped[:, :2])
    assert np.abs(made[:, 2] - shipped[:, 2]).max() <= 1.001e-4


def test_damping_is_concealed():
    """Most single readings are displaced by less than one standard deviation of the noise."""
    assert SCRIPT["concealed"]() > 0.5


def test_the_case_does_not_tell_its_answer():
    """Neither file says what was left out, and both together are small."""
    texts = [(DEMO / name).read_text().lower() for name in ("simulation.toml", "recording.csv")]
    assert not any(word in text for text in texts for word in ("viscous", "damping", "drag", str(SCRIPT["DAMPING"])))
    assert sum(map(len, texts)) < 40_000
