"""Files from which a stopped computation goes on: arrays alone, written whole or not at all, checked when read."""

import hashlib
import io
import os
import re
import zipfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from types import CellType, CodeType, FunctionType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from ._errors import InputError, shown

# Where an object lies in memory is part of how it is written, and another in each process.
_ADDRESS = re.compile(r" at 0x[0-9a-f]+")


class Checkpoint(NamedTuple):
    """A file of the arrays of a pytree, NumPy's npz without pickles; `seal` says what computation they belong to."""

    path: Path
    seal: str

    def save(self, state: PyTree) -> None:
        """Write the arrays, whole or not at all."""
        buffer = io.BytesIO()
        leaves = {f"leaf{i}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(state))}
        np.savez(buffer, seal=np.array(self.seal), **leaves)  # type: ignore[arg-type]
        unfinished = self.path.with_name(f".{self.path.name}.{os.getpid()}")
        try:
            unfinished.write_bytes(buffer.getbuffer())
            os.replace(unfinished, self.path)
        finally:
            unfinished.unlink(missing_ok=True)

    def load(self, like: PyTree) -> PyTree:
        """What was saved, in the shape of `like`; `like` itself where there is no file.

        **Raises:** `InputError` where the file is damaged, or of another computation.
        """
        leaves, structure = jax.tree.flatten(like)
        if not self.path.exists():
            return like
        try:
            # Of bytes: of a path, NumPy leaves a damaged file open.
            with np.load(io.BytesIO(self.path.read_bytes()), allow_pickle=False) as file:
                own = str(file["seal"]) == self.seal and len(file.files) == len(leaves) + 1
                arrays = [file[f"leaf{i}"] for i in range(len(leaves))] if own else []
        except (OSError, ValueError, KeyError, EOFError, TypeError, AttributeError, zipfile.BadZipFile) as error:
            raise InputError(f"The checkpoint {shown(self.path)} is damaged; remove it to start anew.") from error
        if not own or any(a.shape != b.shape or a.dtype != b.dtype for a, b in zip(arrays, leaves, strict=True)):
            raise InputError(
                f"The checkpoint {shown(self.path)} is of another computation; name another file, or remove it."
            )
        return jax.tree.unflatten(structure, [jnp.asarray(array) for array in arrays])


def seal_of(parts: PyTree, settings: str) -> str:
    """A digest of every leaf of `parts` with its place, of their structure, and of the settings in words.

    Of a function its instructions count, and what it holds: two of one name may be two priors. What a global name
    stands for does not.
    """
    leaves, structure = jax.tree_util.tree_flatten_with_path(parts)
    digest = hashlib.sha256(f"{settings} {_ADDRESS.sub('', str(structure))}".encode())
    for path, leaf in leaves:
        digest.update(jax.tree_util.keystr(path).encode())
        if not eqx.is_array(leaf):
            digest.update(_words_of(leaf, ()).encode())
            continue
        plain = _plain(leaf)
        digest.update(f"{plain.shape} {plain.dtype}".encode())
        digest.update(plain.tobytes())
    return digest.hexdigest()


def _plain(array: Any) -> np.ndarray:
    """The numbers of an array, those behind it if it is of keys."""
    return np.asarray(jax.random.key_data(array) if jnp.issubdtype(array.dtype, jax.dtypes.prng_key) else array)


def _words_of(thing: Any, above: tuple[Any, ...]) -> str:
    """What makes something another in writing; `above` are the functions that lead to it, which may hold themselves.

    Pickles by value (cloudpickle) would not do: they may differ from process to process, and nothing would go on.
    """
    if eqx.is_array(thing) or isinstance(thing, np.ndarray):
        return f"{thing.dtype} {_plain(thing).tolist()}"
    parts = _parts_of(thing)
    if parts is None or any(thing is one for one in above):
        return _ADDRESS.sub("", repr(thing))
    return f"{type(thing).__name__}({', '.join(_words_of(one, (*above, thing)) for one in parts)})"


def _parts_of(thing: Any) -> Sequence[Any] | None:
    """What something is made of that its own words may not tell."""
    match thing:
        case tuple() | list():
            return thing
        case dict():
            return list(thing.items())
        case frozenset() | set():
            return sorted(map(repr, thing))  # its own order is another in each process
        case eqx.Module():
            return jax.tree.leaves(thing) + [str(jax.tree.structure(thing))]
        case partial():
            return thing.func, thing.args, thing.keywords
        case CodeType():
            return thing.co_code.hex(), thing.co_names, thing.co_consts
        case FunctionType():
            # A cell that is not filled yet is of a function that is still being made.
            cells = [cell.cell_contents for cell in thing.__closure__ or () if cell != CellType()]
            return thing.__qualname__, thing.__code__, thing.__defaults__, thing.__kwdefaults__, cells
    inner = getattr(thing, "__wrapped__", None)  # of a function that jax.jit has taken
    return None if inner is None else (inner,)
