"""Loops over time that are machine code: of one lane, or of many where a function is mapped over them.

Of a filter's step XLA makes hundreds of small loops, from memory to memory; machine code keeps numbers in registers,
and those of eight lanes side by side in one. What the code does not know, and graphics cards, are XLA's.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Primitive
from jax.interpreters import ad, batching, mlir

from ._lane_code import Known, Loop, code_of
from ._machine_lanes import filling
from ._scan_sizes import ScanSizes

_Told = TypeVar("_Told")
# Numbers of an array that is written into a loop's function.
_WRITTEN = 4096
# Steps from which on a loop inside of one that is XLA's is worth a call of its own in each of that one's steps.
_LONG = 64
# Traced functions that are looked into for loops, and where they keep what they do; not those with slopes of their own.
_CALLS = {"closed_call": "call_jaxpr", "eval_jaxpr": "call_jaxpr", "jit": "jaxpr", "remat2": "jaxpr"}


_left_to_xla = ContextVar("left to XLA", default=False)


@contextmanager
def left_to_xla() -> Iterator[None]:
    """What is compiled within has no machine code: for comparisons."""
    token = _left_to_xla.set(True)
    try:
        yield
    finally:
        _left_to_xla.reset(token)


def with_lane_loops(function: Callable[..., _Told]) -> Callable[..., _Told]:
    """The same function, whose loops are machine code on a processor, under `jax.vmap` as well. Derivatives of it are
    XLA's: take this of a gradient, not a gradient of this."""

    def looped(*args: Any) -> _Told:
        program, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
        found = _evaluated(program.jaxpr, program.consts, jax.tree.leaves(args))
        return jax.tree.unflatten(jax.tree.structure(shapes), found)

    return looped


def _evaluated(program: Jaxpr, consts: Sequence[Any], args: Sequence[Any]) -> list[Any]:
    """What a traced function yields, with loops as operations of their own."""
    known = dict(zip([*program.constvars, *program.invars], [*consts, *args], strict=True))

    def value(atom: Any) -> Any:
        return atom.val if isinstance(atom, Literal) else known[atom]

    for one in program.eqns:
        name, values = one.primitive.name, [value(atom) for atom in one.invars]
        if name == "scan":
            found = _bound(values, one.params)
        elif name in _CALLS and _has_loops(one.params[_CALLS[name]]):
            inner = one.params[_CALLS[name]]
            closed = isinstance(inner, ClosedJaxpr)
            found = _evaluated(inner.jaxpr if closed else inner, inner.consts if closed else (), values)
        elif _tells_places(one, values):
            with jax.ensure_compile_time_eval():
                found = _plainly(one, values)
        else:
            found = _plainly(one, values)
        known.update(zip(one.outvars, found, strict=True))
    return [value(atom) for atom in program.outvars]


def _plainly(one: JaxprEqn, values: Sequence[Any]) -> list[Any]:
    """What an operation yields."""
    found = one.primitive.bind(*values, **one.primitive.get_bind_params(one.params))
    return list(found) if one.primitive.multiple_results else [found]


def _tells_places(one: JaxprEqn, values: Sequence[Any]) -> bool:
    """Whether an operation yields a few integers that follow from what is known: places in arrays."""
    yielded: list[Any] = [atom.aval for atom in one.outvars]
    few = all(str(aval.dtype) in ("bool", "int32", "int64") and aval.size <= _WRITTEN for aval in yielded)
    return few and not one.effects and not any(isinstance(value, jax.core.Tracer) for value in values)


def _bound(values: Sequence[Any], p: Any) -> list[Any]:
    """A loop as an operation of its own. What it is given and is known is written into its function: places in arrays,
    and matrices most of whose entries are zero."""
    inner, known = p["jaxpr"].jaxpr, {}
    for k, value in enumerate(values[: ScanSizes.of(p).given]):
        if not isinstance(value, jax.core.Tracer) and np.size(value) <= _WRITTEN:
            known[k] = np.asarray(value, inner.invars[k].aval.dtype)
    return loop.bind(*values, known=Known(known), **p)


def _has_loops(program: ClosedJaxpr | Jaxpr) -> bool:
    inner = program.jaxpr if isinstance(program, ClosedJaxpr) else program
    return any(one.primitive.name == "scan" for one in _flat(inner))


def _is_wanted() -> bool:
    return jax.default_backend() == "cpu" and not _left_to_xla.get()


def _as_scan(*values: Any, known: Any, **p: Any) -> list[Any]:
    """The loop as XLA has it."""
    return jax.lax.scan_p.bind(*values, **p)


def _in_parts(*values: Any, known: Any, **p: Any) -> list[Any]:
    """The loop as XLA has it, with long loops inside of it as operations of their own: a filter's stretches."""
    program = p["jaxpr"]
    if any(one.primitive.name == "scan" and one.params["length"] >= _LONG for one in _flat(program.jaxpr)):
        shapes = [jax.ShapeDtypeStruct(one.shape, one.dtype) for one in program.in_avals]

        def body(*some: Any) -> list[Any]:
            given = [known.arrays.get(k, one) for k, one in enumerate(some)]
            return _evaluated(p["jaxpr"].jaxpr, p["jaxpr"].consts, given)

        program = jax.make_jaxpr(body)(*shapes)
    return _as_scan(*values, known=known, **{**p, "jaxpr": program})


def _flat(program: Jaxpr) -> Iterator[JaxprEqn]:
    """What a traced function does, and what those do that it calls."""
    for one in program.eqns:
        inner = one.params[_CALLS[one.primitive.name]] if one.primitive.name in _CALLS else None
        yield from [one] if inner is None else _flat(inner.jaxpr if isinstance(inner, ClosedJaxpr) else inner)


def _batched(values: Sequence[Any], axes: Sequence[int | None], **p: Any) -> tuple[list[Any], list[int]]:
    """The loop of many lanes: by machine code where it can be written."""
    size = next(value.shape[axis] for value, axis in zip(values, axes, strict=True) if axis is not None)
    lanes = filling(size, p["jaxpr"].jaxpr)
    name = code_of(Loop(p), tuple(axis is not None for axis in axes), lanes) if _is_wanted() else None
    if name is None:
        found = jax.vmap(lambda *some: _in_parts(*some, **p), tuple(axes), axis_size=size)(*values)
        return found, [0] * len(found)
    operands = [value if axis is None else _filled(jnp.moveaxis(value, axis, -1), lanes)
                for value, axis in zip(values, axes, strict=True)]  # fmt: skip
    beside = tuple(axis is not None for axis in axes)
    found = [one[..., :size] for one in _many.bind(*operands, beside=beside, lanes=lanes, **p)]
    return found, [one.ndim - 1 for one in found]


def _by_machine(*operands: Any, beside: tuple[bool, ...], lanes: int, **p: Any) -> list[Any]:
    """The loop of so many lanes, which is known to be written; those of operands that are `beside` each other are their
    last axis."""
    name = code_of(Loop(p), beside, lanes)
    assert name is not None
    return list(jax.ffi.ffi_call(name, _yielded(p, lanes))(*operands))


def _beside_as_scan(*operands: Any, beside: tuple[bool, ...], lanes: int, **p: Any) -> list[Any]:
    """The same as XLA has it, for what is compiled for another platform than this one."""
    axes = tuple(one.ndim - 1 if own else None for one, own in zip(operands, beside, strict=True))
    found = jax.vmap(lambda *some: _as_scan(*some, **p), axes, axis_size=lanes)(*operands)
    return [jnp.moveaxis(one, 0, -1) for one in found]


def _still_more(values: Sequence[Any], axes: Sequence[int | None], **p: Any) -> tuple[list[Any], list[int]]:
    """The loop of many times so many lanes: all beside each other."""
    size = next(value.shape[axis] for value, axis in zip(values, axes, strict=True) if axis is not None)
    lanes = p["lanes"]

    def merged(value: Any, axis: int | None, had: bool) -> Any:
        if axis is None:
            if not had:
                return value
            value = value[..., None, :]
        else:
            value = jnp.moveaxis(value, axis, -2) if had else jnp.moveaxis(value, axis, -1)[..., None]
        return jnp.broadcast_to(value, (*value.shape[:-2], size, lanes)).reshape(*value.shape[:-2], size * lanes)

    operands = [merged(*one) for one in zip(values, axes, p["beside"], strict=True)]
    beside = tuple(had or axis is not None for axis, had in zip(axes, p["beside"], strict=True))
    rest = {name: value for name, value in p.items() if name not in ("beside", "lanes")}
    # What one lane has as single numbers may be no matrices of many, of which machine code could be written.
    way = _beside_as_scan if code_of(Loop(rest), beside, size * lanes) is None else _many.bind
    found = way(*operands, beside=beside, lanes=size * lanes, **rest)
    apart = [one.reshape(*one.shape[:-1], size, lanes) for one in found]
    return apart, [one.ndim - 2 for one in apart]


def _alone(*values: Any, **p: Any) -> list[Any]:
    """The loop of a single lane, on a processor."""
    name = None if _left_to_xla.get() else code_of(Loop(p), (False,) * len(values), 1)
    if name is None:
        return _in_parts(*values, **p)
    return [one[..., 0] for one in jax.ffi.ffi_call(name, _yielded(p, 1))(*values)]


def _filled(value: Any, lanes: int) -> Any:
    """So many lanes: the last one again and again."""
    lack = lanes - value.shape[-1]
    return jnp.pad(value, [(0, 0)] * (value.ndim - 1) + [(0, lack)], mode="edge") if lack else value


def _yielded(p: Any, *lanes: int) -> list[Any]:
    """Shapes and types of what a loop yields, lanes last."""
    out, carried = [], ScanSizes.of(p).carried
    for k, aval in enumerate(p["jaxpr"].out_avals):
        along = () if k < carried else (p["length"],)
        out.append(jax.core.ShapedArray((*along, *aval.shape, *lanes), aval.dtype))
    return out


def _with_slopes(primals: Sequence[Any], slopes: Sequence[Any], **p: Any) -> Any:
    """Derivatives are those of the loop as XLA has it."""
    some = [ad.instantiate_zeros(slope) for slope in slopes]
    return jax.jvp(lambda *values: _as_scan(*values, **p), tuple(primals), tuple(some))


loop = Primitive("loop_of_lanes")
loop.multiple_results = True
loop.def_impl(_as_scan)
loop.def_abstract_eval(lambda *_, **p: _yielded(p))
mlir.register_lowering(loop, mlir.lower_fun(_as_scan, multiple_results=True))
mlir.register_lowering(loop, mlir.lower_fun(_alone, multiple_results=True), platform="cpu")
batching.primitive_batchers[loop] = _batched
ad.primitive_jvps[loop] = _with_slopes

_many = Primitive("loop_of_many_lanes")
_many.multiple_results = True
_many.def_impl(_by_machine)
_many.def_abstract_eval(lambda *_, lanes, **p: _yielded(p, lanes))
mlir.register_lowering(_many, mlir.lower_fun(_beside_as_scan, multiple_results=True))
mlir.register_lowering(_many, mlir.lower_fun(_by_machine, multiple_results=True), platform="cpu")
batching.primitive_batchers[_many] = _still_more
