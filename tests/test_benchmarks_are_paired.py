"""A speed is a median of paired ratios, of values that agree; results are strict JSON that a run goes on from."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import _command, _results, _row
from benchmarks._contest import Check, Contender, Spread, contest, paired_ratios, timed
from benchmarks._figures import growth, ratio_line
from benchmarks._operations import bytes_of_products, operations
from benchmarks._row import Disagreement, Effort, Line, Row
from benchmarks._rows import ROWS
from benchmarks._table import placed
from symplearn._lane_loops import with_lane_loops

ROOT = Path(__file__).parents[1]


def test_ratios_are_of_the_same_round():
    """Of times that drift together the ratio is constant, where the ratio of any two others is not."""
    drift = np.array([1.0, 3.0, 10.0, 2.0])
    assert paired_ratios(4.0 * drift, drift) == Spread(4.0, 4.0, 4.0, 4.0, 4.0)
    with pytest.raises(ValueError, match="longer"):
        paired_ratios([1.0], [1.0, 2.0])


def test_the_spread_is_that_of_the_order_statistics():
    """Of 1, 2, 4, 8, 16 the median is 4, the quartiles 2 and 8, the ends 1 and 16."""
    assert paired_ratios([8.0, 1.0, 16.0, 2.0, 4.0], [1.0] * 5) == Spread(4.0, 2.0, 8.0, 1.0, 16.0)


@pytest.mark.parametrize("exponent", [0.0, 0.5, 1.0, 3.0])
def test_growth_is_the_exponent_of_a_power_law(exponent):
    """Along a power law the fitted exponent is its own."""
    # Round-off of the logarithms, some 4e-15, and of the fit.
    assert growth({n: 7e-9 * n**exponent for n in (10, 100, 1000)}) == pytest.approx(exponent, abs=1e-12)


def test_contenders_take_turns():
    """Each contender runs once a round, every other round in the opposite order."""
    turns = []
    ready = {name: Contender(lambda name=name: turns.append(name)) for name in "ab"}
    # A turn of no length is one call.
    wall, cpu = timed(ready, Effort(quick=True), block=0.0)
    assert turns[2:] == list("abbaabbaab")  # one call of each before that says how many calls a turn has
    assert {name: len(times) for name, times in (wall | cpu).items()} == {"a": 5, "b": 5}


def test_who_disagrees_is_not_timed():
    """A value off by more than the tolerance, a gradient too, and NaN in either, are refused."""
    check, slope = Check(1e-6, 1e-5), np.array([1.0, -2.0])
    check("same", (1.0 + 1e-7, slope), (1.0, slope))
    for value, gradient in ((1.0 + 2e-6, slope), (1.0, slope + 1e-4), (np.nan, slope), (1.0, slope * np.nan)):
        with pytest.raises(Disagreement, match="is off by"):
            check("other", (value, gradient), (1.0, slope))


def test_a_contest_tells_the_ratio_to_the_first(capsys):
    """Every other contender has a ratio to the first, and a line meets a goal up to that ratio and none above it."""
    works = {name: lambda: Contender(lambda: 1.0) for name in ("ours", "other")}
    found = contest("case", works, {"other": Check(0.0)}, Effort(quick=True))
    assert list(found["contenders"]) == ["ours", "other"] and list(found["ratios"]) == ["other"]
    ratio = found["ratios"]["other"]["median"]
    assert ratio_line("case", found, "other", goal=ratio).met
    assert not ratio_line("case", found, "other", goal=1.01 * ratio).met
    assert "values agree" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["henon_hailes"], ["cherry", "nothing_like_it"]])
def test_unknown_rows_are_refused(arguments, capsys):
    """A name that is no row ends with exit code 2 and one sentence, and nothing is measured."""
    with pytest.raises(SystemExit) as left:
        _command.main(arguments)
    assert left.value.code == 2
    said = capsys.readouterr()
    assert said.err.count("\n") == 1 and "there is no row" in said.err and not said.out


def test_rows_without_their_peer_name_the_command_and_the_others_run(monkeypatch, capsys):
    """A row whose peer is not installed says which `make` installs it, once; the exit code is 2; the others run."""
    rows = (Row("alone", "needs nobody"), Row("against", "needs a peer", ("a_package_that_nobody_has",)))
    measured = pretend(monkeypatch, rows)
    with pytest.raises(SystemExit) as left:
        _command.main([])
    said = capsys.readouterr()
    assert left.value.code == 2 and measured == ["alone"]
    (sentence,) = [line for line in said.err.splitlines() if "make" in line]
    assert (
        sentence.startswith("benchmarks: against needs a_package_that_nobody_has") and "`make benchmarks`" in sentence
    )
    assert "a figure of alone" in said.out


def pretend(monkeypatch, rows, stop=None):
    """Rows that measure nothing; the names of those asked for. At `stop` the user presses Ctrl-C."""
    measured = []

    def measure(row, effort):
        if row.name == stop:
            raise KeyboardInterrupt
        measured.append(row.name)
        return {"lines": [Line(row.name, "none", f"a figure of {row.name}", met=True)], "seconds": 0.5}

    monkeypatch.setattr(Row, "measure", measure)
    # It takes the compile cache from every test that comes after.
    monkeypatch.setattr(_command, "_prepare", lambda: None)
    for module in (_command, _results):
        monkeypatch.setattr(module, "ROWS", rows)
    monkeypatch.setattr(_command, "row_of", {row.name: row for row in rows}.get)
    return measured


def strict(path):
    """The file as JSON without NaN and infinities."""
    return json.loads(path.read_text(encoding="utf-8"), parse_constant=pytest.fail)


def test_results_are_strict_json_that_a_stopped_run_goes_on_from(tmp_path, monkeypatch, capsys):
    """Ctrl-C keeps the rows that were done, the others are null, and the same command measures only those."""
    rows, path, table = tuple(Row(name, name) for name in "abc"), tmp_path / "found.json", tmp_path / "table.md"
    arguments = ["--json", str(path), "--markdown", str(table)]
    pretend(monkeypatch, rows, stop="b")
    with pytest.raises(SystemExit) as left:
        _command.main(arguments)
    assert left.value.code == 130 and str(path) in capsys.readouterr().err
    found = strict(path)["rows"]
    assert found["a"]["seconds"] == 0.5 and found["b"] is None and found["c"] is None
    assert "Not measured: b, c." in table.read_text(encoding="utf-8")
    measured = pretend(monkeypatch, rows)
    with pytest.raises(SystemExit) as left:
        _command.main(arguments)
    assert left.value.code == 0 and measured == ["b", "c"] and all(strict(path)["rows"].values())
    text = table.read_text(encoding="utf-8")
    assert [f"a figure of {name}" in text for name in "abc"] == [True] * 3 and "Not measured" not in text
    assert list(tmp_path.iterdir()) in ([path, table], [table, path])


def test_the_table_takes_its_place_in_a_page():
    """Between the marks of BENCHMARKS.md the table is replaced and the prose stays; a page of none is the table."""
    page = (ROOT / "BENCHMARKS.md").read_text(encoding="utf-8")
    once = placed(page, "table 1")
    assert placed(once, "table 2") == placed(page, "table 2") == once.replace("table 1", "table 2")
    assert once.splitlines()[0] == page.splitlines()[0] and once.splitlines()[-1] == page.splitlines()[-1]
    assert placed("", "table") == "table"


def test_nan_is_never_written(tmp_path, monkeypatch):
    """A row that finds no number fails, and the file keeps what it had."""
    path = tmp_path / "found.json"
    results = _results.Results(path, Effort())
    before = path.read_text(encoding="utf-8")
    monkeypatch.setattr(Row, "measure", lambda row, effort: {"lines": [], "seconds": float("nan")})
    with pytest.raises(ValueError, match="JSON compliant"):
        results.measure(ROWS[0], Effort())
    assert path.read_text(encoding="utf-8") == before


@pytest.mark.parametrize("text", ["no json", "[]", '{"rows": {}, "quick": true}'])
def test_a_file_of_something_else_is_refused(tmp_path, text, capsys):
    """Anything but results of this machine, these versions and these options is refused, and left as it is."""
    path = tmp_path / "found.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SystemExit) as left:
        _command.main(["--json", str(path), "cherry"])
    assert left.value.code == 2 and capsys.readouterr().err.count("\n") == 1
    assert path.read_text(encoding="utf-8") == text


def test_rows_are_listed(capsys):
    """`--list` tells every row with what it measures, and each has a module of its name."""
    _command.main(["--list"])
    listed = capsys.readouterr().out
    for row in ROWS:
        assert f"{row.name} " in listed and row.about in listed and (ROOT / "benchmarks" / f"{row.name}.py").exists()


def test_rows_of_a_card_are_left_out_where_there_is_none(monkeypatch):
    """Without a graphics card its rows are not among all rows; named, each says what it needs."""
    monkeypatch.setattr(_row, "card", lambda: None)
    monkeypatch.setattr(_command, "card", lambda: None)
    assert not any(row.on_card for row in _command._chosen([]))
    (row,) = _command._chosen(["card_chains"])
    assert row.missing == ["a graphics card that JAX computes on"]
    monkeypatch.setattr(_command, "card", lambda: "a card")
    assert _command._chosen([]) == list(ROWS)


def test_a_loop_of_many_lanes_counts_for_all_of_them():
    """Of sixteen lanes of machine code, of seven steps with one product each, there are 112 products."""

    def steps(x):
        return jax.lax.scan(lambda c, _: (c * x, None), x, length=7)[0]

    assert operations(jax.vmap(with_lane_loops(steps)), np.ones(16)) == 16 * 7


def test_bytes_of_products_are_those_of_their_arrays():
    """A product of matrices of 3 x 4 and 4 x 5 doubles moves 12 + 20 + 15 numbers, in seven steps seven times."""
    a, b = np.ones((3, 4)), np.ones((4, 5))

    def steps(a, b):
        return jax.lax.scan(lambda c, _: (c + jnp.sum(jnp.sin(a) @ b), None), 0.0, length=7)[0]

    assert bytes_of_products(steps, a, b) == 7 * 8 * (12 + 20 + 15)
    # Of each product 2 x 4 - 1 operations for 15 numbers, their sum and one addition; 12 sines.
    assert operations(steps, a, b) == 7 * (15 * 7 + 14 + 1 + 12)
