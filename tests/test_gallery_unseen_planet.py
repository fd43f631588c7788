"""A force that pulls along a known path says when it was strongest, and where on the sky the body stood."""

import numpy as np
import pytest

from experiments._gallery_page_file import Case, Page
from experiments._gallery_prepare import chosen, merged, prepared, windows
from experiments._gallery_pull import (
    averaged,
    degrees_between,
    ecliptic_longitude,
    lines,
    on_the_sky,
    seen_period,
    strongest,
    unseen_body,
)
from experiments._gallery_results import Result, Source
from experiments._gallery_uranus import GM_NEPTUNE, uranus_section
from symplearn._errors import InputError

GM_SUN, GM = 2.96e-4, 1.6e-8
INNER, OUTER, TILT = 19.0, 31.0, 0.02
MEETING = 20_000.0  # days


def circles():
    """Two circles about the Sun by Kepler's third law, the outer one tilted; both at angle 0 when they meet."""
    times = np.arange(0.0, 50_000.0, 50.0)

    def angle(radius):
        return np.sqrt(GM_SUN / radius**3) * (times - MEETING)

    a, b = angle(INNER), angle(OUTER)
    inner = INNER * np.stack([np.cos(a), np.sin(a), 0 * a], 1)
    outer = OUTER * np.stack([np.cos(b), np.sin(b) * np.cos(TILT), np.sin(b) * np.sin(TILT)], 1)
    return times, inner, outer


def pull(path, body):
    """Newton's law."""
    d = body - path
    return GM * d / np.linalg.norm(d, axis=1, keepdims=True) ** 3


def test_strongest_when_they_meet():
    """At the meeting the pull is GM / (difference of radii)^2, straight away from the Sun."""
    times, inner, outer = circles()
    peak = strongest(times, pull(inner, outer), 0.0, 1000.0)
    assert times[peak.place] == MEETING
    assert peak.size == pytest.approx(GM / (OUTER - INNER) ** 2, rel=1e-12)
    assert degrees_between(peak.direction, np.array([1.0, 0.0, 0.0])) < 1e-6


def test_mean_forgets_fast_swings():
    """A fast swing as large as the pull moves the peak under an eight-year window by less than a year and a degree."""
    times, inner, outer = circles()
    swing = GM / (OUTER - INNER) ** 2 * np.sin(2 * np.pi * times / 175.0)[:, None] * np.array([0.3, 0.8, 0.5])
    peak = strongest(times, pull(inner, outer) + swing, 8 * 365.25, 5 * 365.25)
    assert abs(times[peak.place] - MEETING) < 365.25
    assert degrees_between(peak.direction, np.array([1.0, 0.0, 0.0])) < 1.0
    assert averaged(times, swing, 0.0) == pytest.approx(swing)


def test_orbit_and_mass_from_the_force():
    """From the exact force of a body on a circle the least squares find its place at all times, and its mass."""
    times, inner, outer = circles()
    orbit, gm = unseen_body(times, pull(inner, outer), inner, GM_SUN)
    assert orbit.radius == pytest.approx(OUTER, rel=1e-6)
    assert gm == pytest.approx(GM, rel=1e-5)
    np.testing.assert_allclose(orbit.at(times), outer, atol=1e-4)  # of 31 au


def table_of(path, times, **bodies):
    """A CSV of positions at the times."""
    names = [f"{body}_{x}_au" for body in bodies for x in "xyz"]
    rows = np.column_stack([times, *bodies.values()])
    np.savetxt(path, rows, delimiter=",", header=",".join(["t_day", *names]), comments="")


def test_section_of_the_page(tmp_path):
    """With the exact pull of a body of Neptune's mass the page's table says that nothing is apart, and draws it."""
    times, inner, outer = circles()
    sun = np.full_like(inner, 0.003)
    (tmp_path / "uranus").mkdir()
    table_of(tmp_path / "uranus" / "known_bodies.csv", times, sun=sun)
    table_of(tmp_path / "uranus" / "truth_neptune.csv", times, neptune=outer + sun)
    series = {
        "1/fitted_times": times,
        "1/position": inner + sun,
        "1/force_before": GM_NEPTUNE / GM * pull(inner, outer),
    }
    result = Result(Case("uranus"), f"[parameters]\ngm_sun = {GM_SUN}", {}, series)
    text = uranus_section(Page("uranus", ""), result, Source(tmp_path, tmp_path), tmp_path)
    rows = {line.split(" | ")[0][2:]: line.split(" | ") for line in text.splitlines() if line.startswith("| ")}
    assert rows["when the pull was strongest"][3].startswith("+0.0 years")
    for words in ("direction from Uranus, right ascension and declination", "direction from the Sun, by the circle"):
        assert rows[words][3].startswith("0.0°")
    assert float(rows["distance from the Sun, au"][1]) == pytest.approx(OUTER, rel=1e-3)  # four digits are printed
    assert rows["mass of the Sun, in that of the body"][3].startswith(("+0.0%", "-0.0%"))
    assert (tmp_path / "uranus-sky.png").read_bytes().startswith(b"\x89PNG")


def test_directions_on_the_sky():
    """Axes of the equator and the pole of the ecliptic, whose coordinates every almanac has."""
    assert on_the_sky(np.array([0.0, 2.0, 0.0])) == pytest.approx((90.0, 0.0))
    assert on_the_sky(np.array([-1.0, -1.0, np.sqrt(2.0)])) == pytest.approx((225.0, 45.0))
    assert ecliptic_longitude(np.array([1.0, 0.0, 0.0])) == 0.0
    solstice = np.array([0.0, np.cos(np.radians(23.4392911)), np.sin(np.radians(23.4392911))])
    assert ecliptic_longitude(solstice) == pytest.approx(90.0)


def test_lines_and_how_they_are_seen():
    """Periods of two swings are found; a period shorter than the sampling appears where aliasing puts it."""
    times = np.arange(0.0, 50_000.0, 50.0)
    force = np.stack([np.sin(2 * np.pi * times / 8.7), np.cos(2 * np.pi * times / 400.0), 0 * times], 1)
    found = lines(times, force, 2)
    # A peak of the spectrum, padded eightfold, is known to a sixteenth of 1/50,000 days.
    assert found == pytest.approx(sorted([seen_period(8.7, 50.0), 400.0]), rel=400 / 50_000 / 16)
    np.testing.assert_allclose(np.sin(2 * np.pi * times / 8.7),
                               -np.sin(2 * np.pi * times / seen_period(8.7, 50.0)), atol=1e-9)  # fmt: skip


def test_merging_joins_equal_times(tmp_path):
    """Rows are joined where the key is the same text, to the digit, whatever their order; a missing one is refused."""
    (tmp_path / "a.csv").write_text("# a comment\nt,x\n0,1.50\n1,2.5\n")
    (tmp_path / "b.csv").write_text("y,t\n7,1\n8e-10,0\n")
    (tmp_path / "out").mkdir()
    (joined,) = prepared([tmp_path / "a.csv", tmp_path / "b.csv"], {"how": "merged", "by": "t"}, tmp_path / "out")
    assert joined.read_text() == "t,x,y\n0,1.50,8e-10\n1,2.5,7\n"
    with pytest.raises(InputError, match="t = 1"):
        merged([(["t", "x"], [["1", "2"]]), (["t", "y"], [["0", "3"]])], by="t")


def test_rows_chosen_and_windows_cut():
    """Runs are chosen by their value; windows hold the rows from their start on, thinned and numbered."""
    header, rows = ["run", "t"], [["1", "0.0"], ["2", "0.5"], ["2", "1.0"], ["3", "1.5"]]
    assert chosen([(header, rows)], "run", [2, 3]) == (header, rows[1:])
    cut = windows([(header, rows)], "t", [0.0, 1.0], 1.0)
    assert cut == (["window", *header], [["1", *rows[0]], ["1", *rows[1]], ["2", *rows[2]], ["2", *rows[3]]])
    assert windows([(header, rows)], "t", [0.0], 2.0, every=3)[1] == [["1", *rows[0]], ["1", *rows[3]]]
