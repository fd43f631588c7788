"""Stops so hard that a motion is hardly read inside them."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from .._effects import STOP
from ._depths import WALL
from ._law_text import number
from ._outlook import Outlook

# Readings inside a stop at a time, below which no more than that it turns the motion, and where, is seen of it.
_SEEN = 2.0


def hardly_entered(outlooks: Sequence[Outlook]) -> list[str]:
    """Which stops of an estimate throw the motion back between one reading and the next or so: a harder one, nearer to
    the wall that would throw it back alike, does the same. `outlooks` are of one estimate."""
    problem, estimate = outlooks[0].stepper.problem, outlooks[0].estimate
    out = []
    for member, place in problem.placed(estimate.combination):
        one = problem.candidate(member)
        if one.effect is not STOP:
            continue
        sign, a = (-1 if one.side == "lower" else 1), estimate.z[place.stop - 1]
        mine = [o for o in outlooks if o.recording in problem.members[member].recordings]
        depths = [sign * (o.states[_read(o), one.place] - a) for o in mine]
        inside = [depth > 0 for depth in depths]
        stays = sum(np.count_nonzero(np.diff(some, prepend=False) & some) for some in inside)
        if stays and sum(map(np.sum, inside)) < _SEEN * stays:
            wall = a + sign * WALL * max(depth.max() for depth in depths)
            out.append(
                f"the {one.side} contact stop on {one.target} throws the motion back before {_SEEN:g} readings are "
                f"taken in it: it may be far harder than is told, with its place up to {number(wall)}; readings that "
                "are taken faster would tell"
            )
    return out


def _read(outlook: Outlook) -> Bool[np.ndarray, " fitted"]:
    """Which fitted rows hold a reading; long gaps are filled with rows that do not."""
    return ~np.isnan(outlook.rows.readings[: outlook.rows.fitted]).all(axis=1)
