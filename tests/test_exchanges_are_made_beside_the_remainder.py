"""What may do as well is looked for under the remainder that an answer leaves: its errors are whitened as the dense
Gaussian process has them."""

from dataclasses import replace

import engine_cases as cases
import numpy as np
import pytest
from numpy.polynomial import Legendre
from test_a_clock_may_wander import TIMES as LATE
from test_a_clock_may_wander import late, problem, swing
from test_coloured_errors_are_whitened import autocovariance

from symplearn.diagnosis._bend import Bend, Form, Shapes
from symplearn.diagnosis._calibrate import calibrate, weights
from symplearn.diagnosis._clocks import weigh_clocks
from symplearn.diagnosis._coloured import Colour
from symplearn.diagnosis._exchange import Regression
from symplearn.diagnosis._found import Found
from symplearn.diagnosis._prospects import Prospects
from symplearn.diagnosis._refinement import Refinement
from symplearn.diagnosis._score import Start, Unit
from symplearn.diagnosis._sensors_beside import with_sensors
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._trajectory import Stepper
from symplearn.diagnosis._weighed import Estimate
from symplearn.diagnosis._weigher import Weigher
from symplearn.diagnosis._whitening import whitening

COLOUR, CLOCK, BENT, LEFT = Colour(40.0, 2.0, 1.001, 0.0), Colour(300.0, 0.5, 30.0, 0.0), 25.0, 0.03
TIMES = [np.cumsum(np.random.default_rng(r).gamma(2.0, 0.1, n)) for r, n in enumerate((60, 45))]


@pytest.fixture(scope="module")
def fitted():
    """A spring in two recordings, every fifth reading missing; the readings differ from it by anything."""
    y = [np.cos(t) + 0.1 * np.random.default_rng(9).normal(size=len(t)) for t in TIMES]
    recordings = []
    for number, (t, x) in enumerate(zip(TIMES, y, strict=True), 1):
        x[::5] = np.nan
        recordings.append(cases.recorded(t, x, number=number))
    p = cases.problem(cases.simulation("p**2/2 + q**2/2"), recordings, 0.05)
    # Long gaps are filled with rows that nothing was read at.
    rows, begin = [len(r.times) for r in p.rows], np.zeros((1, p.size))
    begin[0, [0, p.state]] = 1.0
    priors = replace(priors_without_effects(p), precision=np.full(p.size, 1e-2))
    return p, calibrate(Stepper(p), begin, [()], priors, rows), rows


def covariances(kind, fits, weight, times):
    """Of all readings, in units of one reading's noise: white, and the remainder's."""
    shown = [p.readings[0, :, 0] for p in fits.predictions]
    rates = [np.gradient(x, t) for x, t in zip(shown, times, strict=True)]
    size = np.sqrt(np.mean(np.concatenate(rates) ** 2))
    total = sum(len(t) for t in times)
    S, first = np.zeros((total, total)), 0
    for t, rate in zip(times, rates, strict=True):
        own = slice(first, first + len(t))
        if kind in ("coloured", "clock", "askew"):
            S[own, own] = COLOUR.ratio * autocovariance(t[:, None] - t, COLOUR.frequency, COLOUR.damping)
        if kind in ("clock", "askew"):
            late = CLOCK.ratio * autocovariance(t[:, None] - t, CLOCK.frequency, CLOCK.damping)
            S[own, own] += np.outer(rate, rate) * late / size**2
        first += len(t)
    seen = np.concatenate(weight) > 0
    moving = [np.gradient(x, t, edge_order=2) for x, t in zip(shown, times, strict=True)]
    if kind == "askew":
        q, v = (place(np.concatenate(x), seen) for x in (shown, moving))
        shapes = np.stack([np.sqrt(5) * q**2, np.sqrt(7) * q**3, 3 * q * v, np.sqrt(5) * v**2])
        S += BENT * shapes.T @ shapes / 4
    if kind in ("positional", "kinematic"):
        shapes = thirteen(np.concatenate(shown), seen)
        if kind == "kinematic":
            shapes = np.concatenate([shapes, thirteen(np.concatenate(moving), seen)[1:]])
        S = BENT * shapes.T @ shapes / len(shapes)
    return S[np.ix_(seen, seen)] + np.diag(1 / np.concatenate(weight)[seen]), seen


def thirteen(x, seen):
    """Polynomials over the range that was read, of equal variances."""
    return np.stack([np.sqrt(2 * k + 1) * Legendre.basis(k)(place(x, seen)) for k in range(13)])


def place(x, seen):
    """Where in the range that was read something is, from -1 to 1."""
    return np.clip(2 * (x - x[seen].min()) / np.ptp(x[seen]) - 1, -1.0, 1.0)


@pytest.mark.parametrize("kind", ["coloured", "clock", "askew", "positional", "kinematic"])
def test_products_of_whitened_columns_are_the_dense_gaussian_process(kind, fitted):
    """For every kind of remainder, a clock with a curve of place and speed among them, two recordings at uneven times
    with readings missing: NumPy's solution with the covariance of all readings."""
    p, fits, rows = fitted
    weight = [w[:, 0] for w in weights(p, rows)]
    nothing = np.zeros((p.size, p.size))
    estimate = Estimate((), kind, fits.z[0], nothing, np.array([LEFT]), 0.0, True, colours=(COLOUR,), bent=(BENT,),
                        clocks=(CLOCK,))  # fmt: skip
    if kind == "askew":
        shown, times = [x.readings[0, :, 0] for x in fits.predictions], [r.times for r in p.rows]
        shapes = Shapes.over(shown, times, np.concatenate(weight) > 0, moving=True, form=Form.CURVE)
        estimate = replace(estimate, kind="clock", bends=(Bend(shapes, np.zeros(4), 0.0),))
    S, seen = covariances(kind, fits, weight, [r.times for r in p.rows])
    columns = np.random.default_rng(4).normal(size=(3, len(seen))) * seen
    root = np.sqrt(np.concatenate(weight)) / fits.noise[0]
    white = whitening(p, fits, rows, estimate)(columns * root)
    expected = columns[:, seen] @ np.linalg.solve(S, columns[:, seen].T) / LEFT**2
    # Covariances of condition up to 1e5 cost the dense solution five of sixteen digits.
    np.testing.assert_allclose(white @ white.T, expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())


@pytest.mark.parametrize("kind", ["white", "force"])
def test_without_an_error_of_the_sensor_readings_stay_as_they_are(kind, fitted):
    """Nothing is whitened beside white noise, nor beside a missing force, which no trajectory has."""
    p, fits, rows = fitted
    estimate = Estimate((), kind, fits.z[0], np.zeros((p.size, p.size)), np.array([LEFT]), 0.0, True)
    assert whitening(p, fits, rows, estimate) is None


def test_a_slow_error_no_longer_looks_like_a_drift():
    """An oscillator with a small viscous damping, read with a slow error of ten times the noise. Under white noise a
    drift of the sensor is ahead of the damping; beside the error the damping is, as strong as it is."""
    times, rng = np.linspace(0.0, 60.0, 400), np.random.default_rng(1)
    y = cases.solved(lambda t, x: [x[1], -x[0] - 0.002 * x[1]], [1.0, 0.0], times)[:, 0]
    lags, size = times[:, None] - times, 0.05
    slow = np.linalg.cholesky(autocovariance(lags, 0.2, 1.001) + 1e-9 * np.eye(len(times))) @ rng.normal(size=400)
    p = cases.problem(cases.simulation("p**2/2 + q**2/2"), [cases.recorded(times, y + size * slow
                      + 0.1 * size * rng.normal(size=400))], 0.05)  # fmt: skip
    priors = replace(priors_without_effects(p), scales=np.full(p.equations.size, 0.3), precision=np.full(p.size, 1e-2))
    stepper, rows, begin = Stepper(p), [400], np.zeros((1, p.size))
    begin[0, 0] = 1.0
    fits = calibrate(stepper, begin, [()], priors, rows)
    wanted = {p.candidate(m).effect.name: m for m in p.searched}
    units = {m: Unit(m, None) for name, m in wanted.items() if name in ("viscous_damping", "sensor_drift")}
    error = Estimate((), "coloured", fits.z[0], np.zeros((p.size, p.size)), np.array([0.1 * size]), 0.0, True,
                     colours=(Colour(100.0, 0.2, 1.001, 0.0),))  # fmt: skip
    found = {}
    for name, whiten in (("white", None), ("coloured", whitening(p, fits, rows, error))):
        starts = Regression(stepper, fits, rows, priors, units, whiten).subsets(1, lambda c: False, 2)
        found[name] = {p.candidate(s.combination[0]).effect.name: s for s in starts}
    gains = {kind: {name: s.gain for name, s in some.items()} for kind, some in found.items()}
    assert gains["white"]["sensor_drift"] > gains["white"].get("viscous_damping", -np.inf)
    assert gains["coloured"]["viscous_damping"] > gains["coloured"].get("sensor_drift", -np.inf) + 3
    damping = found["coloured"]["viscous_damping"].z[p.slots]
    # The error has some power at the oscillator's own frequency: a standard deviation of a seventh here.
    assert damping == pytest.approx(0.002, rel=0.3)


@pytest.mark.slow
def test_the_true_law_is_found_beside_a_wandering_clock():
    """Of a swing with quadratic drag whose rows are read up to a hundredth of a cycle too early or late only a damping
    was weighed, and its clock: the drag is found from there, weighed beside a clock itself, and ahead."""
    p, rows = problem(swing(late(0))), [len(LATE)]
    priors = replace(priors_without_effects(p), scales=np.full(p.equations.size, 0.3), precision=np.full(p.size, 1e-2))
    wanted = {p.candidate(m).effect.name: m for m in p.searched}
    drag, damping = (wanted["quadratic_drag"],), (wanted["viscous_damping"],)
    few = replace(p, searched=tuple(wanted[name] for name in ("viscous_damping", "quadratic_drag", "sensor_drift")))
    weigher = Weigher(Stepper(few), Found(few, priors))
    z = np.zeros(p.size)
    z[[0, p.head]] = 1.0
    weigher.weigh([Start((), z, 0.0), Start(damping, z, 0.0)])
    weigh_clocks(weigher, [(), damping])
    assert drag not in weigher.found.estimates and rows == weigher.rows
    Refinement(Prospects(weigher), lambda line: None).weigh_beside_the_remainder()
    found = weigher.found
    assert found.of(drag, "clock").log_evidence > found.best(damping) + 10
    assert max(found.estimates, key=found.odds) == drag


def test_a_drift_is_tried_where_an_error_that_lasts_stands_for_it():
    """Of a damped swing whose sensor drifts only the damping was weighed, and an error that remembers itself is ahead
    of white noise beside it: damping and drift are weighed from there, and are the likeliest."""
    motion = cases.solved(lambda t, x: [x[1], -x[0] - 0.05 * x[1]], [1.0, 0.0], LATE)
    readings = motion[:, 0] + 0.004 * LATE + 0.02 * np.random.default_rng(5).normal(size=len(LATE))
    p = cases.problem(cases.simulation("p**2/2 + q**2/2"), [cases.recorded(LATE, readings)], 0.05)
    wanted = {p.candidate(m).effect.name: m for m in p.searched if m == p.whole(m)}
    few = replace(p, searched=tuple(wanted[name] for name in ("viscous_damping", "sensor_drift", "sensor_gain")))
    weigher = cases.weigher(few, motion[:, 0], motion[:, 1])
    damping, both = (wanted["viscous_damping"],), tuple(sorted((wanted["viscous_damping"], wanted["sensor_drift"])))
    weigher.weigh([Start((), weigher.found.priors.mean, 0.0), Start(damping, weigher.found.priors.mean, 0.0)])
    kinds = {e.kind: e.log_evidence for e in weigher.found.estimates[damping]}
    assert kinds["coloured"] > kinds["white"] + 5
    starts = with_sensors(weigher, [damping])
    assert {s.combination for s in starts} == {both, tuple(sorted((*damping, wanted["sensor_gain"])))}
    Refinement(Prospects(weigher), lambda line: None).weigh_beside_the_remainder()
    assert max(weigher.found.estimates, key=weigher.found.odds) == both
