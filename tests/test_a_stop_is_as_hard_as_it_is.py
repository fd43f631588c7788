"""A soft stop far inside a swing and a hard one at its edge do alike: a fit of the one is tried as the other."""

import engine_cases as cases
import numpy as np
import pytest

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
    stepper = Stepper(cases.problem(file, [cases.recorded(TIMES, y)], 0.1))
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
    """Over the swing of a spring, the impulse of every stop that is tried is that of the first within a tenth, by the
    integral of its force; none lies outside the motion."""
    start = began(search, 0.0, 0.75)
    start.z[dict(search.problem.placed(start.combination))[upper_stop(search)].start] = 0.01
    moved = along_the_depths(search.weigher, start.combination, start.z, upper_stop(search))
    t = np.linspace(0.0, 2 * np.pi, 200_001)
    ((_, place),) = search.problem.placed(start.combination)
    # A parabola for the swing of a spring is off by 1.5 % here; the rest is how near a row comes to the swing's edge.
    impulse = lambda k, a: k * np.mean(np.maximum(np.sin(t) - a, 0.0))  # noqa: E731
    assert len(moved) > 3 and all(z[place][1] < 1.01 for z in moved)
    assert [impulse(*z[place]) for z in moved] == pytest.approx([impulse(0.01, 0.75)] * len(moved), rel=0.1)
