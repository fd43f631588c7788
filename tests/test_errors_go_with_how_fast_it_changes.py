"""An error of the sensor that is another on the way back is told from one that goes with place, and is predicted."""

from dataclasses import replace

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis._bend import Form, Shapes
from symplearn.diagnosis._calibrate import calibrate
from symplearn.diagnosis._forecast import forecast
from symplearn.diagnosis._outlook import Outlook
from symplearn.diagnosis._positional import _weighed, weigh_positional
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._trajectory import Stepper
from symplearn.diagnosis._weighed import weigh_coloured, weigh_white

NOISE, TIMES, LOSS = 0.01, np.linspace(0.0, 50.0, 400), 0.01
KNOWN = (
    f'[parameters]\nk = {{ value = 1.0, sd = 0.1 }}\n[[terms]]\neffect = "viscous_damping"\ntarget = "q"\nc = {LOSS}\n'
)


def swing(times):
    """Place and speed of a spring whose motion dies slowly, by SciPy."""
    return cases.solved(lambda t, x: [x[1], -x[0] - LOSS * x[1]], [1.0, 0.0], times).T


def read(q, v, size):
    """What a sensor reads that is off by more the faster it is passed, and by less on the way back."""
    return q + size * (2 * v**2 + v**3)


def fitted(size, hold=0.0, read=read):
    """A spring, its stiffness calibrated, read by a sensor that errs by `size`, fitted; a share is held out."""
    q, v = swing(TIMES)
    y = read(q, v, size) + NOISE * np.random.default_rng(2).normal(size=len(TIMES))
    p = cases.problem(cases.simulation("p**2/2 + k*q**2/2", more=KNOWN), [cases.recorded(TIMES, y)], 0.05, hold)
    priors = replace(priors_without_effects(p), precision=np.full(p.size, 1e-2))
    begin = np.zeros((1, p.size))
    begin[0, [0, p.head]] = 1.0
    return p, calibrate(Stepper(p), begin, [()], priors, [p.rows[0].fitted]), priors


def kinematic(p, fits, priors):
    (found,) = weigh_positional(p, fits, priors, [p.rows[0].fitted], moving=True)
    return found


def test_it_is_told_from_an_error_of_place():
    """Off by three times its noise as it goes with the speed: tens of nats above an error that goes with what is read
    alone, above one that remembers itself, and above white noise."""
    p, fits, priors = fitted(0.02)
    rows = [p.rows[0].fitted]
    others = [weigh(p, fits, priors, rows)[0] for weigh in (weigh_white, weigh_coloured, weigh_positional)]
    found = kinematic(p, fits, priors)
    assert found.kind == "kinematic"
    assert found.log_evidence > max(one.log_evidence for one in others) + 10


def test_a_sensor_that_errs_by_nothing_has_none():
    """White noise alone gains nothing by it."""
    p, fits, priors = fitted(0.0)
    assert kinematic(p, fits, priors).log_evidence < weigh_white(p, fits, priors, [len(TIMES)])[0].log_evidence + 1.0


def test_the_error_found_is_that_of_the_sensor():
    """Over the places and speeds of the motion, but for what another start, scale or zero would do as well, to the
    noise's half."""
    p, fits, priors = fitted(0.02)
    found, (q, v) = kinematic(p, fits, priors), swing(TIMES)
    off = found.bends[0](q, TIMES) - (read(q, v, 0.02) - q)
    alike = np.stack([np.ones_like(q), q, v])
    left = off - np.linalg.lstsq(alike.T, off, rcond=None)[0] @ alike
    assert np.sqrt(np.mean(left**2)) < 0.5 * NOISE < NOISE < np.std(read(q, v, 0.02) - q)


def test_what_is_read_the_later_the_farther_out_it_is_errs_by_a_plain_curve():
    """The rows of a camera are read one after the other: its error is the lateness, in proportion to the place, times
    the speed. It is seen tens of nats above white noise and above an error of place, and is what it is."""
    shutter = lambda q, v, size: q + size * q * v  # noqa: E731
    p, fits, priors = fitted(0.05, read=shutter)
    white, place = (weigh(p, fits, priors, [len(TIMES)])[0] for weigh in (weigh_white, weigh_positional))
    found, (q, v) = kinematic(p, fits, priors), swing(TIMES)
    assert found.bends[0].shapes.form is Form.CURVE
    assert found.log_evidence > max(white.log_evidence, place.log_evidence) + 20
    # The error's rms is 0.014, the noise 0.01. Seen: 0.0012.
    assert np.sqrt(np.mean((found.bends[0](q, TIMES) - 0.05 * q * v) ** 2)) < 0.2 * NOISE


def linked(q, half):
    """What is read through a linkage with play, by the textbook's rule: it stands still until the gap is passed."""
    out = [q[0] - half]
    for x in q[1:]:
        out.append(min(max(out[-1], x - half), x + half))
    return np.array(out)


def test_a_linkage_with_play_is_off_by_which_way_it_goes():
    """By more than the noise, one way and the other: tens of nats above white noise and above polynomials of speed, and
    what is told of it is the error."""
    q = swing(np.linspace(0.0, 50.0, 399 * 20 + 1))[0]
    errors = (linked(q, 1.5 * NOISE) - q)[::20]
    p, fits, priors = fitted(1.0, read=lambda q, v, size: q + size * errors)
    found, white = kinematic(p, fits, priors), weigh_white(p, fits, priors, [len(TIMES)])[0]
    bends = _weighed(p, fits, 0, priors, [len(TIMES)], True, Form.BENDS)
    assert found.bends[0].shapes.form is Form.PLAY
    # Seen: 36 nats above polynomials, 60 above white noise; and 0.0025 of 0.0147 is left.
    assert found.log_evidence > max(white.log_evidence, bends.log_evidence) + 20
    left = found.bends[0](swing(TIMES)[0], TIMES) - errors
    assert np.sqrt(np.mean(left**2)) < 0.5 * NOISE < NOISE < np.std(errors)


def test_the_shapes_are_polynomials_of_place_and_of_speed():
    """Of a sine, known by its closed form: orthonormal over both ranges, the speeds to what differences of such rows
    leave of them; the same for many motions at once, and none of speed where there is one row."""
    times = np.linspace(0.0, 6.0, 601)
    q, v = np.sin(times), np.cos(times)
    shapes = Shapes.over([q], [times], np.ones(601, bool), moving=True)
    found = shapes(q, times)
    expected = np.concatenate([np.polynomial.legendre.legvander(x, 12) for x in (q, v)], axis=1)
    expected = np.delete(expected * np.sqrt(2 * np.tile(np.arange(13), 2) + 1), 13, axis=1)
    # Differences over 0.01 on both sides miss a cosine by 2e-5, at an end by twice that; the slope of the polynomial of
    # degree 12, up to 78 times its factor of 5, makes 0.013 of the latter.
    np.testing.assert_allclose(found, expected, atol=0.02)
    # The same differences and polynomials of two rows at once: round-off of values up to 5.
    np.testing.assert_allclose(shapes(np.stack([q, q]), times)[1], found, rtol=0, atol=1e-12)
    assert np.isfinite(shapes(q[:1], times[:1])).all()


@pytest.mark.slow
def test_what_is_known_of_it_is_expected_of_later_rows():
    """Held-out readings and a forecast are those of the sensor as it is, to a tenth and to a half of its noise; without
    what is known of the error they are missed by more than the noise."""
    p, fits, priors = fitted(0.02, hold=0.4)
    found, fit = kinematic(p, fits, priors), p.rows[0].fitted
    shown = [Outlook(Stepper(p), one, 0, np.zeros(1)).readings for one in (found, replace(found, bends=()))]
    known, unknown = (np.sqrt(np.mean((x - p.rows[0].readings)[fit:] ** 2)) for x in shown)
    assert known < 1.1 * NOISE < 1.5 * NOISE < unknown
    later = np.linspace(50.5, 70.0, 100)
    truth = read(*swing(np.append(0.0, later))[:, 1:], 0.02)
    both = forecast(Stepper(p), cases.recorded(TIMES, p.rows[0].readings), found, found, later, 1.0, 0)
    assert np.sqrt(np.mean((both.columns["y"]["after"] - truth) ** 2)) < 0.5 * NOISE
