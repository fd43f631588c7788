"""Readings far off are left out, whatever force a path could have gone through them with; and no others."""

from dataclasses import replace

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis._calibrate import grow, weights
from symplearn.diagnosis._found import Found
from symplearn.diagnosis._noisy import PathFit
from symplearn.diagnosis._null_paths import null_paths
from symplearn.diagnosis._score import Start
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._trajectory import Stepper
from symplearn.diagnosis._weigher import Weigher

NOISE = 0.002
TIMES = 0.25 * np.arange(80)
FAR = [7, 22, 41, 63]
FILE = f"""
[parameters]
k = {{ value = 1.0, sd = 0.01 }}

[initial]
q = {{ value = 1.0, sd = 0.05 }}
p = {{ value = 0.0, sd = 0.05 }}

[recording.noise]
y = {NOISE}
"""


@pytest.mark.slow
@pytest.mark.parametrize("far", [FAR, []], ids=["outliers", "healthy"])
def test_what_lies_far_off_is_left_out_and_nothing_else(far):
    """With a noise that is given, twenty of its sd off: those four of eighty readings; without them, none."""
    weigher, some = followed(1.0, far)
    assert some is bool(far)
    assert np.nonzero(weigher.flagged[0][:, 0])[0].tolist() == far
    assert len(weigher.base) == bool(far)


def followed(omega, far):
    """A swing of frequency `omega`, followed by the simulation's of frequency one with a missing force, and whether
    outliers were taken out."""
    readings = np.cos(omega * TIMES) + NOISE * np.random.default_rng(0).normal(size=len(TIMES))
    readings[far] += 20 * NOISE * np.array([1, -1, -1, 1])[: len(far)]
    file = cases.simulation("p**2/2 + k*q**2/2", more=FILE)
    stepper = Stepper(cases.problem(file, [cases.recorded(TIMES, readings)], 0.25))
    priors = priors_without_effects(stepper.problem)
    weigher = Weigher(stepper, Found(stepper.problem, priors))
    paths = null_paths(stepper, priors.mean, weigher.rows, priors, 16)
    return weigher, weigher.take_out_outliers(paths, priors)


def test_a_path_that_goes_through_all_is_granted_no_more_for_them():
    """Where the noise is not stated, a path that leaves a tenth of what it takes for its noise owes as much for four
    readings far off as one that leaves all of it, but for their density under that noise."""
    errors = np.random.default_rng(0).normal(size=len(TIMES))
    rest = NOISE * np.sqrt(np.mean(np.delete(errors, FAR) ** 2))
    one, ten = (owed(NOISE * errors, size * rest) for size in (1, 10))
    # 1e-9: round-off of logarithms.
    assert ten - one == pytest.approx(-4 * np.log(10), rel=1e-9)


def test_under_a_noise_that_is_given_no_error_is_made_larger():
    """There a path that leaves a half of it or a tenth owes the same for the four, but for what little the two scales
    differ from one nearer to the middle."""
    errors = np.random.default_rng(0).normal(size=len(TIMES))
    half, tenth = (owed(share * NOISE * errors, NOISE, f"[recording.noise]\ny = {NOISE}") for share in (0.5, 0.1))
    # 0.1: no probability tells. Seen: 0.02; errors made as large as the noise were 6.6 off.
    assert half == pytest.approx(tenth, abs=0.1)


def test_rows_that_average_many_readings_owe_no_more():
    """The same rows, of the same errors, as averages of twenty or of four hundred readings, whose own noise is by as
    much larger: what was taken out has the same density."""
    readings, found = np.cos(TIMES) + NOISE * np.random.default_rng(0).normal(size=len(TIMES)), []
    readings[FAR] += 0.05
    out = np.zeros((len(TIMES), 1), bool)
    out[FAR] = True
    p = cases.problem(cases.simulation("p**2/2 + q**2/2"), [cases.recorded(TIMES, readings)], 0.25)
    member = next(m for m in p.searched if p.candidate(m).effect.name == "sensor_outliers")
    errors = (readings - np.cos(TIMES))[:, None] / NOISE
    for count in (1.0, 20.0, 400.0):
        many = replace(p, rows=(replace(p.rows[0], counts=count * p.rows[0].counts),))
        (weight,) = weights(many, [len(TIMES)])
        w = Weigher(Stepper(many), Found(many, priors_without_effects(many)))
        found.append(w.owed_for((member,), errors, out, np.full(1, NOISE * np.sqrt(weight[0, 0])), weight))
    np.testing.assert_allclose(found, found[0], rtol=1e-12)


def owed(errors, noise, more=""):
    """What four readings far off a swing owe beside the true path of the others, which leaves these errors of them."""
    readings = np.cos(TIMES) + errors
    readings[FAR] = np.cos(TIMES[FAR]) + 0.05
    p = cases.problem(cases.simulation("p**2/2 + q**2/2", more=more), [cases.recorded(TIMES, readings)], 0.25)
    priors = priors_without_effects(p)
    member = next(m for m in p.searched if p.candidate(m).effect.name == "sensor_outliers")
    path = np.stack([np.cos(TIMES), 0 * TIMES, -np.sin(TIMES), 0 * TIMES], axis=1)
    out = np.zeros((len(TIMES), 1), bool)
    out[FAR] = True
    fit = PathFit((), np.zeros(1), priors.mean, np.full(1, noise), [path], left_out=(out,))
    return Weigher(Stepper(p), Found(p, priors))._path_owed(fit, (member,))


@pytest.mark.slow
@pytest.mark.parametrize("steps_short", [False, True], ids=["converged", "on its way"])
def test_a_fit_that_is_far_off_is_granted_nothing_for_them(steps_short, monkeypatch):
    """Where the simulation cannot follow, under no remainder is the evidence above what readings of that noise can
    have: the density of all of them without any error."""
    weigher, some = followed(1.05, FAR)
    if steps_short:
        monkeypatch.setattr("symplearn.diagnosis._weigher.grow", one_step)
    weigher.weigh([Start(weigher.base, weigher.found.priors.mean, 0.0)], whole=True)
    estimates = weigher.found.estimates[weigher.base]
    highest = -sum(weigher.rows) * np.log(np.sqrt(2 * np.pi) * NOISE)
    assert some and {"white", "coloured"} <= {e.kind for e in estimates}
    assert estimates[0].converged is not steps_short
    assert all(e.log_evidence < highest for e in estimates)


def one_step(*arguments, **options):
    return grow(*arguments, **{**options, "final": 1})


def test_outliers_that_the_file_knows_are_not_found_again():
    """What augmented.toml says of one column is taken out there, and looked for in the other alone: of a buoy of the
    eleventh exam they were told once more, with certainty."""
    known = '[[terms]]\neffect = "sensor_outliers"\ntarget = "a"\ne = 0.04\nsd = 0.5\n'
    file = cases.simulation("p**2/2 + q**2/2", observe={"a": "q", "b": "p"}, more=known)
    swing = np.stack([np.cos(TIMES), -np.sin(TIMES)], axis=1)
    p = cases.problem(file, [cases.recorded(TIMES, swing, columns=("a", "b"))], 0.25)
    searched = [p.candidate(m).targets for m in p.searched if p.candidate(m).effect.name == "sensor_outliers"]
    assert searched == [("b",)] and p.known_outliers == (0,)
