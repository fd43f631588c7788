"""Wrong files are refused with one sentence naming the file, quickly, and with nothing but InputError."""

import errno
import gzip
import random
import re
import time

import pytest

from symplearn._errors import InputError
from symplearn._recording import read_recordings
from symplearn._simulation_file import parse_simulation, read_simulation

GOOD = """
title = "Pendulum"
[system]
coordinates = ["theta"]
momenta = ["p_theta"]
hamiltonian = "p_theta**2/(2*m*l**2) - m*g*l*cos(theta)"
[parameters]
m = 0.1
g = 9.81
l = { value = 0.30, sd = 0.01 }
[initial]
theta = { value = 1.0, sd = 0.1 }
p_theta = 0.0
[forces]
p_theta = "m*u"
[recording]
time = "t_s"
inputs = ["u"]
[recording.observe]
angle = "theta"
[recording.noise]
angle = 0.01
[integrator]
name = "auto"
step = 0.01
[[terms]]
effect = "viscous_damping"
target = "theta"
c = 0.03
"""
ROWS = ["t_s,u,angle", *(f"{0.1 * i:.1f},0.5,{(i * 37 % 11) / 10}" for i in range(20))]


def changed(old, new):
    assert old in GOOD
    return GOOD.replace(old, new)


TOML = {
    "not TOML": "this is not TOML",
    "open string": 'title = "abc',
    "doubled key": GOOD + '\n[system]\ncoordinates = ["x"]\n',
    "empty": "",
    "blank": "  \n\n ",
    "comment only": "# nothing\n",
    "nested lists": "a = " + "[" * 5000 + "]" * 5000,
    "huge integer": changed("m = 0.1", "m = 1" + "0" * 400),
    "endless integer": changed("m = 0.1", "m = " + "9" * 5000),
    "bad date": changed("m = 0.1", "m = 2024-13-45"),
    "unknown section": GOOD + "\n[sytem]\na = 1\n",
    "unknown key": changed("hamiltonian =", "hamiltonain ="),
    "unknown recording key": changed('time = "t_s"', 'time = "t_s"\nstrat = 1'),
    "unknown prior key": changed("sd = 0.01", "std = 0.01"),
    "unknown integrator key": changed("step = 0.01", "stepp = 0.01"),
    "no system": GOOD[: GOOD.index("[system]")] + GOOD[GOOD.index("[parameters]") :],
    "no recording": GOOD.split("[recording]")[0],
    "no momenta": changed('momenta = ["p_theta"]\n', ""),
    "no hamiltonian": changed('hamiltonian = "p_theta**2/(2*m*l**2) - m*g*l*cos(theta)"\n', ""),
    "no time": changed('time = "t_s"\n', ""),
    "no observe": changed('[recording.observe]\nangle = "theta"\n', ""),
    "empty observe": changed('angle = "theta"\n', ""),
    "system a number": GOOD.replace("[system]\n", "system = 3\n[x]\n"),
    "coordinates text": changed('coordinates = ["theta"]', 'coordinates = "theta"'),
    "coordinates of numbers": changed('["theta"]', "[1]"),
    "no coordinates": changed('["theta"]', "[]").replace('momenta = ["p_theta"]', "momenta = []"),
    "coordinate without momentum": changed('["theta"]', '["theta", "phi"]'),
    "coordinate twice": changed('["theta"]', '["theta", "theta"]').replace('["p_theta"]', '["p_theta", "q"]'),
    "coordinate is momentum": changed('["p_theta"]', '["theta"]'),
    "parameter is coordinate": changed("m = 0.1", "theta = 0.1"),
    "input is parameter": changed('inputs = ["u"]', 'inputs = ["m"]'),
    "reserved t": changed("m = 0.1", "t = 0.1"),
    "reserved sin": changed("m = 0.1", "sin = 0.1"),
    "reserved pi": changed('["u"]', '["pi"]'),
    "bad name": changed("m = 0.1", '"m-1" = 0.1'),
    "unicode name": changed('["theta"]', '["θ"]'),
    "newline name": changed('["theta"]', '["a\\nb"]'),
    "empty name": changed('["theta"]', '[""]'),
    "undeclared": changed("m*g*l*cos", "m*gg*l*cos"),
    "code": changed("cos(theta)", "__import__('os').system('true')"),
    "attribute": changed("cos(theta)", "theta.__class__"),
    "tower": changed("cos(theta)", "9**9**9**9"),
    "ten thousand brackets": changed("cos(theta)", "(" * 10_000 + "theta" + ")" * 10_000),
    "1 MB expression": changed("cos(theta)", "theta+" * 160_000 + "theta"),
    "2 MB file": GOOD + "#" * 2_000_000,
    "hamiltonian a number": GOOD.replace('"p_theta**2/(2*m*l**2) - m*g*l*cos(theta)"', "3"),
    "constant hamiltonian": GOOD.replace('"p_theta**2/(2*m*l**2) - m*g*l*cos(theta)"', '"m*g"'),
    "empty hamiltonian": GOOD.replace('"p_theta**2/(2*m*l**2) - m*g*l*cos(theta)"', '""'),
    "parameter truth value": changed("m = 0.1", "m = true"),
    "parameter text": changed("m = 0.1", 'm = "0.1"'),
    "parameter date": changed("m = 0.1", "m = 2024-01-01"),
    "parameter list": changed("m = 0.1", "m = [0.1]"),
    "parameter inf": changed("m = 0.1", "m = inf"),
    "parameter nan": changed("m = 0.1", "m = nan"),
    "prior without value": changed("value = 0.30, ", ""),
    "sd zero": changed("sd = 0.01", "sd = 0"),
    "sd negative": changed("sd = 0.01", "sd = -1"),
    "sd inf": changed("sd = 0.01", "sd = inf"),
    "value below lower": changed("sd = 0.01", "lower = 0.5"),
    "value above upper": changed("sd = 0.01", "upper = 0.1"),
    "limits without room": changed("sd = 0.01", "lower = 0.4, upper = 0.2"),
    "a forcing that never comes round": GOOD
    + '[[terms]]\neffect = "periodic_forcing"\ntarget = "theta"\na = 1.0\nomega = 0\nphi = 0.0\n',
    "positive but negative": changed("value = 0.30", "value = -0.3, positive = true"),
    "positive a number": changed("sd = 0.01", "positive = 1"),
    "initial of unknown": changed("theta = { value = 1.0, sd = 0.1 }", "thta = 1"),
    "initial of parameter": changed("theta = { value = 1.0, sd = 0.1 }", "m = 1"),
    "force on coordinate": changed('p_theta = "m*u"', 'theta = "m*u"'),
    "force on unknown": changed('p_theta = "m*u"', 'p_thet = "m*u"'),
    "force a number": changed('p_theta = "m*u"', "p_theta = 1.0"),
    "force undeclared": changed("m*u", "m*v"),
    "observed undeclared": changed('angle = "theta"', 'angle = "thet"'),
    "observed constant": changed('angle = "theta"', 'angle = "m*u"'),
    "observed time": changed('angle = "theta"', 't_s = "theta"').replace("angle = 0.01", ""),
    "observed input": changed('angle = "theta"', 'u = "theta"').replace("angle = 0.01", ""),
    "noise of unobserved": changed("angle = 0.01", "angl = 0.01"),
    "noise zero": changed("angle = 0.01", "angle = 0"),
    "noise text": changed("angle = 0.01", 'angle = "a"'),
    "interpolation": changed('inputs = ["u"]', 'inputs = ["u"]\ninterpolation = "cubic"'),
    "start text": changed('time = "t_s"', 'time = "t_s"\nstart = "1"'),
    "start after end": changed('time = "t_s"', 'time = "t_s"\nstart = 2\nend = 1'),
    "start table without group": changed('time = "t_s"', 'time = "t_s"\nstart = { "1" = 2 }'),
    "group a number": changed('time = "t_s"', 'time = "t_s"\ngroup = 1'),
    "group empty": changed('time = "t_s"', 'time = "t_s"\ngroup = []'),
    "where truth value": changed('time = "t_s"', 'time = "t_s"\nwhere = { ball = true }'),
    "where a list": changed('time = "t_s"', 'time = "t_s"\nwhere = ["ball"]'),
    "integrator": changed('name = "auto"', 'name = "leapfrg"'),
    "step zero": changed("step = 0.01", "step = 0"),
    "step text": changed("step = 0.01", 'step = "small"'),
    "units a number": GOOD.replace("[integrator]", "[units]\nt = 1\n[integrator]"),
    "title a number": changed('title = "Pendulum"', "title = 3"),
    "terms a table": GOOD.replace("[[terms]]", "[terms]"),
    "term without effect": changed('effect = "viscous_damping"\n', ""),
    "unknown effect": changed("viscous_damping", "viscous_dampng"),
    "effect a list": changed('"viscous_damping"', '["viscous_damping"]'),
    "term without target": changed('target = "theta"\n', ""),
    "term of unknown target": changed('target = "theta"', 'target = "thet"'),
    "term of two targets": changed('target = "theta"', 'target = ["theta", "theta"]'),
    "term of column": changed('target = "theta"', 'target = "angle"'),
    "term without coefficient": changed("c = 0.03\n", ""),
    "term of other coefficient": changed("c = 0.03", "k = 0.03"),
    "term negative": changed("c = 0.03", "c = -0.03"),
    "term text": changed("c = 0.03", 'c = "0.03"'),
    "term prior wrong": changed("c = 0.03", "c = { value = 0.03, sd = 0 }"),
    "term prior key": changed("c = 0.03", "c = { vale = 0.03 }"),
    "term recordings": changed("c = 0.03", "c = 0.03\nrecordings = [0]"),
    "term recordings empty": changed("c = 0.03", "c = 0.03\nrecordings = []"),
    "term side": changed("c = 0.03", 'c = 0.03\nside = "lower"'),
    "noise term without noise": GOOD.replace("viscous_damping", "sensor_noise")
    .replace('target = "theta"', 'target = "angle"')
    .replace("c = 0.03", "s = 2")
    .replace("[recording.noise]\nangle = 0.01", ""),
}  # fmt: skip


def refused(call, name):
    """The one sentence with which `call` is refused."""
    begin = time.perf_counter()
    with pytest.raises(InputError) as error:
        call()
    sentence = str(error.value)
    assert time.perf_counter() - begin < 2  # seconds, the promise; on a free machine it is milliseconds
    assert name in sentence and "\n" not in sentence and sentence.isprintable()
    assert 20 < len(sentence) < 600
    return sentence


@pytest.mark.parametrize("text", TOML.values(), ids=TOML)
def test_wrong_simulation_files(text, tmp_path):
    """A wrong simulation file is refused in one sentence naming the file."""
    path = tmp_path / "pendulum.toml"
    path.write_text(text)
    refused(lambda: read_simulation(path), "pendulum.toml")


@pytest.mark.parametrize(
    ("case", "sentence"),
    [
        ("unknown key", r"\[system\] hamiltonain: unknown key; did you mean `hamiltonian`"),
        ("unknown prior key", r"\[parameters\] l.std: unknown key; did you mean `sd`"),
        ("unknown section", r"sytem: unknown key; did you mean `system`"),
        ("coordinate without momentum", r"\[system\]: 2 coordinates but 1 momenta"),
        ("undeclared", r"\[system\] hamiltonian: undeclared name `gg` at character 27"),
        ("parameter truth value", r"\[parameters\] m: the truth value true was given where a number is needed"),
        ("observed constant", r"\[recording.observe\] angle: does not depend on the state"),
        ("noise of unobserved", r"\[recording.noise\] angl: the column is not observed; did you mean `angle`"),
        ("unknown effect", r"\[\[terms\]\] 1 effect: unknown effect `viscous_dampng`; did you mean"),
        ("integrator", r"\[integrator\] name: unknown word `leapfrg`; did you mean `leapfrog`"),
        ("force on coordinate", r"\[forces\] theta: a force changes a momentum.*use `p_theta`"),
        ("no time", r"\[recording\] time: missing; name the column of times"),
    ],
)
def test_the_sentence_says_place_and_remedy(case, sentence):
    """The place in the file and what would be right are part of the sentence."""
    with pytest.raises(InputError, match=sentence):
        parse_simulation(TOML[case], "pendulum.toml")


def test_paths_that_are_no_simulation_file(tmp_path):
    """No file, a directory, foreign bytes, impossible paths: each is told by its name."""
    refused(lambda: read_simulation(tmp_path / "absent.toml"), "absent.toml")
    refused(lambda: read_simulation(tmp_path), tmp_path.name)
    refused(lambda: read_simulation(tmp_path / ("x" * 300)), "x" * 50)
    refused(lambda: read_simulation("nul\0.toml"), "nul")
    refused(lambda: read_simulation("http://localhost/a.toml"), "http")
    refused(lambda: read_simulation("line\nbreak.toml"), "line")
    foreign = tmp_path / "foreign.toml"
    foreign.write_bytes(b'title = "\xff\xfe"\n')
    assert "line 1" in refused(lambda: read_simulation(foreign), "foreign.toml")
    foreign.write_bytes(GOOD.encode("utf-16"))
    refused(lambda: read_simulation(foreign), "foreign.toml")


def row(number, text):
    return "\n".join([*ROWS[:number], text, *ROWS[number + 1 :]]) + "\n"


CSV = {
    "empty": ("", "empty"),
    "comments only": ("# a\n# b\n", "empty"),
    "header only": (ROWS[0] + "\n", "no rows"),
    "no column": ("\n".join(ROWS).replace("angle", "angel"), "did you mean `angel`"),
    "no time column": ("\n".join(ROWS).replace("t_s", "time"), "no column `t_s`"),
    "no input column": ("\n".join(ROWS).replace("u,", "v,"), "no column `u`"),
    "doubled header": ("t_s,u,angle,angle\n" + "\n".join(f"{r},1" for r in ROWS[1:]), "two columns"),
    "text in a number column": (row(5, "0.4,0.5,abc"), r"line 6, column `angle`: `abc` is not a number"),
    "text in time": (row(5, "x,0.5,0.3"), r"line 6, column `t_s`"),
    "NA": (row(5, "0.4,0.5,NA"), "`NA` is not a number; give a number .a missing reading is an empty cell"),
    "null": (row(5, "0.4,0.5,null"), "null"),
    "None": (row(5, "0.4,0.5,None"), "None"),
    "dash": (row(5, "0.4,0.5,-"), "`-` is not a number"),
    "hash": (row(5, "0.4,0.5,#3"), "#3"),
    "underscore": (row(5, "0.4,0.5,1_0"), "1_0"),
    "hexadecimal": (row(5, "0.4,0.5,0x1"), "0x1"),
    "arabic digits": (row(5, "0.4,0.5,٣"), "line 6"),
    "inf": (row(5, "0.4,0.5,inf"), "not finite"),
    "-Infinity": (row(5, "0.4,0.5,-Infinity"), "not finite"),
    "overflow": (row(5, "0.4,0.5,1e999"), "not finite"),
    "inf in time": (row(5, "inf,0.5,1"), "not finite"),
    "escape sequence": (row(5, "0.4,0.5,\x1b[31m"), "line 6"),
    "short row": (row(5, "0.4,0.5"), "line 6: 2 cells where the header has 3"),
    "long row": (row(5, "0.4,0.5,0.3,0.1"), "line 6: 4 cells.*decimal"),
    "time missing": (row(5, ",0.5,0.3"), "line 6, column `t_s`: the time is missing"),
    "time nan": (row(5, "nan,0.5,0.3"), "the time is missing"),
    "time repeats": (row(5, "0.3,0.5,0.3"), "line 6.*repeats"),
    "time goes back": (row(5, "0.2,0.5,0.3"), "line 6.*goes back"),
    "input missing": (row(5, "0.4,,0.3"), "line 6, column `u`: the input is missing"),
    "input text": (row(5, "0.4,a,0.3"), "line 6, column `u`"),
    "too few rows": ("\n".join(ROWS[:2]), "1 rows"),
    "all missing": ("t_s,u,angle\n" + "\n".join(f"{i},1," for i in range(20)), "missing"),
    "all nan": ("t_s,u,angle\n" + "\n".join(f"{i},1,NaN" for i in range(20)), "missing"),
    "constant": ("t_s,u,angle\n" + "\n".join(f"{i},1,0.5" for i in range(20)), "constant"),
    "semicolons": ("\n".join(ROWS).replace(",", ";"), "semicolons"),
    "tabs": ("\n".join(ROWS).replace(",", "\t"), "tabs"),
    "decimal commas": ("\n".join(ROWS[:1] + [r.replace(".", ",") for r in ROWS[1:]]), "decimal"),
    "quoted decimal comma": (row(5, '0.4,0.5,"0,3"'), "decimal mark"),
    "open quote": (row(5, '0.4,0.5,"0.3'), "line"),
    "text after a quote": (row(5, '0.4,0.5,"0.3"1'), "line 6"),
    "zero bytes": ("\0\0\0" + "\n".join(ROWS), "UTF-8"),
    "endless line": ("t_s,u,angle\n" + "1" * 2_000_000, "line 2"),
}  # fmt: skip


@pytest.mark.parametrize(("text", "reason"), CSV.values(), ids=CSV)
def test_wrong_recordings(text, reason, tmp_path):
    """A wrong recording is refused in one sentence naming file, line and column."""
    path = tmp_path / "swing.csv"
    path.write_text(text, newline="")
    simulation = parse_simulation(GOOD, "pendulum.toml")
    sentence = refused(lambda: read_recordings(simulation, [path]), "swing.csv")
    assert re.search(reason, sentence)


def test_files_of_one_name_are_told_apart(tmp_path):
    """Of two files called alike what is wrong in one is told by its folder, too."""
    simulation, folders = parse_simulation(GOOD, "pendulum.toml"), [tmp_path / "first", tmp_path / "second"]
    for folder, rows in zip(folders, (ROWS, [*ROWS[:-1], ROWS[1]]), strict=True):
        folder.mkdir()
        (folder / "swing.csv").write_text("\n".join(rows))
    refused(lambda: read_recordings(simulation, [folder / "swing.csv" for folder in folders]), "second/swing.csv")


def test_paths_that_are_no_recording(tmp_path):
    """No file, a directory, an address, broken and false gzip: each is told by its name."""
    simulation = parse_simulation(GOOD, "pendulum.toml")
    refused(lambda: read_recordings(simulation, [tmp_path / "absent.csv"]), "absent.csv")
    refused(lambda: read_recordings(simulation, [tmp_path]), tmp_path.name)
    refused(lambda: read_recordings(simulation, ["https://localhost/a.csv"]), "https")
    refused(lambda: read_recordings(simulation, ["nul\0.csv"]), "nul")
    refused(lambda: read_recordings(simulation, []), "pendulum.toml")
    packed = tmp_path / "swing.csv.gz"
    packed.write_text("\n".join(ROWS))
    assert "gzip" in refused(lambda: read_recordings(simulation, [packed]), "swing.csv.gz")
    packed.write_bytes(gzip.compress("\n".join(ROWS).encode())[:-20])
    assert "gzip" in refused(lambda: read_recordings(simulation, [packed]), "swing.csv.gz")
    packed.write_bytes(gzip.compress("\n".join(ROWS).encode()))
    unnamed = packed.rename(tmp_path / "packed.csv")
    assert ".csv.gz" in refused(lambda: read_recordings(simulation, [unnamed]), "packed.csv")
    utf16 = tmp_path / "wide.csv"
    utf16.write_bytes("\n".join(ROWS).encode("utf-16"))
    assert "UTF-8" in refused(lambda: read_recordings(simulation, [utf16]), "wide.csv")


def test_a_file_that_may_not_be_read(tmp_path, monkeypatch):
    """A file without permission is told so."""
    path = tmp_path / "secret.toml"
    path.write_text(GOOD)

    def forbidden(*arguments, **options):
        raise PermissionError(errno.EACCES, "Permission denied")

    # Not by the file's mode: root, as which CI runs, may read everything.
    monkeypatch.setattr("builtins.open", forbidden)
    refused(lambda: read_simulation(path), "secret.toml")


PIECES = [
    "",
    "0",
    "-1",
    "1e999",
    "nan",
    "inf",
    '"',
    "[",
    "]",
    "{",
    "}",
    "=",
    ",",
    "\n",
    "#",
    "\0",
    "é",
    "true",
    "**",
    "(",
]


def mutated(text, rng):
    """`text` with one to four random cuts, swaps and insertions."""
    for _ in range(rng.randint(1, 4)):
        begin = rng.randrange(len(text))
        end = min(len(text), begin + rng.choice([0, 1, 2, 5, 40]))
        piece = rng.choice([rng.choice(PIECES), text[begin:end] * 2, chr(rng.randrange(1, 0x2FF))])
        text = text[:begin] + piece + text[end:]
    return text or " "


def only_input_errors(call, name):
    try:
        call()
    except InputError as error:
        assert name in str(error) and str(error).isprintable()
        return 1
    return 0


def test_random_damage_to_a_simulation_file():
    """Four hundred damaged simulation files are read or refused; nothing else is ever raised."""
    rng = random.Random(20240)
    count = sum(
        only_input_errors(lambda: parse_simulation(mutated(GOOD, rng), "pendulum.toml"), "pendulum.toml")
        for _ in range(400)
    )
    assert 100 < count < 400  # damage to a title is harmless, most other damage is not


def test_random_damage_to_a_recording(tmp_path):
    """Four hundred damaged recordings are read or refused; nothing else is ever raised."""
    rng = random.Random(20241)
    simulation = parse_simulation(GOOD, "pendulum.toml")
    path = tmp_path / "swing.csv"

    def damaged():
        path.write_text(mutated("\n".join(ROWS), rng), newline="")
        return only_input_errors(lambda: read_recordings(simulation, [path]), "swing.csv")

    assert 100 < sum(damaged() for _ in range(400)) < 400
