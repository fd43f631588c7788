"""The page and the lines for the terminal say what the document says, offline, and obey no file."""

import dataclasses
import html
import io
import re

import pytest
import report_cases as cases
from rich.console import Console

from symplearn.report import html_report, summary
from symplearn.report._equation import equation_pairs, parts

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
        "Held-out misfit by what is expected, angle_deg": [fit["holdout_misfit"]["angle_deg"] for fit in fits],
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
        fit |= {"holdout_rmse": {ATTACK: 1.0}, "holdout_misfit": {ATTACK: 1.0}, "noise_sd": {ATTACK: 1.0}}
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


def test_a_loss_that_is_too_strong_was_not_left_out():
    """Where a finding takes from a known loss, the headline says that there is too much of it."""
    answer = cases.document()
    answer["findings"][0]["coefficients"]["c"] |= {"mean": -0.0009, "interval95": [-0.00094, -0.00086]}
    page = html_report(cases.damped_pendulum(document=answer, series=()))
    assert "The simulation has too much viscous damping on theta (probability 93.1 %)." in page
    answer["findings"].append({**answer["findings"][0], "effect": "constant_force", "coefficients": {}})
    page = html_report(cases.damped_pendulum(document=answer, series=()))
    assert "left something out or has too much: too much viscous damping on theta, constant force on theta" in page


def test_unexplained_names_nothing():
    """Where no effect has the better of it, the page says that none does."""
    answer = cases.document() | {"verdict": "unexplained", "findings": []}
    page = html_report(cases.damped_pendulum(document=answer, series=()))
    assert "no effect with a name explains it (probability 93.1 %)" in page
    assert "No effect with a name explains the difference" in text_of(page, "findings")
    assert "process noise alone) (reported)" in text_of(page, "remains")


@pytest.mark.parametrize(("key", "said"), [("converged", "did not converge"), ("complete", "cut short")])
def test_what_is_not_to_be_relied_on_is_said_first(key, said, tmp_path):
    """Neither page nor terminal shows a failed fit, or a search that was cut short, as a success."""
    answer = cases.document() | {key: False}
    record = cases.damped_pendulum(document=answer, series=())
    page = html_report(record)
    assert page.index(said) < page.index('<section id="where">')
    assert said in printed(record, tmp_path).splitlines()[1]


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


def test_the_table_calls_a_coefficient_as_its_sentence_does():
    """The place of a stop on the coordinate `a` has an index; its stiffness has none."""
    numbers = {name: {"mean": 1.0, "sd": 0.1, "interval95": [0.8, 1.2]} for name in ("k", "a")}
    diagnosis = cases.damped_pendulum()
    stop = diagnosis.document["findings"][0] | {"effect": "contact_stop", "target": "a", "coefficients": numbers}
    page = html_report(
        dataclasses.replace(diagnosis, coordinates=("a",), document=diagnosis.document | {"findings": [stop]})
    )
    assert [row[0] for row in rows_of(page, "findings")][1:] == ["k", "a_0"]


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
