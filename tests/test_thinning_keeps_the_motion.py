"""Averaging rows keeps the motion, says how much noise is left, and never looks across the held-out boundary."""

import engine_cases as cases
import numpy as np
import pytest

from symplearn._rows import bin_width, lay_out
from symplearn._simulation_file import parse_simulation
from symplearn._thinning import highest_frequency, thin, thinning_width
from symplearn.diagnosis._build import averaged_over
from symplearn.diagnosis._calibrate import THINNED

DENSE = 20_000
SPAN = 100.0
FREQUENCY = 0.9


def sine(times, frequency=FREQUENCY):
    return np.sin(2 * np.pi * frequency * times + 0.4)[:, None]


def even():
    return np.linspace(0.0, SPAN, DENSE)


def irregular(seed=0):
    return np.sort(np.random.default_rng(seed).uniform(0.0, SPAN, DENSE))


def inner(values):
    """Without both ends, where the curvature is that of the neighbour."""
    return values[2:-2]


def test_a_sine_keeps_its_height():
    """Averaged at the width that is chosen for it, an even sine changes by a few parts in 1e5."""
    width = thinning_width(even(), sine(even()))
    thinned = thin(even(), sine(even()), width)
    error = np.abs(inner(thinned.readings - sine(thinned.times)))
    angle = 2 * np.pi * FREQUENCY * width
    assert len(thinned.times) < DENSE / 4 and angle <= 2 * np.pi / 20 + 1e-12
    # Of the mean, 1 - x^2/24 + x^4/1920, and the correction by second differences of means,
    # x^2/24 (1 - x^2/12 - x^2/24), there is left 9 x^4 / 1920: 4.6e-5 at the widest bin.
    assert error.max() < 1.1 * 9 * angle**4 / 1920 < 5.1e-5


def test_irregular_rows_keep_a_sine_better_than_a_plain_mean():
    """At random times, where bins hold unlike numbers of rows, the correction still takes out most of the loss."""
    times = irregular()
    thinned = thin(times, sine(times), 0.05)
    places = np.unique(np.floor((times - times[0]) / 0.05).astype(int), return_inverse=True)[1]
    plain = np.bincount(places, sine(times)[:, 0]) / np.bincount(places)
    truth = sine(thinned.times)[:, 0]
    # The spread of ten random times scatters by a third, and with it the neighbours that curvature is read from.
    assert np.abs(inner(thinned.readings[:, 0] - truth)).max() < 0.35 * np.abs(plain - truth).max()


def _is_even(times):
    return np.ptp(np.diff(times)) < 1e-9


def test_a_parabola_is_kept_exactly():
    """Slope and curvature inside a bin are taken out: a parabola on even times passes unchanged."""
    times = np.linspace(0.0, 10.0, 5000, endpoint=False)
    thinned = thin(times, (1.0 - 2 * times + 0.3 * times**2)[:, None], 0.05 - 1e-9)
    expected = 1.0 - 2 * thinned.times + 0.3 * thinned.times**2
    # A hair less than 25 rows wide, so that round-off moves no row to the next bin. What is left is that of sums of 25
    # readings of some tens, and of their differences over 0.05.
    np.testing.assert_allclose(inner(thinned.readings[:, 0]), inner(expected), atol=1e-9)


@pytest.mark.parametrize("times", [even(), irregular(1)], ids=["even", "irregular"])
def test_noise_is_as_stated(times):
    """The variance of a thinned reading is THINNED times that of one reading over how many it averages."""
    noise = np.random.default_rng(2).normal(size=(DENSE, 4))
    thinned = thin(times, noise, 10 * SPAN / DENSE)
    found = (inner(thinned.readings) ** 2 * inner(thinned.counts)).mean()
    # 8,000 squares: 1.6 %, four times. Irregular bins hold 3 to 20 readings and pass on noise unevenly.
    assert found == pytest.approx(THINNED, rel=0.064 if _is_even(times) else 0.15)


def test_every_reading_is_counted_once_and_missing_ones_never():
    """Counts add up to what was read, column by column; a bin without a reading is missing, not zero."""
    times, readings = irregular(3), sine(irregular(3)) * [1.0, 2.0]
    readings[::3, 0] = np.nan
    readings[4000:9000, 1] = np.nan
    thinned = thin(times, readings, 0.05)
    np.testing.assert_array_equal(thinned.counts.sum(0), (~np.isnan(readings)).sum(0))
    np.testing.assert_array_equal(np.isnan(thinned.readings), thinned.counts == 0)
    inside = (thinned.times > times[4000] + 0.05) & (thinned.times < times[8999] - 0.05)
    assert np.isnan(thinned.readings[inside, 1]).all() and not np.isnan(thinned.readings[inside, 0]).all()
    assert (np.diff(thinned.times) > 0).all()


@pytest.mark.parametrize("number", [3999, 50])
def test_short_recordings_are_left_alone(number):
    """Below 4,000 rows nothing is averaged: rows, readings and counts of one."""
    times = np.linspace(0.0, SPAN, number)
    assert thinning_width(times, sine(times, 0.01)) == 0.0
    readings = sine(times)
    readings[7] = np.nan
    same = thin(times, readings, 0.0)
    np.testing.assert_array_equal(same.times, times)
    np.testing.assert_array_equal(same.readings, readings)
    np.testing.assert_array_equal(same.counts, np.where(np.isnan(readings), 0.0, 1.0))


def test_fast_motion_is_left_alone():
    """Where a tenth of a period has hardly a row more than two, nothing is averaged, however many rows there are."""
    times = even()
    assert thinning_width(times, sine(times, 6.0)) == 0.0
    assert thinning_width(times, sine(times, 3.0)) > 0.0


@pytest.mark.parametrize(
    ("times", "noise"), [(even(), 0.0), (even(), 0.3), (irregular(), 0.0)], ids=["even", "noisy", "irregular"]
)
def test_the_highest_frequency_is_that_of_the_motion(times, noise):
    """Of two lines the faster counts, and no noise above it, gaps or not; the resolution is a few over the span."""
    readings = sine(times) + 0.2 * sine(times, 2.3) + noise * np.random.default_rng(4).normal(size=(DENSE, 1))
    readings[500:900] = np.nan
    assert highest_frequency(times, readings) == pytest.approx(2.3, abs=6 / SPAN)


def test_a_column_that_holds_nothing_has_no_frequency():
    """Constants and columns without readings neither count nor fail."""
    times = even()
    assert highest_frequency(times, np.stack([np.full(DENSE, 2.0), np.full(DENSE, np.nan)], 1)) == 0.0


def dense_run(number=DENSE, gap=None, seed=0):
    times = np.linspace(0.0, SPAN, number)
    if gap:
        times = times[(times < gap[0]) | (times > gap[1])]
    readings = sine(times) + 0.01 * np.random.default_rng(seed).normal(size=(len(times), 1))
    return cases.recorded(times, readings)


@pytest.mark.parametrize("holdout", [0.25, 0.1, 0.0])
def test_no_bin_straddles_the_boundary(holdout):
    """Fitted rows average the rows before the boundary alone, and all of them; held-out rows the others."""
    run = dense_run()
    (rows,) = lay_out([run], holdout, bin_width([run]), 0.05)
    kept = DENSE - int(DENSE * holdout)
    assert rows.counts[: rows.fitted].sum() == kept and rows.counts.sum() == DENSE
    assert rows.boundary == run.times[kept - 1]
    assert rows.times[rows.fitted - 1] <= rows.boundary < np.append(rows.times, np.inf)[rows.fitted]
    # Changing what is held out changes nothing before it.
    changed = run.readings.copy()
    changed[kept:] += 5.0
    (other,) = lay_out([cases.recorded(run.times, changed)], holdout, bin_width([run]), 0.05)
    np.testing.assert_array_equal(other.readings[: rows.fitted], rows.readings[: rows.fitted])


def test_a_known_start_keeps_its_row():
    """The row at which the start is known is averaged with no other; without one its bin is like all others."""
    run = dense_run()
    (rows,) = lay_out([run], 0.25, bin_width([run]), 0.05)
    assert rows.times[0] == run.times[0] and rows.readings[0] == run.readings[0] and rows.counts[0] == 1
    assert rows.counts[1] > 5 and rows.counts.sum() == DENSE
    (free,) = lay_out([run], 0.25, bin_width([run]), 0.05, is_begun=False)
    assert free.times[0] > run.times[0] and free.counts[0] > 5 and free.counts.sum() == DENSE


def test_readings_of_an_input_are_not_averaged():
    """Where an input is part of a reading it may change from row to row, and every row is taken by itself."""
    observed = {"q": 'y = "q"', "q + u / 2": 'y = "q + u/2"'}
    widths = {}
    for name, line in observed.items():
        text = f"""
[system]
coordinates = ["q"]
momenta = ["p"]
hamiltonian = "p**2/2 + q**2/2"
[forces]
p = "u"
[recording]
time = "t"
inputs = ["u"]
[recording.observe]
{line}
"""
        widths[name] = averaged_over(parse_simulation(text, "fed.toml"), [dense_run()])
    assert widths["q"] == bin_width([dense_run()]) > 0 == widths["q + u / 2"]


def test_wide_gaps_are_bridged():
    """A hole in the rows is crossed by rows without readings, so that no span is far longer than the others."""
    run = dense_run(1000, gap=(40.0, 55.0))
    (rows,) = lay_out([run], 0.2, 0.0, 0.05)
    usual = np.median(np.diff(run.times))
    assert np.diff(rows.times).max() <= 1.5 * usual * (1 + 1e-9)
    empty = rows.counts[:, 0] == 0
    np.testing.assert_array_equal(rows.times[~empty], run.times)
    np.testing.assert_array_equal(rows.readings[~empty], run.readings)
    assert (
        np.isnan(rows.readings[empty]).all() and (rows.times[empty] > 39.8).all() and (rows.times[empty] < 55.2).all()
    )
    assert rows.used == rows.given == len(run.times) < len(rows.times)


def test_substeps_are_short_enough_and_end_at_the_rows():
    """Spans join the rows in substeps no longer than asked for on usual gaps, equally many for every recording."""
    runs = [dense_run(700, seed=1), dense_run(350, seed=2)]
    laid = lay_out(runs, 0.25, 0.0, 0.11)
    assert len({int(n) for rows in laid for n in rows.spans.pieces}) == 1
    for rows in laid:
        np.testing.assert_allclose(rows.spans.length, np.diff(rows.times), rtol=1e-12)
        np.testing.assert_array_equal(rows.spans.start, rows.times[:-1])
        assert np.median(rows.spans.step) <= 0.11 * (1 + 1e-9)


def test_inputs_are_averaged_over_every_substep():
    """A substep gets the mean of a held input over it, the exact integral over its length."""
    times = np.linspace(0.0, 4.0, 41)
    values = np.sign(np.sin(3 * times))[:, None]
    inputs = cases.Inputs(times, values)
    run = cases.recorded(times[::2], sine(times[::2]), inputs)
    (rows,) = lay_out([run], 0.0, 0.0, 0.2)
    # Held between rows 0.1 apart: each span of 0.2 has the mean of two of them.
    np.testing.assert_allclose(rows.spans.inputs[:, 0], 0.5 * (values[:-1:2] + values[1::2]), atol=1e-12)
    np.testing.assert_array_equal(rows.inputs, values[::2])


def test_one_width_serves_all_recordings():
    """Recordings are averaged alike, at the narrowest width that any of them needs; short ones do not count."""
    fast, slow, short = dense_run(), dense_run(), dense_run(300)
    fast = cases.recorded(fast.times, sine(fast.times, 2.0))
    widths = [thinning_width(r.times, r.readings) for r in (fast, slow)]
    assert 0 < widths[0] < widths[1]
    assert bin_width([slow, fast, short]) == widths[0]
    assert bin_width([short]) == 0.0
