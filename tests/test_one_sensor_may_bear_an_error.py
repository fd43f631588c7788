"""An error of the sensors is that of all or of a single one; which ones bear it is averaged over."""

from dataclasses import replace

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis._bearers import borne, sizes
from symplearn.diagnosis._calibrate import calibrate
from symplearn.diagnosis._positional import weigh_positional
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._trajectory import Stepper

NOISE, TIMES = 0.01, np.linspace(0.0, 40.0, 250)


def gaussian(centre, width):
    """A log likelihood of a size."""
    return lambda size: -0.5 * ((np.log(size + 0.01) - centre) / width) ** 2


def test_bearers_and_sizes_are_averaged_over():
    """Of three channels: the likelihood taken and what is owed are the mean over bearers and sizes, by summing all."""
    tried = np.geomspace(0.1, 10.0, 5)
    values = [gaussian(0.5, 0.3), gaussian(-4.0, 1.0), gaussian(-3.0, 2.0)]
    chosen, owed = borne([sizes(value, tried) for value in values])
    taken = sum(value(size) for value, size in zip(values, chosen, strict=True))
    on = [np.mean([np.exp(value(size)) for size in tried]) for value in values]
    off = [np.exp(value(0.0)) for value in values]
    single = [np.prod([on[k] if k == j else off[k] for k in range(3)]) for j in range(3)]
    # 1e-9: no error at all is one of 1e-12 of the noise.
    assert taken + owed == pytest.approx(np.log(0.5 * np.prod(on) + 0.5 * np.mean(single)), abs=1e-9)
    assert chosen[0] > 0.1 and max(chosen[1:]) < 1e-9


def test_a_single_channel_bears_it():
    """Of one channel it is the mean over sizes alone."""
    value, tried = gaussian(0.0, 1.0), np.geomspace(0.1, 10.0, 5)
    ((chosen,), owed) = borne([sizes(value, tried)])
    # 1e-12: round-off.
    assert value(chosen) + owed == pytest.approx(np.log(np.mean(np.exp([value(size) for size in tried]))), abs=1e-12)


def test_what_no_size_allows_is_owed_without_end():
    """Where every size is beyond what an error may be, there is none, and no evidence."""
    chosen, owed = borne([sizes(lambda size: -np.inf, np.ones(2)), sizes(lambda size: -np.inf, np.ones(2))])
    assert np.isfinite(chosen).all() and owed == -np.inf


def test_the_straight_sensor_is_left_straight():
    """Of a spring read by its place and its speed, the first on a bent scale, only the first is said to err."""
    q, v = cases.solved(lambda t, x: [x[1], -x[0]], [1.0, 0.2], TIMES).T
    rng = np.random.default_rng(0)
    y = np.stack([q + 0.03 * (3 * q**2 - 2 * q**4), v], axis=1) + NOISE * rng.normal(size=(len(TIMES), 2))
    file = cases.simulation("p**2/2 + q**2/2", observe={"y0": "q", "y1": "p"})
    p = cases.problem(file, [cases.recorded(TIMES, y)], 0.05)
    priors = replace(priors_without_effects(p), precision=np.full(p.size, 1e-2))
    begin = np.zeros((1, p.size))
    begin[0, [0, 2]] = 1.0, 0.2
    fits = calibrate(Stepper(p), begin, [()], priors, [len(TIMES)])
    (one,) = weigh_positional(p, fits, priors, [len(TIMES)])
    assert one.bent[0] > 1.0 and one.bent[1] < 1e-6
    # Of 250 readings the standard deviation has a standard error of 4.5 %.
    assert one.reading_noise[1] == pytest.approx(NOISE, rel=0.15)
