"""Many motions at once: lanes that differ in parameters, coefficients and starts, stepped together with order 8.

The nodes are the rows, subdivided where they are far apart; the coefficients are those of SciPy's DOP853 with a step
that is not adapted. Impulses, beginning regimes and turning friction are met to their own times, lane by lane.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.integrate import DOP853

from ._concealed_effects import Modes, World, other_forces, rates

_A, _B, _C = DOP853.A, DOP853.B, DOP853.C
STEPS = 10  # at least this many in the shortest period


def nodes(times: np.ndarray, longest: float) -> tuple[np.ndarray, np.ndarray]:
    """Times with the rows among them, no step above `longest`, and the places of the rows."""
    parts = [np.array([times[0]])]
    for a, b in zip(times[:-1], times[1:], strict=True):
        parts.append(np.linspace(a, b, int(np.ceil((b - a) / longest - 1e-9)) + 1)[1:])
    places = np.cumsum([len(part) for part in parts]) - 1
    return np.concatenate(parts), places


def step(t: Any, x: np.ndarray, h: Any, world: World, modes: Modes) -> np.ndarray:
    """One step of order 8; h may differ by lane."""
    slopes = np.empty((len(_C), *x.shape))
    flat = slopes.reshape(len(_C), -1)
    y = x
    for k, c in enumerate(_C):
        if k:
            y = x + h * (_A[k, :k] @ flat[:k]).reshape(x.shape)
        for place, one in enumerate(rates(t + c * h, y, world, modes)):
            slopes[k, place] = one
    return x + h * (_B @ flat).reshape(x.shape)


def run(world: World, start: np.ndarray, times: np.ndarray, longest: float) -> np.ndarray:
    """States at times, shape (time, state, lane), from `start` at the first of them, shape (state, lane).

    A lane that runs away holds values that are not finite.
    """
    kinks = [k for k, e in enumerate(world.effects) if e.word in ("coulomb_friction", "contact_stop")]
    ts, places = nodes(times, longest / 2 if kinks else longest)
    x = np.array(start, dtype=float)
    lanes, modes = x.shape[1], Modes(ts[0])
    jumps = _jumps(world, lanes)
    for k in jumps:
        modes.begun[k] = (jumps[k] <= ts[0]).astype(float)
    for k in kinks:
        if world.effects[k].word == "coulomb_friction":
            modes.side[k] = _sides(ts[0], x, world, modes, k, lanes)
    kept = [x]
    modes.past = _memory(ts, kept) if any(e.word == "delayed_force" for e in world.effects) else None
    with np.errstate(all="ignore"):
        for t, end in zip(ts[:-1], ts[1:], strict=True):
            modes.since = t
            x = _across(t, end, x, world, modes, jumps, kinks)
            kept.append(x)
    return np.array([kept[place] for place in places])


def _memory(ts: np.ndarray, kept: list[np.ndarray]) -> Any:
    """Linear interpolation of what was kept; before the first node, its state."""

    def past(t: Any) -> np.ndarray:
        s = np.ravel(t)[0]
        k = min(max(int(np.searchsorted(ts, s, side="right")) - 1, 0), len(kept) - 1)
        after = min(k + 1, len(kept) - 1)
        if after == k:
            return kept[k]
        w = min(max((s - ts[k]) / (ts[after] - ts[k]), 0.0), 1.0)
        return (1 - w) * kept[k] + w * kept[after]

    return past


def _jumps(world: World, lanes: int) -> dict[int, np.ndarray]:
    """Times of the jumps of each effect that has one, by lane."""
    return {k: np.broadcast_to(np.asarray(e.values["t_star"], dtype=float), (lanes,)) for k, e in
            enumerate(world.effects) if "t_star" in e.values}  # fmt: skip


def _across(t: float, end: float, x: Any, world: World, modes: Modes, jumps: Any, kinks: Any) -> np.ndarray:
    """From one node to the next, stopping at each lane's own jumps."""
    due = [k for k, at in jumps.items() if np.any((at > t) & (at <= end))]
    if not due:
        return _slide(t, x, end - t, world, modes, kinks)
    now = np.full(x.shape[1], t)
    for _ in range(len(due)):
        following = np.min([np.where((jumps[k] > now) & (jumps[k] <= end), jumps[k], np.inf) for k in due], axis=0)
        to = np.minimum(following, end)
        x = _slide(now, x, to - now, world, modes, kinks)
        for k in due:
            _jump(world, modes, k, x, (jumps[k] == to) & (jumps[k] > now))
        now = to
    return _slide(now, x, end - now, world, modes, kinks)


def _jump(world: World, modes: Modes, k: int, x: np.ndarray, there: np.ndarray) -> None:
    effect, d = world.effects[k], world.system.dof
    if effect.word == "impulse":
        i = world.system.coordinates.index(str(effect.target))
        x[d + i] += np.where(there, effect.values["j"], 0.0)
        for m in modes.side:
            modes.side[m] = np.where(there & (x[d + i] != 0), np.sign(x[d + i]), modes.side[m])
    else:
        modes.begun[k] = np.where(there, 1.0, modes.begun[k])


def _sides(t: Any, x: np.ndarray, world: World, modes: Modes, k: int, lanes: int) -> np.ndarray:
    """The side on which friction k acts in each lane, from rest or not."""
    i = world.system.dof + world.system.coordinates.index(str(world.effects[k].target))
    push = np.broadcast_to(other_forces(t, x, world, modes, k), (lanes,))
    most = world.effects[k].values["f"]
    return np.where(x[i] != 0, np.sign(x[i]), np.where(np.abs(push) <= most, 0.0, np.sign(push)))


def _slide(t: Any, x: np.ndarray, h: Any, world: World, modes: Modes, kinks: list[int]) -> np.ndarray:
    """One step, divided where a coordinate comes to rest or is let go, and where a stop is touched or left."""
    if not kinks:
        return step(t, x, h, world, modes)
    h = np.broadcast_to(np.asarray(h, dtype=float), x.shape[1:])
    for _ in range(6):
        after = step(t, x, h, world, modes)
        part, first = h, np.full(x.shape[1], -1)
        for k in kinks:
            for bent, mine in _bends(t, x, h, after, world, modes, k):
                sooner = bent & (mine < part)
                part, first = np.where(sooner, mine, part), np.where(sooner, k, first)
        if np.all(first < 0):
            break
        x, t, h = step(t, x, part, world, modes), t + part, h - part
        for k in kinks:
            _settle(t, x, first == k, world, modes, k)
    else:
        after = step(t, x, h, world, modes)
    return after


def _bends(t: Any, x: np.ndarray, h: Any, after: Any, world: World, modes: Modes, k: int) -> Iterator[tuple[Any, Any]]:
    """Lanes in which effect k bends the motion within the step, and when."""
    if k in modes.side and np.any(modes.side[k] == 0):
        yield _released(t, x, h, after, world, modes, k)
    i, level = _kink(world, k)
    crossed = (after[i] - level) * (x[i] - level) < 0
    if np.any(crossed):
        yield crossed, _crossing(t, x, np.where(crossed, h, 0.0), after[i], (i, level), world, modes)


def _released(t: Any, x: np.ndarray, h: Any, after: Any, world: World, modes: Modes, k: int) -> tuple[Any, Any]:
    """Lanes in which what holds gives way within the step, and when: the other forces reach the friction."""
    most = world.effects[k].values["f"]
    early = np.abs(other_forces(t, x, world, modes, k)) - most
    late = np.abs(other_forces(t + h, after, world, modes, k)) - most
    crossed = (modes.side[k] == 0) & (late > 0)
    # An input that jumped may have freed it at the step's beginning.
    return crossed, np.where(early < 0, h * early / np.where(late > early, early - late, -1.0), 0.0)


def _settle(t: Any, x: np.ndarray, where: Any, world: World, modes: Modes, k: int) -> None:
    """In lanes that have come to a bend: put them on it exactly; what held lets go, what slid holds or turns."""
    if not np.any(where):
        return
    i, level = _kink(world, k)
    x[i] = np.where(where, level, x[i])
    if k in modes.side:
        push = np.sign(other_forces(t, x, world, modes, k))
        turned = np.where(modes.side[k] == 0, push, _sides(t, x, world, modes, k, x.shape[1]))
        modes.side[k] = np.where(where, turned, modes.side[k])


def _kink(world: World, k: int) -> tuple[int, Any]:
    """Which component of the state bends the motion where it passes which level."""
    effect, d = world.effects[k], world.system.dof
    i = world.system.coordinates.index(str(effect.target))
    return (d + i, 0.0) if effect.word == "coulomb_friction" else (i, effect.values["a"])


def _crossing(
    t: Any, x: np.ndarray, h: np.ndarray, late: np.ndarray, at: tuple[int, Any], world: World, modes: Modes
) -> np.ndarray:
    """The part of each lane's step after which a component is at a level: secant steps kept within the step."""
    i, level = at
    low, high = np.zeros_like(h), h.copy()
    at_low, at_high = x[i] - level, late - level
    part = low
    for _ in range(3):
        slope = at_high - at_low
        part = np.where(slope != 0, low - at_low * (high - low) / np.where(slope != 0, slope, 1.0), low)
        part = np.clip(part, 0.0, h)
        value = step(t, x, part, world, modes)[i] - level
        before = value * at_low > 0
        low, at_low = np.where(before, part, low), np.where(before, value, at_low)
        high, at_high = np.where(before, high, part), np.where(before, at_high, value)
    return part
