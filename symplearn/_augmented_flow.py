"""The augmented simulation in motion: its flow between rows, and what its sensors show."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

import integrators as ig

from ._augmented import Equations
from ._augmented_system import EVERYTHING, Simulated, SimulatedHamiltonian, Switches
from ._effects import BIAS, COULOMB, DELAY, DRIFT, GAIN, IMPULSE

# Classical Runge-Kutta: where a stage stands, and its weight.
_STAGES = np.array([[0.0, 1 / 6], [0.5, 1 / 3], [0.5, 1 / 3], [1.0, 1 / 6]])
# Steps in which a sensor's delay is gone back: half a period then to 5e-4 of the amplitude, where one step is off by 2.
_BACKWARDS = 8
# Of a piece of the time before a reading: shorter steps back lie in the latest of them.
_SHORT = 1e-9
# What acts in a part of a substep: the Hamiltonian, a kick that belongs to no stage of it, or one that does.
_FLOW, _KICK, _DRAG = range(3)


class Span(eqx.Module):
    """One interval between rows: where it starts, its substep, how many, and the inputs' mean over each of them.

    Their number is data, so that finer steps are no new program; without inputs there is one empty row of them.
    """

    start: Float[Array, "..."]
    step: Float[Array, "..."]
    inputs: Float[Array, "... substep input"]
    pieces: Int[Array, "..."]

    @property
    def length(self) -> Float[Array, "..."]:
        return self.step * self.pieces


class _Part(NamedTuple):
    """A part of a substep: what acts, for which share of it, at which moment, and where the time lies that a sign of
    the velocity is averaged over."""

    what: int
    share: float
    place: float
    ahead: float = 0.0


class SimulatedFlow(eqx.Module):
    """The flow of the augmented simulation over one `Span`: Hamiltonian part symplectic, dissipation by splitting.

    Suzuki's composition of the integrator, of order 4, in everything conservative, and Strang splitting with kicks of
    positive length outside: order 2 in dissipative forces, which are small. Where forces that a velocity enters are
    known, and may be large, the smooth ones are composed with all else, to order 4; dry friction stays outside. The
    doubled state of Tao's method is projected by the mean of its copies at every substep. Time stands still at the
    middle of every stage and kick.
    """

    system: Simulated
    integrator: ig.AbstractIntegrator  # symmetric, of order 2

    def __init__(
        self, equations: Equations, integrator: ig.AbstractIntegrator, parameters: Any, coefficients: Any,
        switches: Switches = EVERYTHING,
    ):  # fmt: skip
        self.system, self.integrator = Simulated(equations, parameters, coefficients, switches), integrator

    def __call__(self, x: Float[Array, " state"], span: Span) -> Float[Array, " state"]:
        def substep(k: Array, x: Array) -> Array:
            inputs = span.inputs[k] if span.inputs.shape[-1] else span.inputs[0]
            return self._substep(x, span.start + k * span.step, span.step, inputs)

        return jax.lax.fori_loop(0, span.pieces, substep, x)

    def _substep(self, x: Array, t: Array, dt: Array, inputs: Array) -> Array:
        x = self._struck(x, t, dt, inputs)

        # Kicks and stages are one loop, so that either is compiled once: unrolled they take minutes to compile.
        def part(carry: Any, data: Any) -> tuple[Any, None]:
            what, share, place, ahead = data
            system = self.system.at(t + place * dt, inputs, dt)
            return self._part(system, carry, share * dt, ahead, what), None

        what, *shares = map(np.asarray, zip(*self._parts(), strict=True))
        begin = self.integrator.lift(x), jnp.ones(len(x) // 2, bool)
        (state, held), _ = jax.lax.scan(part, begin, (what, *(one.astype(x.dtype) for one in shares)))
        q, p = ig.split(self.integrator.project(state))
        # Held at both ends: without this a body at rest would creep through the flow in between.
        return jnp.concatenate([jnp.where(held, ig.split(x)[0], q), p])

    def _parts(self) -> list["_Part"]:
        """What a substep is made of, in its order."""
        weights = np.asarray(ig.suzuki4(self.integrator).weights)
        ends = np.concatenate([[0.0], np.cumsum(weights)])
        inside = [_Part(_FLOW, w, begin + 0.5 * w) for w, begin in zip(weights, ends[:-1], strict=True)]
        if self.system.equations.kick is not None:
            halves = np.concatenate([[0.0], weights, [0.0]]) / 2
            drags = [_Part(_DRAG, w, end) for w, end in zip(halves[:-1] + halves[1:], ends, strict=True)]
            inside = [one for pair in zip(drags[:-1], inside, strict=True) for one in pair] + drags[-1:]
        return [_Part(_KICK, 0.5, 0.25, 1.0), *inside, _Part(_KICK, 0.5, 0.75, -1.0)]

    def _part(
        self, system: SimulatedHamiltonian, carry: tuple[Array, Array], dt: Array, ahead: Array, what: Array
    ) -> tuple[Array, Array]:  # fmt: skip
        """The state after one part of a substep, and what friction has held so far."""

        def carried(carry: tuple[Array, Array]) -> tuple[Array, Array]:
            return self.integrator.flow(system, carry[0], system.moment.time, dt), carry[1]

        def kicked(carry: tuple[Array, Array]) -> tuple[Array, Array]:
            q, p = ig.split(self.integrator.project(carry[0]))
            p, held = self.kick(system, q, p, dt, ahead, carry[1] & (ahead < 0))
            return self.integrator.lift(jnp.concatenate([q, p])), carry[1] & held

        def dragged(carry: tuple[Array, Array]) -> tuple[Array, Array]:
            copies = [ig.split(x) for x in carry[0].reshape(self.integrator.copies, -1)]
            return jnp.concatenate([x for q, p in copies for x in (q, _dragged(system, q, p, dt))]), carry[1]

        if system.equations.kick is None:
            return jax.lax.cond(what == _KICK, kicked, carried, carry)
        return jax.lax.switch(what, [carried, kicked, dragged], carry)

    def kick(
        self, system: SimulatedHamiltonian, q: Float[Array, " width"], p: Float[Array, " width"],
        dt: Float[Array, ""], ahead: Float[Array, ""] | float = 1.0, stuck: Bool[Array, " width"] | bool = False,
    ) -> tuple[Float[Array, " width"], Bool[Array, " width"]]:  # fmt: skip
        """The momentum after the forces that depend on velocity have acted for `dt` at frozen q, and what sticks.

        Smooth drag by the explicit midpoint rule, where it is not composed with all else. What is `stuck` has not moved
        since a kick as long as this one.
        """
        if system.equations.kick is None:
            half = p + 0.5 * dt * system.smooth_force(q, p)
            p = p + dt * system.smooth_force(q, half)
        free = jnp.zeros(p.shape, bool)
        return jax.lax.cond(
            self.system.switches.friction, lambda p: _rubbed(system, q, p, dt, ahead, stuck), lambda p: (p, free), p
        )

    def _struck(self, x: Array, t: Array, dt: Array, inputs: Array) -> Array:
        """The phase point from which a substep starts that has impulses in it, as if they came at once.

        What comes at a share s of the substep acts too early by s dt, during which it would still have moved with the
        rates before it: right to order two.
        """

        def struck(x: Array) -> Array:
            size, share, places = self._impulses(t, dt, inputs)
            system = self.system.at(t + 0.5 * dt, inputs, dt)
            before = system.rates(x)

            def one(size: Array, share: Array, place: Array) -> Array:
                jump = size * (jnp.arange(len(x)) == place)
                return jump + share * dt * (before - system.rates(x + jump))

            return x + jax.vmap(one)(size, share, places).sum(0)

        return jax.lax.cond(self.system.switches.impulses, struck, lambda x: x, x)

    def _impulses(self, t: Array, dt: Array, inputs: Array) -> tuple[Array, Array, Array]:
        """Sizes of all impulses, 0 outside this substep; when they come, in shares of it; where they enter."""
        eq = self.system.equations
        empty = jnp.zeros(eq.width, t.dtype)
        known = eq.impulses(self.system.at(t, inputs, dt).arguments(empty, empty)).reshape(-1, 2)
        sizes, times = self.system.values[IMPULSE.name, None]
        size, when = jnp.concatenate([sizes, known[:, 0]]), jnp.concatenate([times, known[:, 1]])
        share = (when - t) / jnp.where(dt > 0, dt, 1.0)
        inside = (share >= 0) & (share < 1) & (dt > 0)
        places = eq.width + jnp.asarray([*range(eq.declared), *eq.jumping])
        return jnp.where(inside, size, 0.0), jnp.where(inside, share, 0.0), places


def _dragged(system: SimulatedHamiltonian, q: Array, p: Array, dt: Array) -> Float[Array, " width"]:
    """The momentum after these have acted for `dt` at frozen q, by classical Runge-Kutta; its stages are a loop, so
    that the force is compiled once."""

    def stage(carry: tuple[Array, Array], row: Array) -> tuple[tuple[Array, Array], None]:
        total, rate = carry
        place, weight = row
        rate = system.smooth_force(q, p + place * dt * rate)
        return (total + weight * dt * rate, rate), None

    return jax.lax.scan(stage, (p, jnp.zeros_like(p)), jnp.asarray(_STAGES, p.dtype))[0][0]


def _rubbed(system: SimulatedHamiltonian, q: Array, p: Array, dt: Array, ahead: Any, stuck: Any) -> tuple[Array, Array]:
    """The momentum after dry friction has acted for `dt`, and what it has stopped.

    By the mean sign of the velocity over the time that the kick stands for, which lies `ahead` (1) or behind (-1): a
    sign taken at one instant would make the trajectory jump with the starting values. Where friction can hold every
    other force, it stops the motion; of what was stuck it takes all that the other forces have given since, half of it
    before this kick's own time. Exact for a kinetic energy quadratic in each momentum.
    """
    eq, n = system.equations, system.equations.declared
    friction = system.of(COULOMB)
    v, acceleration = jax.jvp(system.velocity, (q, p), (system.velocity(q, p), -system.slope(q, p)))
    v, acceleration = v[:n], acceleration[:n]
    softness = eq.softness(system.arguments(q, p))[:n]
    stop = v / softness
    most = friction * dt * jnp.where(jnp.broadcast_to(stuck, q.shape)[:n], 2.0, 1.0)
    held = (friction > 0) & (jnp.abs(stop) <= most) & (jnp.abs(acceleration) <= friction * softness)
    change = jnp.where(held, stop, friction * dt * _mean_sign(v, v + ahead * dt * acceleration))
    return p - jnp.pad(change, (0, eq.width - n)), jnp.pad(held, (0, eq.width - n))


def _mean_sign(begin: Float[Array, " d"], end: Float[Array, " d"]) -> Float[Array, " d"]:
    """Mean of the sign of what goes evenly from `begin` to `end`: (|end| - |begin|) / (end - begin)."""
    crosses = begin * end < 0
    change = jnp.where(crosses, end - begin, 1.0)
    return jnp.where(crosses, (jnp.abs(end) - jnp.abs(begin)) / change, jnp.sign(begin + end))


class SimulatedReading(eqx.Module):
    """What the sensors show at a phase point, (1 + g) h(x(t - tau)) + b + r (t - t_0).

    The context is the time and what is known of the inputs: how they stand, or besides the length of pieces of the time
    before and their means in each, the latest first.
    """

    system: Simulated

    def __init__(
        self, equations: Equations, parameters: Any, coefficients: Any, switches: Switches = EVERYTHING
    ):  # fmt: skip
        self.system = Simulated(equations, parameters, coefficients, switches)

    def __call__(
        self, x: Float[Array, " state"], context: tuple[Float[Array, ""], Float[Array, " known"]]
    ) -> Float[Array, " channel"]:
        t, known = context
        system = self.system.at(t, known)  # a reading is taken at an instant
        off = system.of(BIAS) + system.of(DRIFT) * (t - system.equations.start - system.of(DRIFT, 1))
        seen = self._seen(system, x, known) if system.equations.delayed else _shown(system, x)
        return (1 + system.of(GAIN)) * seen + off

    def _seen(self, system: SimulatedHamiltonian, x: Array, known: Array) -> Float[Array, " channel"]:
        """h as it was a delay ago, of the phase point, the inputs and all else of then."""
        t = system.moment.time

        def back(x: Array, delay: Array) -> Float[Array, " channel"]:
            then = self.system.at(t - delay, _input_then(known, len(self.system.equations.inputs), delay))
            return _shown(then, self._back(x, t, known, delay))

        def late(x: Array) -> Array:
            shown = jax.vmap(lambda delay: back(x, delay))(system.of(DELAY))
            return jnp.stack([row[k] for k, row in enumerate(shown)])

        return jax.lax.cond(self.system.switches.delays, late, lambda x: _shown(system, x), x)

    def _back(self, x: Array, t: Array, known: Array, delay: Array) -> Float[Array, " state"]:
        """The phase point a little earlier, in steps of classical Runge-Kutta; their stages are one loop, so that the
        rates are compiled once."""
        h = -delay / _BACKWARDS

        def stepped(begun: Array, step: Array) -> tuple[Array, None]:
            inputs = _inputs_back(known, len(self.system.equations.inputs), -h, step)

            def stage(carry: tuple[Array, Array], row: Array) -> tuple[tuple[Array, Array], None]:
                (total, rate), (place, weight) = carry, row
                rate = self.system.at(t + (step + place) * h, inputs).rates(begun + place * h * rate)
                return (total + weight * h * rate, rate), None

            return jax.lax.scan(stage, (begun, jnp.zeros_like(x)), jnp.asarray(_STAGES, x.dtype))[0][0], None

        return jax.lax.scan(stepped, x, jnp.arange(_BACKWARDS, dtype=x.dtype))[0]


def _inputs_back(
    known: Float[Array, " known"], number: int, length: Float[Array, ""], step: Float[Array, ""]
) -> Float[Array, " input"]:
    """The inputs' mean in one of the steps of some length back from a reading; as they stand, where no more is
    known."""
    if len(known) == number:
        return known
    now, piece, means = _past(known, number)

    def since(age: Array) -> Float[Array, " input"]:
        """Their integral from so long before the reading on."""
        inside = jnp.clip(age - piece * np.arange(len(means)), 0.0, piece)
        return inside @ means + jnp.maximum(age - piece * len(means), 0.0) * means[-1] + jnp.minimum(age, 0.0) * now

    is_short = jnp.abs(length) <= _SHORT * piece
    mean = (since((step + 1.0) * length) - since(step * length)) / jnp.where(is_short, 1.0, length)
    return jnp.where(is_short, means[0], mean)


def _past(known: Float[Array, " known"], number: int) -> tuple[Array, Array, Array]:
    """The inputs as they stand, the length of a piece of the time before, and their means in each."""
    return known[:number], known[number], known[number + 1 :].reshape(-1, number)


def _input_then(known: Float[Array, " known"], number: int, delay: Float[Array, ""]) -> Float[Array, " input"]:
    """The inputs as they stood a delay ago, from one middle of a piece to the next; as they stand, where no more is
    known."""
    if len(known) == number:
        return known
    now, piece, means = _past(known, number)
    middles = piece * (np.arange(len(means)) + 0.5)
    begins, gaps = jnp.append(0.0, middles[:-1]), piece * np.append(0.5, np.ones(len(means) - 1))
    share = jnp.clip((delay - begins) / jnp.where(gaps > 0, gaps, 1.0), 0.0, 1.0)  # rows that only fill up have none
    return now + share @ (means - jnp.concatenate([now[None], means[:-1]]))


def _shown(system: SimulatedHamiltonian, x: Float[Array, " state"]) -> Float[Array, " channel"]:
    """What sensors without delay and without error show."""
    return system.equations.readings(system.arguments(*ig.split(x)))
