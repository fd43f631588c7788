"""The shape of a simulation file (contract, section 1), checked by pydantic and told in one sentence."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, TypeAdapter, ValidationError

from ._errors import InputError, nearest, shown
from ._simulation_records import Quantity

# Tags of unions appear in pydantic's locations; no key of a file can be mistaken for these.
_NUMBER, _TABLE, _TEXT, _LIST = "\0number", "\0table", "\0text", "\0list"
_TAGS = {_NUMBER, _TABLE, _TEXT, _LIST}

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Text = Annotated[str, Field(strict=True)]
Name = Annotated[str, Field(strict=True, min_length=1)]


class _Section(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)


class CalibratedTable(_Section):
    """`{ value, sd?, positive?, lower?, upper? }`."""

    value: Number
    sd: Number | None = None
    positive: bool = False
    lower: Number | None = None
    upper: Number | None = None


def _kind(value: Any) -> str:
    if isinstance(value, dict):
        return _TABLE
    return _TEXT if isinstance(value, str) else _LIST if isinstance(value, list) else _NUMBER


def _kind_of_columns(value: Any) -> str:
    return _LIST if isinstance(value, list) else _TEXT


def _kind_of_bound(value: Any) -> str:
    return _TABLE if isinstance(value, dict) else _NUMBER


QuantityEntry = Annotated[
    Annotated[Number, Tag(_NUMBER)] | Annotated[CalibratedTable, Tag(_TABLE)], Discriminator(_kind_of_bound)
]
BoundEntry = Annotated[
    Annotated[Number, Tag(_NUMBER)] | Annotated[dict[str, Number], Tag(_TABLE)], Discriminator(_kind_of_bound)
]
ColumnsEntry = Annotated[
    Annotated[Name, Tag(_TEXT)] | Annotated[Annotated[list[Name], Field(min_length=1)], Tag(_LIST)],
    Discriminator(_kind_of_columns),
]
CellEntry = Annotated[
    Annotated[Number, Tag(_NUMBER)] | Annotated[Text, Tag(_TEXT)],
    Discriminator(lambda v: _TEXT if isinstance(v, str) else _NUMBER),
]


class SystemSection(_Section):
    """`[system]`"""

    coordinates: Annotated[list[Name], Field(min_length=1)]
    momenta: Annotated[list[Name], Field(min_length=1)]
    hamiltonian: Text


class RecordingTable(_Section):
    """`[recording]`"""

    time: Name
    inputs: list[Name] = []
    interpolation: Literal["hold", "linear", "bandlimited"] = "hold"
    start: BoundEntry | None = None
    end: BoundEntry | None = None
    group: ColumnsEntry | None = None
    where: dict[str, CellEntry] = {}
    observe: Annotated[dict[str, Text], Field(min_length=1)]
    noise: dict[str, Number] = {}


class IntegratorTable(_Section):
    """`[integrator]`"""

    name: Literal["auto", "leapfrog", "tao"] = "auto"
    step: Number | None = None


class SimulationTable(_Section):
    """The whole file."""

    title: Text = ""
    system: SystemSection
    parameters: dict[str, QuantityEntry] = {}
    initial: dict[str, QuantityEntry] = {}
    forces: dict[str, Text] = {}
    recording: RecordingTable
    units: dict[str, Text] = {}
    integrator: IntegratorTable = IntegratorTable()
    terms: list[dict[str, Any]] = []


_QUANTITY: TypeAdapter[float | CalibratedTable] = TypeAdapter(QuantityEntry)
_SECTIONS: dict[tuple[str, ...], type[BaseModel]] = {
    (): SimulationTable,
    ("system",): SystemSection,
    ("recording",): RecordingTable,
    ("integrator",): IntegratorTable,
}
_SUBTABLES = {("recording", "observe"), ("recording", "noise"), ("recording", "where")}


def checked_table(data: Mapping[str, Any], file: str) -> SimulationTable:
    """The file's table in its right shape, or the first thing that is wrong with it as an `InputError`."""
    try:
        return SimulationTable.model_validate(data)
    except ValidationError as error:
        raise InputError(_sentence(error, file)) from None


def checked_quantity(value: Any, where: str) -> Quantity:
    """A number or a calibrated table, as a coefficient of a term is."""
    try:
        return quantity(_QUANTITY.validate_python(value), where)
    except ValidationError as error:
        first = _first(error)
        inner = [str(k) for k in first["loc"] if k not in _TAGS]
        place = ".".join([where, *map(_key, inner)])
        raise InputError(f"{place}: {_complaint(dict(first), inner, CalibratedTable)}") from None


def quantity(entry: float | CalibratedTable, where: str) -> Quantity:
    """A known number or a calibrated one whose prior makes sense."""
    if not isinstance(entry, CalibratedTable):
        return Quantity(float(entry))
    if entry.sd is not None and not entry.sd > 0:
        raise InputError(f"{where}: sd = {entry.sd:g} is not a standard deviation; give a number above zero")
    if entry.positive and not entry.value > 0:
        raise InputError(f"{where}: value = {entry.value:g} but positive = true; give a value above zero")
    lower, upper = entry.lower, entry.upper
    if lower is not None and upper is not None and not lower < upper:
        raise InputError(f"{where}: lower = {lower:g} and upper = {upper:g} leave no room; give lower < upper")
    # A value may stand on a limit, where a calibration leaves one that it would move further.
    if lower is not None and not entry.value >= lower or upper is not None and not entry.value <= upper:
        limits = f"{'' if lower is None else f'{lower:g} <= '}value{'' if upper is None else f' <= {upper:g}'}"
        raise InputError(f"{where}: value = {entry.value:g} is outside its limits; {limits} is needed")
    if entry.positive and upper is not None and upper <= 0:
        raise InputError(f"{where}: positive = true but upper = {upper:g}; give an upper limit above zero")
    return Quantity(entry.value, False, entry.sd, entry.positive, lower, upper)


def _first(error: ValidationError) -> Any:
    """The complaint to tell: an unknown key before a missing one, which it often explains (`hamiltonain`)."""
    errors = error.errors(include_url=False)
    return next((e for e in errors if e["type"] == "extra_forbidden"), errors[0])


def _sentence(error: ValidationError, file: str) -> str:
    first = _first(error)
    path = [k for k in first["loc"] if k not in _TAGS]
    keys = [str(k + 1) if isinstance(k, int) else str(k) for k in path]
    known = _SECTIONS.get(tuple(keys[:-1]), CalibratedTable)
    return f"{file}, {place(keys)}: {_complaint(dict(first), keys, known)}"


def place(keys: list[str]) -> str:
    """Where a key stands, as it is written in the file: `[recording.observe] angle`."""
    if not keys:
        return "top level"
    if tuple(keys[:2]) in _SUBTABLES:
        section, rest = ".".join(keys[:2]), keys[2:]
    elif len(keys) == 1 and keys[0] not in (
        "system",
        "recording",
        "parameters",
        "integrator",
        "initial",
        "forces",
    ):
        return _key(keys[0])
    else:
        section, rest = keys[0], keys[1:]
    brackets = f"[[{section}]]" if section == "terms" else f"[{section}]"
    return f"{brackets} {'.'.join(map(_key, rest))}" if rest else brackets


def _key(key: str) -> str:
    return shown(key, 60)[1:-1]


def _complaint(error: dict[str, Any], keys: list[str], section: type[BaseModel]) -> str:
    kind, given = error["type"], error.get("input")
    if kind == "extra_forbidden":
        return f"unknown key; {nearest(keys[-1], section.model_fields)}"
    if kind == "missing":
        return "missing; " + _REQUIRED.get(keys[-1] if keys else "", "it must be given")
    if kind == "finite_number":
        return f"{given} is not a finite number; give a finite one"
    if kind == "literal_error":
        return f"unknown word {shown(given)}; {nearest(str(given), _words(error))}"
    if kind == "too_short":
        return "is empty; name at least one"
    if kind == "float_type" and type(given) is int:
        return f"{shown(given, 20)} is too large for a double-precision number; give a smaller one"
    needed = _NEEDED.get(kind, error["msg"])
    return f"{_described(given)} was given where {needed} is needed"


def _words(error: dict[str, Any]) -> list[str]:
    expected = str(error["ctx"]["expected"])
    return [word.strip(" '") for word in expected.replace(" or ", ",").split(",")]


_REQUIRED = {
    "system": "a table [system] with coordinates, momenta and hamiltonian is needed",
    "recording": "a table [recording] with time and observe is needed",
    "coordinates": 'name the coordinates, such as coordinates = ["q"]',
    "momenta": 'name the momenta, such as momenta = ["p"]',
    "hamiltonian": 'give the Hamiltonian, such as hamiltonian = "p**2/2 + q**2/2"',
    "time": "name the column of times",
    "observe": "say what is observed: column = expression of the state",
    "value": "a calibrated number is written { value = .., sd = .. }",
}
_NEEDED = {
    "float_type": "a number",
    "string_type": "text in quotes",
    "string_too_short": "a name that is not empty",
    "list_type": "a list",
    "dict_type": "a table",
    "model_type": "a table",
    "model_attributes_type": "a table",
    "bool_type": "true or false",
}


def _described(value: Any) -> str:
    if isinstance(value, bool):
        return f"the truth value {str(value).lower()}"
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, list):
        return "a list"
    return f"the text {shown(value)}" if isinstance(value, str) else shown(value)
