"""Where no reading was left out, as of a motion that was not understood, the outliers of the answer are found."""

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis import Options, _far_off, diagnose, restriction_of
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


def test_those_far_off_the_answer_are_left_out(outlying):
    """These five of 150 readings and no others, thirty of the noise off, in place of a larger noise; the likeliest is
    then the damping with outliers, whose coefficient is what it was to within three of its errors."""
    weigher, expected = outlying
    assert weigh_without_far(weigher)
    assert np.nonzero(weigher.flagged[0][:, 0])[0].tolist() == FAR
    best = max(weigher.found.estimates, key=weigher.found.odds)
    assert set(best) == set(expected) and weigher.base == expected[1:]
    one, (place,) = weigher.found.of(best, "white"), [p for m, p in weigher.problem.placed(best) if m == expected[0]]
    assert abs(one.z[place.start] - 0.08) < 3 * np.sqrt(one.covariance[place.start, place.start])


@pytest.mark.parametrize(
    ("spared", "asked"), [(frozenset({0}), True), pytest.param(frozenset(), False, marks=pytest.mark.slow)],
    ids=["left in", "taken out"],
)  # fmt: skip
def test_a_search_that_left_none_out_asks_at_last(spared, asked):
    """Whether they were taken out at the beginning or at last, the damping is told with the same five outliers."""
    _, p = read(FAR)
    stepper, said = Stepper(p), []
    seeds = first_fits(stepper, priors_without_effects(p), [r.fitted for r in p.rows])
    search = Search(stepper, seeds.z, np.inf, said.append, spared)
    found = search.run()
    assert ("looking for readings far off the likeliest answer" in said) == asked
    best = max(found.estimates, key=found.odds)
    assert {p.candidate(m).effect.name for m in best} == {"viscous_damping", "sensor_outliers"}
    assert np.nonzero(search.weigher.flagged[0][:, 0])[0].tolist() == FAR


def test_where_they_turn_out_to_be_none_all_stay_in_again(monkeypatch):
    """As they were, for whatever is weighed next."""
    weigher, _ = weighed(FAR)
    monkeypatch.setattr(_far_off, "doubtful_outliers", lambda *_: frozenset({0}))
    assert not weigh_without_far(weigher)
    assert weigher.base == () and weigher.stepper is weigher.plain and not weigher.flagged[0].any()


@pytest.mark.parametrize("doubted", [False, True])
def test_what_was_out_before_stays_out(monkeypatch, doubted):
    """A reading that a term of the simulation takes for an outlier is left out beside those that are found, and alone
    where these turn out to be none."""
    weigher, _ = weighed(FAR)
    known = np.arange(len(TIMES))[:, None] == 5
    weigher.leave_out([known], (), 0.0)
    if doubted:
        monkeypatch.setattr(_far_off, "doubtful_outliers", lambda *_: frozenset({0}))
    assert weigh_without_far(weigher) != doubted
    assert np.nonzero(weigher.flagged[0][:, 0])[0].tolist() == ([5] if doubted else [5, *FAR])


def test_without_such_readings_all_stay_in():
    """Nothing is weighed again."""
    weigher, _ = weighed([])
    before = set(weigher.found.estimates)
    assert not weigh_without_far(weigher)
    assert set(weigher.found.estimates) == before and weigher.base == () and weigher.stepper is weigher.plain


@pytest.mark.slow
def test_what_a_force_passed_through_is_told_at_last():
    """Two swings of which nothing says that they are coupled: a force on each that follows what is read goes through
    readings that are ten times the noise off, and the coupling leaves them."""
    rng = np.random.default_rng(22)
    times = 0.19 * np.arange(128) + 0.04 * rng.uniform(-1, 1, 128) * (np.arange(128) > 0)

    def rates(t, x):
        between = 0.12 * (x[0] - x[1]) + 0.025 * (x[2] - x[3])
        return [x[2], x[3], -4 * np.sin(x[0]) - between, -4 * np.sin(x[1]) + between]

    shown = cases.solved(rates, [0.8, -0.1, 0.0, 0.3], times)[:, :2]
    readings = shown + [0.02, 0.015] * rng.normal(size=shown.shape)
    far = np.sort(rng.choice(128, 5, replace=False))
    readings[far, 0] += 0.2 * rng.normal(size=len(far))
    file = cases.simulation(
        "(p**2 + s**2)/2 - G*(cos(a) + cos(b))", ("a", "b"), ("p", "s"), {"y0": "a", "y1": "b"},
        "[parameters]\nG = { value = 4.0, sd = 0.05 }\n[recording.noise]\ny0 = 0.02\ny1 = 0.015\n",
    )  # fmt: skip
    some = restriction_of(["relative_damping", "coupling_spring", "viscous_damping", "sensor_noise", "sensor_outliers"])
    document = diagnose(file, [cases.recorded(times, readings)], Options(restriction=some, jobs=1)).document
    told = {finding["effect"] for finding in document["findings"]}
    assert told == {"relative_damping", "coupling_spring", "sensor_outliers"} and document["probability"] > 0.9
