"""A traced function of scalars as machine code: values as they are, slopes along many directions in one register.

XLA runs small operations one after the other from memory to memory; here a whole step of a trajectory stays in
registers, and is compiled in a tenth of the time. Nothing but arithmetic, branches, loops, and tables that are read is
known; `Unsupported` is raised for all else, which XLA does then.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal
from llvmlite import ir

DOUBLE, INTEGER = ir.DoubleType(), ir.IntType(64)
_BIT, _SHORT = ir.IntType(1), ir.IntType(32)
_TYPES = {"float64": DOUBLE, "bool": _BIT, "int32": _SHORT, "int64": INTEGER}


class Unsupported(Exception):
    """An operation, or a type, that is not made into machine code here."""


class Table:
    """Numbers in memory, row by row, that are only read."""

    def __init__(self, pointer: ir.Value, shape: tuple[int, ...], type_: ir.Type = DOUBLE):
        self.pointer, self.shape, self.type = pointer, shape, type_


# A scalar, a register with one entry a direction, a few scalars in an array, or a table.
Value: TypeAlias = Any


class Code:
    """Writes traced operations into a function that is being built; registers hold `width` directions."""

    def __init__(self, builder: ir.IRBuilder, width: int):
        self.builder, self.width = builder, width

    def evaluated(self, program: ClosedJaxpr, values: Sequence[Value]) -> list[Any]:
        """What a traced function yields."""
        known: dict[Any, Any] = dict(zip(program.jaxpr.constvars, map(self._constant, program.consts), strict=True))
        known.update(zip(program.jaxpr.invars, values, strict=True))

        def value(atom: Any) -> Any:
            return (
                self._constant(np.asarray(atom.val, _shaped(atom).dtype)) if isinstance(atom, Literal) else known[atom]
            )

        for one in program.jaxpr.eqns:
            known.update(zip(one.outvars, self._applied(one, [value(atom) for atom in one.invars]), strict=True))
        return [value(atom) for atom in program.jaxpr.outvars]

    def _applied(self, one: JaxprEqn, values: list[Any]) -> Sequence[Any]:
        name = one.primitive.name
        if name in _PARTS:
            return _PARTS[name](self, one, values)
        if name not in _SCALAR:
            raise Unsupported(f"the operation {name}")
        if not all(isinstance(value, ir.Value) for value in values):
            raise Unsupported(f"{name} of an array")
        return [_SCALAR[name](self, one.params, *self.alike(values))]

    def _constant(self, array: Any) -> Any:
        plain = np.asarray(array)
        if plain.ndim == 0:
            return ir.Constant(type_of(plain.dtype), plain.item())
        kind = type_of(plain.dtype)
        row = ir.Constant(ir.ArrayType(kind, plain.size), [ir.Constant(kind, entry.item()) for entry in plain.ravel()])
        module = self.builder.module
        kept = ir.GlobalVariable(module, row.type, module.get_unique_name("table"))
        kept.initializer, kept.global_constant, kept.linkage = row, True, "internal"
        zero = ir.Constant(INTEGER, 0)
        return Table(self.builder.gep(kept, [zero, zero]), plain.shape, kind)

    def splat(self, value: ir.Value) -> ir.Value:
        """A register with the same in every direction."""
        if isinstance(value.type, ir.VectorType):
            return value
        if isinstance(value, ir.Constant):
            return ir.Constant(ir.VectorType(value.type, self.width), [value.constant] * self.width)
        empty = ir.Constant(ir.VectorType(value.type, self.width), ir.Undefined)
        first = self.builder.insert_element(empty, value, ir.Constant(_SHORT, 0))
        places = ir.Constant(ir.VectorType(_SHORT, self.width), [0] * self.width)
        return self.builder.shuffle_vector(first, empty, places)

    def alike(self, values: Sequence[ir.Value]) -> Sequence[ir.Value]:
        """Scalars as registers where others are."""
        wide = any(isinstance(value.type, ir.VectorType) for value in values)
        return [self.splat(value) for value in values] if wide else values

    def called(self, name: str, values: Sequence[ir.Value]) -> ir.Value:
        """A function of the C library, direction by direction."""
        kind = ir.FunctionType(DOUBLE, [DOUBLE] * len(values))
        known = self.builder.module.globals.get(name) or ir.Function(self.builder.module, kind, name)
        known.attributes.add("nounwind")
        if not isinstance(values[0].type, ir.VectorType):
            return self.builder.call(known, values)
        out = ir.Constant(values[0].type, ir.Undefined)
        for k in range(self.width):
            place = ir.Constant(_SHORT, k)
            entries = [self.builder.extract_element(value, place) for value in values]
            out = self.builder.insert_element(out, self.builder.call(known, entries), place)
        return out

    def intrinsic(self, name: str, *values: ir.Value) -> ir.Value:
        """A function that LLVM knows, of all directions at once."""
        kind = values[0].type
        suffix = f"v{self.width}f64" if isinstance(kind, ir.VectorType) else "f64"
        full = f"llvm.{name}.{suffix}"
        module = self.builder.module
        known = module.globals.get(full) or ir.Function(module, ir.FunctionType(kind, [kind] * len(values)), full)
        return self.builder.call(known, values)

    def number(self, value: float, like: ir.Value) -> ir.Value:
        """The same number in every direction that `like` has."""
        scalar = ir.Constant(DOUBLE, float(value))
        return self.splat(scalar) if isinstance(like.type, ir.VectorType) else scalar

    def loaded(self, table: Table, place: ir.Value) -> ir.Value:
        """One entry of a table."""
        return self.builder.load(self.builder.gep(table.pointer, [place]))

    def cells(self, values: Sequence[ir.Value]) -> list[ir.Value]:
        """Places in memory that begin with these values, for what changes along a loop or by a branch."""
        with self.builder.goto_entry_block():
            cells = [self.builder.alloca(value.type) for value in values]
        for cell, value in zip(cells, values, strict=True):
            self.builder.store(value, cell)
        return cells


def type_of(dtype: Any) -> ir.Type:
    """The machine's type of an array's entries."""
    if str(dtype) not in _TYPES:
        raise Unsupported(f"numbers of type {dtype}")
    return _TYPES[str(dtype)]


def _shaped(atom: Any) -> Any:
    """Shape and type of what stands for a value in a traced function."""
    return atom.aval


def _wanted(code: Code, value: ir.Value, shaped: Any) -> ir.Value:
    """A value as a loop or a branch yields it: with an entry for every direction if it may differ among them."""
    return code.splat(value) if shaped.shape else value


def _inlined(code: Code, one: JaxprEqn, values: list[Any]) -> list[Any]:
    return code.evaluated(one.params.get("jaxpr") or one.params["call_jaxpr"], values)


def _branches(code: Code, one: JaxprEqn, values: list[Any]) -> list[Any]:
    if one.params.get("branches_platforms") is not None:
        raise Unsupported("a branch by platform")
    index, *operands = values
    build, shapes = code.builder, list(map(_shaped, one.outvars))
    nothing = [ir.Constant(ir.VectorType(type_of(s.dtype), code.width) if s.shape else type_of(s.dtype), None)
               for s in shapes]  # fmt: skip
    cells, blocks, end = code.cells(nothing), [], build.append_basic_block("joined")
    here = build.block
    for program in one.params["branches"]:
        blocks.append(build.append_basic_block("branch"))
        build.position_at_end(blocks[-1])
        for cell, value, shaped in zip(cells, code.evaluated(program, operands), shapes, strict=True):
            build.store(_wanted(code, value, shaped), cell)
        build.branch(end)
    build.position_at_end(here)
    choice = build.switch(index, blocks[-1])
    for k, block in enumerate(blocks[:-1]):
        choice.add_case(ir.Constant(index.type, k), block)
    build.position_at_end(end)
    return [build.load(cell) for cell in cells]


def _while(code: Code, one: JaxprEqn, values: list[Any]) -> list[Any]:
    p, build = one.params, code.builder
    asked, given = p["cond_nconsts"], p["cond_nconsts"] + p["body_nconsts"]
    shapes = list(map(_shaped, one.outvars))
    cells = code.cells([_wanted(code, v, shaped) for v, shaped in zip(values[given:], shapes, strict=True)])
    again, inside, end = map(build.append_basic_block, ("again", "inside", "end"))
    build.branch(again)
    build.position_at_end(again)
    now = [build.load(cell) for cell in cells]
    (goes_on,) = code.evaluated(p["cond_jaxpr"], [*values[:asked], *now])
    build.cbranch(goes_on, inside, end)
    build.position_at_end(inside)
    new = code.evaluated(p["body_jaxpr"], [*values[asked:given], *now])
    for cell, value, shaped in zip(cells, new, shapes, strict=True):
        build.store(_wanted(code, value, shaped), cell)
    build.branch(again)
    build.position_at_end(end)
    return now


def _scan(code: Code, one: JaxprEqn, values: list[Any]) -> list[Any]:
    p, build = one.params, code.builder
    given, last = p["num_consts"], p["num_consts"] + p["num_carry"]
    shapes, ahead = list(map(_shaped, one.outvars)), values[last:]
    if len(shapes) > p["num_carry"] or not all(isinstance(one, Table) and len(one.shape) == 1 for one in ahead):
        raise Unsupported("a loop along arrays")
    zero, length = ir.Constant(INTEGER, 0), ir.Constant(INTEGER, p["length"])
    start = [_wanted(code, v, shaped) for v, shaped in zip(values[given:last], shapes, strict=True)]
    count, *cells = code.cells([zero, *start])
    again, inside, end = map(build.append_basic_block, ("again", "inside", "end"))
    build.branch(again)
    build.position_at_end(again)
    k, *now = [build.load(cell) for cell in (count, *cells)]
    build.cbranch(build.icmp_signed("<", k, length), inside, end)
    build.position_at_end(inside)
    place = build.sub(build.sub(length, ir.Constant(INTEGER, 1)), k) if p["reverse"] else k
    rows = [code.loaded(table, place) for table in ahead]
    for cell, value, shaped in zip(
        cells, code.evaluated(p["jaxpr"], [*values[:given], *now, *rows]), shapes, strict=True
    ):
        build.store(_wanted(code, value, shaped), cell)
    build.store(build.add(k, ir.Constant(INTEGER, 1)), count)
    build.branch(again)
    build.position_at_end(end)
    return now


def _row(code: Code, one: JaxprEqn, values: list[Any]) -> list[Any]:
    """One row of a table, by its entries."""
    table, *starts = values
    sizes, build = one.params["slice_sizes"], code.builder
    if not isinstance(table, Table) or sizes[0] != 1 or tuple(sizes[1:]) != table.shape[1:]:
        raise Unsupported("a part of an array that moves")
    row = math.prod(table.shape[1:])
    first = starts[0] if starts[0].type == INTEGER else build.sext(starts[0], INTEGER)
    begin = build.mul(first, ir.Constant(INTEGER, row))
    out = np.empty(row, object)
    for k in range(row):
        out[k] = code.loaded(table, build.add(begin, ir.Constant(INTEGER, k)))
    return [_scalar(out.reshape(sizes))]


def _scalar(array: np.ndarray) -> Any:
    """An array of one entry is that entry."""
    return array.item() if array.size == 1 else array


def _array(value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """A value by its entries; a scalar has one."""
    if isinstance(value, np.ndarray):
        return value
    if isinstance(value, Table) or isinstance(value.type, ir.VectorType):
        raise Unsupported("an array of arrays")
    out = np.empty(shape, object)
    out[...] = value
    return out


def _moved(rule: Callable[[np.ndarray, Any], np.ndarray]) -> Callable[[Code, JaxprEqn, list[Any]], list[Any]]:
    """An operation that only picks or orders entries."""

    def applied(code: Code, one: JaxprEqn, values: list[Any]) -> list[Any]:
        value, shape = values[0], _shaped(one.outvars[0]).shape
        if isinstance(value, ir.Value) and isinstance(value.type, ir.VectorType):
            if math.prod(shape) != code.width:
                raise Unsupported("a part of a register")
            return [value]
        return [_scalar(rule(_array(value, _shaped(one.invars[0]).shape), one.params))]

    return applied


def _spread(code: Code, one: JaxprEqn, values: list[Any]) -> list[Any]:
    size = math.prod(_shaped(one.outvars[0]).shape)
    if isinstance(values[0], ir.Value) and size in (1, code.width):
        return [code.splat(values[0]) if size > 1 else values[0]]
    raise Unsupported("a value that is spread over an array")


def _cut(array: np.ndarray, p: Any) -> np.ndarray:
    steps = p["strides"] or (1,) * array.ndim
    return array[tuple(map(slice, p["start_indices"], p["limit_indices"], steps))]


_PARTS: dict[str, Callable[[Code, JaxprEqn, list[Any]], list[Any]]] = {
    "jit": _inlined,
    "custom_jvp_call": _inlined,
    "cond": _branches,
    "while": _while,
    "scan": _scan,
    "dynamic_slice": _row,
    "broadcast_in_dim": _spread,
    "reshape": _moved(lambda array, p: array.reshape(p["new_sizes"])),
    "slice": _moved(_cut),
    "squeeze": _moved(lambda array, p: np.squeeze(array, p["dimensions"])),
}


def _compared(sign: str) -> Callable[..., ir.Value]:
    def rule(code: Code, p: Any, a: ir.Value, b: ir.Value) -> ir.Value:
        if not _is_real(a):
            return code.builder.icmp_signed(sign, a, b)
        if sign == "!=":
            return code.builder.fcmp_unordered(sign, a, b)
        return code.builder.fcmp_ordered(sign, a, b)

    return rule


def _is_real(value: ir.Value) -> bool:
    kind = value.type.element if isinstance(value.type, ir.VectorType) else value.type
    return kind == DOUBLE


def _arithmetic(real: str, whole: str) -> Callable[..., ir.Value]:
    def rule(code: Code, p: Any, a: ir.Value, b: ir.Value) -> ir.Value:
        if _is_real(a):
            return getattr(code.builder, real)(a, b, flags=("contract",))
        return getattr(code.builder, whole)(a, b)

    return rule


def _larger(sign: str) -> Callable[..., ir.Value]:
    def rule(code: Code, p: Any, a: ir.Value, b: ir.Value) -> ir.Value:
        build = code.builder
        if not _is_real(a):
            return build.select(build.icmp_signed(sign, a, b), a, b)
        # What is not a number stays so, on either side.
        return build.select(build.or_(build.fcmp_ordered(sign, a, b), build.fcmp_unordered("uno", a, a)), a, b)

    return rule


def _power(code: Code, p: Any, a: ir.Value) -> ir.Value:
    """An integer power by squaring."""
    left, square, out = abs(p["y"]), a, None
    while left:
        if left & 1:
            out = square if out is None else code.builder.fmul(out, square)
        left >>= 1
        square = code.builder.fmul(square, square) if left else square
    out = code.number(1.0, a) if out is None else out
    return code.builder.fdiv(code.number(1.0, a), out) if p["y"] < 0 else out


def _sign(code: Code, p: Any, a: ir.Value) -> ir.Value:
    build, one = code.builder, code.number(1.0, a)
    stays = build.fcmp_unordered("ueq", a, code.number(0.0, a))  # zeros, and what is no number
    return build.select(stays, a, code.intrinsic("copysign", one, a))


def _chosen(code: Code, p: Any, which: ir.Value, *cases: ir.Value) -> ir.Value:
    if len(cases) != 2 or (getattr(which.type, "element", which.type) != _BIT):
        raise Unsupported("a choice among more than two")
    return code.builder.select(which, cases[1], cases[0])


def _converted(code: Code, p: Any, a: ir.Value) -> ir.Value:
    build, wide = code.builder, isinstance(a.type, ir.VectorType)
    new, old = type_of(p["new_dtype"]), a.type.element if wide else a.type
    kind = ir.VectorType(new, code.width) if wide else new
    if new == old:
        return a
    if DOUBLE not in (new, old):
        if new == _BIT:
            return build.icmp_signed("!=", a, ir.Constant(a.type, None))
        return build.trunc(a, kind) if new.width < old.width else (build.zext if old == _BIT else build.sext)(a, kind)
    if new == DOUBLE:
        return (build.uitofp if old == _BIT else build.sitofp)(a, kind)
    return build.fcmp_unordered("!=", a, code.number(0.0, a)) if new == _BIT else build.fptosi(a, kind)


def _not(code: Code, p: Any, a: ir.Value) -> ir.Value:
    return code.builder.not_(a)


def _negative(code: Code, p: Any, a: ir.Value) -> ir.Value:
    return code.builder.fneg(a) if _is_real(a) else code.builder.neg(a)


def _bounded(code: Code, p: Any, low: ir.Value, a: ir.Value, high: ir.Value) -> ir.Value:
    return _larger("<")(code, p, _larger(">")(code, p, a, low), high)


def _finite(code: Code, p: Any, a: ir.Value) -> ir.Value:
    return code.builder.fcmp_ordered("<", code.intrinsic("fabs", a), code.number(math.inf, a))


def _size(code: Code, p: Any, a: ir.Value) -> ir.Value:
    if not _is_real(a):
        raise Unsupported("the size of an integer")
    return code.intrinsic("fabs", a)


def _of_library(name: str) -> Callable[..., ir.Value]:
    return lambda code, p, *values: code.called(name, values)


# Functions that the C library has by the name that JAX gives them.
_LIBRARY = (
    "acos", "acosh", "asin", "asinh", "atan", "atan2", "atanh", "cos", "cosh", "exp", "expm1", "log", "log1p", "pow",
    "sin", "sinh", "tan", "tanh",
)  # fmt: skip
_SCALAR: dict[str, Callable[..., ir.Value]] = {
    "abs": _size,
    "add": _arithmetic("fadd", "add"),
    "add_any": _arithmetic("fadd", "add"),
    "and": lambda code, p, a, b: code.builder.and_(a, b),
    "clamp": _bounded,
    "convert_element_type": _converted,
    "copy": lambda code, p, a: a,
    "copy_p": lambda code, p, a: a,
    "div": _arithmetic("fdiv", "sdiv"),
    "eq": _compared("=="),
    "ge": _compared(">="),
    "gt": _compared(">"),
    "integer_pow": _power,
    "is_finite": _finite,
    "le": _compared("<="),
    "lt": _compared("<"),
    "max": _larger(">"),
    "min": _larger("<"),
    "mul": _arithmetic("fmul", "mul"),
    "ne": _compared("!="),
    "neg": _negative,
    "not": _not,
    "or": lambda code, p, a, b: code.builder.or_(a, b),
    "rsqrt": lambda code, p, a: code.builder.fdiv(code.number(1.0, a), code.intrinsic("sqrt", a)),
    "select_n": _chosen,
    "sign": _sign,
    "sqrt": lambda code, p, a: code.intrinsic("sqrt", a),
    "square": lambda code, p, a: code.builder.fmul(a, a),
    "stop_gradient": lambda code, p, a: a,
    "sub": _arithmetic("fsub", "sub"),
    **{name: _of_library(name) for name in _LIBRARY},
}
