"""Prior prices and posterior probabilities are those of the contract (section 4)."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from posterior_cases import estimate, found, made, place

from symplearn._effects import prices, vocabulary
from symplearn.diagnosis._document import told_apart
from symplearn.diagnosis._found import Ahead
from symplearn.diagnosis._posterior import posterior

# Sums of a few dozen numbers below one.
ROUND_OFF = 1e-12

# By hand from the contract: the families and `any` (what has no name) share equally, then the effects of a family,
# then the two coordinates, their pair, the two columns, or the parameter, whose value is known. No noise is given, so
# that none can be wrong.
EFFECTS = {
    "dissipation": ["viscous_damping", "quadratic_drag", "coulomb_friction", "relative_damping"],
    "activity": ["self_excitation"],
    "conservative": ["constant_force", "linear_stiffness", "quadratic_stiffness", "cubic_stiffness", "coupling_spring",
                     "contact_stop", "central_correction"],
    "gyroscopic": ["gyroscopic_coupling"],
    "forcing": ["periodic_forcing", "impulse"],
    "time variation": ["parametric_modulation", "parameter_drift", "regime_change"],
    "hidden degree of freedom": ["hidden_oscillator"],
    "calibration": ["parameter_error"],
    "sensor": ["sensor_bias", "sensor_gain", "sensor_drift", "sensor_delay", "sensor_outliers"],
}  # fmt: skip
FAMILIES = len(EFFECTS) + 1
DAMPING, GAIN = 1 / (FAMILIES * 4 * 2), 1 / (FAMILIES * 5 * 2)  # of a drag on a coordinate, of a gain on a column
ONE_TARGET = {"relative_damping", "coupling_spring", "central_correction", "gyroscopic_coupling",
              "parametric_modulation", "parameter_drift", "regime_change", "parameter_error"}  # fmt: skip

KINDS = ("white", "coloured", "clock", "positional", "kinematic", "jitter", "static", "force", "spell")
OTHERS = len(KINDS) - 1  # that are a remainder


@pytest.fixture(scope="module")
def problem():
    return made(1)


def alike(problem, combination, log_evidence, sd=0.01):
    """The same under white noise and beside every kind of remainder."""
    return [estimate(problem, combination, log_evidence, kind, sd) for kind in KINDS]


def singles(problem):
    return [(c,) for c in problem.searched]


def price(problem, candidate):
    one = problem.equations.candidates[candidate].effect
    targets = 1 if one.name in ONE_TARGET else (4 if one.name == "contact_stop" else 2)  # a stop has two sides
    return 1 / (FAMILIES * len(EFFECTS[one.family]) * targets)


def test_what_has_no_number_for_its_evidence_takes_nothing_from_the_others(problem):
    """A fit that ran away, kept before all others, has no probability and leaves theirs as they are."""
    lost, *some = singles(problem)[:4]
    others = [one for k, c in enumerate(some) for one in alike(problem, c, 10.0 + k)]
    base = [*alike(problem, (), 0.0), *others]
    without = posterior(problem, found(problem, *base, *alike(problem, lost, -np.inf)), 1.0)
    beside = posterior(problem, found(problem, *alike(problem, lost, np.nan), *base), 1.0)
    told = {one.combination: one.probability for one in beside.named}
    assert told.get(lost, 0.0) == 0.0
    assert max(told, key=told.get) == some[-1]
    # Round-off: the sums run in another order.
    assert told == pytest.approx({one.combination: one.probability for one in without.named}, abs=1e-12)


def test_every_effect_on_every_target_is_in_the_vocabulary(problem):
    """Two coordinates, their pair, a parameter and two columns, each once with each effect; a stop once by side. Beside
    it two powers of each coordinate that shape a force without a name, and are never looked for."""
    keys = [(c.effect.name, c.target if isinstance(c.target, str) else tuple(c.target), c.side)
            for c in problem.equations.candidates]  # fmt: skip
    assert len(set(keys)) == len(keys)
    by_hand = {effect for family in EFFECTS.values() for effect in family} | {"sensor_noise"}
    assert {effect for effect, _, _ in keys} == by_hand | {"quartic_stiffness", "quintic_stiffness"}
    for effect in by_hand:
        targets = {target for name, target, _ in keys if name == effect}
        if effect in ("relative_damping", "coupling_spring", "central_correction", "gyroscopic_coupling"):
            assert targets == {("q1", "q2")}
        elif effect in ONE_TARGET:
            assert targets == {"k"}
        else:
            assert targets == ({"a", "b"} if effect.startswith("sensor") else {"q1", "q2"})
    assert {side for effect, _, side in keys if effect == "contact_stop"} == {"upper", "lower"}
    assert {problem.candidate(m).effect.name for m in problem.searched} == by_hand - {"sensor_noise"}


def test_values_of_candidates_fill_the_coefficient_vector_once(problem):
    """Every entry of the vector belongs to one candidate."""
    taken = np.zeros(problem.equations.size, int)
    for c in problem.equations.candidates:
        taken[c.first : c.first + c.effect.entries] += 1
    assert (taken == 1).all()


def test_prices_are_shared_by_families_then_effects_then_targets(problem):
    """Each price is 1 / (families x effects of its family x targets), and with the unexplained they sum to one."""
    candidates = [problem.candidate(m) for m in problem.searched]
    found = prices(candidates, ["any", *EFFECTS])
    for index, member in enumerate(problem.searched):
        assert found[index] == pytest.approx(price(problem, member), rel=ROUND_OFF)
    assert sum(found.values()) + 1 / FAMILIES == pytest.approx(1.0, rel=ROUND_OFF)


@pytest.mark.parametrize("recordings", [1, 2, 3, 4, 5])
def test_members_in_some_recordings_share_what_their_target_has(recordings):
    """Where all explain alike, every effect and target keeps its price however many choices of recordings there are,
    half of it for all of them; an impulse, at one time, is in one recording and each is as likely; a change in time
    that would begin anew in every recording, whose clocks overlap, has a thirtieth for all of them, and a wrong known
    value, which they share, nine tenths; outliers are taken out of all recordings alike."""
    problem, members = made(recordings), []
    for m in problem.searched:
        once = problem.candidate(m).effect.name == "impulse" and recordings > 1
        variants = [v for v in problem.variants(m) if not once or len(problem.members[v].recordings) == 1]
        alone = problem.candidate(m).effect.name == "sensor_outliers"
        members += [m] if alone else variants if once else [m, *variants]
    fits = [one for c in [(), *((m,) for m in members)] for one in alike(problem, c, 1.0)]
    p = posterior(problem, found(problem, *fits), 1.0)
    assert p.as_it_is == pytest.approx(0.5, rel=1e-9) and p.unexplained == pytest.approx(0.5 / FAMILIES, rel=1e-9)
    whole, part = {}, {}
    for w in p.named:
        (m,) = w.combination
        share = whole if len(problem.members[m].recordings) == recordings else part
        share[problem.whole(m)] = share.get(problem.whole(m), 0.0) + w.probability
    for m in problem.searched:
        total = whole.get(m, 0.0) + part.get(m, 0.0)
        assert total == pytest.approx(0.5 * price(problem, m), rel=1e-9)
        one = problem.candidate(m).effect
        every = 1 / 30 if one.family == "time variation" else 1 / 2
        every = {"sensor_outliers": 1.0, "parameter_error": 0.9}.get(one.name, every)
        assert recordings == 1 or one.name == "impulse" or whole[m] == pytest.approx(total * every, rel=1e-9)
    subsets = {problem.members[m].recordings for m in members}
    # Any of up to four; of more all, each one alone, and all but one.
    assert len(subsets) == {1: 1, 2: 3, 3: 7, 4: 15, 5: 11}[recordings]


def test_choices_of_recordings_and_sides_stand_together():
    """Of one effect and target the answer tells one line, with the probability of all its choices together."""
    problem = made(2)
    drag, stop = place(problem, "viscous_damping", "q1"), place(problem, "contact_stop", "q2")
    (other,) = [m for m in problem.searched if problem.candidate(m).key == problem.candidate(stop).key and m != stop]
    members = [drag, *problem.variants(drag), stop, other]
    fits = [estimate(problem, (), 0.0), *(estimate(problem, (m,), float(k)) for k, m in enumerate(members))]
    named = posterior(problem, found(problem, *fits), 1.0).named
    told = told_apart(problem, named)
    assert len(named) == 5 and len(told) == 2
    for one, choices in zip(sorted(told, key=lambda w: w.combination[0] == stop or w.combination[0] == other),
                            (members[:3], members[3:]), strict=True):  # fmt: skip
        mine = [w for w in named if w.combination[0] in choices]
        assert one.probability == pytest.approx(sum(w.probability for w in mine), rel=ROUND_OFF)
        assert one.combination == max(mine, key=lambda w: w.probability).combination


def test_a_narrower_search_shares_among_what_is_left():
    """With one effect of a family left on two targets, its family's share is halved and no more."""
    candidates = [c for c in vocabulary(["q1", "q2"], ["a"]) if c.effect.name in ("viscous_damping", "sensor_bias")]
    found = prices(candidates, ["any", "dissipation", "sensor"])
    assert [found[i] for i in range(3)] == pytest.approx([1 / 6, 1 / 6, 1 / 3], rel=ROUND_OFF)


@pytest.mark.parametrize("value", [0.0, -1234.5, 5678.9])
def test_equal_evidences_give_the_prior_back(problem, value):
    """Where all explain alike: 1/2 for nothing, 1/8 for the unexplained, half its price for each effect."""
    fits = [one for c in [(), *singles(problem)] for one in alike(problem, c, value)]
    p = posterior(problem, found(problem, *fits), 1.0)
    # Evidences of some thousands keep twelve digits behind the point.
    assert p.as_it_is == pytest.approx(0.5, rel=1e-9)
    assert p.unexplained == pytest.approx(0.5 / FAMILIES, rel=1e-9)
    for w in p.named:
        assert w.probability == pytest.approx(0.5 * price(problem, w.combination[0]), rel=1e-9)


def test_probabilities_add_to_one_and_come_likeliest_first(problem):
    """With arbitrary evidences of all singles and pairs under every kind of remainder."""
    rng = np.random.default_rng(0)
    everything = [(), *singles(problem), *combinations(problem.searched, 2)]
    fits = [estimate(problem, c, 4 * rng.normal(), kind) for c in everything for kind in KINDS]
    p = posterior(problem, found(problem, *fits), 1.0)
    named = [w.probability for w in p.named]
    assert p.as_it_is + p.unexplained + p.faint + sum(named) == pytest.approx(1.0, rel=ROUND_OFF)
    n = len(problem.searched)
    assert named == sorted(named, reverse=True) and len(named) == n + n * (n - 1) // 2


def test_what_was_not_fitted_may_be_too_weak_to_be_seen(problem):
    """Effects without a fit keep their price as far as four standard errors lie above 1e-4 of the largest."""
    one = (place(problem, "viscous_damping", "q1"),)
    p = posterior(problem, found(problem, estimate(problem, (), 0.0), estimate(problem, one, -2.0, sd=0.01)), 1.0)
    rest = 1 - 1 / FAMILIES - DAMPING
    # Round-off of logarithms of ratios.
    assert p.faint / p.as_it_is == pytest.approx(rest * np.log10(4 * 0.01 / 1e-4) / 4, rel=1e-9)
    everything = [estimate(problem, c, 0.0) for c in singles(problem)]
    assert posterior(problem, found(problem, estimate(problem, (), 0.0), *everything), 1.0).faint == 0.0


def test_a_combination_pays_every_members_price(problem):
    """Odds of a pair against nothing are the product of two prices, times the ratio of evidences."""
    pair = (place(problem, "viscous_damping", "q1"), place(problem, "sensor_gain", "b"))
    p = posterior(problem, found(problem, *alike(problem, (), -3.0), *alike(problem, pair, 2.0)), 1.0)
    odds = p.named[0].probability / p.as_it_is
    assert odds == pytest.approx(DAMPING * GAIN * np.exp(5.0), rel=1e-9)


def test_beside_a_finding_a_remainder_has_a_quarter(problem):
    """Of an effect's price, three quarters go to white noise alone and one to the kinds of remainder, which share it. A
    kind that gains more than the effect does has the price of `any` there, as all have without a finding."""
    one, nothing = (place(problem, "viscous_damping", "q1"),), [estimate(problem, (), 0.0, kind) for kind in KINDS]
    values = dict(zip(KINDS, (2.0, 5.0, 3.5, 3.0, 2.8, 1.5, -1.0, 3.0, 2.5), strict=True))
    shares = dict(zip(KINDS, (3 / 4, 1 / FAMILIES / OTHERS, *[1 / 4 / OTHERS] * (OTHERS - 1)), strict=True))
    kinds = [estimate(problem, one, value, kind) for kind, value in values.items()]
    p = posterior(problem, found(problem, *nothing, *kinds), 1.0)
    expected = DAMPING * sum(shares[kind] * np.exp(value) for kind, value in values.items())
    assert p.named[0].probability / p.as_it_is == pytest.approx(expected, rel=ROUND_OFF)
    assert p.unexplained / p.as_it_is == pytest.approx(1 / FAMILIES, rel=ROUND_OFF)
    assert p.named[0].best.kind == "coloured"


@pytest.mark.parametrize(
    ("ahead", "counts"),
    [
        (Ahead(0.0, True, False), True),
        (Ahead(-0.5, False, True), True),
        (Ahead(-1.5, False, False), False),
        (None, False),
    ],
)
def test_findings_that_explain_less_than_they_leave_must_predict(problem, ahead, counts):
    """Of an effect that gains 2 nats beside a coloured error that gains 3, that part counts as unexplained where the
    fit neither goes on ahead as it began nor predicts better than nothing does, or was not tried; beside remainders
    that gain less it is the effect all the same."""
    one, nothing = (place(problem, "viscous_damping", "q1"),), [estimate(problem, (), 0.0, kind) for kind in KINDS]
    values = {"white": 2.0, "coloured": 5.0, "clock": 3.0}
    kept = found(problem, *nothing, *(estimate(problem, one, value, kind) for kind, value in values.items()))
    kept.ahead = {(): Ahead(-3.0, False, False)} | ({} if ahead is None else {one: ahead})
    p = posterior(problem, kept, 1.0)
    small, large = 3 / 4 * np.exp(2.0) + 1 / 4 / OTHERS * np.exp(3.0), 1 / FAMILIES / OTHERS * np.exp(5.0)
    mine, rest = (small + large, 0.0) if counts else (small, large)
    scored = np.exp(min((one.score for one in kept.ahead.values()) if ahead is None else [ahead.score]))
    assert p.named[0].probability / p.as_it_is == pytest.approx(DAMPING * mine * scored / np.exp(-3.0), rel=1e-9)
    alone = np.mean([*[1.0] * (OTHERS - 1), np.exp(3.0)]) / FAMILIES  # a spell has no score
    assert p.unexplained / p.as_it_is == pytest.approx(alone + DAMPING * rest * scored / np.exp(-3.0), rel=1e-9)


def test_how_a_trajectory_goes_on_says_nothing_of_a_spell(problem):
    """A score ahead counts for every kind of remainder but the force that acts for a while."""
    nothing, one = [estimate(problem, (), 0.0, kind) for kind in KINDS], (place(problem, "viscous_damping", "q1"),)
    kept = found(problem, *nothing, *alike(problem, one, 0.0))
    kept.ahead = {(): Ahead(-4.0, False, False), one: Ahead(0.0, True, True)}
    p = posterior(problem, kept, 1.0)
    alone = np.mean([*[1.0] * (OTHERS - 1), np.exp(4.0)]) / FAMILIES
    assert p.unexplained / p.as_it_is == pytest.approx(alone, rel=1e-9)


def test_beside_a_spell_a_finding_need_not_go_on(problem):
    """An effect that gains 2 nats beside a force for a while that gains 30 keeps what it has there, whatever it
    predicts: where the force acts no trajectory goes on."""
    one, nothing = (place(problem, "viscous_damping", "q1"),), [estimate(problem, (), 0.0, kind) for kind in KINDS]
    kept = found(problem, *nothing, estimate(problem, one, 2.0), estimate(problem, one, 32.0, "spell"))
    kept.ahead = {(): Ahead(0.0, False, False), one: Ahead(0.0, False, False)}
    p = posterior(problem, kept, 1.0)
    expected = DAMPING * (3 / 4 * np.exp(2.0) + np.exp(32.0) / FAMILIES / OTHERS)
    assert p.named[0].probability / p.as_it_is == pytest.approx(expected, rel=1e-9)


def test_a_remainder_that_is_not_white_tempers_every_evidence(problem):
    """At an inflation of 4 the log odds of evidence are a quarter, at 1 they stand; below 1 there is nothing to add."""
    one = (place(problem, "coulomb_friction", "q2"),)
    fits = found(problem, *alike(problem, (), -20.0), *alike(problem, one, 0.0))
    for inflation, evidence in ((4.0, 5.0), (1.0, 20.0), (0.5, 20.0)):
        p = posterior(problem, fits, inflation)
        assert np.log(p.named[0].probability / p.as_it_is) == pytest.approx(np.log(DAMPING) + evidence, rel=1e-9)
        assert p.tempered == pytest.approx(evidence / 20.0)


def test_a_fit_that_failed_has_no_probability(problem):
    """A combination of evidence minus infinity is not weighed, and nothing becomes NaN."""
    one, other = singles(problem)[:2]
    fits = [estimate(problem, (), 0.0), estimate(problem, one, -np.inf), estimate(problem, other, 1.0)]
    p = posterior(problem, found(problem, *fits), 1.0)
    assert [w.combination for w in p.named] == [other]
    assert p.unexplained == 0.0 and p.as_it_is + p.faint + p.named[0].probability == pytest.approx(1.0)


def test_of_two_estimates_of_one_kind_the_better_counts(problem):
    """Fits from two starts do not count twice: the larger evidence stays, in whichever order they came."""
    one = singles(problem)[0]
    for values in ((1.0, 2.0), (2.0, 1.0)):
        kept = found(problem, *(estimate(problem, one, v) for v in values))
        assert kept.best(one) == 2.0 and len(kept.estimates[one]) == 1


def test_what_converged_stands_before_what_is_barely_ahead(problem):
    """Of two fits of one kind the one that converged is reported unless the other is three nats ahead, in whichever
    order they came."""
    one = singles(problem)[0]
    for ahead, is_reported in ((2.0, True), (4.0, False)):
        stopped = replace(estimate(problem, one, ahead), converged=False)
        for pair in ((stopped, estimate(problem, one, 0.0)), (estimate(problem, one, 0.0), stopped)):
            assert found(problem, *pair).of(one, "white").converged is is_reported


def test_what_no_fit_of_came_to_its_end_counts_less(problem):
    """A combination whose every fit stopped on its way has three nats less than one that settled, and is not thrown
    out; one that has a settled fit beside another remainder loses nothing."""
    one, other, third = singles(problem)[:3]
    fits = [estimate(problem, (), -50.0), estimate(problem, one, 5.0), estimate(problem, third, 5.0, "coloured")]
    fits += [replace(estimate(problem, c, 5.0), converged=False) for c in (other, third)]
    p = {w.combination: w.probability for w in posterior(problem, found(problem, *fits), 1.0).named}
    ratio = p[other] / p[one] * price(problem, one[0]) / price(problem, other[0])
    assert ratio == pytest.approx(np.exp(-3.0), rel=1e-9)
    assert p[third] / price(problem, third[0]) >= p[one] / price(problem, one[0])


def test_optima_at_different_times_add_up(problem):
    """Two impulses at times that are far apart are two modes of one effect; the same one from two starts is one."""
    one = place(problem, "impulse", "q1")
    early, late = (estimate(problem, (one,), value) for value in (1.0, 2.0))
    late.z[problem.slots + 1] = 5.0  # five hundred of its standard deviations later
    kept = found(problem, early, late, early)
    assert kept.best((one,)) == pytest.approx(np.logaddexp(1.0, 2.0))
    assert kept.estimates[(one,)][0].z[problem.slots + 1] == 5.0
