"""A force that acts for a while and that no word says is told as such: when it acted, and no blow in its place."""

from dataclasses import replace

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis import Options, diagnose
from symplearn.diagnosis._effect_priors import with_effects
from symplearn.diagnosis._found import Found
from symplearn.diagnosis._locate import strained_when
from symplearn.diagnosis._motion import motion_along
from symplearn.diagnosis._noisy import PathFit, fit_paths
from symplearn.diagnosis._outlook import Outlook
from symplearn.diagnosis._prospects import Prospects
from symplearn.diagnosis._score import Start
from symplearn.diagnosis._spells import Spells, spells
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._trajectory import Stepper
from symplearn.diagnosis._weigher import Weigher

TIMES = np.linspace(0.0, 20.0, 121)
# 2.3 s. Spells of 1.25, 2.5, 5 and 10 s are tried, so the right one may lie off by a few rows of 1/6 s: it covers seven
# tenths of the push at least, and is no three times as long.
ON, OFF, PUSH = 8.3, 10.6, 0.15
PENDULUM = cases.simulation("p**2/2 - g*cos(q)", more="[parameters]\ng = 1.0\n[recording.noise]\ny = 0.01")


def pushed(seed, drag=0.0, push=PUSH, times=TIMES):
    """A pendulum that a constant force pushes from ON to OFF, by SciPy from one to the other; with a viscous drag."""
    x, parts = [1.0, 0.0], []
    for begin, end, force in ((times[0], ON, 0.0), (ON, OFF, push), (OFF, times[-1], 0.0)):
        inner = times[(times >= begin) & (times < end)] if end < times[-1] else times[times >= begin]
        asked = np.unique(np.concatenate([[begin], inner, [end]]))
        found = cases.solved(lambda t, x, f=force: [x[1], -np.sin(x[0]) - drag * x[1] + f], x, asked)
        parts.append(found[np.isin(asked, inner), 0])
        x = found[-1]
    noise = 0.01 * np.random.default_rng(seed).normal(size=len(times))
    return cases.recorded(times, np.concatenate(parts) + noise)


def calm(seed):
    """The same, left alone and let go elsewhere."""
    x = cases.solved(lambda t, x: [x[1], -np.sin(x[0])], [0.8, 0.1], TIMES[:80])[:, 0]
    return cases.recorded(TIMES[:80], x + 0.01 * np.random.default_rng(seed).normal(size=80), number=2)


@pytest.fixture(scope="module")
def weighed():
    """The pendulum as simulated, on a recording with the push and on one without, beside forces always at work and
    for a while."""
    p = cases.problem(PENDULUM, [pushed(0), calm(1)], 0.1)
    stepper, priors = Stepper(p), priors_without_effects(p)
    weigher = Weigher(stepper, Found(p, priors))
    z, rows = np.zeros(p.size), weigher.rows
    for r, x in enumerate(([1.0, 0.0], [0.8, 0.1])):
        z[r * p.state : (r + 1) * p.state][[0, p.state // 2]] = x
    paths = [np.tile(z[r * p.state : (r + 1) * p.state], (n, 1)) for r, n in enumerate(rows)]
    always = [PathFit((), np.array([q]), z, np.array([0.01]), paths) for q in (1e-4, 1e-3, 1e-2)]
    weigher.add_paths(fit_paths(stepper, always, priors, rows, 20))
    starts = spells(stepper, weigher.found.of((), "force"), np.array([0.7]), rows)
    weigher.add_paths(fit_paths(stepper, starts, priors, rows, 20))
    return weigher, starts


def test_it_is_looked_for_where_the_recording_is_strained(weighed):
    """For every length the stretch overlaps the push, in the recording that has it, and the other has none."""
    for start in weighed[1]:
        acting, other = start.exposures
        assert not other.any()
        spans = np.flatnonzero(acting)
        assert np.array_equal(spans, np.arange(spans[0], spans[-1] + 1))
        assert TIMES[spans[0]] < OFF and TIMES[spans[-1] + 1] > ON


def test_a_force_that_always_acts_tells_too_when_it_is_strained(weighed):
    """What stands out is a part of the recording that has the push, about the push, and no part of the other."""
    weigher, _ = weighed
    pull = weigher.found.of((), "force")
    outlooks = [Outlook(weigher.stepper, pull, r, pull.intensity) for r in range(2)]
    (here, first), (there, second) = strained_when(outlooks, [0])
    assert (first, second) == (1, 2) and there == [TIMES[0], TIMES[79]]
    assert here[0] < OFF and here[1] > ON and here[1] - here[0] < 3 * (OFF - ON)


def test_its_evidence_pays_for_when_it_acts(weighed):
    """The evidence is the mean over lengths and strengths, each less the log of how many places it was chosen from; it
    is far ahead of a force that is always at work."""
    weigher, starts = weighed
    fits = fit_paths(weigher.stepper, starts, weigher.found.priors, weigher.rows, 20)
    spans = sum(n - 1 for n in weigher.rows)
    values = [one.log_evidence + weigher._granted(one) - np.log(2 * spans / one.exposures[0].sum()) for one in fits]
    spell = weigher.found.of((), "spell")
    # The same sum in another order: round-off.
    assert spell.log_evidence == pytest.approx(np.logaddexp.reduce(values) - np.log(len(values)), abs=1e-9)
    # 46 nats.
    assert spell.log_evidence > weigher.found.of((), "force").log_evidence + 10.0
    # What is chosen covers most of the push and is not much longer.
    times = TIMES[np.flatnonzero(spell.exposures[0])]
    assert min(times[-1], OFF) - max(times[0], ON) > 0.7 * (OFF - ON) and times[-1] - times[0] < 3 * (OFF - ON)


def test_what_cannot_come_near_the_best_is_given_up(weighed):
    """Fits of which those that promise too little stop early give the evidence that full ones give; and where another
    answer is far ahead of all, none goes on."""
    weigher, starts = weighed
    full = weigher.found.of((), "spell")
    other = Weigher(weigher.stepper, Found(weigher.problem, weigher.found.priors))
    other.found.add(weigher.found.of((), "force"))
    fits = Spells(Prospects(other), np.array([0.7]))._add(starts)
    # A fit has settled when a step moves it by less than 0.05 nats.
    assert other.found.of((), "spell").log_evidence == pytest.approx(full.log_evidence, abs=0.1)
    assert sum(other.may_matter(fit, 50.0) for fit in fits) in range(1, len(fits) + 1)
    other.found.add(replace(full, kind="white", log_evidence=full.log_evidence + 200.0))
    assert not any(other.may_matter(fit, 50.0) for fit in fits)


def test_what_a_spell_does_needs_no_effect_beside_it(weighed):
    """A blow that was told with a damping, where a force that acts for a while does its work: the damping alone gets
    the same force, and is ahead of both."""
    weigher, starts = weighed
    p, found = weigher.problem, weigher.found
    drag, blow = (next(m for m in p.searched if p.candidate(m).key == (effect, ("q",)))
                  for effect in ("viscous_damping", "impulse"))  # fmt: skip
    priors = with_effects(p, found.priors, motion_along(p, starts[0].z, starts[0].paths))
    other = Weigher(weigher.stepper, Found(p, priors))
    both = tuple(sorted((drag, blow)))
    for c in ((), (drag,), both):
        z = p.carried(starts[0].z, (), c)
        if blow in c:
            z[dict(p.placed(c))[blow].stop - 1] = 9.0
        other.weigh([Start(c, z, 0.0)], whole=True)
    z, first = other.found.of(both, "white").z, starts[0]
    always = [PathFit(both, np.array([q]), z, first.noise, first.paths) for q in (1e-4, 1e-3, 1e-2)]
    other.add_paths(fit_paths(other.stepper, always, priors, other.rows, 20))
    Spells(Prospects(other), np.array([0.7])).weigh(both, 1e9)
    assert other.found.of((drag,), "spell").log_evidence > other.found.of(both, "spell").log_evidence


def test_a_given_noise_stays_as_it_is_given(weighed):
    """Paths that begin at a fit with twice the given noise end with the given one, and where they end from it: a wrong
    noise that a force for a while stood beside was called that force."""
    weigher, starts = weighed
    doubled = [replace(one, noise=2 * one.noise) for one in starts]
    given, other = (
        fit_paths(weigher.stepper, some, weigher.found.priors, weigher.rows, 4) for some in (starts, doubled)
    )
    for one, same in zip(given, other, strict=True):
        assert one.noise == same.noise == 0.01
        assert one.log_evidence == same.log_evidence


def test_a_calm_recording_gains_nothing_by_it(weighed):
    """Where nothing pushes, a force for a while is no likelier than one that is always at work and very weak."""
    p = cases.problem(PENDULUM, [calm(3)], 0.1)
    stepper, priors = Stepper(p), priors_without_effects(p)
    weigher = Weigher(stepper, Found(p, priors))
    z = np.zeros(p.size)
    z[[0, p.state // 2]] = [0.8, 0.1]
    first = PathFit((), np.array([1e-10]), z, np.array([0.01]), [np.tile(z[: p.state], (80, 1))])
    weigher.add_paths(fit_paths(stepper, [first, replace(first, intensity=np.array([1e-9]))], priors, [80], 20))
    quiet = weigher.found.of((), "force")
    weigher.add_paths(fit_paths(stepper, spells(stepper, quiet, np.array([0.7]), [80]), priors, [80], 20))
    assert weigher.found.of((), "spell").log_evidence < quiet.log_evidence


@pytest.mark.slow
def test_a_push_is_no_blow():
    """Through the verb, with the whole vocabulary: unexplained, when it acted, and what is held out is met."""
    found = diagnose(PENDULUM, [pushed(0)], Options(jobs=2)).document
    assert found["verdict"] == "unexplained" and found["probability"] > 0.9
    ((begin, end),) = found["location"]["time_windows"]
    assert found["location"]["targets"] == ["q"] and "for a while" in found["location"]["where"]
    assert min(end, OFF) - max(begin, ON) > 0.7 * (OFF - ON) and end - begin < 3 * (OFF - ON)


@pytest.mark.slow
def test_a_push_in_one_of_two_recordings_is_put_there():
    """The location names the recording that has the push, and no other."""
    found = diagnose(PENDULUM, [calm(1), pushed(0)], Options(jobs=2)).document
    assert found["verdict"] == "unexplained" and found["location"]["recordings"] == [2]
    ((begin, end, which),) = found["location"]["time_windows"]
    assert which == 2 and begin < OFF and end > ON


@pytest.mark.slow
def test_a_push_may_be_left_beside_a_drag():
    """A drag all the time and a push for a while: dissipation is certain, though its law is open, and when the push
    acted is told as what is left beside it."""
    found = diagnose(PENDULUM, [pushed(0, drag=0.03)], Options(jobs=2)).document
    assert found["family_probability"]["dissipation"] > 0.99 and len(found["findings"]) == 1
    laws = [found["findings"][0], *(one["findings"][0] for one in found["alternatives"] if one["findings"])]
    assert "viscous_damping" in [law["effect"] for law in laws[:2]]
    (told,) = [one for one in found["warnings"] if "for a while" in one]
    begin, end = (float(part) for part in told.split("t = ")[1].split(" to "))
    assert min(end, OFF) - max(begin, ON) > 0.7 * (OFF - ON) and end - begin < 3 * (OFF - ON)


@pytest.mark.slow
def test_a_blow_is_no_push():
    """As much momentum at once is a blow for certain, whatever stands beside it."""
    x = cases.struck(lambda t, x: [x[1], -np.sin(x[0])], [1.0, 0.0], TIMES, [0.0, PUSH * (OFF - ON)], ON)
    readings = x[:, 0] + 0.01 * np.random.default_rng(0).normal(size=len(TIMES))
    found = diagnose(PENDULUM, [cases.recorded(TIMES, readings)], Options(jobs=2)).document
    blow = next(f for f in found["findings"] if f["effect"] == "impulse")
    # Seen: 8.35. Rows are 0.17 s apart, so when a blow fell between two of them is known to about half of that.
    assert blow["probability"] > 0.9 and blow["coefficients"]["t_star"]["mean"] == pytest.approx(ON, abs=0.1)
    assert all(one["probability"] < 0.1 for one in found["alternatives"] if one["unexplained"])
