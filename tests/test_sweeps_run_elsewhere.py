"""Sweeps done by the workers of a cluster leave the files that they leave here, and go on where they were stopped."""

import importlib
import math
import pickle
import sys
from functools import partial

import equinox as eqx
import pytest
from command_line_cases import ROOT

from symplearn._errors import InputError
from symplearn._places import Here, Outcome

sys.path.insert(0, str(ROOT))  # experiments are no installed package
_cluster = importlib.import_module("experiments._cluster")
_concealed_run = importlib.import_module("experiments._concealed_run")
_ensemble = importlib.import_module("experiments._ensemble")
_pendulum_case = importlib.import_module("experiments._pendulum_case")
_realisations = importlib.import_module("experiments._realisations")
Run = importlib.import_module("experiments._command").Run
double_pendulum = importlib.import_module("experiments.double_pendulum")
tao = importlib.import_module("experiments.tao")

SWEEPS = (
    "calibration", "cherry", "concealed", "controlled_pendulum", "double_pendulum", "henon_heiles", "linear_pendulum",
    "markov_parameters", "noise_starts", "nonlinear_pendulum", "samplers", "tao",
)  # fmt: skip
MADE = []


@pytest.fixture
def workers(monkeypatch):
    """A cluster whose work is done in this process: whoever asks for one is given it."""
    monkeypatch.setattr(_cluster, "Cluster", lambda address, tell: Here())
    MADE.clear()


def realisation(run, k, settings="settings"):
    """A realisation that counts how often it is made, and fails where k is negative."""

    def make():
        MADE.append(run.out)
        return {"root": math.sqrt(k)}

    return _realisations.kept(run, "root", abs(k), settings, make)


def test_realisations_are_kept_as_here_and_made_once(workers, tmp_path):
    """Results come in order, each made in a folder of its own; a second run makes nothing, and here is the same."""
    there, here = Run(tmp_path / "there", scheduler="tcp://HOST:8786"), Run(tmp_path / "here")
    jobs = [partial(realisation, k=k) for k in (3, 1, 2)]
    found = list(_realisations.realisations(there, jobs))
    assert [one["root"] for one in found] == [math.sqrt(k) for k in (3, 1, 2)]
    assert len(MADE) == 3 and there.out not in MADE
    assert list(_realisations.realisations(there, jobs)) == found and len(MADE) == 3
    here.out.mkdir()
    assert list(_realisations.realisations(here, jobs)) == found
    assert _cluster.files_in(there.out) == _cluster.files_in(here.out)


def test_what_fails_is_told_and_the_rest_is_kept(workers, tmp_path):
    """One sentence counts the parts that failed; the same command then makes those alone."""
    run = Run(tmp_path, scheduler="tcp://HOST:8786")
    jobs = [partial(realisation, k=k) for k in (4, -1, 9)]
    with pytest.raises(InputError, match="1 of 3 parts failed, the first as ValueError: .*; what is done is kept"):
        list(_realisations.realisations(run, jobs))
    with pytest.raises(InputError, match="1 of 1 parts failed"):
        list(_realisations.realisations(run, jobs))
    assert len(MADE) == 4 and len(_cluster.files_in(tmp_path)) == 2


def numbered(seed, cell, k):
    """A data set, made up."""
    MADE.append((cell.n, k))
    return {"k": k, "seed": seed}


def test_blocks_are_kept_as_here_and_made_once(workers, tmp_path):
    """Every block of data sets of a cell is a part, and leaves the file of here; a second run makes none."""
    cells, there, here = [_pendulum_case.Cell(n, 0.1) for n in (8, 9)], *(Run(tmp_path / name) for name in "th")
    blocks = partial(_pendulum_case.each_block, cells=cells, datasets=4, size=2, settings="so")
    here.out.mkdir()
    found = blocks(here, one=partial(numbered, 5))
    assert [one["k"] for one in found[cells[1]]] == [0, 1, 2, 3]
    there = there._replace(scheduler="tcp://HOST:8786")
    assert blocks(there, one=partial(numbered, 5)) == found == blocks(there, one=partial(numbered, 5))
    assert MADE[8:] == MADE[:8] and len(_cluster.files_in(there.out)) == 4
    assert _cluster.files_in(there.out) == _cluster.files_in(here.out)


def of_its_place(run):
    """A realisation whose settings are others at a worker, as those of another version are."""
    return realisation(run, 4, f"for {run.scheduler}")


def test_workers_of_another_version_are_told(workers, tmp_path):
    """What is brought and is no result of these settings is one sentence; nothing is made here in its stead."""
    with pytest.raises(InputError, match="other settings; start them in a checkout of this version"):
        list(_realisations.realisations(Run(tmp_path, scheduler="tcp://HOST:8786"), [of_its_place]))
    assert len(MADE) == 1 and tmp_path not in MADE


def test_a_part_is_imported_as_its_experiment_is(tmp_path, monkeypatch):
    """Constants of a module are single at a worker, though parts before it have turned to double precision."""
    (tmp_path / "singular.py").write_text(
        "import jax.numpy as jnp\n\nTENTH = jnp.asarray(0.1)\n\n\n"
        "def told(run):\n    return str(TENTH.dtype), str(jnp.asarray(0.1).dtype)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    part = pickle.dumps(importlib.import_module("singular").told)
    monkeypatch.delitem(sys.modules, "singular")
    assert _cluster.apart(part, Run(tmp_path), {})[0] == ("float32", "float64")


def test_a_file_sent_back_lies_in_its_folder(tmp_path):
    """A path that leads out of the folder is refused, and nothing is written there."""
    with pytest.raises(InputError, match="does not lie in"):
        _cluster.put_all(tmp_path / "out", {"../elsewhere": b"x"})
    assert not (tmp_path / "elsewhere").exists()


def test_the_trial_counts_a_lost_case_and_tries_it_again(tmp_path, monkeypatch):
    """A case whose workers died counts as crashed, is not kept, and is diagnosed by the next run alone."""
    cases = [tmp_path / name for name in ("case_001", "case_002")]
    for case in cases:
        case.mkdir()
        for name in _concealed_run.PUBLIC:
            (case / name).write_text(case.name)
    seen = []

    class Losing(Here):
        def outcomes(self, work, cases):
            for outcome in super().outcomes(work, cases):
                seen.append(cases[outcome.number][0]["recording.csv"])
                lost = len(seen) == 1
                yield Outcome(outcome.number, failure="every worker that was at it died") if lost else outcome

    monkeypatch.setattr(_concealed_run, "apart", lambda files, jobs: {"status": "done", "of": sorted(files)})
    run = partial(_concealed_run.every_at, Losing(), cases, tmp_path / "kept", False, lambda line: None)
    first, second = run(), run()
    assert [one["status"] for one in first] == ["crashed", "done"] and first[0]["told"].endswith("died")
    assert [one["status"] for one in second] == ["done", "done"] and second[1] == first[1]
    assert seen == [b"case_001", b"case_002", b"case_001"]
    assert second[0]["of"] == ["recording.csv", "simulation.toml"]


def test_a_training_goes_on_from_what_was_begun(workers, tmp_path, monkeypatch):
    """Every n is a part of its own, the longest first; what a training has begun goes with it until it is done."""
    settings = tao.Settings(((0.0, 300), (0.0, 400)), (), (), repeats=1, width=2, epochs=20, depth=2)
    run, told = Run(tmp_path, scheduler="tcp://HOST:8786"), []
    (tmp_path / "parts").mkdir()

    def train(settings, group, seed, folder, seal, deadline):
        told.append((group, sorted(path.name for path in folder.iterdir()), deadline.left() > 0))
        begun = folder / f"{group[0]}_l1.npz"
        if deadline.left() <= 0:
            begun.write_bytes(b"half")
        else:
            begun.unlink(missing_ok=True)
            tao.Checkpoint(folder / f"n_{group[0]}.npz", seal).save(tao._blank(settings, group[0]))

    monkeypatch.setattr(tao, "_train", train)
    assert tao.study(settings, run, tao.Deadline(0.0)) == {}
    assert sorted(tao.study(settings, run, tao.Deadline())) == [300, 400]
    assert told == [
        ([400], [], False),
        ([300], [], False),
        ([400], ["400_l1.npz"], True),
        ([300], ["300_l1.npz"], True),
    ]
    assert sorted(_cluster.files_in(tmp_path)) == ["parts/n_300.npz", "parts/n_400.npz"]
    tao.study(settings, run, tao.Deadline())
    assert len(told) == 4


class OneBlock(_ensemble.Deadline):
    """Comes after one block of a training, unless it is over already."""

    @property
    def moment(self):
        self.blocks -= 1
        return math.inf if self.blocks >= 0 else -math.inf

    @moment.setter
    def moment(self, value):
        self.blocks = int(value > -math.inf)


def test_ways_go_on_from_what_was_begun(workers, tmp_path, monkeypatch):
    """Every way is a part; what is begun goes with it until it is done, and is then the file of here, and read here."""
    settings = double_pendulum.Settings(readings=11, repeats=1, width=2, epochs=20, piece=2, batch=4)
    there, here, begun = *(Run(tmp_path / name) for name in "th"), []
    study, done = partial(double_pendulum.study, settings), dict.fromkeys(double_pendulum.WAYS, "trained")

    def advance(ensemble, state, count):
        begun.append(int(state.epoch.max()))
        return eqx.tree_at(lambda state: state.epoch, state, state.epoch + count)

    monkeypatch.setattr(_ensemble, "_advance", advance)
    monkeypatch.setattr(_ensemble, "_best", lambda ensemble, state: "trained")
    for run in (there, here):
        run.out.mkdir()
    there = there._replace(scheduler="tcp://HOST:8786")
    with monkeypatch.context() as brief:
        brief.setattr(double_pendulum, "Deadline", OneBlock)
        assert study(there, _ensemble.Deadline()) == {} and begun == 4 * [0]
    assert study(there, _ensemble.Deadline()) == done and begun.count(0) == begun.count(1) == 4
    count = len(begun)
    assert study(there, _ensemble.Deadline()) == done and len(begun) == count
    assert study(here, _ensemble.Deadline()) == done and begun.count(0) == 8
    assert _cluster.files_in(there.out) == _cluster.files_in(here.out)


@pytest.mark.parametrize("name", SWEEPS)
def test_a_wrong_address_is_one_sentence(name, tmp_path, capsys):
    """Of every command with a sweep: exit code 2 before anything is drawn or made, the folder included."""
    arguments = ["--out", str(tmp_path / "out"), "--quick", "--scheduler", "nonsense"]
    with pytest.raises(SystemExit) as stopped:
        importlib.import_module(f"experiments.{name}").main(arguments)
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert stopped.value.code == 2 and said.startswith(f"experiments.{name}: --scheduler: `nonsense` is no address")
    assert not any(tmp_path.iterdir())
