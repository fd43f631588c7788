"""The output folder: checked before the long work, and files that appear in it complete or not at all."""

import os
import secrets
from collections.abc import Mapping
from pathlib import Path

from .._errors import InputError, shown

OUTPUTS = ("forecast.csv", "augmented.toml", "report.html", "diagnosis.json")


def prepare_directory(path: str | Path) -> Path:
    """Makes the output folder and tries it with a file that is removed again.

    **Raises:** `InputError` where it is no folder, cannot be made or cannot be written.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = _temporary(path, "probe")
        with open(probe, "xb"):
            pass
        probe.unlink()
        occupied = [name for name in OUTPUTS if (path / name).is_dir()]
    except (OSError, ValueError) as error:
        raise InputError(f"output folder {shown(path, 200)}: {_reason(path, error)}") from None
    if occupied:
        raise InputError(
            f"output folder {shown(path, 200)}: {occupied[0]} in it is a folder where a file is to be "
            f"written; remove it or give another folder with --out"
        )
    return path


def _reason(path: Path, error: OSError | ValueError) -> str:
    """What is wrong, and what to do."""
    if isinstance(error, FileExistsError):
        return "a file of that name is in the way; give a folder with --out"
    if isinstance(error, NotADirectoryError):
        return "part of its path is a file; give a folder with --out"
    words = getattr(error, "strerror", None) or str(error)
    return f"it cannot be made or written ({words.lower()}); give one that can be written with --out"


def _temporary(directory: Path, name: str) -> Path:
    """A hidden name in the same folder, so that renaming never crosses file systems."""
    return directory / f".{name}.{secrets.token_hex(6)}.tmp"


def put(contents: Mapping[Path, bytes]) -> None:
    """Writes all files under temporary names, then renames them in order.

    Where one cannot be written, none is renamed; no temporary file is left.
    """
    waiting = {path: _temporary(path.parent, path.name) for path in contents}
    try:
        for path, content in contents.items():
            # Opened by name, not by mkstemp: the file gets the user's usual mode, not 0600.
            with open(waiting[path], "xb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        for path, temporary in waiting.items():
            os.replace(temporary, path)
    finally:
        for temporary in waiting.values():
            temporary.unlink(missing_ok=True)
