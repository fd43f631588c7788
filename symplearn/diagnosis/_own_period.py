"""Effects of an outside clock that goes at the motion's own period, as anything does that goes with the motion; a
stiffness that goes with place swings twice in it."""

import numpy as np
from jaxtyping import Float

from .._effects import FORCING, MODULATION, Effect
from .._rows import Rows
from ._problem import Problem
from ._weighed import Estimate

# What goes with the motion may be told as these, and how often in its period they come round.
_WHOLE, _HALF = {"the period": 1}, {"half the period": 2}
_OWN: dict[Effect, dict[str, int]] = {FORCING: _WHOLE, MODULATION: _WHOLE | _HALF}
# Frequencies that differ by less than this share, or by less than one in the whole time, are the same.
_ALIKE = 0.02
# Share of the strongest line's power from which others are lines of the motion: far above a Hann window's side lobes.
_SHARE = 0.02
# Points of the periodogram for each that the fitted rows tell apart.
_FINER = 8


def in_tune(problem: Problem, estimate: Estimate) -> list[str]:
    """Which forcings and modulations of an estimate have the period of what is read in their recordings."""
    out = []
    for member, place in problem.placed(estimate.combination):
        one, omega = problem.candidate(member), float(estimate.z[place.stop - 1])
        rows = [problem.rows[r] for r in problem.members[member].recordings]
        shares = _OWN.get(one.effect, {}).items()
        own = [share for share, often in shares if any(_is_own(omega / often, some) for some in rows)]
        if own:
            out.append(
                f"{one.effect.name} of {one.target} has {own[0]} of the motion itself, {2 * np.pi / omega:.4g}: an "
                "error of the simulation that goes with the motion, as of a sensor or of the shape of a force, may "
                "look like it; a clock from outside keeps its period at another amplitude"
            )
    return out


def _is_own(omega: float, rows: Rows) -> bool:
    times, columns = rows.times[: rows.fitted], rows.readings[: rows.fitted].T
    near = max(_ALIKE * abs(omega), 2 * np.pi / (times[-1] - times[0])) if len(times) > 1 else 0.0
    return any((np.abs(omega - _lines(times, column)) < near).any() for column in columns)


def _lines(times: Float[np.ndarray, " time"], column: Float[np.ndarray, " time"]) -> Float[np.ndarray, " line"]:
    """The angular frequencies at which a column swings, each of two modes; none where too little was read."""
    seen = ~np.isnan(column)
    if seen.sum() < 8:
        return np.zeros(0)
    grid = np.linspace(times[0], times[-1], len(times))
    even = np.interp(grid, times[seen], column[seen])
    power = np.abs(np.fft.rfft((even - even.mean()) * np.hanning(len(grid)), _FINER * len(grid)))[1:] ** 2
    beside = np.pad(power, 1)
    peaks = np.flatnonzero((power >= beside[:-2]) & (power >= beside[2:]) & (power > _SHARE * power.max()))
    return 2 * np.pi * (1 + peaks) / (_FINER * (grid[1] - grid[0]) * len(grid))
