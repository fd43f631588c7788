"""What an unseen oscillator does that hardly feels the seen one, a periodic force does as well: its push's own line.

An oscillator is found where the simulation as it is has gone astray, for it swings as the motion that is missed; no
exchange about its fit takes it out, and what a force would do is seen only beside a trajectory that is near.
"""

import numpy as np
from jaxtyping import Float

from .._effects import FORCING, HIDDEN
from ._along import along, force
from ._problem import Combination
from ._score import Start
from ._stochastic import trajectories
from ._weigher import Weigher

# Frequencies that are tried in one that a recording tells apart, how many at most, and in how many rows.
_FINER, _MOST, _ROWS = 4, 4096, 2000


def as_driven(weigher: Weigher, combination: Combination) -> list[Start]:
    """A fitted combination with a periodic force in place of its unseen oscillator; none where there is no such."""
    problem, white = weigher.problem, weigher.found.of(combination, "white")
    hidden = next((m for m in combination if problem.candidate(m).effect is HIDDEN), None)
    if hidden is None or white is None or not np.isfinite(white.log_evidence):
        return []
    one, own = problem.candidate(hidden), problem.members[hidden].recordings
    instead = [m for m in problem.searched if problem.candidate(m).effect is FORCING
               and problem.candidate(m).place == one.place and problem.members[m].recordings == own]  # fmt: skip
    paths = trajectories(weigher.stepper, white.z, combination, weigher.rows)
    rest = tuple(m for m in combination if m != hidden)
    driven = tuple(sorted((*rest, *instead[:1])))
    if not instead or not problem.is_possible(driven) or not all(np.isfinite(path).all() for path in paths):
        return []
    push, times = [], []
    for r in own:
        both = [along(problem, force, r, white.z, some, paths[r])[:, one.place] for some in (combination, rest)]
        push.append(both[0] - both[1])
        times.append(problem.rows[r].times[: len(paths[r])] - problem.origin(instead[0]))
    values = problem.candidate(instead[0]).values.stop - 1
    bounds = weigher.found.priors.lower[values], weigher.found.priors.upper[values]
    z = problem.carried(white.z, combination, driven)
    for r in own:
        z[problem.unseen(r)] = 0.0
    z[dict(problem.placed(driven))[instead[0]]] = _line(
        np.concatenate(push)[:_ROWS], np.concatenate(times)[:_ROWS], bounds
    )
    return [Start(driven, z, 0.0)]


def _line(
    push: Float[np.ndarray, " row"], times: Float[np.ndarray, " row"], bounds: tuple[float, float]
) -> Float[np.ndarray, "3"]:
    """Cosine, sine and frequency of the swing, within bounds, that is nearest to a push."""
    number = int(np.clip(_FINER * np.ptp(times) * (bounds[1] - bounds[0]) / (2 * np.pi), 2, _MOST))
    found, left = np.zeros(3), np.inf
    for omega in np.linspace(*bounds, number):
        waves = np.stack([np.cos(omega * times), np.sin(omega * times)], axis=1)
        sizes = np.linalg.lstsq(waves, push, rcond=None)[0]
        rest = float(((push - waves @ sizes) ** 2).sum())
        if rest < left:
            found, left = np.array([*sizes, omega]), rest
    return found
