"""The page and the lines for the terminal say what the document says, offline, and obey no file."""

import dataclasses
import html
import io
import re

import numpy as np
import pytest
import report_cases as cases
from PIL import Image
from rich.console import Console

from symplearn._vocabulary import VOCABULARY
from symplearn.report import html_report, summary
from symplearn.report._decimate import envelope
from symplearn.report._equation import equation_pairs, parts
from symplearn.report._force import missing
from symplearn.report._law import Motion, added_force
from symplearn.report._motion import channel, close_up_window, motion_panels
from symplearn.report._palette import AFTER, BEFORE, READING, SHADE
from symplearn.report._panel import limits
from symplearn.report._units import coefficient_unit

ATTACK = "<script>alert('x')</script>\"onload=\"$\\frac{1}{0}$ [red]{{7*7}}\u202e"


@pytest.fixture(scope="module")
def page():
    """The report of the damped pendulum."""
    return html_report(cases.damped_pendulum(forecast=cases.forecast()))


def text_of(page, section=None):
    """What a reader sees, without tags, of a section or of all."""
    if section:
        page = re.search(rf'<section id="{section}">.*?</section>', page, re.DOTALL).group()
    page = re.sub(r"<(style|title)>.*?</\1>", "", page, flags=re.DOTALL)
    return " ".join(html.unescape(re.sub(r"<[^>]*>", " ", page)).split())


def rows_of(page, section):
    """Cells of the tables of a section."""
    page = re.search(rf'<section id="{section}">.*?</section>', page, re.DOTALL).group()
    rows = re.findall(r"<tr>(.*?)</tr>", page, re.DOTALL)
    return [[html.unescape(cell) for cell in re.findall(r"<t[dh]>(.*?)</t[dh]>", row)] for row in rows]


def printed(diagnosis, path, **options):
    """The lines of the terminal."""
    file = io.StringIO()
    Console(file=file, width=300, **options).print(summary(diagnosis, path))
    return file.getvalue()


def test_sections_come_in_order(page):
    """Verdict first; then where, what, equations, pictures, numbers, remainder, what to record next."""
    order = ["where", "findings", "equations", "pictures", "numbers", "remains", "next"]
    assert re.findall(r'<section id="(\w+)">', page) == order
    verdict = "The simulation left something out: viscous damping on theta (probability 93.1 %)."
    assert 0 < page.index(verdict) < page.index('<section id="where">')


def test_numbers_are_those_of_the_document(page):
    """Each number of the fit, the parameters and the coefficients is the document's, to the digits shown."""
    document = cases.document()
    rows = {row[0]: row[1:] for row in rows_of(page, "numbers")}
    fits = [document["fit"][when] for when in ("before", "after")]
    expected = {
        "Held-out rmse, angle_deg [°]": [fit["holdout_rmse"]["angle_deg"] for fit in fits],
        "Held-out log density [nats]": [fit["holdout_log_density"] for fit in fits],
        "Process noise, p": [fit["process_noise_sd"]["p"] for fit in fits],
        "Reading noise, angle_deg [°]": [fit["noise_sd"]["angle_deg"] for fit in fits],
        "F": [document["parameters"][when]["F"]["mean"] for when in ("before", "after")],
    }
    for name, values in expected.items():
        shown = [float(cell.split(" ± ")[0]) for cell in rows[name][:2]]
        # Four significant digits: half a unit in the fourth is at most 5e-4 of the number.
        assert shown == pytest.approx(values, rel=5e-4)
    assert float(rows["Held-out rmse, angle_deg [°]"][2]) == pytest.approx(14.532 / 0.61234, rel=5e-3)
    name, mean, sd, ends, unit = rows_of(page, "findings")[1]
    assert (name, float(mean)) == ("c", pytest.approx(0.00090321, rel=5e-4))
    assert float(sd) == pytest.approx(0.0000213, rel=5e-2)
    assert [float(end) for end in ends.split(" to ")] == [0.00086, 0.00094]
    assert unit == "kg·m²/(s·rad)"
    assert cases.SENTENCE in text_of(page, "findings")


def test_every_alternative_is_listed(page):
    """The table of what was weighed has the reported one, every alternative, and the rest."""
    assert rows_of(page, "remains")[1:] == [
        ["viscous damping on theta (reported)", "93.1 %"],
        ["quadratic drag on theta, coulomb friction on theta", "5.12 %"],
        ["something without a name (process noise alone)", "1.01 %"],
        ["nothing left out", "less than 0.1 %"],
        ["all other combinations together", "0.75 %"],
    ]


def test_equations_stand_whole_and_only_the_new_is_marked(page):
    """Both equations are there letter by letter, and the marked letters are exactly the added term."""
    record = cases.damped_pendulum()
    codes = [html.unescape(re.sub(r"</?mark>", "", code)) for code in re.findall(r"<code>(.*?)</code>", page)]
    assert codes == [*record.equation_before, *record.equation_after]
    assert re.findall(r"<mark>(.*?)</mark>", page) == [" - 0.0009032*p/J"]


def test_parts_of_an_equation_are_the_equation():
    """Whatever is marked, the parts put together are the new equation, of any length."""
    long = " + ".join(f"k*x**{n}" for n in range(2000))
    for old, now in [
        ("", "a"),
        ("a*b", "a*b"),
        ("x + y", "c*x + y - 2.5e-3*z"),
        (long, long + "-f"),
        ("a", ""),
    ]:
        cut = parts(old, now)
        assert "".join(part.text for part in cut) == now
        assert any(part.new for part in cut) == (now not in (old, ""))


def test_the_page_needs_nothing_else(page):
    """No address, script, link or import: pictures are inside, and the page forbids itself the rest."""
    assert not re.search(r"https?:|<script|<link|<iframe|@import|url\(|\son\w+=", page, re.IGNORECASE)
    assert set(re.findall(r'src="([^,]*),', page)) == {"data:image/png;base64"}
    assert "default-src 'none'" in page


def test_texts_of_files_are_only_texts(tmp_path):
    """A title, column, coordinate, unit, recording or sentence made to break out is shown, not obeyed."""
    record = hostile()
    page = html_report(record)
    assert "<script" not in page.lower() and "\u202e" not in page
    assert not re.search(r"<[^>]*onload=\"\$", page)
    assert text_of(page).count("<script>alert('x')</script>") >= 8
    assert "{{7*7}}" in text_of(page)
    lines = printed(record, tmp_path, force_terminal=True, color_system="truecolor")
    assert "[red]" in lines and "\\u202e" in lines and "\x1b]0;" not in lines


def hostile():
    """The damped pendulum with hostile words in every text that comes from a file."""
    answer = cases.document()
    answer["location"] |= {"where": ATTACK, "targets": [ATTACK]}
    answer["findings"][0] |= {
        "sentence": ATTACK + "\x1b]0;owned\x07",
        "target": ATTACK,
        "effect": "sensor_bias",
    }
    answer["warnings"] = [ATTACK]
    answer["next_measurement"] = ATTACK
    for fit in answer["fit"].values():
        fit |= {"holdout_rmse": {ATTACK: 1.0}, "noise_sd": {ATTACK: 1.0}}
    one = dataclasses.replace(cases.series(rows=60, end=4.0), name=ATTACK)
    return cases.damped_pendulum(
        title=ATTACK,
        document=answer,
        columns=(ATTACK,),
        coordinates=("theta",),
        units={ATTACK: ATTACK, "t": ATTACK, "theta": ATTACK},
        equation_before=(ATTACK,),
        equation_after=(ATTACK + " + b",),
        series=(one, one),
    )


def test_consistent_is_said_calmly(tmp_path):
    """Where nothing was left out, the page says so, without findings or before and after; null is a dash."""
    record = cases.consistent()
    page = html_report(record)
    assert "The simulation agrees with the recording; nothing needs to be added (probability 98.8 %)." in page
    assert 'id="findings"' not in page and "<mark>" not in page
    assert "After" not in text_of(page, "numbers")
    assert ["Held-out rmse, angle_deg [°]", "–"] in rows_of(page, "numbers")
    assert "None" not in text_of(page) and "nan" not in text_of(page).lower()
    lines = printed(record, tmp_path)
    assert "nothing needs to be added" in lines and "->" not in lines


def test_an_unlikely_consistent_does_not_claim_agreement():
    """Where nothing left out is merely not ruled out, the sentence does not say that all is well."""
    record = cases.consistent()
    record.document["probability"] = 0.08
    assert "rules out neither" in html_report(dataclasses.replace(record, series=()))


def test_unexplained_names_nothing():
    """Where no effect has the better of it, the page says that none does."""
    answer = cases.document() | {"verdict": "unexplained", "findings": []}
    page = html_report(cases.damped_pendulum(document=answer, series=()))
    assert "no effect with a name explains it (probability 93.1 %)" in page
    assert "No effect with a name explains the difference" in text_of(page, "findings")
    assert "process noise alone) (reported)" in text_of(page, "remains")


def test_a_fit_that_did_not_converge_is_said_first(tmp_path):
    """Neither page nor terminal shows a failed fit as a success."""
    answer = cases.document() | {"converged": False}
    record = cases.damped_pendulum(document=answer, series=())
    page = html_report(record)
    assert page.index("did not converge") < page.index('<section id="where">')
    assert "did not converge" in printed(record, tmp_path).splitlines()[1]


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


def test_units_of_coefficients_follow_from_the_law():
    """A force is p / t and a speed q / t; where a unit is unknown, nothing is said."""
    record = cases.damped_pendulum(units={"theta": "m", "p": "N", "t": "s", "angle_deg": "V"})
    expected = {
        ("viscous_damping", "c"): "N/m",
        ("quadratic_drag", "c"): "N·s/m²",
        ("coulomb_friction", "f"): "N/s",
        ("constant_force", "f"): "N/s",
        ("linear_stiffness", "k"): "N/(m·s)",
        ("cubic_stiffness", "k"): "N/(m³·s)",
        ("impulse", "j"): "N",
        ("impulse", "t_star"): "s",
        ("viscous_damping", "k"): None,
        ("unnamed_force", "expression"): None,
    }
    for (effect, name), unit in expected.items():
        assert coefficient_unit({"effect": effect, "target": "theta"}, record, name) == unit
    assert coefficient_unit({"effect": "sensor_bias", "target": "angle_deg"}, record, "b") == "V"
    assert coefficient_unit({"effect": "sensor_drift", "target": "angle_deg"}, record, "r") == "V/s"
    assert coefficient_unit({"effect": "sensor_gain", "target": "angle_deg"}, record, "g") == ""
    unknown = dataclasses.replace(record, units={"theta": "m"})
    assert coefficient_unit({"effect": "viscous_damping", "target": "theta"}, unknown, "c") is None


def test_every_coefficient_of_a_finding_has_its_row():
    """Pairs, sides, coefficients with their own units, and recordings that an effect is not in, are all said."""
    page = html_report(cases.two_masses())
    rows = [row for row in rows_of(page, "findings") if row[0] != "Coefficient"]
    assert rows == [
        ["k", "3.1", "0.1", "2.9 to 3.3", "N/m"],
        ["k", "40", "2", "36 to 44", "N/m"],
        ["a", "0.7", "0.01", "0.68 to 0.72", "m"],
        ["side", "lower", "–", "–", ""],
        ["a", "0.2", "0.02", "0.16 to 0.24", "N"],
        ["omega", "2.1", "0.01", "2.08 to 2.12", "rad/s"],
        ["phi", "0.3", "0.05", "0.2 to 0.4", "rad"],
        ["expression", "-0.1*x**3", "–", "–"],
    ]
    headings = re.findall(
        r"<h3>(.*?)</h3>", re.search(r'<section id="findings">.*?</section>', page, re.DOTALL).group()
    )
    assert headings == [
        "coupling spring between x and y",
        "lower contact stop on y in recording 2 only",
        "periodic forcing on x",
        "unnamed force on x",
    ]
    where = text_of(page, "where")
    assert "On x and y, y, x" in where
    assert "0 to 3 s in recording 1; 1.5 to 3 s in recording 2" in where
    assert "parameter drift of m, sensor bias of left in recording 1 only" in text_of(page, "remains")


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


def test_new_equations_do_not_shift_the_old_ones():
    """A line that has no like before is new as a whole; the others keep their partner."""
    before = ("H = p**2/2", "dp/dt = -dH/dq", "y = q")
    after = ("H = p**2/2", "dp/dt = -dH/dq + 0.4 z", "dz/dt = P_z", "y = 1.1 (q)", "scatter of y: sd -> 2 sd")
    pairs = equation_pairs(before, after)
    assert [old for old, _ in pairs] == ["H = p**2/2", "dp/dt = -dH/dq", "", "y = q", ""]
    assert ["".join(part.text for part in now) for _, now in pairs] == list(after)
    assert pairs[2][1] == [("dz/dt = P_z", True)]
    assert pairs[0][1] == [("H = p**2/2", False)]


def test_the_terminal_says_it_in_a_few_plain_lines(tmp_path):
    """Verdict, sentence, rmse with its factor, next recording, warnings, report; in a file no colours."""
    answer = cases.document() | {"warnings": ["thinned from 4000 rows"]}
    lines = printed(cases.damped_pendulum(document=answer), tmp_path).splitlines()
    assert lines == [
        "The simulation left something out: viscous damping on theta (probability 93.1 %).",
        f"Where: {answer['location']['where']}",
        f"  * {cases.SENTENCE}",
        "Held-out rmse of angle_deg: 14.5 -> 0.612 ° (23.7 times smaller)",
        f"Record next: {answer['next_measurement']}",
        "Warning: thinned from 4000 rows",
        f"Report: {tmp_path / 'report.html'}",
    ]


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


def test_very_short_recordings_are_drawn():
    """One held-out row, or none at all and a single reading, make a page without a complaint."""
    one = cases.series(rows=40, end=4.0)
    short = dataclasses.replace(one, boundary=float(one.times[-2]))
    rows = {name: getattr(one, name)[:1] for name in ("times", "readings", "before", "after")}
    single = dataclasses.replace(one, boundary=0.0, **rows)
    page = html_report(cases.damped_pendulum(series=(short, single)))
    assert page.count("<img") == 4 + 2 + 3 + 1
