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
    """Each equation as it was, and as it is now, in parts; one of the two is empty where the other has no like.

    Equations are alike that have the same left side.
    """
    old, now = ([line.split(" = ")[0] for line in lines] for lines in (before, after))
    pairs: list[tuple[str, str]] = []
    for _, i, j, k, m in difflib.SequenceMatcher(None, old, now, autojunk=False).get_opcodes():
        pairs += zip_longest(before[i:j], after[k:m], fillvalue="")
    return [(was, parts(was, is_now) if is_now else []) for was, is_now in pairs]


def parts(old: str, now: str) -> list[Part]:
    """`now` cut where it departs from `old`."""
    if old == now:
        return [Part(now, False)]
    a, b = _TOKENS.findall(old), _TOKENS.findall(now)
    if max(len(a), len(b)) > _LONGEST:
        return [Part(now, True)]
    codes = difflib.SequenceMatcher(None, a, b, autojunk=False).get_opcodes()
    return [Part("".join(b[j:k]), kind != "equal") for kind, _, _, j, k in codes if k > j]
