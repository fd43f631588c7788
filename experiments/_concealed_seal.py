"""Answers under seal: canonical JSON, a SHA-256 for each case and one for all, written before the first diagnosis."""

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

SEALS = "seals.json"


class BrokenSeal(Exception):
    """An answer is not the one that was sealed."""


def canonical(document: Mapping[str, Any]) -> bytes:
    """The one way to write a document: sorted keys, no spaces, numbers that read back exactly. NaN is refused."""
    return json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def put(path: Path, content: bytes) -> None:
    """Write a file whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    unfinished.write_bytes(content)
    os.replace(unfinished, path)


def total(seals: Mapping[str, str]) -> str:
    """SHA-256 over all cases' lines in their order."""
    return hashlib.sha256("".join(f"{name} {seals[name]}\n" for name in sorted(seals)).encode()).hexdigest()


def seal(folder: Path, names: list[str], settings: Mapping[str, Any]) -> dict[str, Any]:
    """Hash the answers in `folder` and store the hashes beside them; those of an earlier run must be the same."""
    seals = {name: hashlib.sha256((folder / f"{name}.json").read_bytes()).hexdigest() for name in names}
    found = {"settings": dict(settings), "cases": seals, "total": total(seals)}
    path = folder / SEALS
    if path.exists():
        before = json.loads(path.read_text(encoding="utf-8"))
        if before != found:
            raise BrokenSeal(f"{path}: the answers are not those that were sealed; give another --out")
    put(path, canonical(found))
    return found


def opened(folder: Path, name: str) -> dict[str, Any]:
    """An answer, its bytes checked against the seal."""
    seals = json.loads((folder / SEALS).read_text(encoding="utf-8"))
    content = (folder / f"{name}.json").read_bytes()
    if hashlib.sha256(content).hexdigest() != seals["cases"][name] or total(seals["cases"]) != seals["total"]:
        raise BrokenSeal(f"{folder / name}.json is not the answer that was sealed")
    return json.loads(content)
