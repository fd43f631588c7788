"""A traced function, with its slopes along many directions, or of many lanes side by side, as machine code.

XLA runs small operations one after the other, from memory to memory; here all that a trajectory's row or a filter's
step takes stays in registers: every number as a scalar, and its slopes along the directions, which are carried beside
it (forward mode), in one register; or the same number of every lane in one. Arithmetic, branches, loops, and tables
that are read are known; `Unsupported` is raised for all else, which is then XLA's work.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal

from ._machine_arithmetic import Dual, Unsupported
from ._machine_flow import PARTS, each
from ._machine_memory import AbstractCode, AbstractTable, shaped
from ._machine_places import PLACED
from ._machine_rules import RULES, ruled, spared


class Code(AbstractCode):
    """Writes a traced function, operation by operation."""

    def evaluated(self, program: ClosedJaxpr, values: Sequence[Any]) -> list[Any]:
        inner = program.jaxpr
        found: dict[Any, Any] = dict(zip(inner.constvars, map(self.constant, program.consts), strict=True))
        found.update(zip(inner.invars, values, strict=True))

        def value(atom: Any) -> Any:
            if not isinstance(atom, Literal):
                return found[atom]
            return self.constant(np.asarray(atom.val, shaped(atom).dtype))

        for one in inner.eqns:
            yielded = self._applied(one, [value(atom) for atom in one.invars])
            for atom, array in zip(one.outvars, yielded, strict=True):
                if array.shape != shaped(atom).shape:
                    raise Unsupported(f"{one.primitive.name} as it is used here")
                found[atom] = array
        return [value(atom) for atom in inner.outvars]

    def _applied(self, one: JaxprEqn, values: list[Any]) -> Sequence[Any]:
        name = one.primitive.name
        if name in PARTS:
            return PARTS[name](self, one, values)
        if any(isinstance(value, AbstractTable) for value in values):
            raise Unsupported(f"{name} of a table")
        if name in PLACED:
            return PLACED[name](self, one, values)
        if name not in RULES:
            raise Unsupported(f"the operation {name}")
        return [each(lambda *entries: self._ruled(one, entries), *np.broadcast_arrays(*values))]

    def _ruled(self, one: JaxprEqn, entries: Sequence[Dual]) -> Dual:
        less = spared(one.primitive.name, entries) if self.beside else None
        return ruled(self, one, entries) if less is None else less
