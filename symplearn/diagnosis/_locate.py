"""Where the mismatch lives: which equation, which sensor, which times, and what the missing force goes with."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from .._effects import IMPULSE, Candidate
from ._along import force
from ._law_text import moment
from ._outlook import Outlook
from ._problem import Combination, Problem

# Standardised disturbances are looked at in this many stretches of the recording.
_STRETCHES = 24
# A stretch stands out when its mean square is this many times that of most, and nearly as large as the force's own
# intensity would have it: where most of the recording is quiet that is fitted to what stands out.
_STANDS_OUT, _STRONG = 2.5, 0.7
# Share of the forces already there below which a missing one goes with nothing: a fit that needs none leaves as much.
_NOTHING = 1e-5


@dataclass(frozen=True)
class Explained:
    """What speed and place explain of the missing force on one coordinate: shares of what both together explain.

    The rest of a smoothed missing force is mostly reading noise passed on, so it is not counted against them.
    """

    speed: float
    place: float


def explained(outlook: Outlook, coordinate: int) -> Explained:
    """Regress the smoothed missing force on functions of velocity and of position, each beside the other.

    A group counts by how much the fit loses without it (Type III sums of squares), so nothing is counted twice.
    """
    force = outlook.missing_force()[:, coordinate]
    q, v = motion(outlook)
    q, v = q[:, coordinate], v[:, coordinate]
    q, v = q / max(np.abs(q).max(), 1e-300), v / max(np.abs(v).max(), 1e-300)
    speed, place = np.stack([v, np.abs(v) * v, np.sign(v)], 1), np.stack([np.ones_like(q), q, q**2, q**3], 1)
    full = _left(force, np.concatenate([speed, place], axis=1))
    lost = _left(force, place) - full, _left(force, speed) - full
    both = max(sum(lost), 1e-300)
    return Explained(lost[0] / both, lost[1] / both)


def motion(outlook: Outlook) -> tuple[np.ndarray, np.ndarray]:
    """Smoothed positions and velocities over the fitted rows, each (time, coordinate)."""
    q = outlook.states[:, : outlook.stepper.problem.equations.dim]
    return q, np.gradient(q, outlook.rows.times[: outlook.rows.fitted], axis=0)


def _left(values: np.ndarray, columns: np.ndarray) -> float:
    fit = columns @ np.linalg.lstsq(columns, values, rcond=1e-10)[0]
    return float(((values - fit) ** 2).sum())


def strained_windows(outlook: Outlook, coordinate: int) -> list[list[float]]:
    """Times at which the standardised disturbances stand out; the whole span where all do, or none does."""
    n, times = outlook.rows.fitted, outlook.rows.times
    whole = [[float(times[0]), float(times[n - 1])]]
    series = outlook.strain()[:, coordinate] ** 2
    edges = np.linspace(0, n, min(_STRETCHES, max(2, n // 8)) + 1).astype(int)
    level = np.array([series[a:b].mean() for a, b in zip(edges[:-1], edges[1:], strict=True)])
    out = level > max(_STRONG, _STANDS_OUT * float(np.median(level)))
    if out.all() or not out.any():
        return whole
    windows: list[list[float]] = []
    for k in np.nonzero(out)[0]:
        a, b = float(times[edges[k]]), float(times[min(edges[k + 1], n - 1)])
        if windows and windows[-1][1] >= a:
            windows[-1][1] = b
        else:
            windows.append([a, b])
    return windows


def strained_when(outlooks: Sequence[Outlook], coordinates: Sequence[int]) -> list[tuple[list[float], int]]:
    """When disturbances stand out, and in which recording: on the first of some coordinates on which they do so for a
    part of the time only; else always."""
    whole = [([float(o.rows.times[0]), float(o.rows.times[o.rows.fitted - 1])], o.recording + 1) for o in outlooks]
    every = [[(w, o.recording + 1) for o in outlooks for w in strained_windows(o, i)] for i in coordinates]
    return next((found for found in every if found != whole), whole)


def spell_windows(problem: Problem, exposures: Sequence[np.ndarray]) -> list[tuple[int, list[float]]]:
    """The recording, and from when to when, of a missing force that acts for a while."""
    acting = [(r, np.flatnonzero(each)) for r, each in enumerate(exposures) if each.any()]
    times = [problem.rows[r].times for r, _ in acting]
    return [(r, [float(t[spans[0]]), float(t[min(spans[-1] + 1, len(t) - 1)])])
            for (r, spans), t in zip(acting, times, strict=True)]  # fmt: skip


def strained_coordinates(outlooks: Sequence[Outlook]) -> list[int]:
    """Coordinates whose equation is strained, the worst first; at least one."""
    level = np.mean([(o.strain() ** 2).mean(0) for o in outlooks], axis=0)
    level = np.where(np.isfinite(level), level, 0.0)
    order = [int(i) for i in np.argsort(level)[::-1]]
    return [i for i in order if level[i] >= 0.5 * level[order[0]]]


def kind_and_targets(problem: Problem, combination: Combination) -> tuple[str, list[str]]:
    """`dynamics`, `sensor` or `both`, and the targets, in the order of the combination."""
    chosen = [problem.candidate(member) for member in combination]
    places = {one.effect.is_dynamics for one in chosen}
    kind = "both" if len(places) == 2 else ("dynamics" if True in places else "sensor")
    return kind, list(dict.fromkeys(target for one in chosen for target in one.targets))


def present_windows(
    problem: Problem, outlooks: Sequence[Outlook], combination: Combination, values: Mapping[int, Mapping[str, float]]
) -> list[list[float | int]]:
    """When the effects of a combination are at work, by recording: at a jump, from a change on, else all the time."""
    out: list[list[float | int]] = []
    for o in outlooks:
        first, last = float(o.rows.times[0]), float(o.rows.times[-1])
        gap = float(np.median(np.diff(o.rows.times)))
        mine = [m for m in combination if o.recording in problem.members[m].recordings]
        windows = [_window(problem.candidate(m), values.get(m, {}), first, last, gap) for m in mine]
        if any(w == (first, last) for w in windows):
            windows = [(first, last)]
        number: list[float | int] = [o.recording + 1] if len(outlooks) > 1 else []
        out += [[*w, *number] for w in sorted(dict.fromkeys(windows))]
    return out


def _window(one: Candidate, values: Mapping[str, float], first: float, last: float, gap: float) -> tuple[float, float]:
    if "t_star" not in values:
        return first, last
    begin = min(max(values["t_star"], first), last)
    if one.effect is IMPULSE:
        return max(first, begin - gap), min(last, begin + gap)
    return begin, last


def most_strained(outlooks: Sequence[Outlook], coordinate: int) -> Outlook:
    """The recording whose missing force on a coordinate is the clearest."""
    level = [np.nan_to_num(np.mean(o.strain()[:, coordinate] ** 2)) for o in outlooks]
    return outlooks[int(np.argmax(level))]


def whole_windows(outlooks: Sequence[Outlook]) -> list[list[float | int]]:
    """The whole span of every recording, with its number where there are several."""
    spans = []
    for o in outlooks:
        span: list[float | int] = [float(o.rows.times[0]), float(o.rows.times[-1])]
        spans.append(span + [o.recording + 1] if len(outlooks) > 1 else span)
    return spans


def where_sentence(problem: Problem, outlook: Outlook, coordinate: int) -> str:
    """What the missing force goes with."""
    name = problem.equations.coordinates[coordinate]
    if not (np.isfinite(outlook.missing_force()).all() and np.isfinite(outlook.states).all()):
        return f"the simulation of {name} diverges from the recording, so that no missing force can be followed"
    if _is_nothing(outlook, coordinate):
        return f"no missing force on {name} can be followed by itself"
    shares = explained(outlook, coordinate)
    speed, place = (f"{100 * max(0.0, x):.0f} %" for x in (shares.speed, shares.place))
    alone = [word for word, share in (("its speed", shares.speed), ("its place", shares.place)) if share > 0.6]
    goes = alone[0] if alone else "both its speed and its place"
    return (
        f"the missing force on {name} goes with {goes}: of what the two explain of it, "
        f"{speed} goes with speed and {place} with position"
    )


def _is_nothing(outlook: Outlook, coordinate: int) -> bool:
    """Whether a missing force is nothing beside those that are there."""
    there, missing = outlook.along(force, outlook.states)[:, coordinate], outlook.missing_force()[:, coordinate]
    return bool(np.linalg.norm(missing) <= _NOTHING * np.linalg.norm(there))


def blows_sentence(blows: Sequence[Candidate], times: Sequence[float]) -> str:
    """What is struck, and when: a blow goes with neither speed nor place."""
    struck = [f"a blow to {one.targets[0]} at t = {moment(t)}" for one, t in zip(blows, times, strict=True)]
    return " and ".join(struck)
