"""An outside clock that is found at the motion's own period is told with a warning, and beside a larger remainder only
where its run goes on; one at another period is not doubted. Nor is it kept quiet where findings predict worse than
nothing."""

from dataclasses import replace

import engine_cases as cases
import numpy as np
import pytest
from posterior_cases import found

from symplearn.diagnosis._found import Ahead
from symplearn.diagnosis._own_period import in_tune
from symplearn.diagnosis._posterior import posterior
from symplearn.diagnosis._warnings import set_back
from symplearn.diagnosis._weighed import Estimate

TIMES = np.linspace(0.0, 60.0, 600)


def said(name, omega, readings=None):
    """What is said of an effect with a frequency, in a spring that swings once in 2 pi and fades."""
    return in_tune(*swinging(name, omega, readings))


def swinging(name, omega, readings=None):
    """The problem, and an estimate that has the effect."""
    readings = np.exp(-0.03 * TIMES) * np.cos(TIMES) if readings is None else readings
    file = cases.simulation("p**2/2 + k*q**2/2", more="[parameters]\nk = 1.0\n")
    p = cases.problem(file, [cases.recorded(TIMES, readings)], 0.1)
    (member,) = [m for m in p.searched if p.candidate(m).effect.name == name][:1]
    z = np.zeros(p.size)
    z[p.slots + p.candidate(member).effect.size - 1] = omega
    return p, Estimate((member,), "white", z, 1e-4 * np.eye(p.size), np.ones(1), 0.0, True)


@pytest.mark.parametrize("name", ["periodic_forcing", "parametric_modulation"])
def test_only_the_own_period_is_doubted(name):
    """Within what a recording of ten periods tells apart, a tenth; nothing of a frequency that is 30 % higher."""
    (warning,) = said(name, 1.03)
    assert name in warning and f"{2 * np.pi / 1.03:.4g}" in warning
    assert said(name, 1.3) == []


def test_half_of_it_is_where_a_stiffness_is_modulated():
    """As one that goes with place is; a force that comes twice in a period is none that goes with the motion."""
    (warning,) = said("parametric_modulation", 2.02)
    assert "half the period" in warning
    assert said("periodic_forcing", 2.02) == []


def test_either_of_two_modes_is_the_motions_own():
    """Of two carts between springs that swing at 1 and at 1.73, the second one a third as far."""
    beating = np.cos(TIMES) + 0.33 * np.cos(1.73 * TIMES)
    assert said("periodic_forcing", 1.73, beating) and said("periodic_forcing", 1.0, beating)
    assert said("periodic_forcing", 1.4, beating) == []


@pytest.mark.parametrize(("omega", "counts"), [(1.03, False), (1.3, True)])
def test_beside_a_larger_remainder_it_must_go_on(omega, counts):
    """A periodic force that gains 2 nats beside a clock that gains 30 more, and runs on better than nothing though not
    as it began, is what was left out at a period of its own, and unexplained at the motion's."""
    p, one = swinging("periodic_forcing", omega)
    kept = found(p, *(replace(one, combination=(), log_evidence=0.0, kind=k) for k in ("white", "clock")))
    kept.add(replace(one, log_evidence=2.0))
    kept.add(replace(one, log_evidence=32.0, kind="clock"))
    kept.ahead = {(): Ahead(-1.0, False, False), one.combination: Ahead(0.0, False, True)}
    told = posterior(p, kept, 1.0)
    assert (told.named[0].probability > 0.99) == counts
    assert (told.unexplained > 0.99) != counts


def test_no_other_effect_is():
    """An unseen oscillator may well be tuned like the one that is seen; and what is not read has no period."""
    assert said("hidden_oscillator", 1.0) == []
    assert said("periodic_forcing", 1.0, np.where(TIMES > 0.3, np.nan, 1.0)) == []


def test_findings_that_set_back_are_told():
    """Of three columns the one whose error grows by more than a tenth; none where nothing was held out."""
    before, after = ({"holdout_rmse": {"a": 1.0, "b": 1.0, "c": x}} for x in (None, 2.0))
    after["holdout_rmse"] |= {"a": 1.05, "b": 3.5}
    (warning,) = set_back(before, after)
    assert warning.endswith("3.5 against 1") and " b " in warning
    assert set_back({"holdout_rmse": None}, {"holdout_rmse": None}) == []
