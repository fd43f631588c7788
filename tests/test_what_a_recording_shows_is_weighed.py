"""Only effects of which a recording says something take part in its probabilities."""

from dataclasses import replace

import engine_cases as cases
import numpy as np
import pytest
from posterior_cases import estimate, found, made, place

from symplearn.diagnosis._build import Restriction, augmented_equations, build
from symplearn.diagnosis._laws import laws, priced
from symplearn.diagnosis._posterior import posterior

# Sums of a few dozen numbers below one.
ROUND_OFF = 1e-12


@pytest.fixture(scope="module")
def problem():
    return made(1)


def test_what_the_recording_says_nothing_of_is_not_weighed(problem):
    """An effect whose posterior is as wide as its prior is left out, and so is a pair that holds one."""
    known, blind = place(problem, "viscous_damping", "q1"), place(problem, "linear_stiffness", "q2")
    fits = [estimate(problem, (), 0.0), estimate(problem, (known,), 0.0), estimate(problem, (blind,), 9.0, sd=0.95)]
    pair = tuple(sorted((known, blind)))
    both = estimate(problem, pair, 9.0)
    slot = problem.slots + pair.index(blind)
    wide = both.covariance.copy()
    wide[slot, slot] = 0.9
    p = posterior(problem, found(problem, *fits, replace(both, covariance=wide)), 1.0)
    assert [w.combination for w in p.named] == [(known,)]
    assert p.as_it_is + p.unexplained + p.faint + p.named[0].probability == pytest.approx(1.0, rel=ROUND_OFF)


def test_how_wide_is_measured_in_each_effects_own_prior(problem):
    """A spread of 0.9 is known well beside a prior of 10 and not at all beside one of 1."""
    one = place(problem, "cubic_stiffness", "q1")
    fits = found(problem, estimate(problem, (), 0.0), estimate(problem, (one,), 0.0, sd=0.9))
    assert not posterior(problem, fits, 1.0).named
    scales = fits.priors.scales.copy()
    scales[problem.candidate(one).first] = 10.0
    fits.priors = replace(fits.priors, scales=scales)
    assert len(posterior(problem, fits, 1.0).named) == 1


def test_what_has_moved_far_was_seen_however_narrow_its_prior(problem):
    """Nearly as wide as its prior, an effect counts where it is more than two standard deviations from nothing."""
    one = place(problem, "viscous_damping", "q1")
    for size, is_weighed in ((1.8, False), (2.0, True)):
        fit = estimate(problem, (one,), 9.0, sd=0.95)
        fit.z[problem.slots] = size
        assert bool(posterior(problem, found(problem, estimate(problem, (), 0.0), fit), 1.0).named) == is_weighed


def test_a_law_without_a_word_that_may_be_nothing_is_none():
    """Though it is known well beside its prior, a law counts where it is more than two standard deviations from
    nothing; a word does in any case."""
    file = cases.simulation("(p1**2 + p2**2 + q1**2 + q2**2)/2", ["q1", "q2"], ["p1", "p2"], {"a": "q1"})
    recording, every = cases.recorded(np.arange(10.0), np.ones((10, 1)), columns=("a",)), Restriction()
    built = augmented_equations(file, 0.0, every, 0.0, priced(laws(file)))
    p = build(file, built, [recording], 0.0, 1.0, every)
    law, word = (len(p.equations.candidates) - 1,), (place(p, "viscous_damping", "q1"),)
    for combination, size, is_weighed in ((law, 0.018, False), (law, 0.022, True), (word, 0.018, True)):
        fit = estimate(p, combination, 9.0)
        fit.z[p.slots] = size
        assert bool(posterior(p, found(p, estimate(p, (), 0.0), fit), 1.0).named) == is_weighed


@pytest.mark.parametrize("effect", ["periodic_forcing", "hidden_oscillator"])
def test_what_has_not_come_round_once_was_not_seen_to_swing(problem, effect):
    """At the lowest frequency that is looked for, or below where a step led, an oscillation is not weighed, alone or in
    a pair; above it is."""
    one, other = place(problem, effect, "q1"), place(problem, "viscous_damping", "q2")
    for combination in ((one,), tuple(sorted((one, other)))):
        entry = dict(problem.placed(combination))[one].stop - 1
        for omega, is_weighed in ((-1.0, False), (-1.1, False), (-0.9, True)):  # from -1 on
            fit = estimate(problem, combination, 9.0)
            fit.z[entry] = omega
            named = posterior(problem, found(problem, estimate(problem, (), 0.0), fit), 1.0).named
            assert [w.combination for w in named] == ([combination] if is_weighed else [])


def test_what_changes_at_the_very_beginning_was_not_seen_to_change():
    """A sudden change after the fourth reading of two coordinates, whose start is four numbers, is another value of the
    parameter; after the sixth it is a change. In one of two recordings it may come at the beginning: the other shows
    how it was."""
    more = "[parameters]\nk = { value = 1.0, sd = 0.01 }\n"
    file = cases.simulation("(p1**2 + p2**2 + k*q1**2 + q2**2)/2", ["q1", "q2"], ["p1", "p2"],
                            {"a": "q1", "b": "q2"}, more=more)  # fmt: skip
    one = cases.recorded(np.arange(20.0), np.ones((20, 2)), columns=("a", "b"))
    for recordings, time, is_weighed in (([one], 1.5, False), ([one], 2.5, True), ([one, one], 1.5, False)):
        p = cases.problem(file, recordings, 1.0)
        member = place(p, "regime_change", "k")
        for some, counts in ((member, is_weighed), *((v, True) for v in p.variants(member))):
            fit = estimate(p, (some,), 9.0)
            fit.z[p.slots : p.slots + 2] = 0.1, time
            named = posterior(p, found(p, estimate(p, (), 0.0), fit), 1.0).named
            assert bool(named) == counts
