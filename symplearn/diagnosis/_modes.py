"""Along what two modes leave open: how stiff the seen coordinate is, how fast and how closely joined the unseen one.

A coordinate that swings with an unseen one shows two modes. Where its own stiffness is calibrated and nothing else says
what it is, a continuum of pairs has the same two modes: from a soft coordinate that a weak one hardly touches, which is
where a search from nothing ends, to one as stiff as the faster mode. Only what is damped, how, tells them apart; a fit
that walks there step by step does not arrive.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from .._effects import HIDDEN
from ._along import along, along_all, force, rates, velocity
from ._motion import regressed, stiffening, stiffness
from ._problem import Combination, Problem
from ._score import Start
from ._stochastic import trajectories
from ._weigher import Weigher

# Where between the two modes the seen coordinate's own frequency, squared, is put.
_SHARES = (0.1, 0.3, 0.5, 0.7, 0.9)
# How many of its prior's standard deviations a calibrated value may be moved.
_REACH = 3.0
# Of the time between two rows, for the rate of a force.
_STEP = 1e-6


def along_the_modes(weigher: Weigher, combination: Combination) -> list[Start]:
    """Starts of a fitted combination with the same two modes, and more or less of the stiffness the seen one's."""
    problem, white = weigher.problem, weigher.found.of(combination, "white")
    joined = [(m, place) for m, place in problem.placed(combination) if problem.candidate(m).effect is HIDDEN]
    if not joined or white is None or not np.isfinite(white.log_evidence):
        return []
    paths = trajectories(weigher.stepper, white.z, combination, weigher.rows)
    if not all(np.isfinite(path).all() for path in paths):
        return []
    lower, upper = weigher.found.priors.bounds_of(problem, combination)
    moved = [z for z in _moved(weigher, paths, joined[0], white.z) if ((lower <= z) & (z <= upper)).all()]
    return [Start(combination, _with_starts(problem, combination, joined[0][0], paths, white.z, z), 0.0) for z in moved]


def _moved(
    weigher: Weigher, paths: list[np.ndarray], joined: tuple[int, slice], z: Float[np.ndarray, " z"]
) -> Iterator[Float[np.ndarray, " z"]]:  # fmt: skip
    """The same with the parameter moved that priors leave most room for, and the oscillator that keeps the modes."""
    problem, (member, place) = weigher.problem, joined
    i, points = problem.candidate(member).place, np.concatenate(paths)
    lightness = regressed(points[:, problem.equations.width + i], along_all(problem, velocity, z, paths)[:, i])
    own, change = lightness * stiffness(problem, z, paths)[i], lightness * stiffening(problem, z, paths)[i]
    room = np.abs(change) * weigher.found.priors.widths(problem)
    (strength, omega), k = z[place], int(np.argmax(room)) if len(room) else 0
    centre, half = (own + omega**2) / 2, np.hypot((own - omega**2) / 2, np.sqrt(max(lightness * strength, 0.0)))
    for share in _SHARES if len(room) and room[k] > 0 and half < centre else ():
        stiff = centre + (2 * share - 1) * half
        entry, by = problem.head + k, (stiff - own) / change[k]
        some = z.copy()
        some[entry] += by
        some[place] = share * (1 - share) * (2 * half) ** 2 / lightness, np.sqrt(2 * centre - stiff)
        if abs(by * change[k]) < _REACH * room[k]:
            yield some


def _with_starts(
    problem: Problem, combination: Combination, member: int, paths: list[np.ndarray], z: np.ndarray, moved: np.ndarray
) -> Float[np.ndarray, " z"]:
    """With what the unseen one pushes at the first row, and its rate, so that the seen one is pushed as before."""
    for r in problem.members[member].recordings:
        first, step = paths[r][:1], _STEP * float(np.median(np.diff(problem.rows[r].times)))
        ahead = np.concatenate([first, first + step * along(problem, rates, r, z, combination, first)])
        before, after = (along(problem, force, r, some, (), ahead) for some in (z, moved))
        less = (before - after)[:, problem.candidate(member).place]
        moved[problem.unseen(r)] += less[0], (less[1] - less[0]) / step
    return moved
