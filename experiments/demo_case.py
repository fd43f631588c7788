"""The case that `symplearn demo` diagnoses: a pendulum whose air drag is concealed below the reading noise.

    python -m experiments.demo_case [--out DIR]

Three swings of the same pendulum are computed by SciPy's DOP853 (rtol 1e-10, atol 1e-12), which shares no code with
symplearn, and read with Gaussian noise from a fixed seed. The damping displaces most single readings by less than the
standard deviation of that noise.
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

FOLDER = Path(__file__).parents[1] / "symplearn" / "demo"
MASS, GRAVITY, LENGTH = 0.2, 9.81, 0.5013  # kg, m/s^2, m; the simulation takes the length as 0.5 +- 0.001
DAMPING = 0.0015  # N m s
STARTS = (1.4, 0.7, 0.35)  # rad, at rest
TIMES = np.linspace(0.0, 20.0, 501)  # s
NOISE = 0.08  # rad
SEED = 20

SIMULATION = """\
title = "Pendulum without friction"

[system]
coordinates = ["theta"]
momenta     = ["p_theta"]
hamiltonian = "p_theta**2/(2*m*l**2) - m*g*l*cos(theta)"

[parameters]
m = 0.2                                  # kg, weighed
g = 9.81                                 # m/s^2
l = { value = 0.5, sd = 0.001 }          # m, by a ruler

[recording]
time  = "t_s"
group = "run"                            # three swings in one file
[recording.observe]
angle_rad = "theta"

[units]
angle_rad = "rad"
t = "s"
"""


def motion(start: float, damping: float) -> np.ndarray:
    """Angle at `TIMES` of the pendulum let go at rest from `start`."""

    def field(t: float, x: np.ndarray) -> list[float]:
        theta, p = x
        speed = p / (MASS * LENGTH**2)
        return [speed, -MASS * GRAVITY * LENGTH * np.sin(theta) - damping * speed]

    solution = solve_ivp(
        field, (TIMES[0], TIMES[-1]), [start, 0.0], method="DOP853", t_eval=TIMES, rtol=1e-10, atol=1e-12
    )
    return solution.y[0]


def concealed() -> float:
    """Share of the readings that the damping displaces by less than the sd of the noise."""
    displaced = [np.abs(motion(start, DAMPING) - motion(start, 0.0)) for start in STARTS]
    return float((np.concatenate(displaced) < NOISE).mean())


def recording() -> str:
    """The CSV: all runs with noise, four digits after the point."""
    key = np.random.default_rng(SEED)
    lines = ["# An angle sensor on a pendulum that is let go at rest, three times.", "run,t_s,angle_rad"]
    for run, start in enumerate(STARTS, 1):
        readings = motion(start, DAMPING) + NOISE * key.standard_normal(TIMES.size)
        lines += [f"{run},{t:.2f},{y:.4f}" for t, y in zip(TIMES, readings, strict=True)]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Write both files, and say how well the damping is concealed."""
    parser = argparse.ArgumentParser(description="Make the recording that `symplearn demo` diagnoses.")
    parser.add_argument("--out", type=Path, default=FOLDER, help="folder to write to (default: symplearn/demo)")
    folder = parser.parse_args().out
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "simulation.toml").write_text(SIMULATION, encoding="utf-8")
    (folder / "recording.csv").write_text(recording(), encoding="utf-8")
    print(
        f"Wrote {folder}: damping {DAMPING} N m s displaces {concealed():.0%} of the readings by less than the noise."
    )


if __name__ == "__main__":
    main()
