"""A soft stop far inside a swing and a hard one at its edge do alike: a fit of the one is tried as the other."""

import engine_cases as cases
import numpy as np
import pytest
from scipy.optimize import least_squares

from symplearn.diagnosis import Options, diagnose
from symplearn.diagnosis._build import Restriction
from symplearn.diagnosis._depths import along_the_depths
from symplearn.diagnosis._refinement import Refinement
from symplearn.diagnosis._score import Start
from symplearn.diagnosis._search import Search
from symplearn.diagnosis._start import first_fits, priors_without_effects
from symplearn.diagnosis._trajectory import Stepper

# A stop twelve times as stiff as the spring, four hundredths of the amplitude inside a swing.
STOP, STIFFNESS, NOISE = 0.96, 12.0, 0.005
TIMES = np.linspace(0.0, 120.0, 400)


@pytest.fixture(scope="module")
def search():
    """A search of a recording that DOP853 made, before its first step, and the stop above."""
    rates = lambda t, x: [x[1], -x[0] - STIFFNESS * max(x[0] - STOP, 0.0)]  # noqa: E731
    # A tolerance that no touch of the stop is stepped over at: what is left is far below the noise.
    y = cases.solved(rates, [0.0, 1.0], TIMES, 1e-10)[:, 0]
    y = y + NOISE * np.random.default_rng(0).normal(size=len(y))
    file = cases.simulation("p**2/2 + q**2/2", more=f"[recording.noise]\ny = {NOISE}")
    # Substeps that resolve the stop: in longer ones its force is a mean over more than its depth.
    stepper = Stepper(cases.problem(file, [cases.recorded(TIMES, y)], 0.03))
    p = stepper.problem
    seeds = first_fits(stepper, priors_without_effects(p), [r.fitted for r in p.rows])
    found = Search(stepper, seeds.z, np.inf, lambda message: None)
    found.beginning.run()
    return found


def upper_stop(search):
    p = search.problem
    return next(
        m for m in p.searched if p.candidate(m).effect.name == "contact_stop" and p.candidate(m).side == "upper"
    )


def began(search, k, a):
    """The recorded motion with a stop."""
    stop = (upper_stop(search),)
    ((_, place),) = search.problem.placed(stop)
    z = search.beginning.seed.copy()
    z[:3:2], z[place] = (0.0, 1.0), (k, a)
    return Start(stop, z, 0.0)


@pytest.mark.slow
def test_a_soft_stop_is_tried_harder(search):
    """From a stop that a fit left a quarter of the amplitude inside, the moves lead to where a fit from the truth does;
    the fit itself had been caught ten nats short of it."""
    stop = (upper_stop(search),)
    search.weigher.weigh([began(search, STIFFNESS, STOP)], whole=True)
    truth = search.found.of(stop, "white")
    del search.found.estimates[stop]
    search.weigher.weigh([began(search, STIFFNESS * (0.04 / 0.25) ** 1.5, 0.75)], whole=True)
    caught = search.found.of(stop, "white")
    assert caught.log_evidence < truth.log_evidence - 10
    Refinement(search.prospects, search.progress).move_places()
    # A kink between two of the depths that are tried may cost a nat or two.
    assert search.found.of(stop, "white").log_evidence > truth.log_evidence - 2


@pytest.mark.slow
def test_moved_stops_turn_the_swing_alike(search):
    """Every stop that is tried takes from the swing of a spring the impulse of the first within a tenth, by the
    integral of its force, or throws what hits it back from the same wall: after half the period of its own swing, as
    fast as it came. Some do the one, some the other; none lies outside the motion."""
    start, k, a = began(search, 0.0, 0.75), 0.01, 0.75
    start.z[dict(search.problem.placed(start.combination))[upper_stop(search)].start] = k
    moved = along_the_depths(search.weigher, start.combination, start.z, upper_stop(search))
    t = np.linspace(0.0, 2 * np.pi, 200_001)
    ((_, place),) = search.problem.placed(start.combination)
    speed = 0.25 * np.sqrt(k)  # which comes a quarter deep
    wall = lambda k, a: a + speed * 0.5 * np.pi / np.sqrt(k)  # noqa: E731
    impulse = lambda k, a: k * np.mean(np.maximum(np.sin(t) - a, 0.0))  # noqa: E731
    # A parabola for the swing of a spring is off by 1.5 % here; the rest is how near a row comes to the swing's edge.
    alike = [impulse(*z[place]) == pytest.approx(impulse(k, a), rel=0.1) for z in moved]
    # How near a row comes to the swing's edge, by which the depth is told: 5e-4 was seen.
    thrown = [wall(*z[place]) == pytest.approx(wall(k, a), abs=0.002) for z in moved]
    assert sum(alike) > 3 and sum(thrown) > 1 and all(np.array(alike) | np.array(thrown))
    assert all(z[place][1] < 1.01 for z in moved)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 5])
def test_the_stiffness_of_a_hard_stop_is_that_of_its_profile(seed):
    """A stop a hundred times as stiff as the spring, which a swing runs into at speed: its stiffness, and how well that
    is known, are those of its profile by SciPy's least squares with DOP853, and the truth is in the interval."""
    times, noise = np.arange(0.0, 15.0, 0.05), 0.01

    def shown(values):
        q, p, k, a = values
        return cases.solved(lambda t, x: [x[1], -4 * x[0] - k * max(x[0] - a, 0.0)], [q, p], times, 1e-9)[:, 0]

    y = shown([0.5, 1.6, 400.0, 0.6]) + noise * np.random.default_rng(seed).normal(size=len(times))

    def left(rest, k):
        return (shown([*rest[:2], k, rest[2]]) - y) / noise

    # What all else leaves of the likelihood of each stiffness: at its best, times how far it may vary there.
    stiffnesses, begin, told = np.geomspace(150.0, 1100.0, 13), [0.5, 1.6, 0.57], []
    for k in stiffnesses:
        # Steps of the differences that no rounding of DOP853 shows in.
        fit = least_squares(left, begin, x_scale=[0.01, 0.01, 0.01], diff_step=1e-4, args=(k,))
        begin = fit.x
        told.append(-fit.cost - 0.5 * np.linalg.slogdet(fit.jac.T @ fit.jac)[1])
    weight = np.exp(np.array(told) - max(told)) * np.gradient(stiffnesses)
    mean = np.average(stiffnesses, weights=weight)
    sd = np.sqrt(np.average((stiffnesses - mean) ** 2, weights=weight))

    file = cases.simulation("p**2/2 + 2*q**2")
    allowed = Options(holdout=0.0, restriction=Restriction(effects=("contact_stop",)))
    document = diagnose(file, [cases.recorded(times, y, columns=("y",))], allowed).document
    (finding,) = document["findings"]
    k = finding["coefficients"]["k"]
    assert finding["effect"] == "contact_stop" and k["interval95"][0] < 400.0 < k["interval95"][1]
    # A normal density about the likeliest stiffness stands for a skewed one, whose mean lies above it and which is
    # wider: by 0.40 of its sd and 22 % at most in these two.
    assert abs(k["mean"] - mean) < 0.5 * sd and k["sd"] == pytest.approx(sd, rel=0.3)
