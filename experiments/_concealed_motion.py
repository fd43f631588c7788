"""One true motion: SciPy's DOP853 at 1e-10, begun anew at every jump: friction turns or holds, impulse, contact."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from ._concealed_effects import Effect, Modes, World, other_forces, rates

RTOL, ATOL = 1e-10, 1e-12
_EVENTS = 20_000  # more restarts than any motion here needs


class Motion(NamedTuple):
    """Pieces of dense output, in order."""

    begins: list[float]
    pieces: list[Callable[[Any], np.ndarray]]

    def at(self, times: np.ndarray) -> np.ndarray:
        """States at times, shape (state, time). At a jump: after it."""
        times = np.asarray(times, dtype=float)
        place = np.clip(np.searchsorted(self.begins, times, side="right") - 1, 0, None)
        found = np.empty((len(self.pieces[0](self.begins[0])), len(times)))
        for k in np.unique(place):
            found[:, place == k] = self.pieces[k](times[place == k])
        return found

    def one(self, t: float) -> np.ndarray:
        """The state at one time; before the motion began, its first state."""
        k = int(np.searchsorted(self.begins, t, side="right")) - 1
        return self.pieces[max(k, 0)](max(t, self.begins[0]))


def true_motion(world: World, start: np.ndarray, begin: float, end: float, before: float = 0.0) -> Motion:
    """The motion from `start` at `begin`, which holds the extra states too, and the time `before` it that led there.

    A delayed force remembers nothing from before the first state but that state.
    `FloatingPointError` where it runs away.
    """
    motion = Motion([], [])
    t, x = begin, np.array(start, dtype=float)
    first = x.copy()
    modes = Modes(begin, past=lambda s: motion.one(s) if motion.pieces else first)
    stops = _stops(world, begin, end)
    for k, effect in enumerate(world.effects):
        if effect.word == "regime_change":
            modes.begun[k] = float(begin >= effect.values["t_star"])
        if effect.word == "coulomb_friction":
            modes.side[k] = _side(t, x, world, modes, k)
    if before > 0:
        found = _solved(world, modes, begin, begin - before, x, None, np.inf)
        motion.begins.append(begin - before)
        motion.pieces.append(found.sol)
    while t < end:
        modes.since = t
        t, x = _piece(motion, world, modes, t, x, stops[np.searchsorted(stops, t, side="right")])
        if t in stops:
            x = _jumped(world, modes, t, x)
        if len(motion.pieces) > _EVENTS:
            raise FloatingPointError("the motion needs too many restarts")
    return motion


def _stops(world: World, begin: float, end: float) -> np.ndarray:
    """Times at which the integration begins anew."""
    found = [end]
    for effect in world.effects:
        found += [effect.values[name] for name in ("t_star", "t_on", "t_off") if name in effect.values]
        if effect.word == "delayed_force":
            found += list(np.arange(begin, end, effect.values["tau"])[1:])
    if world.inputs is not None and world.system.drive is not None:
        found += list(world.inputs.times)
    return np.array(sorted({float(s) for s in found if begin < s <= end}))


def _piece(
    motion: Motion, world: World, modes: Modes, t: float, x: np.ndarray, stop: float
) -> tuple[float, np.ndarray]:
    """Integrate to the next stop or event, and settle what the event changes."""
    events, settle = _events(world, modes, t, x)
    # A step so long that an event comes and goes within it would hide both.
    longest = world.system.period(world.values) / world.system.quick / 40 if events else np.inf
    found = _solved(world, modes, t, stop, x, events or None, longest)
    motion.begins.append(t)
    motion.pieces.append(found.sol)
    t, x = (stop if found.status == 0 else float(found.t[-1])), found.y[:, -1].copy()
    if found.status == 1:
        for k, times in enumerate(found.t_events):
            if len(times):
                settle[k](t, x)
    return t, x


def _solved(world: World, modes: Modes, t: float, stop: float, x: np.ndarray, events: Any, longest: float) -> Any:
    """One call of SciPy."""
    with np.errstate(all="ignore"):
        found = solve_ivp(
            lambda s, y: rates(s, y, world, modes), (t, stop), x, "DOP853", dense_output=True, events=events,
            rtol=RTOL, atol=ATOL, max_step=longest,
        )  # fmt: skip
    if found.status < 0 or not np.all(np.isfinite(found.y[:, -1])) or np.max(np.abs(found.y[:, -1])) > 1e6:
        raise FloatingPointError("the motion runs away")
    return found


def _events(world: World, modes: Modes, t: float, x: np.ndarray) -> tuple[list[Any], list[Any]]:
    """Events that end a piece, and what each changes."""
    events: list[Any] = []
    settle: list[Any] = []
    for k, effect in enumerate(world.effects):
        if effect.word == "coulomb_friction":
            events.append(_friction_event(world, modes, k))
            settle.append(lambda t, x, k=k: _turn(t, x, world, modes, k))
        if effect.word == "contact_stop":
            events.append(_contact_event(world, effect, x))
            settle.append(lambda t, x: None)
    return events, settle


def _friction_event(world: World, modes: Modes, k: int) -> Any:
    """While it slides: the velocity passes zero. While it holds: the other forces exceed it."""
    d, i = world.system.dof, world.system.coordinates.index(str(world.effects[k].target))
    side = modes.side[k]

    def event(t: float, x: np.ndarray) -> float:
        if side == 0:
            return abs(other_forces(t, x, world, modes, k)) - world.effects[k].values["f"]
        return float(x[d + i])

    event.terminal, event.direction = True, 1.0 if side == 0 else -side  # type: ignore[attr-defined]
    return event


def _contact_event(world: World, effect: Effect, x: np.ndarray) -> Any:
    """The stop is touched or left."""
    d, i = world.system.dof, world.system.coordinates.index(str(effect.target))

    def event(t: float, y: np.ndarray) -> float:
        return float(y[i] - effect.values["a"])

    # At the stop itself the sign of the next crossing is the other one; away from it, the next crossing is either.
    away = x[i] - effect.values["a"]
    event.terminal, event.direction = True, -1.0 if away >= 0 else 1.0  # type: ignore[attr-defined]
    if abs(away) < 1e-9:
        speed = world.system.velocity(x[:d], x[d : 2 * d], world.values)[i]
        event.direction = -1.0 if speed > 0 else 1.0  # type: ignore[attr-defined]
    return event


def _turn(t: float, x: np.ndarray, world: World, modes: Modes, k: int) -> None:
    """At standstill: hold, or slide the way the other forces push."""
    d, i = world.system.dof, world.system.coordinates.index(str(world.effects[k].target))
    x[d + i] = 0.0
    push = other_forces(t, x, world, modes, k)
    released = modes.side[k] == 0  # the event said that the other forces have reached it
    held = not released and abs(push) <= world.effects[k].values["f"]
    modes.side[k] = 0.0 if held else float(np.sign(push))


def _side(t: float, x: np.ndarray, world: World, modes: Modes, k: int) -> float:
    """The side on which friction begins."""
    d, i = world.system.dof, world.system.coordinates.index(str(world.effects[k].target))
    if x[d + i] != 0:
        return float(np.sign(x[d + i]))
    push = other_forces(t, x, world, modes, k)
    return 0.0 if abs(push) <= world.effects[k].values["f"] else float(np.sign(push))


def _jumped(world: World, modes: Modes, t: float, x: np.ndarray) -> np.ndarray:
    """Impulses given and regimes begun at t."""
    d = world.system.dof
    for k, effect in enumerate(world.effects):
        if effect.values.get("t_star") == t:
            if effect.word == "impulse":
                x[d + world.system.coordinates.index(str(effect.target))] += effect.values["j"]
            else:
                modes.begun[k] = 1.0
    modes.since = t
    for k, effect in enumerate(world.effects):
        moving = x[d + world.system.coordinates.index(str(effect.target))] if effect.word == "coulomb_friction" else 0
        # What has just been let go at this very time stays so.
        if effect.word == "coulomb_friction" and (moving != 0 or modes.side[k] == 0):
            modes.side[k] = _side(t, x, world, modes, k)
    return x
