"""Where a missing force lies is told of the recording that has it."""

import engine_cases as cases
import numpy as np

from symplearn.diagnosis import Options, Restriction, diagnose

TIMES = np.linspace(0.0, 15.0, 201)


KNOWN = """
[recording.noise]
y = 0.01
[[terms]]
effect = "viscous_damping"
target = "q"
c = 0.3
"""


def swing(damping, start, seed):
    y = cases.solved(lambda t, x: [x[1], -4 * x[0] - damping * x[1]], start, TIMES)[:, 0]
    return y + 0.01 * np.random.default_rng(seed).normal(size=len(TIMES))


def test_a_damping_in_the_second_recording_goes_with_its_speed():
    """Of two recordings the second alone is damped less than the file has it: what is told of the missing force is how
    it is there, not what little is missing in the first."""
    runs = [cases.recorded(TIMES, swing(c, x0, 15 * k), number=k, columns=("y",)) for k, (c, x0) in
            enumerate([(0.3, [0.92, 0.78]), (0.1, [0.7, -1.43])], start=1)]  # fmt: skip
    only = Options(restriction=Restriction(("viscous_damping", "quadratic_drag")))
    document = diagnose(cases.simulation("p**2/2 + 2*q**2", more=KNOWN), runs, only).document
    (finding,) = document["findings"]
    assert (finding["effect"], finding["recordings"]) == ("viscous_damping", [2])
    assert "goes with its speed" in document["location"]["where"]
