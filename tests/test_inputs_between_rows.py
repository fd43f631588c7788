"""Inputs between their rows: held, linear, or without new frequencies."""

import numpy as np
import pytest

from symplearn._errors import InputError
from symplearn._inputs import Inputs

TIMES = np.array([0.0, 1.0, 1.5, 3.0])
VALUES = np.array([[1.0, -1.0], [2.0, 5.0], [-4.0, 0.0], [8.0, 2.0]])


def test_hold_is_the_latest_row():
    """The held input is that of the latest row at or before the time, also within rounding of it."""
    held = Inputs(TIMES, VALUES, "hold")
    at = np.array([-0.2, 0.0, 0.999, 1.0, 1.0 - 1e-12, 1.4, 1.5, 3.0, 3.4])
    np.testing.assert_array_equal(held.at(at)[:, 0], [1, 1, 1, 2, 2, 2, -4, 8, 8])


def test_linear_is_the_chord():
    """Between two rows the input runs along the straight line."""
    linear = Inputs(TIMES, VALUES, "linear")
    expected = [[1.25, 0.5], [2.0, 1.0], [8.0, 2.0]]
    np.testing.assert_allclose(linear.at(np.array([0.25, 2.25, 3.0])), expected)


@pytest.mark.parametrize("interpolation", ["hold", "linear"])
def test_means_are_exact(interpolation):
    """The mean over an interval, within a row or across rows, is that of a sum over 20,000 points."""
    inputs = Inputs(TIMES, VALUES, interpolation)
    begin, end = np.array([0.0, 0.2, 0.9, 1.0, 2.0, 0.0]), np.array([3.0, 0.4, 1.6, 1.5, 2.9, 1.0])
    count = 20_000
    middles = begin[:, None] + (end - begin)[:, None] * (np.arange(count) + 0.5) / count
    expected = inputs.at(middles.ravel()).reshape(len(begin), count, 2).mean(axis=1)
    # Each of at most three jumps, of up to 12, is placed to one of the 20,000 points.
    np.testing.assert_allclose(inputs.mean_over(begin, end), expected, atol=3 * 12 / count)
    same = np.array([0.5, 1.0])
    np.testing.assert_allclose(inputs.mean_over(same, same), inputs.at(same))


def test_means_over_a_long_recording_lose_no_digits():
    """After 100,000 rows around a large offset a mean over one row is still that row's value."""
    rng = np.random.default_rng(0)
    times = np.arange(100_000) * 1e-3 + 1e3
    held = Inputs(times, 50.0 + rng.standard_normal((100_000, 1)), "hold")
    # Rounding of times: 1e-13 of 1e3 against rows 1e-3 long, times jumps of about 4.
    np.testing.assert_allclose(held.mean_over(times[:-1], times[1:]), held.values[:-1], atol=2e-9)


def tones(times, count=20, highest=0.8, seed=1):
    """A sum of tones up to `highest` of the Nyquist frequency of rows one unit apart; unit variance."""
    rng = np.random.default_rng(seed)
    frequency = rng.uniform(0.0, highest * 0.5, count)
    phase = rng.uniform(0, 2 * np.pi, count)
    return np.sqrt(2 / count) * np.sin(2 * np.pi * np.outer(times, frequency) + phase).sum(axis=1)


@pytest.mark.parametrize("length", [20_000, 20_011])
def test_bandlimited_gives_the_tones_themselves(length):
    """Far from the ends, tones below 0.8 of the Nyquist frequency come back to 1e-6 of the signal."""
    rows = np.arange(length, dtype=float)
    inputs = Inputs(rows, tones(rows)[:, None] + 3.0, "bandlimited")
    at = np.sort(np.random.default_rng(2).uniform(2000, length - 2000, 5000))
    # The 8-point polynomial on 8 points a row errs by 1e-7; what the ends do has died out 2,000 rows inside.
    np.testing.assert_allclose(inputs.at(at)[:, 0], tones(at) + 3.0, atol=1e-6)


def test_bandlimited_near_the_ends():
    """Near the ends the error is small after tens of rows, and the rows themselves are met everywhere."""
    rows = np.arange(4000, dtype=float)
    inputs = Inputs(rows, tones(rows)[:, None], "bandlimited")
    for distance, bound in ((30, 1e-3), (300, 3e-5)):  # measured: 2e-4 and 4e-6
        at = np.linspace(distance, 2 * distance, 997)
        np.testing.assert_allclose(inputs.at(at)[:, 0], tones(at), atol=bound)
    np.testing.assert_allclose(inputs.at(rows)[:, 0], inputs.values[:, 0], atol=1e-12)


def test_bandlimited_takes_off_the_ramp():
    """A straight line comes back exactly: the ends, which differ, do not ring."""
    rows = np.linspace(5.0, 6.0, 101)
    inputs = Inputs(rows, np.stack([3 * rows - 2, 1 - rows], axis=1), "bandlimited")
    at = np.linspace(5.0, 6.0, 777)
    np.testing.assert_allclose(inputs.at(at), np.stack([3 * at - 2, 1 - at], axis=1), atol=1e-12)


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_bandlimited_with_few_rows(count):
    """One to four rows are enough to say something finite."""
    inputs = Inputs(np.arange(count) * 1.0, np.ones((count, 1)), "bandlimited")
    np.testing.assert_allclose(inputs.at(np.array([0.0, (count - 1) * 0.7])), 1.0)


def test_times_rounded_in_the_file_are_even():
    """Times written with three significant digits of a spacing are even; a skipped row is not."""
    even = np.round(66.6 + 1.63836e-3 * np.arange(5000), 6)
    Inputs(even, np.zeros((5000, 1)), "bandlimited")
    with pytest.raises(InputError, match='not evenly spaced near t = .*; give evenly spaced rows or inter.*"linear"'):
        Inputs(np.delete(even, 2500), np.zeros((4999, 1)), "bandlimited")


@pytest.mark.parametrize("interpolation", ["hold", "linear", "bandlimited"])
def test_outside_the_rows_by_more_than_half_a_spacing(interpolation):
    """Inputs that are not known are asked for, with the time until which they are needed."""
    inputs = Inputs(np.arange(5.0), np.ones((5, 1)), interpolation, "swing.csv")
    np.testing.assert_allclose(inputs.at(np.array([-0.49, 4.49])), 1.0)
    for at in (-0.51, 4.51):
        with pytest.raises(InputError, match=f"swing.csv: inputs are needed at {at}, .*add rows with inputs and empty"):
            inputs.at(np.array([1.0, at]))
    with pytest.raises(InputError, match="needed at 9"):
        inputs.mean_over(np.array([1.0]), np.array([9.0]))
    assert inputs.at(np.zeros(0)).shape == (0, 1)
