"""A recording holds the rows of the file: the right ones, in order, with missing readings as NaN."""

import gzip

import numpy as np
import pytest
from real_recordings import real_case

from symplearn._errors import InputError
from symplearn._recording import read_recordings
from symplearn._simulation_file import parse_simulation, read_simulation


def simulation(recording="", observe='a = "q"'):
    return parse_simulation(
        f"""
[system]
coordinates = ["q"]
momenta = ["p"]
hamiltonian = "p**2/2 + q**2/2"
[recording]
time = "t"
{recording}
[recording.observe]
{observe}
""",
        "s.toml",
    )


def read(tmp_path, text, recording="", observe='a = "q"', name="r.csv"):
    path = tmp_path / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_recordings(simulation(recording, observe), [path])


def test_one_path_needs_no_list(tmp_path):
    """One file may be given by its path alone, in words or as a `Path`: no string is taken for its characters."""
    path = tmp_path / "r.csv"
    path.write_text("t,a\n" + "".join(f"{t},{t % 3}\n" for t in range(6)))
    for one in (path, str(path), [path], (str(path),)):
        (recording,) = read_recordings(simulation(), one)
        assert recording.times.tolist() == [0, 1, 2, 3, 4, 5]


PLAIN = "t,a\n0,1\n1,2\n2,\n3,NaN\n4,-5e-1\n"
TIMES, READINGS = [0, 1, 2, 3, 4], [1, 2, np.nan, np.nan, -0.5]


@pytest.mark.parametrize(
    "text",
    [
        PLAIN,
        PLAIN.replace("\n", "\r\n"),
        PLAIN.rstrip("\n"),
        "\ufeff" + PLAIN,
        "# made by hand\n" + PLAIN.replace("2,\n", "# a pause, of 1 s\n2,\n"),
        PLAIN.replace("t,a", '"t","a"').replace("1,2", '"1","2"'),
        PLAIN.replace(",", " , "),
        PLAIN.replace("2,\n", "\n  \n2,\n") + ",\n",
        "b,t,c,a\n" + "".join(f"x#,{row.split(',')[0]},NA,{row.split(',')[1]}\n" for row in PLAIN.split()[1:]),
        "b\u00e9,".encode("latin-1") + PLAIN.replace("\n", "\n,").rstrip(",").encode(),
    ],
    ids=["plain", "CRLF", "no end", "BOM", "comments", "quotes", "spaces", "blank", "others", "latin"],
)
def test_every_way_to_write_the_same_numbers(text, tmp_path):
    """Line ends, a byte-order mark, comments, quotes, blank lines and unused columns change nothing."""
    (recording,) = read(tmp_path, text)
    np.testing.assert_array_equal(recording.times, TIMES)
    np.testing.assert_array_equal(recording.readings[:, 0], READINGS)


def test_gzip(tmp_path):
    """A name that ends in .gz is read through gzip."""
    (recording,) = read(tmp_path, gzip.compress(PLAIN.encode()), name="r.csv.gz")
    np.testing.assert_array_equal(recording.readings[:, 0], READINGS)


def test_numbers_are_read_to_the_last_bit(tmp_path):
    """Every double survives being written with repr and read again, missing cells between them or not."""
    values = np.random.default_rng(0).standard_normal(5000) * 10.0 ** np.arange(-250, 250, 0.1)
    rows = [f"{i},{v!r}" for i, v in enumerate(values.tolist())]
    (recording,) = read(tmp_path, "\n".join(["t,a", *rows]))
    np.testing.assert_array_equal(recording.readings[:, 0], values)


def test_lines_are_the_files_own(tmp_path):
    """`lines` counts comments and blank lines too, as an editor does."""
    (recording,) = read(tmp_path, "# one\nt,a\n\n0,1\n# five\n1,2\n2,3\n")
    np.testing.assert_array_equal(recording.lines, [4, 6, 7])


def test_several_columns_keep_the_order_of_the_simulation(tmp_path):
    """Readings stand in the order of [recording.observe], whatever the file's order."""
    (recording,) = read(tmp_path, "b,t,a\n1,0,5\n,1,6\n3,2,7\n", observe='a = "q"\nb = "p"')
    assert recording.columns == ("a", "b")
    np.testing.assert_array_equal(recording.readings, [[5, 1], [6, np.nan], [7, 3]])


BALL = 'group = "run"\nwhere = { ball = "x" }\n'
UNEVEN = "t,u,a\n0,1,1\n1,1,2\n3,1,3\n"
GROUPED = "run,ball,t,a\n2,x,0,1\n2,x,1,2\n1,x,0,3\n2,y,5,9\n1,x,1,4\n2,x,2,5\n1,x,2,6\n"


def test_groups_are_numbered_as_met_files_first(tmp_path):
    """Group values are told apart in the order met, also where their rows alternate, file by file."""
    first, second = tmp_path / "a.csv", tmp_path / "b.csv"
    first.write_text(GROUPED)
    second.write_text(GROUPED)
    found = read_recordings(simulation('group = "run"\nwhere = { ball = "x" }'), [first, second])
    assert [r.number for r in found] == [1, 2, 3, 4]
    assert [r.name for r in found] == ["a.csv (run 2)", "a.csv (run 1)", "b.csv (run 2)", "b.csv (run 1)"]
    np.testing.assert_array_equal(found[0].readings[:, 0], [1, 2, 5])
    np.testing.assert_array_equal(found[1].readings[:, 0], [3, 4, 6])


def test_groups_by_two_columns(tmp_path):
    """A list of columns tells recordings apart by all their values."""
    found = read(tmp_path, GROUPED, 'group = ["run", "ball"]\nstart = { "2, x" = 1 }')
    assert [r.name for r in found] == [
        "r.csv (run 2, ball x)",
        "r.csv (run 1, ball x)",
        "r.csv (run 2, ball y)",
    ]
    np.testing.assert_array_equal(found[0].times, [1, 2])
    np.testing.assert_array_equal(found[1].times, [0, 1, 2])


def test_where_matches_text_and_numbers(tmp_path):
    """`where` takes rows with the same text, or with a number of the same value."""
    for wanted in ('"1"', "1", "1.0"):
        (recording,) = read(tmp_path, GROUPED, f"where = {{ run = {wanted} }}")
        np.testing.assert_array_equal(recording.readings[:, 0], [3, 4, 6])


def test_rows_left_out_by_where_are_not_read(tmp_path):
    """Text in a number column does no harm in rows that are not used."""
    text = GROUPED.replace("2,y,5,9", "2,y,five,broken")
    assert len(read(tmp_path, text, 'group = "run"\nwhere = { ball = "x" }')) == 2


def test_start_and_end_are_both_inside(tmp_path):
    """The window holds its own ends; by group value it may differ."""
    rows = "t,a\n" + "".join(f"{i},{i * i}\n" for i in range(10))
    (recording,) = read(tmp_path, rows, "start = 2\nend = 6")
    np.testing.assert_array_equal(recording.times, [2, 3, 4, 5, 6])
    found = read(tmp_path, GROUPED, 'group = "run"\nwhere = { ball = "x" }\nstart = { "1" = 1 }\nend = { "2" = 1 }')
    np.testing.assert_array_equal(found[0].times, [0, 1])
    np.testing.assert_array_equal(found[1].times, [1, 2])


def test_a_start_of_a_group_that_is_left_out_does_no_harm(tmp_path):
    """A start may be given for every group of the file, also for one of which `where` takes no row."""
    starts = 'where = { run = 1 }\ngroup = "run"\nstart = { "1" = 1, "2" = 0.5 }'
    (recording,) = read(tmp_path, GROUPED, starts)
    assert recording.name == "r.csv (run 1)"
    np.testing.assert_array_equal(recording.times, [1, 2])


def test_rows_after_the_last_reading_only_carry_inputs(tmp_path):
    """Future inputs are rows with empty observed cells: known to `inputs`, not among the used rows."""
    text = "t,u,a\n0,1,1\n1,2,\n2,3,4\n3,5,2\n4,7,\n5,9,\n6,,\n"
    (recording,) = read(tmp_path, text, 'inputs = ["u"]')
    np.testing.assert_array_equal(recording.times, [0, 1, 2, 3])
    np.testing.assert_array_equal(recording.inputs.times, [0, 1, 2, 3, 4, 5])
    np.testing.assert_array_equal(recording.inputs.at(np.array([4.5])), [[7]])
    with pytest.raises(InputError, match="inputs are needed at 7, .* from 0 to 5"):
        recording.inputs.at(np.array([7.0]))


def test_inputs_reach_outside_the_window(tmp_path):
    """Rows before `start` still tell what the input was."""
    text = "t,u,a\n" + "".join(f"{i},{i},{i * i}\n" for i in range(10))
    (recording,) = read(tmp_path, text, 'inputs = ["u"]\ninterpolation = "linear"\nstart = 4\nend = 7')
    np.testing.assert_allclose(recording.inputs.at(np.array([1.5, 8.25])), [[1.5], [8.25]])


@pytest.mark.parametrize(
    ("text", "recording", "reason"),
    [
        (GROUPED, 'group = "run"', r"r.csv \(run 2\), line 7, column `t`: the time goes back"),
        (GROUPED, "", "line 4.*the time repeats|line 4.*goes back"),
        (GROUPED, 'group = "rnu"', "no column `rnu`; did you mean `run`"),
        (GROUPED, 'where = { ball = "z" }', "none has `ball = z`"),
        (GROUPED, BALL + 'start = { "3" = 1 }', "no group has the value `3`"),
        (GROUPED, 'where = { run = 1 }\ngroup = "run"\nend = { "3" = 1 }', "no group has the value `3`; known are `1`"),
        (GROUPED, BALL + "start = 7", "no row lies between start = 7"),
        (PLAIN, "start = 2\nend = 3", "all readings of the rows used are missing"),
        (GROUPED.replace("1,x,1", ",x,1"), BALL, "line 6, column `run`: no group"),
        (UNEVEN, 'inputs = ["u"]\ninterpolation = "bandlimited"', "not evenly spaced near t = 1"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_choice_of_rows(text, recording, reason, tmp_path):
    """A window, group or value that does not fit the file is told with what would fit."""
    with pytest.raises(InputError, match=reason):
        read(tmp_path, text, recording)


def test_a_term_of_an_absent_recording(tmp_path):
    """A term's recordings are among those given."""
    path = tmp_path / "r.csv"
    path.write_text(PLAIN)
    text = '[[terms]]\neffect = "viscous_damping"\ntarget = "q"\nc = 1\nrecordings = [1, 2]'
    with pytest.raises(InputError, match=r"\[\[terms\]\] 1 recordings: there is no recording 2"):
        read_recordings(simulation(observe='a = "q"\n' + text), [path])


def test_one_constant_column_beside_one_that_moves(tmp_path):
    """A reading that stays the same is information where another one moves."""
    (recording,) = read(tmp_path, "t,a,b\n0,1,5\n1,2,5\n2,1,5\n", observe='a = "q"\nb = "p"')
    assert recording.readings.shape == (3, 2)


@pytest.mark.recordings
@pytest.mark.parametrize(
    ("folder", "file", "rows", "first", "last"),
    [
        ("pendulum_two_balls", "recording.csv", 20_186, 1.5, 35.245),
        ("pendulum_encoder", "recording.csv", 60_001, 4.6, 64.6),
        ("silverbox_duffing", "recording.csv.gz", 131_072, 0.0, 214.7471616),
    ],
)
def test_real_recordings(folder, file, rows, first, last):
    """Real recordings are read whole, with the window of the simulation beside them."""
    simulation_path, path = real_case(folder, file)
    (recording,) = read_recordings(read_simulation(simulation_path), [path])
    assert len(recording.times) == rows
    # 1e-3: the window's ends lie on rows a millisecond or two apart.
    np.testing.assert_allclose(recording.times[[0, -1]], [first, last], atol=1e-3)
