"""From a module of code to machine code of this processor, kept where JAX keeps its compiled programs."""

import contextlib
import hashlib
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import jax
import llvmlite
import llvmlite.binding as llvm
from llvmlite import ir

_DIGEST = hashlib.sha256().digest_size


def compiled(module: ir.Module) -> Any:
    """The engine that holds the machine code of a module."""
    text, machine = str(module), _machine()
    code = _kept(text, lambda: _object_code(text, machine))
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _new_machine())
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    return engine


def _object_code(text: str, machine: Any) -> bytes:
    checked = llvm.parse_assembly(text)
    checked.verify()
    options = llvm.create_pipeline_tuning_options(speed_level=2)
    builder = llvm.create_pass_builder(machine, options)
    builder.getModulePassManager().run(checked, builder)
    return bytes(machine.emit_object(checked))


def _kept(text: str, make: Callable[[], bytes]) -> bytes:
    """Code from the folder of JAX's persistent cache, if there is one, or made and left there."""
    folder = jax.config.jax_compilation_cache_dir if jax.config.jax_enable_compilation_cache else None  # type: ignore[attr-defined]
    if not folder:
        return make()
    of = "\0".join((text, llvmlite.__version__, llvm.get_host_cpu_name(), _features()))
    path = Path(folder, f"symplearn-{hashlib.sha256(of.encode()).hexdigest()}.o")
    with contextlib.suppress(OSError):
        digest, code = (kept := path.read_bytes())[:_DIGEST], kept[_DIGEST:]
        if digest == hashlib.sha256(code).digest():  # a damaged file would end the process
            return code
    code, unfinished = make(), path.with_name(f".{path.name}.{os.getpid()}")
    with contextlib.suppress(OSError):  # a cache that cannot be written is none
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished.write_bytes(hashlib.sha256(code).digest() + code)
        os.replace(unfinished, path)
    return code


@cache
def span() -> int:
    """How many real numbers a register of this processor holds, as far as arrays are worked out by it."""
    _machine()
    return 8 if "+avx512f" in _features() else 4


@cache
def _machine() -> Any:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return _new_machine()


def _new_machine() -> Any:
    """What code is written for: an engine takes the one it is given."""
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=_features(), opt=2, jit=True
    )


@cache
def _features() -> str:
    return str(llvm.get_host_cpu_features().flatten())
