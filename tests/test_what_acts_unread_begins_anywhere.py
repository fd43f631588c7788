"""What acts on a coordinate that is not read is looked for from several starts of it: a simulation that is symmetric in
it does not tell on which side it begins, in any of several recordings."""

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis import Options, Restriction, diagnose

TIMES = np.linspace(0.0, 24.0, 160)


def ring(b, start):
    """Speed of the second of two nearly equal modes of a ring, of which the first is not read, by SciPy; b turns one
    into the other."""

    def rates(t, s):
        u, v, vu, vv = s
        stiff = 0.4 * (u**2 + v**2)
        return [vu, vv, -(1.0 + stiff) * u - b * vv, -(1.1 + stiff) * v + b * vu]

    return cases.solved(rates, start, TIMES)[:, 3]


@pytest.mark.slow
def test_a_gyroscopic_force_is_found_through_the_mode_that_is_read():
    """Two recordings whose unread modes begin on different sides: the coupling is told, in its interval."""
    file = cases.simulation(
        "(pu**2 + pv**2)/2 + ku*u**2/2 + 0.55*v**2 + 0.1*(u**2 + v**2)**2", ["u", "v"], ["pu", "pv"], {"y": "pv"},
        more="[parameters]\nku = { value = 1.02, sd = 0.02 }",
    )  # fmt: skip
    rng = np.random.default_rng(7)
    runs = [cases.recorded(TIMES, ring(0.03, start) + 0.03 * rng.normal(size=len(TIMES)), number=k)
            for k, start in enumerate(([0.9, 0.2, 0.0, 0.3], [-0.1, 0.7, -0.6, 0.0]), start=1)]  # fmt: skip
    document = diagnose(file, runs, Options(restriction=Restriction(("gyroscopic_coupling",)))).document
    (found,) = document["findings"]
    low, high = found["coefficients"]["b"]["interval95"]
    assert found["effect"] == "gyroscopic_coupling"
    # Both modes mirrored are the same motion under the other sign.
    assert low < 0.03 < high or low < -0.03 < high


@pytest.mark.slow
def test_what_acts_unread_is_found_though_something_else_follows_too():
    """A bob in two directions of which one is filmed, turned by a gyroscopic force and damped in the other one: a
    modulation and an unseen oscillator follow the film with the coupling far off its prior, and are not the answer."""
    times, m, g, length, b, c = np.arange(1000) * 0.15, 5.1, 9.81, 6.2, 0.16, 0.13

    def rates(t, s):
        x, y, vx, vy = s
        return [vx, vy, -g / length * x - (0.05 * y + 0.05 * vx - b * vy) / m,
                -g / length * y - (0.05 * x + c * vy + b * vx) / m]  # fmt: skip

    file = cases.simulation(
        "(px**2 + py**2)/(2*m) + m*g/(2*l)*(x**2 + y**2) + e*x*y", ["x", "y"], ["px", "py"], {"film": "x"},
        more="""[parameters]
m = 5.1
g = 9.81
l = { value = 6.25, sd = 0.05 }
e = { value = 0.06, sd = 0.01 }
cx = { value = 0.055, sd = 0.008 }
[initial]
x = { value = 0.62, sd = 0.02 }
y = { value = 0.33, sd = 0.03 }
px = { value = 0.05, sd = 0.1 }
py = { value = 1.05, sd = 0.1 }
[forces]
px = "-cx*px/m"
""",
    )  # fmt: skip
    read = cases.solved(rates, [0.62, 0.35, 0.0, 0.216], times)[:, 0]
    run = cases.recorded(times, read + 0.009 * np.random.default_rng(2).normal(size=len(times)))
    likely = "gyroscopic_coupling", "viscous_damping", "hidden_oscillator", "parametric_modulation"
    document = diagnose(file, [run], Options(restriction=Restriction(likely))).document
    assert {(f["effect"], str(f["target"])) for f in document["findings"]} == {
        ("gyroscopic_coupling", "['x', 'y']"), ("viscous_damping", "y")}  # fmt: skip
