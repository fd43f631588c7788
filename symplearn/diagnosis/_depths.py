"""Along what a stop leaves open: how hard it is, and how deep the motion runs into it.

A soft stop far inside and a hard one at the edge turn a swing alike. Between the two every reading that comes to lie
inside or outside bends the likelihood, and a fit is caught at one of these kinks.
"""

import numpy as np
from jaxtyping import Float

from ._problem import Combination
from ._stochastic import trajectories
from ._weigher import Weigher

# Depths that are tried, in that of the fit.
_SHARES = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 2.0)
# A swing that turns as a parabola in time takes from a stop's force, k times the depth, an impulse in proportion to k
# times the depth to this power.
_IMPULSE = 1.5
# What bounces off a stop at speed v comes v / sqrt(k) deep, and back as from a wall this many times as deep.
_BOUNCE, WALL = 2.0, np.pi / 2


def along_the_depths(
    weigher: Weigher, combination: Combination, z: Float[np.ndarray, " z"], member: int
) -> list[Float[np.ndarray, " z"]]:
    """Unknowns of a fitted combination with one stop nearer to the edge of the motion and harder, or the reverse: of
    the same impulse where the swing turns by itself, and of the same wall where it bounces."""
    problem = weigher.problem
    one, place = problem.candidate(member), dict(problem.placed(combination))[member]
    paths = trajectories(weigher.stepper, z, combination, weigher.rows)
    q = np.concatenate([paths[r][:, one.place] for r in problem.members[member].recordings])
    k, a = z[place]
    depth = np.max(q - a) if one.side == "upper" else np.min(q - a)  # below a lower stop: less than nothing
    low, high = weigher.found.priors.lower[one.values.stop - 1], weigher.found.priors.upper[one.values.stop - 1]
    found = []
    for power, reach in ((_IMPULSE, 1.0), (_BOUNCE, WALL)):
        for share in _SHARES if np.isfinite(depth) and k > 0 else ():
            moved = z.copy()
            moved[place] = k * share**-power, a + reach * (1 - share) * depth
            if low < moved[place][1] < high:
                found.append(moved)
    return found
