"""A traced function, with its slopes along many directions, or of many lanes side by side, as machine code.

XLA runs small operations one after the other, from memory to memory; here all that a trajectory's row or a filter's
step takes stays in registers: every number as a scalar, and its slopes along the directions, which are carried beside
it (forward mode), in one register; or the same number of every lane in one. Arithmetic, branches, loops, and tables
that are read are known; `Unsupported` is raised for all else, which is then XLA's work.
"""

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal

from ._machine_arithmetic import Dual, Unsupported
from ._machine_block_rules import applied
from ._machine_blocks import Block, Pending
from ._machine_flow import PARTS, each
from ._machine_memory import AbstractCode, AbstractTable, shaped
from ._machine_places import PLACED
from ._machine_rules import RULES, ruled, spared


class Code(AbstractCode):
    """Writes a traced function, operation by operation."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self._uses: dict[int, tuple[Any, _Uses]] = {}

    def evaluated(self, program: ClosedJaxpr, values: Sequence[Any]) -> list[Any]:
        inner = program.jaxpr
        found: dict[Any, Any] = dict(zip(inner.constvars, map(self.constant, program.consts), strict=True))
        found.update(zip(inner.invars, values, strict=True))
        uses = self._uses_in(inner)

        def value(atom: Any) -> Any:
            if not isinstance(atom, Literal):
                return found[atom]
            return self.constant(np.asarray(atom.val, shaped(atom).dtype))

        for k, one in enumerate(inner.eqns):
            yielded = self._applied(one, [value(atom) for atom in one.invars], k in uses.turned, k in uses.joined)
            for atom, array in zip(one.outvars, yielded, strict=True):
                if array.shape != shaped(atom).shape:
                    raise Unsupported(f"{one.primitive.name} as it is used here")
                found[atom] = array
            for atom in uses.last[k]:  # memory of what is not asked for again is used again
                found.pop(atom, None)
        return [value(atom) for atom in inner.outvars]

    def _uses_in(self, program: Jaxpr) -> "_Uses":
        if id(program) not in self._uses:
            self._uses[id(program)] = program, _Uses(program)  # the first is kept, so that no other gets its number
        return self._uses[id(program)][1]

    def _applied(self, one: JaxprEqn, values: list[Any], turned: bool, joined: bool) -> Sequence[Any]:
        name = one.primitive.name
        if name in PARTS:
            return PARTS[name](self, one, values)
        if any(isinstance(value, AbstractTable) for value in values):
            raise Unsupported(f"{name} of a table")
        if any(isinstance(value, Block | Pending) for value in values) or any(
            self.is_many(shaped(atom).shape, shaped(atom).dtype) for atom in one.outvars
        ):
            return applied(self, one, values, turned, joined)
        return self.plainly(one, values)

    def plainly(self, one: JaxprEqn, values: list[Any]) -> Sequence[Any]:
        name = one.primitive.name
        if name in PLACED:
            return PLACED[name](self, one, values)
        if name not in RULES:
            raise Unsupported(f"the operation {name}")
        return [each(lambda *entries: self.ruled(one, entries), *np.broadcast_arrays(*values))]

    def ruled(self, one: JaxprEqn, entries: Sequence[Dual]) -> Dual:
        less = spared(one.primitive.name, entries) if self.beside else None
        return ruled(self, one, entries) if less is None else less


class _Uses:
    """Of a traced function's operations: which values each is the last to use (`last`), and which yield a matrix that
    is only asked for with its rows and columns exchanged (`turned`), or, thus or not, to be added to another of its
    shape (`joined`)."""

    def __init__(self, program: Jaxpr):
        self.program, self.users = program, defaultdict(list)
        for k, one in enumerate(program.eqns):
            for atom in one.invars:
                if not isinstance(atom, Literal):
                    self.users[atom].append(k)
        self.told = {atom for atom in program.outvars if not isinstance(atom, Literal)}
        self.last: dict[int, list[Any]] = defaultdict(list)
        for k, one in enumerate(program.eqns):
            unused = [atom for atom in one.outvars if atom not in self.users]
            for atom in {atom: None for atom in one.invars if not isinstance(atom, Literal)} | dict.fromkeys(unused):
                if atom not in self.told and self.users.get(atom, [k])[-1] == k:
                    self.last[k].append(atom)
        matrices = [k for k, one in enumerate(program.eqns) if one.primitive.name == "dot_general"]
        self.turned = {k for k in matrices if self._is_turned(k)}
        self.joined = {k for k in matrices if self._is_joined(k)}

    def _user(self, k: int) -> int | None:
        """The only operation that asks for what one yields."""
        (out,) = self.program.eqns[k].outvars
        users = self.users.get(out, [])
        return users[0] if len(users) == 1 and out not in self.told else None

    def _is_turned(self, k: int) -> bool:
        user = self._user(k)
        return user is not None and self.program.eqns[user].params.get("permutation") == (1, 0)

    def _is_joined(self, k: int) -> bool:
        user = self._user(self._user(k) or k if self._is_turned(k) else k)
        if user is None:
            return False
        one = self.program.eqns[user]
        shapes = [shaped(atom).shape for atom in (*one.invars, *one.outvars)]
        return one.primitive.name in ("add", "add_any") and len(shapes[0]) == 2 and len(set(shapes)) == 1
