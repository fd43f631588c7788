"""Two equations side by side: which words of the second are new."""

import difflib
import re
from itertools import zip_longest
from typing import NamedTuple

_TOKENS = re.compile(r"\s+|[^\W\d]\w*|\d[\d.]*(?:[eE][-+]?\d+)?|.", re.DOTALL)
_LONGEST = 1500  # tokens; comparing takes their square


class Part(NamedTuple):
    """A piece of an equation."""

    text: str
    new: bool


def equation_pairs(before: tuple[str, ...], after: tuple[str, ...]) -> list[tuple[str, list[Part]]]:
    """Each equation as it was, and as it is now, in parts."""
    return [(old, parts(old, now)) for old, now in zip_longest(before, after, fillvalue="")]


def parts(old: str, now: str) -> list[Part]:
    """`now` cut where it departs from `old`."""
    if old == now:
        return [Part(now, False)]
    a, b = _TOKENS.findall(old), _TOKENS.findall(now)
    if max(len(a), len(b)) > _LONGEST:
        return [Part(now, True)]
    codes = difflib.SequenceMatcher(None, a, b, autojunk=False).get_opcodes()
    return [Part("".join(b[j:k]), kind != "equal") for kind, _, _, j, k in codes if k > j]
