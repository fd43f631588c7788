"""A forecast that leaves everything that was read is said in the warnings; one that stays near is not."""

from dataclasses import replace

import numpy as np

from symplearn._recording import Recording
from symplearn.diagnosis._forecast import _DRAWS, _resolved, _summary
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


def test_where_hardly_any_draw_is_left_nothing_is_told():
    """Of draws that diverge one after the other, mean and sd are those of the ones that are left, and not known from
    where fewer than a quarter are; what diverged once does not come back."""
    number = _DRAWS + 1
    drawn = np.random.default_rng(0).normal(size=(number, 4, 1))
    half, few = np.arange(number) % 2 == 0, np.arange(number) % 8 == 0
    drawn[~half, 1] = np.inf  # back at the next time, which counts for nothing
    drawn[~few, 3] = np.nan
    mean, sd = _summary(drawn, np.zeros(number), about_first=False)
    # Both are sums over at most 129 draws in another order: 1e-12 is a hundred times the round-off of either.
    for t, some in ((0, np.full(number, True)), (1, half), (2, half)):
        np.testing.assert_allclose(mean[t], drawn[some, t].mean(0), rtol=1e-12)
        np.testing.assert_allclose(sd[t], drawn[some, t].std(0), rtol=1e-12)
    assert np.isnan(mean[3]).all() and np.isnan(sd[3]).all()
    about, around = _summary(drawn, np.zeros(number), about_first=True)
    np.testing.assert_array_equal(about[:3], drawn[0, :3])
    np.testing.assert_allclose(around[2], np.sqrt(np.mean((drawn[half, 2] - drawn[0, 2]) ** 2, axis=0)), rtol=1e-12)
    assert np.isnan(about[3]).all()
    assert np.isnan(_summary(drawn, np.full(number, -np.inf), about_first=True)[0]).all()


def test_what_is_not_known_is_said():
    """A forecast without numbers from some time on is named with that time, the other not."""
    lost = np.where(np.arange(5) < 3, 0.5, np.nan)
    (said,) = far_off(forecast(np.cos(np.arange(5)), lost), READ)
    assert "y after the findings is empty from t = 13 on" in said


def test_draws_that_shorter_substeps_change_are_left_out_from_then_on():
    """A draw that passes a centre in too long steps is not looked at from where shorter ones would lead it elsewhere,
    by more than draws differ and readings err; what shifts by less is. Where none has stayed finite none is."""
    fine, noise = np.random.default_rng(3).normal(size=(40, 6, 2)), np.array([0.1, 0.1])
    coarse = fine + 0.5
    coarse[7, 3, 1] += 50.0  # and back
    coarse[9, 4] = np.nan
    fine[:, 5, 0] = np.nan
    kept = _resolved(coarse, fine, noise)
    assert not kept[:, 5].any()
    kept = kept[:, :5]
    assert kept[7].tolist() == [True] * 3 + [False] * 2 and kept[9].tolist() == [True] * 4 + [False]
    assert kept[[k for k in range(40) if k not in (7, 9)]].all()
    known = np.tile(np.linspace(1.0, 2.0, 6)[None, :, None], (40, 1, 2))
    assert _resolved(known + 0.09, known, noise).all() and not _resolved(known + 0.11, known, noise).any()
