"""A small case for the command line, and how to run it: in this process, sharing compiled programs, or in its own."""

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from symplearn.cli import main

ROOT = Path(__file__).parents[1]
DEMO = ROOT / "symplearn" / "demo"
COMMAND = [sys.executable, "-c", "from symplearn.cli import main; main()"]
# One effect alone is searched unless a test is about the search: seconds instead of half a minute.
ONE_EFFECT = ("--effects", "viscous_damping")

SIMULATION = """
title = "Oscillator without friction"
[system]
coordinates = ["x"]
momenta = ["p"]
hamiltonian = "p**2/2 + k*x**2/2"
[parameters]
k = { value = 4.0, sd = 0.1 }
[recording]
time = "t"
[recording.observe]
x_m = "x"
"""


@dataclass(frozen=True)
class Ran:
    """What a run of the command left: exit code and both streams."""

    code: int
    out: str
    err: str


def damped(damping=0.1, rows=81, start=1.0, noise=0.02, seed=0, end=16.0):
    """Times and readings of x'' = -4 x - damping x' from rest, by its closed form."""
    t = np.linspace(0.0, end, rows)
    rate, omega = damping / 2, np.sqrt(4.0 - damping**2 / 4)
    x = start * np.exp(-rate * t) * (np.cos(omega * t) + rate / omega * np.sin(omega * t))
    return t, x + noise * np.random.default_rng(seed).standard_normal(rows)


def csv_text(times, readings):
    """A recording of the small case."""
    return "t,x_m\n" + "".join(f"{t!r},{x!r}\n" for t, x in zip(times.tolist(), readings.tolist(), strict=True))


def write_case(folder, simulation=SIMULATION, **options):
    """The small case as two files."""
    (folder / "simulation.toml").write_text(simulation)
    (folder / "recording.csv").write_text(csv_text(*damped(**options)))
    return [str(folder / "simulation.toml"), str(folder / "recording.csv")]


def run_here(capsys, monkeypatch, *arguments):
    """The real `main()` in this process."""
    monkeypatch.setattr(sys, "argv", ["symplearn", *map(str, arguments)])
    capsys.readouterr()
    with pytest.raises(SystemExit) as left:
        main()
    said = capsys.readouterr()
    return Ran(left.value.code or 0, said.out, said.err)


def environment(**changes):
    """This process's environment with the checkout on the path."""
    return os.environ | {"PYTHONPATH": str(ROOT)} | changes


def run_apart(*arguments, cwd=None, **changes):
    """The command in a process of its own."""
    done = subprocess.run(
        [*COMMAND, *map(str, arguments)],
        cwd=cwd,
        env=environment(**changes),
        capture_output=True,
        text=True,
        timeout=600,
    )
    return Ran(done.returncode, done.stdout, done.stderr)
