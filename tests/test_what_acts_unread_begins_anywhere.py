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
