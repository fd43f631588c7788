"""Pictures of the report show every motion, short, long or diverging, and beside it the law that was found."""

import dataclasses
import io
import re

import numpy as np
import pytest
import report_cases as cases
from matplotlib.figure import Figure
from PIL import Image

from symplearn._vocabulary import VOCABULARY
from symplearn.report import html_report
from symplearn.report._decimate import envelope
from symplearn.report._force import energy_limits, force_panels, missing
from symplearn.report._law import Motion, added_force
from symplearn.report._motion import channel, close_up_window, motion_panels
from symplearn.report._palette import AFTER, BEFORE, LAW, READING, SHADE
from symplearn.report._panel import labels, limits, render


def test_eight_long_recordings_stay_small():
    """Eight recordings of 20,000 rows and five columns make less than 2 MB, and it says what is not drawn."""
    one = cases.series(rows=20_000, end=200.0, columns=5)
    record = cases.damped_pendulum(series=(one,) * 8, columns=tuple(f"column{i}" for i in range(5)))
    page = html_report(record)
    assert len(page.encode()) < 2_000_000
    assert "Pictures are of the first 6 of 8 recordings." in page
    assert "Pictures are of the first 3 of 5 columns." in page
    headings = re.findall(r"<h3>(column\d), recording (\d)", page)
    assert {int(number) for _, number in headings} == set(range(1, 7))


@pytest.mark.parametrize(("told", "drawn"), [([2], 2), ([1, 2], 1), ([], 1)])
def test_the_force_is_drawn_where_something_is_missing(told, drawn):
    """Of several recordings the force and the energy are of the first that the location names, as its sentence is."""
    one = cases.damped_pendulum(series=(cases.series(rows=80, end=4.0, seed=1), cases.series(rows=80, end=4.0, seed=2)))
    place = one.document["location"] | {"recordings": told}
    page = html_report(dataclasses.replace(one, document=one.document | {"location": place}))
    assert re.findall(r"<h3>(?:Missing force on \w+|Energy) in recording (\d)", page) == [str(drawn)] * 2


def test_a_simulation_that_diverges_is_still_drawn():
    """Huge values and infinities break no picture and stretch no axis beyond three times its range."""
    bad = (1e200, 1e308, np.inf, np.nan)
    recordings = [cases.series(rows=120, end=6.0) for _ in bad]
    for one, value in zip(recordings, bad, strict=True):
        one.before[100:] = value
        recordings[0].force_before[bad.index(value) :: 8] = value
        recordings[0].velocity[bad.index(value) :: 9] = value
        recordings[0].energy_before[bad.index(value) :: 9] = value
        low, high = limits(one.readings, one.before)
        size = np.nanmax(one.readings) - np.nanmin(one.readings)
        # One size on either side at most, and a margin of 6 % of the three.
        assert high - low < 3 * size * 1.13
    page = html_report(cases.damped_pendulum(series=tuple(recordings)))
    # Four of the first recording, two of each other, three of the force, one of the energy.
    assert page.count("<img") == 4 + 6 + 3 + 1


def test_an_energy_that_is_lost_is_in_the_picture():
    """Beside one that is kept to a millionth, whichever of the two comes first; one that runs away is not."""
    kept, lost = -0.5 + 1e-6 * np.sin(np.arange(500.0)), -0.5 - 3.0 * np.linspace(0.0, 1.0, 500)
    for pair in ((kept, lost), (lost, kept)):
        low, high = energy_limits(*pair)
        assert low < -3.5 and -0.5 < high and high - low < 1.13 * 3.0  # a margin of 6 % on either side
    away = -0.5 + np.exp(np.linspace(-100.0, 200.0, 500))
    assert np.ptp(energy_limits(away, lost)) < 3 * 3.0 * 1.13


def test_an_envelope_covers_the_line():
    """Of 20,001 values the envelope keeps each stretch's extremes, in order, and a gap stays a gap."""
    values = np.random.default_rng(0).normal(size=20_001)
    values[5000:8000] = np.nan
    kept = envelope(values, 100)
    assert len(kept) <= 202 and np.all(np.diff(kept) > 0)
    for stretch in np.array_split(values, 100):
        if np.isfinite(stretch).any():
            assert np.isin([np.nanmin(stretch), np.nanmax(stretch)], values[kept]).all()
    assert np.isnan(values[kept]).any()


def test_the_close_up_shows_ten_cycles():
    """The close-up of a cosine spans its last ten periods, and lies in the held-out part."""
    one = channel(cases.damped_pendulum(), cases.series(rows=4000), "angle_deg")
    wave = np.cos(2 * np.pi * 7 * one.times)
    first, last = close_up_window(dataclasses.replace(one, after=wave, boundary=15.0))
    assert last == 20.0 and first >= 15.0
    # Ten periods to the last rise, and less than one after it.
    assert 10 / 7 <= last - first <= 11 / 7 + 0.01


def test_colours_in_pictures_are_true():
    """Every colour of the legend stands in the picture of a long recording, within 3 of 255."""
    one = channel(cases.damped_pendulum(), cases.series(rows=5000, end=100.0), "angle_deg")
    image = Image.open(io.BytesIO(motion_panels(one, detail=False)[0].png)).convert("RGB")
    seen = np.unique(np.asarray(image).reshape(-1, 3), axis=0).astype(int)
    for colour in (BEFORE, AFTER, READING, SHADE, "#ffffff"):
        asked = np.array(list(bytes.fromhex(colour[1:])))
        # Pillow looks colours up in cells of 4 levels.
        assert np.abs(seen - asked).max(axis=1).min() <= 3
    assert [255, 255, 255] in seen.tolist()


def test_a_law_far_beyond_the_estimate_is_in_the_picture():
    """A force ten ranges of the estimate away, as where nothing reads its coordinate, is drawn in all three panels."""
    record = cases.damped_pendulum()
    one = missing(record, record.series[0], 1, record.coordinates[0])
    far = dataclasses.replace(one, law=np.full(len(one.times), one.before.max() + 10 * np.ptp(one.before)))
    for panel in force_panels(far, "theta"):
        image = np.asarray(Image.open(io.BytesIO(panel.png)).convert("RGB"))
        below_the_legend = image[image.shape[0] // 10 :].reshape(-1, 3).astype(int)
        asked = np.array(list(bytes.fromhex(LAW[1:])))
        assert (np.abs(below_the_legend - asked).max(axis=1) <= 3).sum() > 20


def test_a_common_factor_stands_in_the_label():
    """The power of ten of small numbers is part of the axis' label, not above the axes, where the legend is."""
    kept = []

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        axes.plot([0.0, 1.0], [0.0, 3e-7])
        labels(axes, "time", "force [N]")
        kept.append(axes)

    render(draw, (4.8, 3.0), dpi=40)
    assert kept[0].get_ylabel().startswith("force [N] × 1e") and kept[0].get_ylabel().endswith("7")
    assert not kept[0].yaxis.get_offset_text().get_visible()


def test_very_short_recordings_are_drawn():
    """One held-out row, or none at all and a single reading, make a page without a complaint."""
    one = cases.series(rows=40, end=4.0)
    short = dataclasses.replace(one, boundary=float(one.times[-2]))
    rows = {name: getattr(one, name)[:1] for name in ("times", "readings", "before", "after")}
    single = dataclasses.replace(one, boundary=0.0, **rows)
    page = html_report(cases.damped_pendulum(series=(short, single)))
    assert page.count("<img") == 4 + 2 + 3 + 1


X, Y, V, W, T = (np.random.default_rng(1).normal(size=(5, 7)) * [[1.0], [1.0], [2.0], [2.0], [9.0]]).tolist()
X, Y, V, W, T = map(np.array, (X, Y, V, W, T))
# Effect, side, coefficients, and by hand the force on x and on y; the pair is (x, y).
LAWS_BY_HAND = [
    ("viscous_damping", None, {"c": 0.4}, -0.4 * V, None),
    ("quadratic_drag", None, {"c": 0.4}, -0.4 * np.sign(V) * V**2, None),
    ("coulomb_friction", None, {"f": 0.4}, np.where(V > 0, -0.4, 0.4), None),
    ("relative_damping", None, {"c": 0.4}, 0.4 * W - 0.4 * V, 0.4 * V - 0.4 * W),
    ("self_excitation", None, {"c": 0.4, "a": 0.5}, 0.4 * V - 1.6 * X**2 * V, None),
    ("constant_force", None, {"f": 0.4}, 0.4 + 0 * X, None),
    ("linear_stiffness", None, {"k": 0.4}, -0.4 * X, None),
    ("quadratic_stiffness", None, {"k": 0.4}, -0.4 * X**2, None),
    ("cubic_stiffness", None, {"k": 0.4}, -0.4 * X**3, None),
    ("coupling_spring", None, {"k": 0.4}, 0.4 * Y - 0.4 * X, 0.4 * X - 0.4 * Y),
    ("contact_stop", "upper", {"k": 0.4, "a": 0.1}, np.where(X > 0.1, 0.04 - 0.4 * X, 0), None),
    ("contact_stop", "lower", {"k": 0.4, "a": 0.1}, np.where(X < 0.1, 0.04 - 0.4 * X, 0), None),
    (
        "central_correction",
        None,
        {"b": 0.4},
        -1.2 * X * (X**2 + Y**2) ** -2.5,
        -1.2 * Y * (X**2 + Y**2) ** -2.5,
    ),
    ("gyroscopic_coupling", None, {"b": 0.4}, 0.4 * W, -0.4 * V),
    (
        "periodic_forcing",
        None,
        {"a": 0.4, "omega": 2.0, "phi": 0.3},
        0.4 * np.cos(0.3) * np.cos(2 * T) - 0.4 * np.sin(0.3) * np.sin(2 * T),
        None,
    ),
]


@pytest.mark.parametrize(("effect", "side", "coefficients", "on_x", "on_y"), LAWS_BY_HAND)
def test_the_drawn_law_is_the_contract_s(effect, side, coefficients, on_x, on_y):
    """The force drawn for each effect, on either coordinate of a pair, is the contract's, written out here by hand."""
    motion = Motion(T, np.stack([Y, X], 1), np.stack([W, V], 1))
    estimates = {name: {"mean": value} for name, value in coefficients.items()}
    finding = {
        "effect": effect,
        "target": "x" if on_y is None else ["x", "y"],
        "recordings": [2],
        "coefficients": estimates | ({"side": side} if side else {}),
    }
    for coordinate, force in (("x", on_x), ("y", on_y)):
        drawn = added_force([finding], ("y", "x"), coordinate, motion, 2)
        if force is None:
            assert drawn is None
        else:
            # Same arithmetic in another order: a few units in the last place of the largest term.
            np.testing.assert_allclose(drawn, force, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(added_force([finding] * 2, ("y", "x"), coordinate, motion, 2), 2 * drawn)
    assert added_force([finding], ("y", "x"), "x", motion, 1) is None


def test_what_is_no_force_of_the_motion_is_not_drawn():
    """All but the laws above: jumps, hidden coordinates, changed parameters, sensors, unnamed expressions."""
    motion, drawn = Motion(T, X[:, None], V[:, None]), {law[0] for law in LAWS_BY_HAND}
    for effect in set(VOCABULARY) - drawn:
        finding = {"effect": effect, "target": "x", "coefficients": {}}
        assert added_force([finding], ("x",), "x", motion, 1) is None
    assert len(drawn) == 14


def test_a_pair_s_force_is_drawn_on_both_coordinates():
    """The spring between x and y is part of the law on either; the stop only in its own recording."""
    record = cases.two_masses()
    for number, series in enumerate(record.series, start=1):
        x, y = series.position.T
        push = -3.1 * (x - y)
        forcing = 0.2 * np.cos(2.1 * series.fitted_times + 0.3)
        np.testing.assert_allclose(missing(record, series, number, "x").law, push + forcing)
        stop = 40 * np.maximum(0.7 - y, 0) if number == 2 else 0
        np.testing.assert_allclose(missing(record, series, number, "y").law, stop - push)
