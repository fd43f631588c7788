"""A missing force whose frequency changes evenly is told by its periods at the beginning and at the end."""

import engine_cases as cases
import numpy as np
import pytest
from scipy.signal import chirp

from symplearn._expression import symbol
from symplearn.diagnosis import Options, diagnose
from symplearn.diagnosis._build import Restriction
from symplearn.diagnosis._sweeps import Sweep, swept

FEW = ("viscous_damping", "periodic_forcing", "hidden_oscillator", "unnamed_force")


@pytest.mark.parametrize(("first", "last"), [(1.0, 4.0), (5.0, 2.0), (2.0, 9.0)])
def test_a_line_in_time_and_frequency_is_found_in_noise(first, last):
    """Of a linear chirp (SciPy's) with half as much noise both frequencies are found; what swings at one frequency,
    or for less than four cycles, is none."""
    times, rng = np.linspace(3.0, 43.0, 900), np.random.default_rng(0)
    wave = chirp(times - 3.0, first / (2 * np.pi), 40.0, last / (2 * np.pi), phi=np.degrees(1.1))
    (found, number), *_ = swept(times, 0.7 * wave + 0.35 * rng.normal(size=900), np.ones((900, 1)))
    # The Cramer-Rao bound of a frequency at one end is sqrt(384 / n) / (span * amplitude / noise), 0.0082; two and a
    # half of them.
    assert (found.first, found.last) == pytest.approx((first, last), abs=0.02)
    assert number > 1
    for other in (np.cos(2.0 * times), chirp(times - 3.0, 0.01, 40.0, 0.12)):  # two and a half cycles are no sweep
        assert swept(times, other + 0.35 * rng.normal(size=900), np.ones((900, 1))) == []


def test_its_terms_are_the_chirp():
    """The terms as they are written are cosine and sine of SciPy's chirp; where it grows, times the square of the
    frequency over the largest."""
    times = np.linspace(3.0, 43.0, 50)
    cosine = chirp(times - 3.0, 1.0 / (2 * np.pi), 40.0, 4.0 / (2 * np.pi))
    sine = chirp(times - 3.0, 1.0 / (2 * np.pi), 40.0, 4.0 / (2 * np.pi), phi=-90.0)
    size = ((1.0 + 3.0 * (times - 3.0) / 40.0) / 4.0) ** 2
    for grows, factor in ((False, 1.0), (True, size)):
        one = Sweep(1.0, 4.0, 3.0, 40.0, grows)
        for row, t in enumerate(times):
            expected = np.array([cosine[row], sine[row]]) * np.broadcast_to(factor, times.shape)[row]
            # Half the last of seven digits of what the phase bends by, 60 rad in the end: 3e-6 rad.
            assert [float(term.subs(symbol("t"), t)) for term in one.terms()] == pytest.approx(expected, abs=1e-5)
        # Round-off of a phase of 100 rad, 1.4e-14, and of SciPy's, which goes through degrees and hertz.
        np.testing.assert_allclose(one.along(times)[:, 0], cosine * factor, atol=1e-9)


@pytest.mark.slow
def test_a_rotor_that_runs_up_through_resonance_is_told():
    """A damped spring of 2 rad/s under a force that sweeps from 1 to 4 rad/s in 60 s: one force without a name, which
    has these periods; the held-out rows are followed to the noise."""
    times = np.linspace(0.0, 60.0, 400)
    rates = lambda t, s: [s[1], -4 * s[0] - 0.1 * s[1] + 0.5 * np.cos(t + 1.5 / 60 * t**2 + 0.7)]  # noqa: E731
    q = cases.solved(rates, [0.1, 0.0], times)[:, 0]
    run = cases.recorded(times, q + 0.01 * np.random.default_rng(0).normal(size=400))
    file = cases.simulation("p**2/2 + 2*q**2", more='[forces]\np = "-0.1*p"')
    told = diagnose(file, [run], Options(restriction=Restriction(FEW), jobs=2))
    (finding,) = told.document["findings"]
    assert finding["effect"] == "unnamed_force" and finding["probability"] > 0.95
    first, last = (
        float(one.split()[0]) for one in finding["sentence"].split("with a period from ")[1].split(" to ")[:2]
    )
    # The sweep that is told ends with the fitted rows, at 45 s, where the frequency is 3.25 rad/s. The last steps that
    # frequencies are moved by are 0.0035 rad/s; three of them at the beginning.
    assert (first, last) == pytest.approx((2 * np.pi, 2 * np.pi / 3.25), rel=0.01)
    assert told.document["fit"]["after"]["holdout_rmse"]["y"] < 0.015
