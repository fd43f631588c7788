"""A missing force that acts for a while and not before or after: where it may have acted, and paths under it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ._noisy import PathFit
from ._outlook import Outlook
from ._trajectory import Stepper
from ._weighed import Estimate

# How long it may act, as shares of the longest recording, and how strong it may be, of the forces already there.
_LENGTHS, _STRENGTHS = (1 / 16, 1 / 8, 1 / 4, 1 / 2), np.geomspace(1e-3, 1.0, 4)
# Places of a spell that are told apart, per length of it.
_OVERLAP = 2


def spells(stepper: Stepper, pull: Estimate, typical: Float[np.ndarray, " d"], rows: Sequence[int]) -> list[PathFit]:
    """Where fits of a combination beside a force that acts for a while begin: for every length of it where `pull`, a
    force that always acts, is strained most."""
    assert pull.intensity is not None and pull.paths is not None  # it is an estimate beside a force
    outlooks = [Outlook(stepper, pull, r, pull.intensity) for r in range(len(rows))]
    if not all(o.ok for o in outlooks):
        return []
    strain = [(o.strain() ** 2).sum(1)[: n - 1] for o, n in zip(outlooks, rows, strict=True)]
    out, most = [], max(rows) - 1
    for width in dict.fromkeys(max(2, round(share * most)) for share in _LENGTHS):
        r, begin = _most_strained(strain, width)
        exposures = tuple(np.zeros(n) for n in rows)
        exposures[r][begin : begin + width] = 1.0
        times = stepper.problem.rows[r].times
        length = times[min(begin + width, len(times) - 1)] - times[begin]
        choices = float(np.log(sum(max(1.0, _OVERLAP * len(each) / width) for each in strain)))
        first = PathFit(
            pull.combination, pull.intensity, pull.z, pull.noise, pull.paths, exposures=exposures, choices=choices
        )
        forces = [share * np.maximum(typical, 1e-300) for share in _STRENGTHS]
        out += [replace(first, intensity=force**2 * length) for force in forces]
    return out


def _most_strained(strain: Sequence[Float[np.ndarray, " _"]], width: int) -> tuple[int, int]:
    """The recording, and the first span in it, of the stretch of this many spans that is strained most."""
    sums = []
    for each in strain:
        total = np.concatenate([[0.0], np.cumsum(np.nan_to_num(each))])
        sums.append(total[width:] - total[:-width] if len(total) > width else total[-1:])
    r = int(np.argmax([one.max() for one in sums]))
    return r, int(np.argmax(sums[r]))
