"""Terms that a simulation already knows act as the contract's table of effects says."""

import numpy as np
import pytest
from engine_cases import solved

from symplearn import Recording, parse_simulation
from symplearn._effects import EFFECTS, NOISE, QUADRATIC, VISCOUS
from symplearn._errors import InputError
from symplearn.diagnosis import Restriction
from symplearn.diagnosis._build import augmented_equations, build
from symplearn.diagnosis._calibrate import grow
from symplearn.diagnosis._course import courses
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._stochastic import free_run
from symplearn.diagnosis._trajectory import Stepper
from symplearn.diagnosis._warnings import doubled, unused

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
    'effect = "viscous_damping"\ntarget = "y"\nc = 0.3': lambda t, x, y, p, r: (0, -0.3 * r),
    'effect = "quadratic_drag"\ntarget = "x"\nc = 0.5': lambda t, x, y, p, r: (-0.5 * abs(p) * p, 0),
    'effect = "constant_force"\ntarget = "y"\nf = 0.2': lambda t, x, y, p, r: (0, 0.2),
    'effect = "linear_stiffness"\ntarget = "x"\nk = 0.4': lambda t, x, y, p, r: (-0.4 * x, 0),
    'effect = "quadratic_stiffness"\ntarget = "y"\nk = 0.2': lambda t, x, y, p, r: (0, -0.2 * y**2),
    'effect = "cubic_stiffness"\ntarget = "x"\nk = 0.6': lambda t, x, y, p, r: (-0.6 * x**3, 0),
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


def made(term, readings):
    """The problem of a file with terms, and a recording for each of the readings; few effects are built in."""
    file = parse_simulation(FILE + term + "\n", "known.toml")
    runs = [Recording(k, f"{k}", ("X", "Y"), TIMES, y, np.arange(len(TIMES))) for k, y in enumerate(readings, start=1)]
    few = Restriction(("viscous_damping",))
    return build(file, augmented_equations(file, TIMES[0], few), runs, 0.0, 0.0125, few)


def simulated(term, runs=1):
    """Readings of the simulation with a term, by recording, from the standard start; what is hidden starts at rest."""
    problem = made(term, [np.zeros((len(TIMES), 2))] * runs)
    width = problem.equations.width
    x, z = np.zeros(2 * width), np.zeros(problem.size)
    x[:2], x[width : width + 2] = START[:2], START[2:]
    return [free_run(problem, course, z, (), r, x, 0)[0] for r, course in enumerate(courses(problem))]


def by_hand(more):
    """DOP853 on the oscillators with further rates."""

    def rates(t, s):
        x, y, p, r = s
        extra = more(t, x, y, p, r)
        return [p, r, -K * x + extra[0], -y + extra[1]]

    return solved(rates, START, TIMES, 1e-10)[:, :2]


PLAIN = solved(lambda t, s: [s[2], s[3], -K * s[0], -s[1]], START, TIMES, 1e-10)[:, :2]


def kicked(more=lambda t, x, y, p, r: (0.0, 0.0)):
    """An impulse of 0.4 on x at time 4.321."""
    early = TIMES < 4.321

    def rates(t, s):
        extra = more(t, *s)
        return [s[2], s[3], -K * s[0] + extra[0], -s[1] + extra[1]]

    before = solved(rates, START, np.append(TIMES[early], 4.321), 1e-10)
    after = solved(rates, before[-1] + [0, 0, 0.4, 0], np.append(4.321, TIMES[~early]), 1e-10)
    return np.concatenate([before[:-1, :2], after[1:, :2]])


def coupled():
    """H gains P^2/2 + omega^2 z^2/2 - kappa x z, with omega = 1.3 and kappa = 0.8."""
    rates = lambda t, s: [*s[3:], -K * s[0] + 0.8 * s[2], -s[1], -1.69 * s[2] + 0.8 * s[0]]  # noqa: E731
    return solved(rates, [*START[:2], 0.0, *START[2:], 0.0], TIMES, 1e-10)[:, :2]


def rubbed():
    """Dry friction that is slow enough never to hold: solved between the turning points of y, where r changes sign."""
    rates = lambda t, s: [s[2], s[3], -K * s[0], -s[1] - 0.02 * np.tanh(s[3] / 1e-4)]  # noqa: E731
    return solved(rates, START, TIMES, 1e-10)[:, :2]


def remembered():
    """A force -w on x with dw/dt = 0.8 v - w / 0.5 - a friend's share, which another number in it remembers."""
    rates = lambda t, s: [  # noqa: E731
        s[2], s[3], -K * s[0] - s[4], -s[1], 0.8 * s[2] - 2 * s[4] - s[5], 0.3 * s[4] - s[5]]  # fmt: skip
    return solved(rates, [*START, 0.0, 0.0], TIMES, 1e-10)[:, :2]


SOLVED = {
    'effect = "unnamed_force"\ntarget = "x"\nexpression = "-w"\nmemory = { w = "0.8*p - 2*w - u", u = "0.3*w - u" }': (
        remembered
    ),
    'effect = "impulse"\ntarget = "x"\nj = 0.4\nt_star = 4.321': kicked,
    'effect = "hidden_oscillator"\ntarget = "x"\nomega = 1.3\nkappa = 0.8': coupled,
    'effect = "coulomb_friction"\ntarget = "y"\nf = 0.02': rubbed,
}
ALL = {**{term: (lambda more=more: by_hand(more)) for term, more in CASES.items()}, **SOLVED}


def test_no_effect_is_left_out():
    """Every effect that moves anything is known as a term here; those of the sensor stand below."""
    named = {term.split('"')[1] for term in ALL}
    assert named == {e for e in EFFECTS if EFFECTS[e].is_dynamics} | {"unnamed_force"}


@pytest.mark.parametrize("term", ALL)
def test_a_known_term_acts_as_its_equation(term):
    """With `recordings = [2]` the second recording moves as the force, written by hand and solved by DOP853, and the
    first as without it."""
    expected = ALL[term]()
    assert np.abs(expected - PLAIN).max() > 1e-2  # the term matters
    without, found = simulated(f"{term}\nrecordings = [2]", 2)
    # Order 2 in velocity-dependent forces, and at the kinks of a stop or a regime change: 6 s at substeps of 0.0125.
    np.testing.assert_allclose(found, expected, atol=2e-4)
    # Order four.
    np.testing.assert_allclose(without, PLAIN, atol=1e-6)


@pytest.mark.parametrize("effect", ["viscous_damping", "periodic_forcing", "impulse", "hidden_oscillator"])
def test_a_term_is_in_every_recording_unless_it_says_so(effect):
    """Without `recordings` every recording moves with the term."""
    term = next(term for term in ALL if f'"{effect}"' in term)
    for found in simulated(term, 2):
        np.testing.assert_allclose(found, ALL[term](), atol=2e-4)


@pytest.mark.parametrize("last", [False, True], ids=["before", "after"])
def test_a_parameter_that_changes_does_so_in_every_force(last):
    """A regime change of k scales an unnamed force that uses k, whether it stands before the force or after it."""
    change = 'effect = "regime_change"\ntarget = "k"\nd = 0.5\nt_star = 5.0\n'
    force = 'effect = "unnamed_force"\ntarget = "x"\nexpression = "-0.4*k*x**3"\n'
    expected = by_hand(lambda t, x, y, p, r: (-K * 0.5 * (t > 5) * x - 0.4 * K * (1 + 0.5 * (t > 5)) * x**3, 0))
    found = simulated("[[terms]]\n".join([force, change] if last else [change, force]))[0]
    np.testing.assert_allclose(found, expected, atol=2e-4)  # order 2 at the kink in time


CALIBRATED = """effect = "coupling_spring"
target = ["x", "y"]
k = { value = 0.2, sd = 0.3 }
recordings = [1]
[[terms]]
effect = "periodic_forcing"
target = "y"
a = { value = 0.2, sd = 0.3 }
omega = { value = 1.6, sd = 0.3 }
phi = 0.4
[[terms]]
effect = "self_excitation"
target = "x"
c = { value = 0.1, sd = 0.3 }
a = 0.5
recordings = [2]
[[terms]]
effect = "impulse"
target = "x"
j = { value = 0.2 }
t_star = 4.321
"""


@pytest.mark.slow
def test_calibrated_coefficients_are_recovered():
    """Coefficients with a prior, additive or written in, of one recording or of both, end at the truth."""
    push = lambda t: 0.3 * np.cos(1.7 * t + 0.4)  # noqa: E731
    first = kicked(lambda t, x, y, p, r: (-0.4 * (x - y), 0.4 * (x - y) + push(t)))
    second = kicked(lambda t, x, y, p, r: (0.2 * (1 - 4 * x**2) * p, push(t)))
    problem = made(CALIBRATED, [first, second])
    priors, stepper = priors_without_effects(problem), Stepper(problem)
    start = priors.mean.copy()
    start[: problem.head] = np.tile(START, 2) + 0.05
    rows = [len(TIMES)] * 2
    fits = grow(stepper, start[None], [()], priors, [[40, 40], [80, 80], rows])
    found = dict(zip(problem.calibrated.names, fits.z[0, problem.head : problem.slots], strict=True))
    expected = {"coupling_spring(x, y).k": 0.4, "periodic_forcing(y).a": 0.3, "periodic_forcing(y).omega": 1.7,
                "self_excitation(x).c": 0.2, "impulse(x).j": 0.4}  # fmt: skip
    # Readings are off by what splitting costs, 1e-4 of motions of some tenths.
    assert fits.converged[0] and found == pytest.approx(expected, abs=3e-3)


def test_a_drift_is_added_to_the_reading():
    """A known sensor drift adds r (t - t_0), t_0 being the first row used."""
    drifting = simulated('effect = "sensor_drift"\ntarget = "X"\nr = 0.2')[0]
    plain = simulated('effect = "sensor_drift"\ntarget = "X"\nr = 0.0')[0]
    np.testing.assert_allclose((drifting - plain)[:, 0], 0.2 * (TIMES - 2.0), atol=1e-12)  # round-off
    np.testing.assert_array_equal((drifting - plain)[:, 1], 0.0)


@pytest.mark.parametrize(
    ("term", "shown"),
    [
        ('effect = "sensor_bias"\ntarget = "Y"\nb = 0.3', lambda y: y + 0.3),
        ('effect = "sensor_gain"\ntarget = "Y"\ng = -0.1', lambda y: 0.9 * y),
    ],
    ids=["bias", "gain"],
)
def test_known_errors_of_a_sensor_are_in_its_readings(term, shown):
    """A bias adds and a gain multiplies, in the recordings they are in."""
    np.testing.assert_allclose(simulated(term)[0][:, 1], shown(PLAIN[:, 1]), atol=1e-6)
    np.testing.assert_allclose(simulated(f"{term}\nrecordings = [2]", 2)[0][:, 1], PLAIN[:, 1], atol=1e-6)


def test_a_known_delay_reads_the_past():
    """A sensor that lags by tau shows what was there tau before."""
    rates = lambda t, s: [s[2], s[3], -K * s[0], -s[1]]  # noqa: E731
    back = solved(rates, START, np.array([TIMES[0], TIMES[0] - 0.07]), 1e-10)[-1]
    earlier = solved(rates, back, TIMES - 0.07, 1e-10)[:, 0]
    found = simulated('effect = "sensor_delay"\ntarget = "X"\ntau = 0.07')[0]
    np.testing.assert_allclose(found[:, 0], earlier, atol=1e-6)


def test_a_known_noise_is_widened():
    """`sensor_noise` multiplies the noise that is given, and can only be in all recordings."""
    text = FILE.replace("[[terms]]", "[recording.noise]\nX = 0.1\n[[terms]]")
    term = 'effect = "sensor_noise"\ntarget = "X"\ns = 3.0'
    file = parse_simulation(text + term, "known.toml")
    run = Recording(1, "1", ("X", "Y"), TIMES, np.zeros((len(TIMES), 2)), np.arange(len(TIMES)))
    problem = build(file, augmented_equations(file, 2.0), [run], 0.0, 0.0125, Restriction())
    np.testing.assert_allclose(problem.noise, [0.3, np.nan], rtol=1e-15)
    partial = parse_simulation(f"{text}{term}\nrecordings = [1]", "known.toml")
    with pytest.raises(InputError, match=r"known\.toml: \[\[terms\]\] 1"):
        augmented_equations(partial, 2.0)


def test_a_term_that_stands_twice_is_told():
    """The same law of the same target twice in a recording is a warning; two forcings, or two runs' terms, are none."""
    damping = 'effect = "viscous_damping"\ntarget = "y"\nc = 0.3\n'
    forcing = 'effect = "periodic_forcing"\ntarget = "y"\na = 0.3\nomega = 2.0\nphi = 0.0\n'

    def told(*terms):
        return doubled(parse_simulation(FILE + "[[terms]]\n".join(terms), "known.toml"))

    assert told(damping, forcing, damping) == ["[[terms]] has viscous_damping of y more than once: all of them act"]
    assert len(told(damping + "recordings = [1, 2]\n", damping + "recordings = [2]\n")) == 1
    assert len(told(damping, damping, damping)) == 1
    assert told(damping, damping.replace('"y"', '"x"'), forcing, forcing.replace("2.0", "3.0")) == []
    assert told(damping + "recordings = [1]\n", damping + "recordings = [2]\n") == []


def test_as_much_is_taken_back_as_is_known_where_it_is():
    """A damping may be found below nothing by what is known of it in the recordings of the finding: by 0.3 in the
    first, by 0.1 in the second, and by the less of the two in both; of a stiffness, any amount."""
    terms = [
        f'effect = "viscous_damping"\ntarget = "y"\nc = {c}\nrecordings = [{r}]\n' for r, c in ((1, 0.3), (2, 0.1))
    ]
    problem = made("[[terms]]\n".join(terms), [np.zeros((len(TIMES), 2))] * 2)
    of_y = {
        (m.candidate.effect, m.recordings): k for k, m in enumerate(problem.members) if m.candidate.targets == ("y",)
    }
    lowest = {key: problem.lowest(k) for key, k in of_y.items()}
    assert [lowest[VISCOUS, r].item() for r in ((0,), (1,), (0, 1))] == [-0.3, -0.1, -0.1]
    assert lowest[EFFECTS["linear_stiffness"], (0,)] == -np.inf and lowest[QUADRATIC, (0,)] == 0.0


def test_what_is_not_used_of_a_file_is_told():
    """Limits of a start, and what is known of the factor of a noise, which is estimated and searched no more."""
    text = FILE.replace("[[terms]]", "[initial]\nx = { value = 1.0, sd = 0.1, lower = 0.5 }\ny = 0.2\n"
                                     "[recording.noise]\nX = 0.1\nY = 0.1\n[[terms]]")  # fmt: skip
    term = 'effect = "sensor_noise"\ntarget = "X"\n'
    file = parse_simulation(f"{text}{term}s = {{ value = 1.0, sd = 0.2 }}", "known.toml")
    limits, noise = unused(file)
    share = 'effect = "sensor_outliers"\ntarget = "Y"\ne = { value = 0.05, sd = 0.01 }\nsd = 2.0'
    assert unused(parse_simulation(FILE + share, "known.toml"))[0].startswith("the outliers of Y are taken out")
    assert limits.startswith("[initial] x has limits") and noise.startswith("the noise of X is estimated")
    assert unused(parse_simulation(f"{text}{term}s = 3.0".replace(", lower = 0.5", ""), "known.toml")) == []
    run = Recording(1, "1", ("X", "Y"), TIMES, np.zeros((len(TIMES), 2)), np.arange(len(TIMES)))
    problem = build(file, augmented_equations(file, 2.0), [run], 0.0, 0.0125, Restriction())
    looked_for = [problem.candidate(m).targets for m in problem.searched if problem.candidate(m).effect is NOISE]
    assert looked_for == [("Y",)]
