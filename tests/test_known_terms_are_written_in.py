"""Terms that a simulation already knows act as the contract's table of effects says."""

import numpy as np
import pytest
from engine_cases import solved

from symplearn import Recording, parse_simulation
from symplearn._errors import InputError
from symplearn.diagnosis import Restriction
from symplearn.diagnosis._build import augmented_equations, build
from symplearn.diagnosis._stochastic import free_run
from symplearn.diagnosis._trajectory import courses

TIMES = np.linspace(2.0, 8.0, 121)
START = np.array([0.7, -0.4, 0.3, 0.5])
K = 2.0
FILE = """
[system]
coordinates = ["x", "y"]
momenta = ["p", "r"]
hamiltonian = "p**2/2 + r**2/2 + k*x**2/2 + y**2/2"
[parameters]
k = 2.0
[recording]
time = "t"
[recording.observe]
X = "x"
Y = "y"
[[terms]]
"""

# Term, extra rates of (p, r) at time t, and what is added to the readings; the textbook side of each effect.
CASES = {
    'effect = "relative_damping"\ntarget = ["x", "y"]\nc = 0.3': lambda t, x, y, p, r: (-0.3 * (p - r), 0.3 * (p - r)),
    'effect = "self_excitation"\ntarget = "x"\nc = 0.2\na = 0.5': lambda t, x, y, p, r: (0.2 * (1 - 4 * x**2) * p, 0),
    'effect = "coupling_spring"\ntarget = ["x", "y"]\nk = 0.4': lambda t, x, y, p, r: (-0.4 * (x - y), 0.4 * (x - y)),
    'effect = "contact_stop"\ntarget = "x"\nk = 5.0\na = 0.3': lambda t, x, y, p, r: (-5 * max(x - 0.3, 0), 0),
    'effect = "contact_stop"\nside = "lower"\ntarget = "y"\nk = 5.0\na = -0.2': lambda t, x, y, p, r: (
        0,
        5 * max(-0.2 - y, 0),
    ),
    'effect = "gyroscopic_coupling"\ntarget = ["x", "y"]\nb = 0.5': lambda t, x, y, p, r: (0.5 * r, -0.5 * p),
    'effect = "periodic_forcing"\ntarget = "y"\na = 0.3\nomega = 1.7\nphi = 0.4': lambda t, x, y, p, r: (
        0,
        0.3 * np.cos(1.7 * t + 0.4),
    ),
    'effect = "parametric_modulation"\ntarget = "k"\na = 0.2\nomega = 1.1\nphi = 0.3': lambda t, x, y, p, r: (
        -K * 0.2 * np.cos(1.1 * t + 0.3) * x,
        0,
    ),
    'effect = "parameter_drift"\ntarget = "k"\nr = 0.05': lambda t, x, y, p, r: (-K * 0.05 * (t - 2.0) * x, 0),
    'effect = "parameter_error"\ntarget = "k"\nd = -0.1': lambda t, x, y, p, r: (K * 0.1 * x, 0),
    'effect = "regime_change"\ntarget = "k"\nd = 0.3\nt_star = 5.0': lambda t, x, y, p, r: (-K * 0.3 * (t > 5) * x, 0),
    'effect = "central_correction"\ntarget = ["x", "y"]\nb = -0.01': lambda t, x, y, p, r: (
        0.03 * x / np.hypot(x, y) ** 5,
        0.03 * y / np.hypot(x, y) ** 5,
    ),
    'effect = "unnamed_force"\ntarget = "x"\nexpression = "-0.3*sin(y)*p"': lambda t, x, y, p, r: (
        -0.3 * np.sin(y) * p,
        0,
    ),
}


def simulated(term):
    """Readings of the simulation with a term, from the standard start."""
    file = parse_simulation(FILE + term + "\n", "known.toml")
    recording = Recording(1, "none", ("X", "Y"), TIMES, np.zeros((len(TIMES), 2)), np.arange(len(TIMES)))
    problem = build(file, augmented_equations(file, TIMES[0]), [recording], 0.0, 0.0125, Restriction())
    z = np.zeros(problem.size)
    return free_run(problem, courses(problem)[0], z, (), 0, START, 0)[0]


@pytest.mark.parametrize("term", CASES)
def test_a_known_term_acts_as_its_equation(term):
    """A term in the file moves the simulation exactly as its force, written by hand and solved by DOP853."""
    more = CASES[term]

    def rates(t, s):
        x, y, p, r = s
        extra = more(t, x, y, p, r)
        return [p, r, -K * x + extra[0], -y + extra[1]]

    expected = solved(rates, START, TIMES, 1e-10)[:, :2]
    plain = solved(lambda t, s: [s[2], s[3], -K * s[0], -s[1]], START, TIMES, 1e-10)[:, :2]
    assert np.abs(expected - plain).max() > 1e-2  # the term matters
    # Order 2 in velocity-dependent forces, and at the kinks of a stop or a regime change: 6 s at substeps of 0.0125.
    np.testing.assert_allclose(simulated(term), expected, atol=2e-4)


def test_a_drift_is_added_to_the_reading():
    """A known sensor drift adds r (t - t_0), t_0 being the first row used."""
    drifting = simulated('effect = "sensor_drift"\ntarget = "X"\nr = 0.2')
    plain = simulated('effect = "sensor_drift"\ntarget = "X"\nr = 0.0')
    np.testing.assert_allclose((drifting - plain)[:, 0], 0.2 * (TIMES - 2.0), atol=1e-12)  # round-off
    np.testing.assert_array_equal((drifting - plain)[:, 1], 0.0)


@pytest.mark.parametrize(
    "term",
    [
        'effect = "impulse"\ntarget = "x"\nj = 0.1\nt_star = 4.0',
        'effect = "coupling_spring"\ntarget = ["x", "y"]\nk = { value = 0.1 }',
        'effect = "coupling_spring"\ntarget = ["x", "y"]\nk = 0.1\nrecordings = [1]',
    ],
)
def test_what_cannot_be_simulated_is_said_in_one_sentence(term):
    """A term beyond this version is refused with its place, never ignored."""
    with pytest.raises(InputError, match=r"known\.toml: \[\[terms\]\] 1"):
        simulated(term)
