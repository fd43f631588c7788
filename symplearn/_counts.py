"""Counts: whole numbers that say how many."""

from typing import Any

import numpy as np

from ._errors import InputError


def is_count(given: Any, least: int = 1) -> bool:
    """Whether something is a whole number of at least `least`; a truth value is none."""
    return isinstance(given, int | np.integer) and not isinstance(given, bool) and bool(given >= least)


def refuse_count(owner: str, name: str, given: Any, least: int = 1) -> None:
    """Refuse, with `InputError`, what is no whole number of at least `least`."""
    if not is_count(given, least):
        raise InputError(f"`{owner}` needs `{name}` of at least {least}, a whole number, but was given {given!r}.")
