"""About a fitted trajectory all combinations of a size are compared, also those that share nothing with what was
fitted."""

import itertools
from dataclasses import replace

import engine_cases as cases
import numpy as np
import pytest
from scipy.special import logsumexp
from test_scans_predict_evidence import FILE, MASS, NOISE, PULL_SD, SCALE, X0_SD, response

from symplearn.diagnosis._calibrate import calibrate
from symplearn.diagnosis._effect_priors import with_effects
from symplearn.diagnosis._exchange import Regression
from symplearn.diagnosis._found import Found
from symplearn.diagnosis._motion import motion_along
from symplearn.diagnosis._prospects import MANY, Prospects
from symplearn.diagnosis._score import Start, Unit
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._strength import WIDTHS
from symplearn.diagnosis._trajectory import Stepper
from symplearn.diagnosis._weigher import Weigher

TIMES = np.linspace(0.0, 12.0, 80)
EFFECTS = ("sensor_bias", "sensor_drift", "periodic_forcing")
FREQUENCY = 0.9


def made(drift, bias, force):
    y = response(TIMES, lambda t: 0.2 + force * np.cos(FREQUENCY * t), [0.4, 0.1])
    noise = NOISE * np.random.default_rng(3).normal(size=len(TIMES))
    return cases.recorded(TIMES, y + bias + drift * TIMES + noise)


@pytest.fixture(scope="module")
def stepper():
    file = cases.simulation(f"p**2/(2*{MASS}) + k*q**2/2 - f*q", more=FILE)
    return Stepper(cases.problem(file, [made(0.03, 0.2, 0.15)], 0.02))


@pytest.fixture(scope="module")
def priors(stepper):
    bare, size = priors_without_effects(stepper.problem), stepper.problem.equations.size
    return replace(bare, scales=np.full(size, SCALE))


@pytest.fixture(scope="module")
def members(stepper):
    p = stepper.problem
    return {name: next(m for m in p.searched if p.candidate(m).effect.name == name) for name in EFFECTS}


@pytest.fixture(scope="module")
def fits(stepper, priors, members):
    """Fitted with a drift alone."""
    return calibrate(stepper, priors.mean[None], [(members["sensor_drift"],)], priors, [len(TIMES)], tolerance=1e-12)


@pytest.fixture(scope="module")
def starts(stepper, priors, members, fits):
    units = {m: Unit(m, FREQUENCY if name == "periodic_forcing" else None) for name, m in members.items()
             if name != "sensor_drift"}  # fmt: skip
    return Regression(stepper, fits, [len(TIMES)], priors, units).subsets(2, lambda c: False, 8)


COLUMNS = {
    "sensor_bias": [np.ones_like(TIMES)],
    "sensor_drift": [TIMES],
    "periodic_forcing": [
        response(TIMES, lambda t: np.cos(FREQUENCY * t)),
        response(TIMES, lambda t: np.sin(FREQUENCY * t)),
    ],
}


def evidence(y, columns, widths):
    """Log evidence of linear least squares with Gaussian priors, the factors' covariance, and all factors."""
    sd = np.array([*X0_SD, PULL_SD, *widths])
    design = np.stack([response(TIMES, start=x) for x in np.eye(2)] + [response(TIMES, lambda t: 1.0), *columns], 1)
    A = np.vstack([design / NOISE, np.diag(1 / sd)])
    b = np.concatenate([y / NOISE, np.zeros(len(sd))])
    z = np.linalg.lstsq(A, b, rcond=None)[0]
    value = -0.5 * ((b - A @ z) ** 2).sum() - 0.5 * np.linalg.slogdet(A.T @ A)[1] - np.log(sd).sum()
    return value, np.linalg.inv(A.T @ A)[3:, 3:], z


def any_strength(y, names):
    """The same with each effect of any order of magnitude: from four standard errors to the largest, equally likely,
    each density times the squares of their strengths, which hang together (Isserlis 1918)."""
    columns = [column for name in names for column in COLUMNS[name]]
    own = np.repeat(np.arange(len(names)), [len(COLUMNS[name]) for name in names])
    covariance = evidence(y, columns, SCALE + 0 * own)[1] / SCALE**2
    shares = []
    for k in range(len(names)):
        told = np.mean(np.maximum(1 / np.linalg.eigvalsh(covariance[np.ix_(own == k, own == k)]) - 1, 0))
        shares.append(np.geomspace(min(4 / np.sqrt(told), 1.0), 1.0, WIDTHS))
    each = []
    for widths in itertools.product(*shares):
        value, covariance, z = evidence(y, columns, SCALE * np.array(widths)[own])
        unit = SCALE * np.array(widths)[own] * np.sqrt(np.bincount(own)[own])
        mean, spread = z[3:] / unit, covariance / np.outer(unit, unit)
        square = np.prod([(mean[own == k] ** 2 + np.diag(spread)[own == k]).sum() for k in range(len(names))])
        if len(names) == 2:
            cross = spread[np.ix_(own == 0, own == 1)]
            square += 2 * (cross**2).sum() + 4 * mean[own == 0] @ cross @ mean[own == 1]
        each.append(value + np.log(square))
    return logsumexp(each) - np.log(len(each))


def named(stepper, start):
    return tuple(stepper.problem.candidate(m).effect.name for m in start.combination)


def test_the_gain_of_every_pair_is_that_of_its_refit(stepper, starts):
    """For effects in which the readings are linear, of all three pairs: NumPy's least squares, each effect of any
    order of magnitude, against the drift that was fitted."""
    y = stepper.problem.rows[0].readings[:, 0]
    assert len(starts) == 3
    for start in starts:
        expected = any_strength(y, named(stepper, start)) - any_strength(y, ["sensor_drift"])
        # The substep's error in the responses: 1.1e-7 at most when this was written, and no more than tenfold.
        assert start.gain == pytest.approx(expected, abs=1e-6)


def test_every_pair_begins_where_its_refit_ends(stepper, starts):
    """The pair without the drift, too: initial state, calibrated force and amplitudes are NumPy's least squares, and a
    frequency is where it was tried."""
    p, y = stepper.problem, stepper.problem.rows[0].readings[:, 0]
    for start in starts:
        columns = [column for name in named(stepper, start) for column in COLUMNS[name]]
        z = evidence(y, columns, np.full(len(columns), SCALE))[2]
        amplitudes = [start.z[place][: p.candidate(m).effect.amplitudes] for m, place in p.placed(start.combination)]
        found = np.concatenate([start.z[: p.slots][p.active(start.combination)[: p.slots]], *amplitudes])
        # The substep's error in the responses, of which a refit's amplitudes have as much as its gain.
        np.testing.assert_allclose(found, z, atol=1e-6)
        for m, place in p.placed(start.combination):
            if p.candidate(m).effect.places:
                assert start.z[place.stop - 1] == FREQUENCY


def test_dry_friction_with_drag_is_found_behind_a_damping():
    """An oscillator with dry friction and quadratic drag, to which a viscous damping was fitted that leaves more
    than twice the noise: of all pairs the two are ahead, as strong as they are."""
    times = np.linspace(0.0, 40.0, 240)
    rates = lambda t, x: [x[1], -x[0] - 0.004 * np.sign(x[1]) - 0.05 * np.abs(x[1]) * x[1]]  # noqa: E731
    y = cases.solved(rates, [1.0, 0.0], times, 1e-8)[:, 0] + 0.002 * np.random.default_rng(5).normal(size=len(times))
    p = cases.problem(
        cases.simulation("p**2/2 + k*q**2/2", more="[parameters]\nk = 1.0"), [cases.recorded(times, y)], 0.1
    )
    stepper, rows, bare = Stepper(p), [len(times)], priors_without_effects(p)
    priors = replace(bare, scales=np.full(p.equations.size, SCALE), precision=np.full(p.size, 1e-2))
    damping = next(m for m in p.searched if p.candidate(m).effect.name == "viscous_damping")
    begin = np.zeros(p.size)
    begin[[0, p.slots]] = 1.0, 0.02
    fits = calibrate(stepper, begin[None], [(damping,)], priors, rows)
    assert fits.converged[0] and fits.noise[0, 0] > 0.004
    units = {m: Unit(m, None) for m in p.searched if m != damping and not p.candidate(m).effect.places
             and p.candidate(m).effect.amplitudes}  # fmt: skip
    found = Regression(stepper, fits, rows, priors, units).subsets(2, lambda c: False, 4)
    names = [{p.candidate(m).effect.name for m in start.combination} for start in found]
    assert names[0] == {"coulomb_friction", "quadratic_drag"}
    for m, place in p.placed(found[0].combination):
        truth = {"coulomb_friction": 0.004, "quadratic_drag": 0.05}[p.candidate(m).effect.name]
        # Where a fit begins, not where it ends: a linear step from a motion that is off by more than twice the noise.
        assert found[0].z[place][0] == pytest.approx(truth, rel=0.2)


def test_what_does_the_same_in_the_same_recording_is_looked_for():
    """Two springs in three recordings, in the second of which one is pulled; the pull there was fitted. An error of
    the sensor's zero there does the same, so that it helps nothing beside the pull: it is looked for in its place, and
    is as likely."""
    times, pull, noise = np.linspace(0.0, 12.0, 60), 0.1, 0.01
    file = cases.simulation("p**2/2 + b**2/2 + q**2 + 1.5*a**2", ("q", "a"), ("p", "b"), {"y": "q", "z": "a"})
    runs, paths, omega = [], [], np.sqrt([2.0, 3.0])
    for number, begin in enumerate(([1.0, 0.5], [0.7, -0.8], [-0.4, 0.9]), start=1):
        swing = begin * np.cos(np.outer(times, omega)), -omega * begin * np.sin(np.outer(times, omega))
        y = swing[0] + (0.0, pull / 3 if number == 2 else 0.0)
        y += noise * np.random.default_rng(number).normal(size=y.shape)
        runs.append(cases.recorded(times, y, number=number, columns=("y", "z")))
        paths.append(np.concatenate([np.pad(part, ((0, 0), (0, 1))) for part in swing], axis=1))
    p = cases.problem(file, runs, 0.05)
    bare = priors_without_effects(p)
    weigher = Weigher(Stepper(p), Found(p, with_effects(p, bare, motion_along(p, bare.mean, paths))))
    there = [
        next(m for m in range(len(p.members)) if p.members[m].recordings == (1,) and said(p.candidate(m)) == wanted)
        for wanted in (("constant_force", "a"), ("sensor_bias", "z"))
    ]
    z = bare.mean.copy()
    z[p.slots] = pull
    weigher.weigh([Start((there[0],), z, 0.0)], whole=True)
    starts = Prospects(weigher).exchanged((there[0],), MANY, 1, 4)
    best = max(starts, key=lambda start: start.gain)
    # Its prior is as wide as the pull's, in units of its own, and a leapfrog moves by a constant force exactly: what is
    # left is round-off, of which 2e-13 was seen.
    assert best.combination == (there[1],) and best.gain == pytest.approx(0.0, abs=1e-9)
    # The noise of the mean of sixty readings is 4 % of it, as much as was seen; chance seldom makes it four times that.
    assert best.z[p.slots] == pytest.approx(pull / 3, rel=0.15)


def said(candidate):
    return candidate.effect.name, candidate.target
