"""What is known of a recording before any run: `gallery/NAME/page.toml`, with the simulations beside it."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from symplearn._errors import InputError

PAGES = Path(__file__).parent / "gallery"


@dataclass(frozen=True)
class Known:
    """One known fact, `about` in words, and what it is held against. One of the following is given:

    - `verdict`: the verdict that is right, or with `not ` before it the one that is wrong.
    - `family`: a family of effects that is certainly there, or with `absent` certainly not.
    - `open`: a family of which this recording does not tell the law, so that none may be called certain.
    - `effects`: effects, as `name` or `name(target)`, one of which is there; with `all` each of them.
    - `only`: effects beside which nothing should be named.
    - `moment`: a time that the location holds in a window no longer than `value`.
    - `coefficient`: as `effect.coefficient`, which is `value`.
    - `parameter`: a calibrated parameter, which is `value`. Both may be known as a range from `value` to `upper`.
    - `column`: a recorded column, on whose held-out rows the best known law leaves an error of `value`, by a fit from
        elsewhere; what is reported should be within `factor` of it.
    """

    about: str
    verdict: str | None = None
    family: str | None = None
    absent: bool = False
    open: str | None = None
    effects: tuple[str, ...] = ()
    all: bool = False
    only: tuple[str, ...] = ()
    moment: float = 0.0
    coefficient: str | None = None
    parameter: str | None = None
    column: str | None = None
    value: float = float("nan")
    upper: float | None = None
    factor: float = 1.5


@dataclass(frozen=True)
class Case:
    """One diagnosis: its files, its options, and what is known to be the answer.

    `simulation` lies beside page.toml or in the recordings' folder; `replace` puts other words in its text. `prepare`
    is how the recordings are given (see `_gallery_prepare`), as they are by default. `limit`, where it is not 0, cuts
    the search short after so many seconds. `brief` leaves a line in the
    page's table and no section of its own.
    """

    name: str
    label: str = ""
    simulation: str = "simulation.toml"
    recordings: tuple[str, ...] = ("recording.csv",)
    holdout: float = 0.25
    limit: float = 0.0
    replace: Mapping[str, str] = field(default_factory=dict)
    prepare: Mapping[str, Any] = field(default_factory=dict)
    brief: bool = False
    picture: int = 1
    known: tuple[Known, ...] = ()


@dataclass(frozen=True)
class Page:
    """A page of the gallery: what is known, from where, what was given, and its diagnoses.

    `extra` names a section that only this page has; without `cases` the page says in `given` why there is none.
    """

    name: str
    title: str
    known: str = ""
    source: str = ""
    given: str = ""
    open: str = ""
    extra: str = ""
    cases: tuple[Case, ...] = ()


def read_page(name: str, folder: Path) -> Page:
    """The page of the recording `name` in `folder`; a plain one where nobody has written down what is known.

    **Raises** `InputError` where page.toml has a key that nothing reads.
    """
    path = PAGES / name / "page.toml"
    if not path.is_file():
        return _plain(name, folder)
    table = tomllib.loads(path.read_text(encoding="utf-8"))
    place = f"gallery/{name}/page.toml"
    cases = tuple(_case(entry, place) for entry in table.pop("cases", []))
    return _filled(Page, {"name": name, **table, "cases": cases}, place)


def simulation_text(name: str, case: Case, folder: Path) -> str:
    """The simulation of a case, as it is given."""
    beside = PAGES / name / case.simulation
    text = (beside if beside.is_file() else folder / name / case.simulation).read_text(encoding="utf-8")
    for old, new in case.replace.items():
        if old not in text:
            raise InputError(f"gallery/{name}/page.toml: {old!r} is to be replaced, but {case.simulation} has it not")
        text = text.replace(old, new)
    return text


def _plain(name: str, folder: Path) -> Page:
    known = "Nothing is written down here about this recording; see the README beside it."
    files = sorted(path.name for path in (folder / name).glob("recording*.csv*"))
    if not (folder / name / "simulation.toml").is_file() or not files:
        return Page(name, name, known, given="No simulation lies beside it, so nothing was diagnosed.")
    cases = tuple(Case(_stem(file), file, recordings=(file,)) for file in files)
    return Page(name, name, known, given="The simulation that lies beside the recording.", cases=cases)


def _stem(file: str) -> str:
    return file.removesuffix(".gz").removesuffix(".csv")


def _case(entry: dict[str, Any], place: str) -> Case:
    facts = [_listed(_listed(one, "effects"), "only") for one in entry.pop("known", [])]
    known = tuple(_filled(Known, fact, place) for fact in facts)
    return _filled(Case, {**_listed(entry, "recordings"), "known": known}, place)


def _listed(entry: dict[str, Any], key: str) -> dict[str, Any]:
    return entry | ({key: tuple(entry[key])} if key in entry else {})


def _filled(kind: Any, values: Mapping[str, Any], place: str) -> Any:
    names = {one.name for one in fields(kind)}
    wrong = next((key for key in values if key not in names), None)
    if wrong is not None:
        raise InputError(f"{place}: unknown key {wrong!r}; one of {', '.join(sorted(names))} is needed")
    return kind(**values)
