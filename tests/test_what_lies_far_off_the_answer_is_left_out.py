"""Where readings were left in as no outliers of a motion that was not understood, those of the answer are found."""

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis import _far_off
from symplearn.diagnosis._build import Restriction, augmented_equations, build
from symplearn.diagnosis._far_off import weigh_without_far
from symplearn.diagnosis._score import Start
from symplearn.diagnosis._search import Search
from symplearn.diagnosis._start import first_fits, priors_without_effects
from symplearn.diagnosis._trajectory import Stepper

TIMES = np.linspace(0.0, 30.0, 150)
FAR = [12, 40, 77, 101, 133]


SOME = Restriction(("viscous_damping", "sensor_noise", "sensor_outliers"))


def read(far):
    """A damped swing with some readings far off, and the problem of a simulation without damping."""
    swing = cases.solved(lambda t, x: [x[1], -x[0] - 0.08 * x[1]], [1.0, 0.0], TIMES)
    readings = swing[:, 0] + 0.01 * np.random.default_rng(1).normal(size=len(TIMES))
    readings[far] += 0.3 * np.array([1, -1, 1, 1, -1])[: len(far)]
    file = cases.simulation("p**2/2 + q**2/2", more="[recording.noise]\ny = 0.01")
    recording = cases.recorded(TIMES, readings)
    return swing, build(file, augmented_equations(file), [recording], 0.0, 0.1, SOME)


def weighed(far):
    """What a weigher found with all readings in: nothing, the damping, and a larger noise beside it."""
    swing, p = read(far)
    weigher = cases.weigher(p, swing[:, 0], swing[:, 1])
    names = {p.candidate(m).effect.name: m for m in p.searched}
    damping, noise = names["viscous_damping"], names["sensor_noise"]
    start = weigher.found.priors.mean
    combinations = [(), (damping,), tuple(sorted((damping, noise)))]
    weigher.weigh([Start(c, start, 0.0) for c in combinations])
    return weigher, (damping, names["sensor_outliers"])


@pytest.fixture(scope="module")
def outlying():
    return weighed(FAR)


def test_no_column_that_was_not_left_in_is_looked_at(outlying):
    """Nothing is weighed for it."""
    weigher, _ = outlying
    before = set(weigher.found.estimates)
    assert not weigh_without_far(weigher, frozenset())
    assert set(weigher.found.estimates) == before and weigher.base == () and weigher.stepper is weigher.plain


def test_those_far_off_the_answer_are_left_out(outlying):
    """These five of 150 readings and no others, thirty of the noise off, in place of a larger noise; the likeliest is
    then the damping with outliers, whose coefficient is what it was to within three of its errors."""
    weigher, expected = outlying
    assert weigh_without_far(weigher, frozenset({0}))
    assert np.nonzero(weigher.flagged[0][:, 0])[0].tolist() == FAR
    best = max(weigher.found.estimates, key=weigher.found.odds)
    assert set(best) == set(expected) and weigher.base == expected[1:]
    one, (place,) = weigher.found.of(best, "white"), [p for m, p in weigher.problem.placed(best) if m == expected[0]]
    assert abs(one.z[place.start] - 0.08) < 3 * np.sqrt(one.covariance[place.start, place.start])


@pytest.mark.parametrize(
    ("spared", "asked"), [(frozenset({0}), True), pytest.param(frozenset(), False, marks=pytest.mark.slow)],
    ids=["left in", "not"],
)  # fmt: skip
def test_a_search_that_leaves_readings_in_asks_again(spared, asked):
    """Whether they were taken out at the beginning or at last, the damping is told with the same five outliers."""
    _, p = read(FAR)
    stepper, said = Stepper(p), []
    seeds = first_fits(stepper, priors_without_effects(p), [r.fitted for r in p.rows])
    search = Search(stepper, seeds.z, np.inf, said.append, spared)
    found = search.run()
    assert ("weighing the best combinations without what lies far off" in said) == asked
    best = max(found.estimates, key=found.odds)
    assert {p.candidate(m).effect.name for m in best} == {"viscous_damping", "sensor_outliers"}
    assert np.nonzero(search.weigher.flagged[0][:, 0])[0].tolist() == FAR


def test_where_they_turn_out_to_be_none_all_stay_in_again(monkeypatch):
    """As they were, for whatever is weighed next."""
    weigher, _ = weighed(FAR)
    monkeypatch.setattr(_far_off, "doubtful_outliers", lambda *_: frozenset({0}))
    assert not weigh_without_far(weigher, frozenset({0}))
    assert weigher.base == () and weigher.stepper is weigher.plain and not weigher.flagged[0].any()


def test_without_such_readings_all_stay_in():
    """Nothing is weighed again."""
    weigher, _ = weighed([])
    before = set(weigher.found.estimates)
    assert not weigh_without_far(weigher, frozenset({0}))
    assert set(weigher.found.estimates) == before and weigher.base == () and weigher.stepper is weigher.plain
