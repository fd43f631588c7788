"""How many of a traced loop's operands never change and how many go round, in either way that JAX writes it."""

from collections.abc import Mapping
from typing import Any, NamedTuple


class ScanSizes(NamedTuple):
    """A loop's first operands are `given`, the next are `carried`, and along the rest it goes row by row."""

    given: int
    carried: int

    @classmethod
    def of(cls, p: Mapping[str, Any]) -> "ScanSizes":
        """The sizes in the parameters of a `scan`: numbers up to JAX 0.10, trees of operands from 0.11 on."""
        if "num_consts" in p:
            return cls(p["num_consts"], p["num_carry"])
        given, carried, _ = p["ft_in"].unpack()
        return cls(len(given), len(carried))

    @property
    def last(self) -> int:
        """The place of the first operand that is gone along."""
        return self.given + self.carried
