"""The picture of README.md: a real pendulum, and its simulation before and after the diagnosis.

    python -m experiments.readme_picture [--out docs/before-after.png]

The recording is pendulum_two_balls of $SYMPLEARN_RECORDINGS (default: ../shared/recordings beside the checkout).
"""

import argparse
import os
from pathlib import Path

import jax

from symplearn._recording import read_recordings
from symplearn._simulation_file import read_simulation
from symplearn.diagnosis import diagnose
from symplearn.report import before_after_picture

ROOT = Path(__file__).parents[1]


def main() -> None:
    """Diagnose the recording, and draw it."""
    parser = argparse.ArgumentParser(description="Make the picture of README.md.")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "before-after.png", help="PNG to write")
    out = parser.parse_args().out
    jax.config.update("jax_enable_x64", True)
    folder = Path(os.environ.get("SYMPLEARN_RECORDINGS") or ROOT.parent / "shared" / "recordings")
    case = folder / "pendulum_two_balls"
    simulation = read_simulation(case / "simulation.toml")
    diagnosis = diagnose(simulation, read_recordings(simulation, [case / "recording.csv"]))
    print(diagnosis)
    print(f"Wrote {before_after_picture(diagnosis, out)}")


if __name__ == "__main__":
    main()
