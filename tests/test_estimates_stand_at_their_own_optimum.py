"""What is known beside a remainder is known about its own optimum, however far off the trajectory fit stands."""

from dataclasses import replace

import engine_cases as cases
import numpy as np
import pytest
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from symplearn.diagnosis._bend import Form
from symplearn.diagnosis._calibrate import Fits
from symplearn.diagnosis._clock import weigh_clock
from symplearn.diagnosis._settle import settle, settled
from symplearn.diagnosis._weighed import weigh_coloured, weigh_white

TIMES, NOISE = np.linspace(0.0, 50.0, 250), 0.02
KNOWN = f"[parameters]\nk = {{ value = 1.0, sd = 0.1 }}\n[recording.noise]\ny = {NOISE}\n"
SPRING = cases.simulation("p**2/2 + k*q**2/2", more=KNOWN)
PLACES = [0, 2, 4]  # of place, speed and stiffness among the unknowns
NEAR = np.array([1.0, 0.0, 1.0])
FAR = np.array([1.0, 0.0, 1.01])  # loses a quarter of a radian by the end


def waved(size):
    """A spring's place by SciPy, of which a sensor reads too much and too little by turns, for some time each."""
    q = cases.solved(lambda t, x: [x[1], -x[0]], [1.0, 0.0], TIMES)[:, 0]
    rng = np.random.default_rng(3)
    slow = np.exp(-0.5 * ((TIMES[:, None] - TIMES) / 4.0) ** 2) @ rng.normal(size=len(TIMES))
    return q + size * slow / np.std(slow) + NOISE * rng.normal(size=len(TIMES))


def weighed_about(start, y, kind):
    """A weigher whose only trajectory fit stands at `start`, and one step from there beside a remainder."""
    p = cases.problem(SPRING, [cases.recorded(TIMES, y)], 0.05)
    weigher = cases.weigher(p, np.cos(TIMES), -np.sin(TIMES))
    z = np.zeros(p.size)
    z[PLACES] = start
    predictions = weigher.stepper.predict(z[None], [()], weigher.rows)
    fits = Fits([()], z[None], np.array([[NOISE]]), predictions, np.zeros(1), np.zeros(1, bool))
    white = weigh_white(p, fits, weigher.found.priors, weigher.rows)[0]
    (coloured,) = weigh_coloured(p, fits, weigher.found.priors, weigher.rows)
    if kind == "clock":
        (one,) = weigh_clock(p, fits, weigher.found.priors, weigher.rows, [coloured.colours])
    else:
        one = coloured if kind == "coloured" else weigher.beside(replace(coloured, kind=kind), z)
    for each in (white, one):
        weigher.found.add(each)
    return weigher, one


def own_optimum(y, colour):
    """Place, speed and stiffness of the largest density, by SciPy, from the closed motion and the dense covariance of
    noise and a colour."""
    memory = cases.autocovariance(TIMES[:, None] - TIMES, colour.frequency, colour.damping)
    held = cho_factor(NOISE**2 * (np.eye(len(TIMES)) + colour.ratio * memory))

    def loss(x):
        w = np.sqrt(x[2])
        left = y - x[0] * np.cos(w * TIMES) - x[1] / w * np.sin(w * TIMES)
        return 0.5 * left @ cho_solve(held, left) + 0.5 * ((x[2] - 1.0) / 0.1) ** 2

    # So that the oracle's own error does not count: places to 1e-9, some millionths of their standard deviations (3e-4
    # and more), and losses to 1e-9 nats, which are some 5e-5 of one. It took 111 steps.
    ends = {"xatol": 1e-9, "fatol": 1e-9, "maxiter": 4000}
    found = minimize(loss, [1.0, 0.0, 1.0], method="Nelder-Mead", options=ends)
    assert found.success
    return found.x


def test_one_step_from_afar_is_not_it_and_more_are():
    """Of a spring read by a sensor that errs for a while: a step from a stiffness that is 1 % off misses by standard
    deviations, the settled estimate by a hundredth of one at most, and its evidence is more."""
    y = waved(0.03)
    weigher, one = weighed_about(FAR, y, "coloured")
    settle(weigher, lambda combination: True)
    found = weigher.found.of((), "coloured")
    best, sd = own_optimum(y, found.colours[0]), np.sqrt(np.diagonal(found.covariance)[PLACES])
    assert found.converged
    assert np.max(np.abs(found.z[PLACES] - best) / sd) < 0.01 < 2 < np.max(np.abs(one.z[PLACES] - best) / sd)
    assert found.log_evidence > one.log_evidence + 10


def ends(kind, far):
    """Two settled estimates beside one remainder, from a start far off and from one close by, and how many standard
    deviations they are apart."""
    y = waved(0.03)
    one, other = (settled(*weighed_about(start, y, kind)) for start in (far, NEAR))
    assert one.converged
    assert other.converged
    return one, other, np.max(np.abs(one.z - other.z)[PLACES] / np.sqrt(np.diagonal(other.covariance)[PLACES]))


@pytest.mark.parametrize("kind", ["coloured", "positional", "kinematic", "jitter"])
def test_it_does_not_matter_where_it_begins(kind):
    """Under every remainder of the readings the same place and the same evidence, from afar and from close by."""
    far, near, apart = ends(kind, FAR)
    assert apart < 0.1
    assert abs(far.log_evidence - near.log_evidence) < 0.1


def test_what_a_clock_does_is_kept_as_it_was_found():
    """From a third as far the place is the same to a standard deviation: errors of a clock are taken as they were found
    there, and their evidence is a little less, not more."""
    far, near, apart = ends("clock", (FAR + 2 * NEAR) / 3)
    assert apart < 1.0  # seen: 0.54
    assert near.log_evidence - 5.0 < far.log_evidence < near.log_evidence + 0.1  # seen: 3.1 below


@pytest.mark.parametrize("form", list(Form))
def test_an_error_keeps_its_form(form):
    """Steps are those of the error that promised them, whichever is likelier about a point on the way."""
    weigher, one = weighed_about(NEAR, waved(0.03), "kinematic")
    other = replace(one, bends=(replace(one.bends[0], shapes=replace(one.bends[0].shapes, form=form)),))
    again = weigher.beside(other, one.z)
    assert again.bends[0].shapes.form is form
    assert again.log_evidence == pytest.approx(weigher.beside(one, one.z).log_evidence)  # that of all forms together


def test_what_is_not_the_weighers_own_stays_as_it_is():
    """Estimates with other outliers taken out are of other readings."""
    weigher, one = weighed_about(FAR, waved(0.03), "coloured")
    before = weigher.found.of((), "coloured")
    settle(weigher, lambda combination: False)
    assert weigher.found.of((), "coloured") is before


@pytest.mark.parametrize("kind", ["coloured", "clock", "positional", "kinematic", "jitter"])
def test_where_every_trajectory_runs_away_nothing_is_settled(kind):
    """From a start beyond every number there is no estimate, and no failure."""
    weigher, one = weighed_about(NEAR, waved(0.03), kind)
    far = np.where(np.arange(len(one.z)) == PLACES[0], 1e200, one.z)
    weigher.found.settle(weigher.found.of((), "white"), replace(weigher.found.of((), "white"), z=far))
    with np.errstate(all="ignore"):  # as a diagnosis has it
        assert settled(weigher, replace(one, z=far)) is None
