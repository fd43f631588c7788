"""A fit of many revolutions arrives: along a curved valley, and it is not given up while it comes nearer."""

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis._calibrate import calibrate, is_hopeless
from symplearn.diagnosis._effect_priors import with_effects
from symplearn.diagnosis._motion import motion_along
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._trajectory import Stepper

NOISE, DRAG, TIMES = 0.001, 0.003, np.linspace(0.0, 100.0, 300)


def rates(t, s):
    """An orbit about a unit mass with a drag as the square of one of its speeds."""
    attraction = cases.attracted(1.0)(t, s)
    return [*attraction[:2], attraction[2] - DRAG * abs(s[2]) * s[2], attraction[3]]


class Ranged:
    """An orbit of which only the distance is read: how it is turned shows by the drag alone, and little."""

    def __init__(self):
        x = cases.solved(rates, [0.9, 0.0, 0.0, 1.1], TIMES)
        y = np.hypot(x[:, 0], x[:, 1]) + NOISE * np.random.default_rng(1).normal(size=len(TIMES))
        more = f"[parameters]\nmu = {{ value = 1.0 }}\n[recording.noise]\nrange = {NOISE}\n"
        file = cases.simulation("(px**2 + py**2)/2 - mu/sqrt(x**2 + y**2)", ["x", "y"], ["px", "py"],
                                {"range": "sqrt(x**2 + y**2)"}, more)  # fmt: skip
        p = cases.problem(file, [cases.recorded(TIMES, y, columns=("range",))], 0.05)
        width = p.equations.width
        path = np.zeros((len(TIMES), p.state))
        path[:, :2], path[:, width : width + 2] = x[:, :2], x[:, 2:]
        self.combination = tuple(
            m for m in p.searched if p.candidate(m).effect.name == "quadratic_drag" and p.candidate(m).place == 0
        )
        self.turned = [slice(0, 2), slice(width, width + 2)]
        self.stepper = Stepper(p)
        self.truth = np.zeros(p.size)
        self.truth[: p.state], self.truth[p.head], self.truth[p.slots] = path[0], 1.0, DRAG
        self.priors = with_effects(p, priors_without_effects(p), motion_along(p, self.truth, [path]))

    def fitted(self, start):
        """A fit of the drag."""
        return calibrate(self.stepper, start[None], [self.combination], self.priors, [len(TIMES)])


@pytest.fixture(scope="module")
def ranged():
    return Ranged()


def test_a_fit_goes_round_along_a_curved_valley(ranged):
    """Begun a tenth of a radian round from the truth, it comes to within a nat of the fit that begins at the truth."""
    # Straight steps take 40 of them for a tenth of the way.
    turn, start = np.array([[np.cos(0.1), -np.sin(0.1)], [np.sin(0.1), np.cos(0.1)]]), ranged.truth.copy()
    for part in ranged.turned:
        start[part] = turn @ start[part]
    far, near = (ranged.fitted(one) for one in (start, ranged.truth))
    assert far.converged.all() and near.converged.all()
    assert far.cost[0] < near.cost[0] + 2  # the cost is twice the nats, and both may rest where they promise one


def test_one_that_comes_nearer_is_not_given_up():
    """Of fits that lie thousands of nats behind the best one, that which halves its distance in three steps goes on;
    those that do not, or that ran away, are given up. One that is near may take its time."""
    steps = np.array([[9e4, 9e4, np.inf, 900.0], [7e4, 8e4, np.inf, 900.0], [6e4, 8e4, np.inf, 900.0],
                      [4e4, 8e4, np.inf, 900.0]])  # fmt: skip
    np.testing.assert_array_equal(is_hopeless(list(steps)), [False, True, True, False])
