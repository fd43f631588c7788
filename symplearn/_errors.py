"""What is said when the input is wrong."""

import difflib
from collections.abc import Iterable


class InputError(Exception):
    """The input is wrong. Its text is one sentence: file, place, what is wrong, what would be right.

    The command line prints it and exits with code 2. Control characters are escaped, so that no file can
    write a second line or an escape sequence to the terminal.
    """

    def __init__(self, sentence: str):
        super().__init__(printable(sentence))


def printable(text: str) -> str:
    """`text` on one line, with everything that is not printable written as an escape."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def shown(text: object, limit: int = 60) -> str:
    """Text of a file as it is quoted in a sentence: printable, and cut at `limit` characters."""
    text = str(text)
    return f"`{printable(text[:limit])}...`" if len(text) > limit else f"`{printable(text)}`"


def nearest(name: str, known: Iterable[str], most: int = 12) -> str:
    """`did you mean ...?`, with the known name nearest to `name`, or the first known names where none is near."""
    known = list(known)
    if not known:
        return "there is none to choose from"
    # Long names are cut: the comparison is quadratic in their length.
    found = difflib.get_close_matches(str(name)[:80], [k[:80] for k in known], n=1, cutoff=0.55)
    if found:
        return f"did you mean {shown(found[0])}?"
    return "known are " + ", ".join(shown(k, 40) for k in known[:most]) + (", ..." if len(known) > most else "")
