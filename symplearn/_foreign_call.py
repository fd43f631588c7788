"""Machine code that XLA calls within its own programs, by its foreign function interface (xla/ffi/api/c_api.h)."""

import ctypes
import re
from functools import cache
from pathlib import Path

import jax
from llvmlite import ir

# Offsets in bytes, in XLA's structs, which only ever grow at their ends: of a call's extensions, arguments and results;
# of an extension's kind and of what is to be filled in there; of a buffer's numbers.
_EXTENSION, _ARGUMENTS, _RESULTS = 8, 72, 112
_KIND, _METADATA, _MAJOR, _MINOR, _TRAITS, _STATE = 8, 24, 24, 28, 32, 40
_DATA = 24
_REGISTER = 64
# The kind of an extension that asks for the version of the interface.
_ASKS = 1
_BYTE, _SHORT, _LONG = ir.IntType(8), ir.IntType(32), ir.IntType(64)
POINTER = _BYTE.as_pointer()
POINTERS = POINTER.as_pointer()


def handler(module: ir.Module, work: ir.Function) -> None:
    """Add the function `called`, of the kind that XLA calls, to a module. It answers what is asked of its version, and
    otherwise gives the pointers to the buffers of arguments and of results to `work`."""
    function = ir.Function(module, ir.FunctionType(POINTER, [POINTER]), "called")
    (frame,), build = function.args, ir.IRBuilder(function.append_basic_block("entry"))
    extension = _loaded(build, frame, _EXTENSION, POINTER)
    nothing = ir.Constant(POINTER, None)
    with build.if_then(build.icmp_unsigned("!=", extension, nothing)):
        asks = build.icmp_signed("==", _loaded(build, extension, _KIND, _SHORT), ir.Constant(_SHORT, _ASKS))
        with build.if_then(asks):
            metadata, (major, minor) = _loaded(build, extension, _METADATA, POINTER), _version()
            for at, value in ((_MAJOR, major), (_MINOR, minor), (_TRAITS, 0)):
                build.store(ir.Constant(_SHORT, value), _place(build, metadata, at, _SHORT))
            build.store(ir.Constant(_LONG, 0), _place(build, metadata, _STATE, _LONG))
            build.ret(nothing)
    build.call(work, [_loaded(build, frame, at, POINTERS) for at in (_ARGUMENTS, _RESULTS)])
    build.ret(nothing)


def with_memory(work: ir.Function, inside: ir.Function, size: int) -> None:
    """Let `work` call another function of the same arguments with memory for so many real numbers besides."""
    module, build, real = work.module, ir.IRBuilder(work.append_basic_block("entry")), ir.DoubleType()
    make = ir.Function(module, ir.FunctionType(POINTER, [_LONG]), "malloc")
    drop = ir.Function(module, ir.FunctionType(ir.VoidType(), [POINTER]), "free")
    # One register more in front, so as to begin at its multiple, and one behind, which is read beyond the last row.
    found = build.call(make, [ir.Constant(_LONG, 8 * size + 2 * _REGISTER)])
    place = build.add(build.ptrtoint(found, _LONG), ir.Constant(_LONG, _REGISTER - 1))
    begin = build.inttoptr(build.and_(place, ir.Constant(_LONG, -_REGISTER)), real.as_pointer())
    build.call(inside, [*work.args, begin])
    build.call(drop, [found])
    build.ret_void()


def numbers(build: ir.IRBuilder, buffers: ir.Value, k: int, kind: ir.Type) -> ir.Value:
    """Where the numbers of buffer `k` are."""
    buffer = build.load(build.gep(buffers, [ir.Constant(_LONG, k)]))
    return _loaded(build, buffer, _DATA, kind.as_pointer())


def registered(address: int, name: str) -> None:
    """Let XLA know the handler at an address by a name."""
    new = ctypes.pythonapi.PyCapsule_New
    new.restype, new.argtypes = ctypes.py_object, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
    jax.ffi.register_ffi_target(name, new(address, None, None), platform="cpu")


def _place(build: ir.IRBuilder, pointer: ir.Value, offset: int, kind: ir.Type) -> ir.Value:
    return build.bitcast(build.gep(pointer, [ir.Constant(_LONG, offset)]), kind.as_pointer())


def _loaded(build: ir.IRBuilder, pointer: ir.Value, offset: int, kind: ir.Type) -> ir.Value:
    return build.load(_place(build, pointer, offset, kind))


@cache
def _version() -> tuple[int, int]:
    """Of the interface that this jaxlib has."""
    header = Path(jax.ffi.include_dir(), "xla", "ffi", "api", "c_api.h").read_text(encoding="utf-8")
    major, minor = (re.search(rf"define XLA_FFI_API_{name} (\d+)", header) for name in ("MAJOR", "MINOR"))
    assert major and minor, "jaxlib's header tells no version of its interface"
    return int(major.group(1)), int(minor.group(1))
