"""Reading a simulation file (contract, section 1)."""

import tomllib
from pathlib import Path
from typing import Any

from ._errors import InputError, shown
from ._simulation_checks import checked_simulation
from ._simulation_records import IntegratorSection as IntegratorSection
from ._simulation_records import Quantity as Quantity
from ._simulation_records import RecordingSection as RecordingSection
from ._simulation_records import SimulationFile as SimulationFile
from ._simulation_records import Term as Term

LARGEST_FILE = 1_000_000  # bytes


def read_simulation(path: str | Path) -> SimulationFile:
    """The simulation file at `path`.

    **Raises** `InputError` in one sentence (file, place, what is wrong, what would be right) for anything
    that is not as the contract says.
    """
    name = shown(path, 200)[1:-1]
    return parse_simulation(_text(path, name), name)


def parse_simulation(text: str, name: str) -> SimulationFile:
    """The simulation file that `text` is; `name` is the file's name for sentences."""
    return checked_simulation(_parsed(text, name), name)


def _text(path: str | Path, name: str) -> str:
    try:
        with open(path, "rb") as file:
            content = file.read(LARGEST_FILE + 1)
    except IsADirectoryError:
        raise InputError(f"{name}: is a directory; give the simulation file (TOML) itself") from None
    except FileNotFoundError:
        raise InputError(f"{name}: no such file; give the path of a simulation file (TOML)") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{name}: cannot be read ({reason}); give the path of a simulation file (TOML)") from None
    if len(content) > LARGEST_FILE:
        raise InputError(f"{name}: is larger than {LARGEST_FILE:,} bytes; a simulation file is a short TOML text")
    if not content.strip():
        raise InputError(f"{name}: is empty; a simulation file (TOML) needs at least [system] and [recording]")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise InputError(f"{name}, line {line}: is not UTF-8 text; save the simulation file as UTF-8") from None


def _parsed(text: str, name: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise InputError(f"{name}: is nested too deeply to be a simulation file; see the contract's example") from None
    except ValueError as error:
        if "digits" in str(error):
            raise InputError(f"{name}: holds a number of thousands of digits; write it as 1.5e10 is") from None
        reason = str(error).removesuffix(".").replace("\n", " ")[:200]
        raise InputError(f"{name}: is not TOML ({reason}); correct the place named") from None
