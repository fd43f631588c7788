"""A forecast that leaves everything that was read is said in the warnings; one that stays near is not."""

from dataclasses import replace

import numpy as np

from symplearn._recording import Recording
from symplearn.diagnosis._record import Forecast
from symplearn.diagnosis._warnings import far_off

TIMES = np.arange(10.0)
READ = Recording(1, "run.csv", ("y",), TIMES, np.cos(TIMES)[:, None], np.arange(10) + 2, None)


def forecast(before, after):
    """Five readings to come."""
    sd = np.full(5, 0.1)
    return Forecast(10.0 + np.arange(5), {"y": {"before": before, "before_sd": sd, "after": after, "after_sd": sd}})


def test_the_time_at_which_it_leaves_is_told():
    """Of two forecasts only the one that leaves the range of the readings tenfold is named, and from when on."""
    (said,) = far_off(forecast(np.cos(np.arange(5)), np.exp(2.0 * np.arange(5))), READ)
    # The readings range over almost 2: ten times that is between e^2 and e^4.
    assert "y after the findings" in said and "t = 12 on" in said


def test_what_never_moved_or_was_never_read_has_no_range():
    """A reading that stands still, and one that is missing throughout, are compared with nothing."""
    for value in (0.0, np.nan):
        still = replace(READ, readings=np.full((10, 1), value))
        assert far_off(forecast(np.full(5, 1e-9), np.full(5, 1e-9)), still) == []


def test_a_forecast_near_what_was_read_is_not_told():
    """Swings three times as wide as what was read are no cause for a warning."""
    wide = 3 * np.cos(np.arange(5))
    assert far_off(forecast(wide, wide), READ) == []
