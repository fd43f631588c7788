"""An error of the sensor that goes with what it reads is integrated out exactly, and is not taken for a force."""

from dataclasses import replace

import engine_cases as cases
import numpy as np
import pytest
from numpy.polynomial import Legendre
from scipy.stats import norm, t

from symplearn import _effects as effects
from symplearn.diagnosis._bend import Form, Shapes
from symplearn.diagnosis._calibrate import calibrate
from symplearn.diagnosis._clock import weigh_clock
from symplearn.diagnosis._forecast import forecast
from symplearn.diagnosis._outlook import Outlook
from symplearn.diagnosis._positional import _Channel, _weighed, weigh_positional
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._trajectory import Stepper
from symplearn.diagnosis._weighed import weigh_coloured, weigh_white

NOISE, TIMES = 0.01, np.linspace(0.0, 50.0, 400)


@pytest.mark.parametrize("ratio", [0.05, 30.0])
def test_polynomials_are_integrated_out(ratio):
    """Gram matrix and determinant are those of the dense covariance that independent coefficients give the errors."""
    rng = np.random.default_rng(1)
    columns = rng.normal(size=(4 + 3, 50))
    one = _Channel(columns, 4, np.ones(50, bool), 0.7, 1.0)
    # 1e-9 is round-off of two ways to solve with a matrix whose condition number is below 1000.
    covariance = np.eye(50) + ratio / 3 * columns[4:].T @ columns[4:]
    gram, log = one.marginal(ratio)
    np.testing.assert_allclose(gram, columns[:4] @ np.linalg.solve(covariance, columns[:4].T), rtol=1e-9)
    assert log == pytest.approx(np.linalg.slogdet(covariance)[1] - 0.7, rel=1e-12)
    np.testing.assert_allclose(columns[:4] @ one.cleared(ratio).T, gram, rtol=1e-9)


@pytest.mark.parametrize("unit", [1.0, 1e-20])
def test_how_large_it_is_is_judged_beside_what_the_unknowns_make_up_for(unit):
    """What is left of the error is that of least squares by unknowns of given precisions, in whatever unit those are;
    one that is known makes up for nothing."""
    rng = np.random.default_rng(3)
    slopes, error, shapes = rng.normal(size=(2, 50)), rng.normal(size=50), rng.normal(size=(3, 50))
    slopes[0] *= unit
    one = _Channel(np.concatenate([error[None], slopes, shapes]), 3, np.ones(50, bool), 0.0, 50.0)
    for known, some in ((False, slopes), (True, slopes[:1])):
        found, log = one.left(np.array([4.0 * unit**2, np.inf if known else 2.0]))(5.0)
        width = np.array([0.5 / unit, np.sqrt(0.5)])[: len(some)]
        # A dense Gaussian process: white noise and the shapes, beside the slopes.
        inside, process = np.eye(50) + 5.0 / 3 * shapes.T @ shapes, (some.T * width**2) @ some
        expected = error @ np.linalg.inv(np.eye(50) + process) @ error
        plain = np.linalg.inv(np.eye(50) + process)
        least = (
            plain - plain @ shapes.T @ np.linalg.inv(3 / 5.0 * np.eye(3) + shapes @ plain @ shapes.T) @ shapes @ plain
        )
        assert found == pytest.approx(error @ least @ error) and found < expected
        assert log == pytest.approx(np.linalg.slogdet(plain @ (inside + process))[1])


@pytest.mark.parametrize("ratio", [0.05, 30.0])
def test_the_error_is_what_a_dense_process_expects(ratio):
    """Its mean, and the rms of what is left of its sd, are those of Gaussian process regression on the same errors."""
    rng = np.random.default_rng(1)
    seen, root = rng.uniform(-2.0, 3.0, 50), np.sqrt(rng.uniform(0.5, 20.0, 50))
    shapes = np.stack([np.sqrt(2 * k + 1) * Legendre.basis(k)(2 * (seen + 2) / 5 - 1) for k in range(13)])
    columns, column = rng.normal(size=(4, 50)) * root, rng.normal(size=4)
    one = _Channel(
        np.concatenate([columns, shapes * root]), 4, np.ones(50, bool), 0.7, float((root**2).sum()), Shapes((-2.0, 3.0))
    )
    found, prior = one.bend(column, ratio, 0.3), ratio / 13 * shapes.T @ shapes
    taken = prior @ np.linalg.inv(prior + np.diag(1 / root**2))
    # Here and below round-off of two ways to solve, with a matrix of condition 4000; times say nothing of it.
    np.testing.assert_allclose(found(seen, np.arange(50.0)), taken @ (column @ columns / root), rtol=1e-9)
    left = np.average(np.diag(prior - taken @ prior), weights=root**2)
    assert found.spread == pytest.approx(0.3 * np.sqrt(left), rel=1e-9)


def swing(times):
    """A spring whose motion dies slowly, by SciPy."""
    return cases.solved(lambda t, x: [x[1], -x[0] - 0.01 * x[1]], [1.0, 0.0], times)[:, 0]


def read(q, scale):
    """What the bent sensor reads."""
    return q + scale * (3 * q**2 - 2 * q**4)


def fitted(scale, errors=None, given=0.0, size=1.0, zero=0.0, hold=0.0, read=read):
    """A spring, its stiffness calibrated, whose reading a sensor bends by `scale`, fitted; its noise is `given`, and
    said to be wrong, or not. It is read in units of `size` from `zero` on; a share is held out."""
    q = swing(TIMES)
    errors = np.random.default_rng(2).normal(size=len(q)) if errors is None else errors
    y = zero + size * (read(q, scale) + NOISE * errors)
    more = (
        '[parameters]\nk = { value = 1.0, sd = 0.1 }\n[[terms]]\neffect = "viscous_damping"\ntarget = "q"\nc = 0.01\n'
    )
    more += f"[recording.noise]\ny = {given}\n" if given else ""
    file = cases.simulation("p**2/2 + k*q**2/2", observe={"y": f"{zero} + {size}*q"}, more=more)
    p = cases.problem(file, [cases.recorded(TIMES, y)], 0.05, hold)
    priors = replace(priors_without_effects(p), precision=np.full(p.size, 1e-2))
    begin = np.zeros(p.size)
    begin[[0, p.head]] = 1.0
    noises = [(m,) for m in p.searched if given and p.candidate(m).effect is effects.NOISE]
    fits = calibrate(Stepper(p), np.stack([begin] * max(len(noises), 1)), noises or [()], priors, [p.rows[0].fitted])
    assert fits.converged.all()
    return p, fits, priors


def evidences(scale, errors=None, **read):
    """Estimates by remainder."""
    p, fits, priors = fitted(scale, errors, **read)
    kinds = (weigh_white, weigh_coloured, weigh_positional)
    return [weigh(p, fits, priors, [len(TIMES)])[0] for weigh in kinds]


@pytest.fixture(scope="module")
def bent_scale():
    return evidences(0.03)


def test_a_bent_scale_is_seen_as_one(bent_scale):
    """Of a sensor that is off by up to three times its noise, in a way that repeats with the decaying motion: tens of
    nats above an error that only remembers itself, and that above white noise; the noise told is what it errs by."""
    white, coloured, positional = bent_scale
    assert positional.kind == "positional"
    assert positional.log_evidence > coloured.log_evidence + 10 > white.log_evidence + 20
    assert NOISE < positional.reading_noise[0] < 0.05  # the bend alone has an rms of 0.024
    assert positional.inflation < white.inflation


@pytest.mark.parametrize(("size", "zero"), [(0.02, 0.0), (30.0, 500.0)])
def test_it_is_seen_wherever_and_in_whatever_unit_it_is_read(size, zero, bent_scale):
    """A bent scale gains as much on white noise where the readings are small, or large and far from zero."""
    (white, _, bent), (plain, _, same) = bent_scale, evidences(0.03, size=size, zero=zero)
    # The fits stop where they promise less than half a nat, each on its own way.
    assert same.log_evidence - plain.log_evidence == pytest.approx(bent.log_evidence - white.log_evidence, abs=1.0)


@pytest.mark.parametrize(
    ("read", "is_curve"),
    [(lambda q, _: np.tanh(0.4 * q) / 0.4, True), (lambda q, _: q + 0.02 * np.sin(9 * q), False)],
    ids=["saturating", "wavy"],
)
def test_a_scale_that_saturates_is_a_plain_curve(read, is_curve):
    """A scale that saturates is likelier as a square and a cube than as many bends, one that waves as bends; what is
    told has half of the prior of either."""
    p, fits, priors = fitted(0.0, read=read)
    rows = [p.rows[0].fitted]
    (told,) = weigh_positional(p, fits, priors, rows)
    curve, bends = (_weighed(p, fits, 0, priors, rows, False, way).log_evidence for way in (Form.CURVE, Form.BENDS))
    assert told.log_evidence == pytest.approx(np.logaddexp(curve, bends) - np.log(2))
    assert (told.bends[0].shapes.form is Form.CURVE) == is_curve
    # Seen: 12.7 nats for the curve, and 156 for the bends.
    assert (curve - bends if is_curve else bends - curve) > 5
    x = np.linspace(-0.8, 0.8, 50)
    error = read(x, 0.0) - x - told.bends[0](x, x)
    # What a start and a stiffness make up for, a shift and a factor, are left out. Seen: 0.001 and 0.003 at most.
    rest = error - np.polyval(np.polyfit(x, error, 1), x)
    assert np.abs(rest).max() < 0.01


@pytest.mark.slow
def test_what_is_known_of_it_is_expected_of_later_rows():
    """Of a sensor that is off by three times its noise, later readings are predicted to a tenth more than the noise;
    without it they are missed by twice the noise."""
    p, fits, priors = fitted(0.03, hold=0.4)
    rows = [p.rows[0].fitted]
    outlook = lambda one: Outlook(Stepper(p), one, 0, np.zeros(1))  # noqa: E731
    (white,), (bent,) = weigh_white(p, fits, priors, rows), weigh_positional(p, fits, priors, rows)
    missed = {}
    for kind, one in (("white", white), ("bent", bent), ("unknown", replace(bent, bends=()))):
        shown = outlook(one)
        missed[kind] = np.sqrt(np.mean((shown.readings - p.rows[0].readings)[rows[0] :] ** 2))
    assert missed["bent"] < 1.1 * NOISE and min(missed["white"], missed["unknown"]) > 2 * NOISE
    # Errors a tenth larger than the noise, of which the prediction is sure, are less dense than white noise can be by
    # half of 1.1^2 - 1 each. Seen: 0.103.
    least = norm.logpdf(NOISE * np.random.default_rng(2).normal(size=len(TIMES))[rows[0] :], scale=NOISE).sum()
    assert outlook(bent).held_out(1.0).log_density > least - 0.105 * (len(TIMES) - rows[0])


@pytest.mark.slow
def test_a_forecast_expects_it_too():
    """Readings to come are those of the bent sensor, to a quarter of its noise, and not those of a straight one."""
    p, fits, priors = fitted(0.03)
    (white,), (bent,) = (weigh(p, fits, priors, [len(TIMES)]) for weigh in (weigh_white, weigh_positional))
    later = np.linspace(50.5, 70.0, 100)
    truth, rows = read(swing(np.append(0.0, later))[1:], 0.03), p.rows[0]
    columns = forecast(Stepper(p), cases.recorded(rows.times, rows.readings), white, bent, later, 1.0, 0).columns
    off = {label: np.sqrt(np.mean((columns["y"][label] - truth) ** 2)) for label in ("before", "after")}
    assert off["after"] < 0.25 * NOISE and off["before"] > NOISE


def test_white_noise_goes_with_nothing():
    """No evidence is gained where the sensor is straight."""
    white, _, positional = evidences(0.0)
    assert positional.log_evidence < white.log_evidence + 1.0
    # An sd estimated from 400 readings has an error of 3.5 %: 10 % is three of those.
    assert positional.reading_noise[0] == pytest.approx(NOISE, rel=0.1)


def test_averages_share_the_bend():
    """Of rows that are averages of nine readings the bend is what the fit leaves beside the scatter, not three times
    that: nine readings at one place err alike."""
    p, fits, priors = fitted(0.03)
    averaged = replace(p, rows=(replace(p.rows[0], counts=np.full((len(TIMES), 1), 9.0)),))
    fits = calibrate(Stepper(averaged), fits.z, [()], priors, [len(TIMES)])
    (positional,) = weigh_positional(averaged, fits, priors, [len(TIMES)])
    left = averaged.rows[0].readings - fits.predictions[0].readings[0]
    bend = np.sqrt((left**2).mean() - NOISE**2)
    # An sd of what is white estimated from 400 rows has an error of 3.5 %, the bend's, which is larger, less: 10 % is
    # three of those.
    assert positional.noise[0] * np.sqrt(positional.bent[0]) == pytest.approx(bend, rel=0.1)


def test_heavy_tails_speak_for_no_remainder():
    """Noise of Student's t is granted its tails whatever remainder is beside it: what that remainder leaves white is
    worth as many nats more than a Gaussian would have it as under white noise alone."""
    errors = np.random.default_rng(3).standard_t(5, len(TIMES)) * np.sqrt(0.6)
    e = errors / np.sqrt((errors**2).mean())
    _, centre, scale = t.fit(e, fdf=5, floc=0)
    tails = (t.logpdf(e, 5, centre, scale) - norm.logpdf(e)).sum()
    assert tails > 10
    straight, bent = evidences(0.0, errors), evidences(0.03, errors)
    for one in straight:
        # Without the tails white noise would be that far ahead; fits of some unknowns change an error by a percent.
        assert one.log_evidence > straight[0].log_evidence - 0.5 * tails
    assert bent[2].log_evidence > bent[0].log_evidence + 20


def test_a_noise_that_is_called_wrong_has_no_rough_remainder_beside_it():
    """Where every combination says that the noise is wrongly given, none is weighed under an error with a memory, which
    would only blur it."""
    p, fits, priors = fitted(0.0, given=NOISE)
    assert len(fits.z) == 1
    assert weigh_coloured(p, fits, priors, [len(TIMES)]) == weigh_clock(p, fits, priors, [len(TIMES)], []) == []
    assert len(weigh_white(p, fits, priors, [len(TIMES)])) == 1


def test_a_noise_given_too_large_is_told_beside_a_bent_scale():
    """Where the noise is two thirds of what is given and the scale is bent, that the noise is wrong is likelier with
    the bend than without, and likelier than the bend alone; the noise told is the noise without the bend."""
    p, fits, priors = fitted(0.03, given=1.5 * NOISE)
    trusting = calibrate(Stepper(p), fits.z, [()], priors, [len(TIMES)])
    (bent,), (straight,) = (weigh(p, fits, priors, [len(TIMES)]) for weigh in (weigh_positional, weigh_white))
    (alone,) = weigh_positional(p, trusting, priors, [len(TIMES)])
    assert bent.log_evidence > max(straight.log_evidence, alone.log_evidence) + 10
    # An sd estimated from 400 readings has an error of 3.5 %: three of those.
    assert bent.noise[0] == pytest.approx(NOISE, rel=0.1)


@pytest.mark.parametrize("astray", [3.0, 1e3])
def test_a_fit_that_went_astray_gains_nothing_by_heavy_tails(astray):
    """A trajectory far off the readings is no likelier under any remainder than one that follows them, though Student's
    t alone would be likelier by nearly all that it is off."""
    p, fits, priors = fitted(0.0, given=NOISE)
    combination = [()]
    near = calibrate(Stepper(p), fits.z[:1], combination, priors, [len(TIMES)])
    z = near.z.copy()
    z[0, p.head] += astray  # a stiffness: such an error is out of step with what is read, and no polynomial takes it
    far = replace(near, z=z, predictions=Stepper(p).predict(z, combination, [len(TIMES)]), converged=np.zeros(1, bool))
    for weigh in (weigh_white, weigh_coloured, weigh_positional):
        values = [weigh(p, one, priors, [len(TIMES)])[0].log_evidence for one in (near, far)]
        assert values[1] < values[0] - 100
