"""What the simulation as it is foretells spreads by the process noise that it is said to need."""

import engine_cases as cases
import numpy as np

from symplearn.diagnosis import Options, Restriction, diagnose


def test_it_spreads_as_an_oscillator_does_under_white_forces():
    """A damping is missing, and the noise of the position is given as a third of what it is, so that an error of the
    sensor would explain more of it than a force. Before, the oscillator q'' = -q is under white forces of the intensity
    s^2 that is reported: of its reading the variance grows by s^2 (T/2 - sin(2 T)/4) in the time T."""
    times = np.linspace(0.0, 30.0, 200)
    x = cases.solved(lambda t, x: [x[1], -x[0] - 0.04 * x[1]], [1.0, 0.0], times)
    recording = cases.recorded(times, x + 0.02 * np.random.default_rng(6).normal(size=x.shape), columns=("y", "v"))
    only = Restriction(("viscous_damping", "sensor_noise"))
    file = cases.simulation("p**2/2 + q**2/2", observe={"y": "q", "v": "p"}, more="[recording.noise]\ny = 0.006\n")
    found = diagnose(file, [recording], Options(restriction=only, forecast_until=60.0, forecast_step=0.5))
    assert found.document["verdict"] == "mismatch" and found.forecast is not None
    later, sd = found.forecast.times - 30.0, found.forecast.columns["y"]["before_sd"]
    s = found.document["fit"]["before"]["process_noise_sd"]["p"]
    expected = np.sqrt(s**2 * (later / 2 - np.sin(2 * later) / 4))
    # Beyond two swings the phase point at the last row adds little; 129 draws tell an sd to a sixteenth.
    far = later > 15
    assert s > 0 and np.all(sd[far] > 0.75 * expected[far]) and np.all(sd[far] < 1.5 * expected[far])
