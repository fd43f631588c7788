"""Many recordings, each a question of its own to one simulation: diagnosed here or on a cluster, kept one by one."""

import hashlib
import tempfile
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

from ._errors import InputError, shown
from ._places import AbstractPlace
from ._private_cache import prepare
from ._recording import read_recordings
from ._simulation_file import parse_simulation
from .diagnosis import Options, Restriction, diagnose
from .report import prepare_directory, write_outputs
from .report._directory import put
from .report._verdict import verdict_sentence

_SEAL = "question.sha256"
_ENDINGS = (".gz", ".csv")


class Settings(NamedTuple):
    """How each is diagnosed, as in `Options`, and whether compiled programs are kept."""

    holdout: float
    seed: int
    restriction: Restriction
    jobs: int
    time_limit: float
    cache: bool = True

    @property
    def options(self) -> Options:
        """As the diagnosis takes them."""
        return Options(self.holdout, self.seed, self.restriction, self.jobs, self.time_limit)


class Question(NamedTuple):
    """A simulation and a recording, by the names and the contents of their files."""

    simulation_name: str
    simulation: bytes
    recording_name: str
    recording: bytes
    settings: Settings

    @property
    def seal(self) -> bytes:
        """A digest of all of it and of this version; threads do not change an answer."""
        digest = hashlib.sha256(f"{version('symplearn')} {self.settings._replace(jobs=1, cache=True)}".encode())
        for part in (self.simulation, self.recording_name.encode(), self.recording):
            digest.update(hashlib.sha256(part).digest())
        return digest.hexdigest().encode()


class Answered(NamedTuple):
    """What is known of a recording: its `verdict` in a sentence, or the `failure`; whether it was there before."""

    name: str
    verdict: str | None = None
    failure: str | None = None
    kept: bool = False


def diagnose_each(
    place: AbstractPlace, simulation: Path, recordings: Sequence[Path], out: Path, settings: Settings
) -> Iterator[Answered]:
    """Each recording's report in a folder of its own under `out`, as soon as it is done.

    An answer that is there already, to the same question by the same version, is not sought again.

    **Raises:** `InputError` where a file cannot be read or two recordings are of one name.
    """
    names = _names(recordings)
    told = simulation.name, _content(simulation)
    questions = [Question(*told, path.name, _content(path), settings) for path in recordings]
    todo = []
    for name, question in zip(names, questions, strict=True):
        if _is_kept(out / name, question):
            yield Answered(name, kept=True)
        else:
            todo.append((name, question))
    for outcome in place.outcomes(answered, [(question,) for _, question in todo]):
        name, question = todo[outcome.number]
        if outcome.failure is not None:
            yield _failed(out / name, outcome.failure)
            continue
        verdict, files = outcome.value
        folder = prepare_directory(out / name)
        put({folder / file: content for file, content in files.items()} | {folder / _SEAL: question.seal})
        yield Answered(name, verdict)


def answered(question: Question) -> tuple[str, dict[str, bytes]]:
    """The verdict in a sentence, and the files of the report."""
    prepare(question.settings.cache)
    with tempfile.TemporaryDirectory(prefix="symplearn-") as folder:
        path = Path(folder) / question.recording_name
        path.write_bytes(question.recording)
        try:
            file = parse_simulation(question.simulation.decode("utf-8", "replace"), question.simulation_name)
            recordings = read_recordings(file, [path])
        except InputError as error:
            raise InputError(str(error).replace(f"{folder}/", "")) from None
        found = diagnose(file, recordings, question.settings.options)
        paths = write_outputs(found, prepare_directory(Path(folder) / "diagnosis"))
        # The JSON, which stands first, is to be put last.
        return verdict_sentence(found), {one.name: one.read_bytes() for one in reversed(paths)}


def _names(recordings: Sequence[Path]) -> list[str]:
    """A folder's name for each recording: its file's, without the ending."""
    names = []
    for path in recordings:
        name = path.name
        for ending in _ENDINGS:
            name = name.removesuffix(ending)
        if not name.strip("."):
            raise InputError(f"{shown(path, 200)}: its name makes no folder for its report; rename it")
        if name in names:
            raise InputError(
                f"{shown(path, 200)}: its report would be in the folder {shown(name)} as another's; rename it"
            )
        names.append(name)
    return names


def _failed(folder: Path, failure: str) -> Answered:
    """A failure, with a word on the answer to an earlier question that its folder may hold."""
    earlier = "; the report in its folder is an earlier one" if (folder / "diagnosis.json").is_file() else ""
    return Answered(folder.name, failure=failure + earlier)


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{shown(path, 200)[1:-1]}: {(error.strerror or str(error)).lower()}; give a file") from None


def _is_kept(folder: Path, question: Question) -> bool:
    seal = folder / _SEAL
    return seal.is_file() and (folder / "diagnosis.json").is_file() and seal.read_bytes() == question.seal
