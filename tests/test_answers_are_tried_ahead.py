"""Beside a remainder without a name answers are weighed by what they predict, and only there."""

from dataclasses import replace

import engine_cases as cases
import numpy as np
import pytest
from posterior_cases import found as weighed
from test_a_clock_at_the_motions_own_period_is_doubted import swinging

from symplearn.diagnosis._ahead import _squares, look_ahead
from symplearn.diagnosis._calibrate import calibrate
from symplearn.diagnosis._found import Ahead, Found
from symplearn.diagnosis._posterior import posterior
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._trajectory import Stepper
from symplearn.diagnosis._weighed import weigh_coloured, weigh_white

TIMES = np.linspace(0.0, 80.0, 500)
ROWS = [len(TIMES)]
# Later than the last of the parts that are fitted.
CHANGE = 74.0


def found_in(remainder, stiffer=0.0):
    """A spring with quadratic drag, from `CHANGE` on `stiffer` by a share, weighed with nothing, with a damping, and
    with the drag; and with that change, too, where there is one."""
    rates = lambda t, x: [x[1], -(1 + stiffer * (t > CHANGE)) * x[0] - 0.02 * np.abs(x[1]) * x[1]]  # noqa: E731
    y = cases.solved(rates, [1.0, 0.0], TIMES)[:, 0] + 0.005 * np.random.default_rng(1).normal(size=len(TIMES))
    more = "[parameters]\nk = { value = 1.0, sd = 0.1 }\n"
    p = cases.problem(cases.simulation("p**2/2 + k*q**2/2", more=more), [cases.recorded(TIMES, y + remainder)], 0.1)
    bare = priors_without_effects(p)
    priors = replace(bare, scales=np.full(p.equations.size, 0.3), precision=np.full(p.size, 1e-2))
    names = [p.candidate(m).effect.name for m in p.searched]
    combinations = [(), *((p.searched[names.index(name)],) for name in ("viscous_damping", "quadratic_drag"))]
    if stiffer:
        change = p.searched[names.index("regime_change")]
        combinations.append(tuple(sorted((*combinations[2], change))))
    begin = np.zeros((len(combinations), p.size))
    begin[:, [0, p.head]] = 1.0
    begin[1:3, p.slots] = 0.01, 0.02
    if stiffer:
        values = dict(p.placed(combinations[3]))
        begin[3, values[combinations[2][0]]], begin[3, values[change]] = 0.02, (stiffer, CHANGE)
        when = p.candidate(change).values.stop - 1
        priors.centres[when], priors.scales[when] = CHANGE, 10.0
    stepper, found = Stepper(p), Found(p, priors)
    fits = calibrate(stepper, begin, combinations, priors, ROWS)
    for estimate in weigh_white(p, fits, priors, ROWS) + weigh_coloured(p, fits, priors, ROWS):
        found.add(estimate)
    look_ahead(stepper, found, ROWS)
    return found, combinations


# An error of the sensor that swings slowly, by three times its noise.
SLOW = 0.01 * np.sin(0.37 * TIMES + 0.5) * np.cos(0.05 * TIMES)


@pytest.fixture(scope="module")
def clear():
    return found_in(SLOW)


def test_what_predicts_is_ahead(clear):
    """The true law scores best, the wrong one less, and nothing at all far less, by ten nats at most; the true one's
    trajectory holds."""
    found, (nothing, damping, drag) = clear
    score = {c: found.ahead[c].score for c in (nothing, damping, drag)}
    assert score[drag] == 0.0 and found.ahead[drag].holds
    assert -10.0 <= score[nothing] < score[damping] < -1.0
    assert found.ahead[drag].is_better and found.ahead[damping].is_better and not found.ahead[nothing].is_better


def test_the_trajectory_that_holds_is_shown(clear):
    """Whatever kind of remainder speaks for it, the numbers shown are the trajectory fit's, wider by its errors' long
    life; they cover the truth."""
    found, (*_, drag) = clear
    coloured, white = (found.of(drag, kind) for kind in ("coloured", "white"))
    assert coloured.log_evidence > white.log_evidence + 10.0
    shown = found.shown(drag, coloured)
    place = found.problem.slots
    assert shown.kind == "white" and shown.covariance[place, place] >= white.covariance[place, place]
    # Three standard errors, which chance passes once in 370; the recording and its noise are always the same.
    assert shown.z[place] == pytest.approx(0.02, abs=3 * np.sqrt(shown.covariance[place, place]))


def test_the_trajectory_runs_on_whatever_the_sensor_remembers(clear):
    """Where no trajectory holds either, the numbers told are those beside the sensor's error; what runs on is the fit
    of the whole trajectory, if there is one that converged."""
    found, (*_, drag) = clear
    coloured = found.of(drag, "coloured")
    lost = replace(found, ahead={drag: replace(found.ahead[drag], holds=False)})
    assert found.shown(drag, coloured).kind == "white"
    assert lost.told(drag, coloured) is coloured and lost.shown(drag, coloured).kind == "white"
    away = [replace(one, converged=one.kind != "white") for one in found.estimates[drag]]
    assert replace(lost, estimates={drag: away}).shown(drag, coloured).kind == "coloured"


def test_it_runs_on_beside_a_clock_whether_or_not_that_fit_is_done(clear):
    """Where the clock is told and a remembering sensor stands next, the whole trajectory runs on, though that one's fit
    is not done and an error that goes with what is read, far behind, has one that is."""
    found, (*_, drag) = clear
    coloured, white = (found.of(drag, kind) for kind in ("coloured", "white"))
    clock = replace(coloured, kind="clock", log_evidence=coloured.log_evidence + 200.0)
    behind = replace(white, kind="positional", log_evidence=white.log_evidence + 1.0)
    ones = [clock, replace(coloured, converged=False), behind, white]
    lost = replace(found, ahead={drag: replace(found.ahead[drag], holds=False)}, estimates={drag: ones})
    assert coloured.log_evidence > behind.log_evidence + 5.0
    assert lost.told(drag, clock) is clock and lost.shown(drag, clock).kind == "white"


@pytest.mark.parametrize("unit", [1.0, 1e3])
def test_a_column_that_begins_late_has_no_part_in_what_holds(unit):
    """Where a second column is read in the last rows alone, what holds on is told by the first, in any unit of it."""
    y = cases.solved(lambda t, x: [x[1], -x[0]], [1.0, 0.0], TIMES) * [1.0, unit]
    y[: int(0.85 * len(TIMES)), 1] = np.nan
    p = cases.problem(cases.simulation("p**2/2 + q**2/2", observe={"a": "q", "b": f"{unit}*p"}),
                      [cases.recorded(TIMES, y, columns=("a", "b"))], 0.1)  # fmt: skip
    z, first = np.zeros((1, p.size)), [int(0.6 * len(TIMES))]
    z[0, 0] = 0.99
    (inside, before), (ahead, after) = _squares(Stepper(p), z, [()], ROWS, first)
    assert before.tolist() == [True, False] and after.tolist() == [True, True]
    # Half the square of what the start is off by, a swing's mean square, but for the part of a swing that is no whole
    # one: of x radians at most 1 / 2x, a twentieth of the last twelve. Held to twice that. Seen: 0.012 and 0.049.
    assert inside[0, 0] == pytest.approx(0.01**2 / 2, rel=0.1)
    assert ahead[0, 1] == pytest.approx(inside[0, 0] * unit**2, rel=0.1)


def test_the_likeliest_without_a_swing_is_tried_however_far_behind(clear):
    """Beside a forcing that is a thousand nats likelier than anything else, the drag is looked at, too."""
    found, (*_, drag) = clear
    p, coloured = found.problem, found.of(drag, "coloured")
    forcing = next((m,) for m in p.searched if p.candidate(m).effect.name == "periodic_forcing")
    ahead = [replace(found.of(drag, kind), combination=forcing, log_evidence=coloured.log_evidence + more)
             for kind, more in (("white", 900.0), ("coloured", 1000.0))]  # fmt: skip
    other = Found(p, found.priors, {**found.estimates, forcing: ahead})
    look_ahead(Stepper(p), other, ROWS)
    assert set(other.ahead) == {(), drag, forcing}


@pytest.mark.parametrize(
    ("swing", "score", "holds", "counts"),
    [("periodic_forcing", -3.0, True, False), ("hidden_oscillator", -3.0, True, False),
     ("constant_force", -3.0, True, True),
     ("periodic_forcing", 0.0, True, True), ("periodic_forcing", -3.0, False, True)],
    ids=["a force", "an oscillator", "nothing swings", "it predicts better", "the other goes astray, too"],
)  # fmt: skip
def test_a_swing_that_goes_astray_is_none_where_something_steady_goes_on(swing, score, holds, counts):
    """A forcing or an unseen oscillator, 30 nats ahead beside a remainder, that does not go on as it began, is not the
    answer where a damping goes on that predicts as well."""
    p, one = swinging(swing, 1.3)
    damping = next((m,) for m in p.searched if p.candidate(m).effect.name == "viscous_damping")
    kept = weighed(p)
    for combination, gain in (((), -2000.0), (damping, 0.0), (one.combination, 30.0)):
        for kind, more in (("white", 0.0), ("clock", 100.0)):
            kept.add(replace(one, combination=combination, log_evidence=gain + more, kind=kind))
    kept.ahead = {
        (): Ahead(-10.0, False, False),
        damping: Ahead(-1.0, holds, True),
        one.combination: Ahead(score, False, True),
    }
    told = posterior(p, kept, 1.0).named[0].combination
    assert told == (one.combination if counts else damping)


def test_white_noise_needs_no_second_look():
    """Where the best answer leaves nothing but noise, evidence alone counts, and the best estimate is shown."""
    found, (*_, drag) = found_in(0.0)
    assert found.ahead == {}
    assert found.shown(drag, found.of(drag, "coloured")).kind == "coloured"


def test_nothing_foretells_what_happens_later():
    """A change that the whole recording shows, after all parts that are fitted, is not used to predict it: the law with
    it is as far ahead as without, which the change sets back."""
    found, (*_, drag, both) = found_in(SLOW, stiffer=0.03)
    white = {c: found.of(c, "white") for c in (drag, both)}
    assert white[both].log_evidence > white[drag].log_evidence + 20.0
    assert found.ahead[both].score == found.ahead[drag].score
    assert found.ahead[both].holds


@pytest.mark.parametrize(
    ("gain", "holds", "is_better", "counts"),
    [(20.0, True, False, False), (80.0, True, False, True), (20.0, False, False, True), (20.0, True, True, True)],
    ids=["dwarfed", "not dwarfed", "nothing goes astray", "it is better"],
)
def test_what_holds_as_nothing_does_is_no_finding_beside_ten_times_as_much(gain, holds, is_better, counts):
    """Of a force that gains 20 nats beside a remainder of 200, both of which go on as they began, nothing is known:
    unexplained, as where an input drives what is missing. It is a finding if it gains 80, or where nothing goes astray
    or the force runs on clearly better."""
    p, one = swinging("periodic_forcing", 1.3)
    kept = weighed(p, *(replace(one, combination=(), log_evidence=0.0, kind=k) for k in ("white", "clock")))
    kept.add(replace(one, log_evidence=gain))
    kept.add(replace(one, log_evidence=gain + 200.0, kind="clock"))
    kept.ahead = {(): Ahead(-1.0, holds, False), one.combination: Ahead(0.0, True, is_better)}
    told = posterior(p, kept, 1.0)
    assert (told.named[0].probability > 0.99) == counts
    assert (told.unexplained > 0.99) != counts
