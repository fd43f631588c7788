"""Measured geometry: what a step preserves, and how its error falls."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from integrators._integrate import Trajectory, strongly_typed
from integrators._integrator import AbstractIntegrator
from integrators._system import System


def symplectic_defect(
    system: System,
    integrator: AbstractIntegrator,
    x: Float[Array, " two_d"],
    dt: float,
    *,
    t: float = 0.0,
    lifted: bool = True,
) -> Float[Array, ""]:
    """Largest entry of |J'SJ - S|, J the Jacobian of one step of `dt` from the phase point `x` at time `t`.

    **Arguments:** - `lifted`: on the integrator's own space, or on (q, p) by lift, step, project.
    """
    integrator.accepts(system)
    return _symplectic_defect(*_strong(system, integrator, x, t, dt), lifted)


def reversibility_defect(
    system: System,
    integrator: AbstractIntegrator,
    x: Float[Array, " two_d"],
    dt: float,
    *,
    t: float = 0.0,
    reversor: Float[Array, " two_d"] | None = None,
) -> Float[Array, ""]:
    """Largest entry of |R step R step x - x| on the integrator's own space, R the reversal of motion.

    **Arguments:** - `reversor`: the signs of R, for a system that is not even in p; by default q is kept and
    p is flipped.
    """
    integrator.accepts(system)
    if reversor is None:
        reversor = jnp.repeat(jnp.array([1.0, -1.0]), len(x) // 2)
    return _reversibility_defect(*_strong(system, integrator, x, t, dt), jnp.asarray(reversor, dtype=float))


class EnergyDrift(eqx.Module):
    """How far the energy strays.

    **Fields:**

    - `largest`: max |H - H_0|.
    - `slope`: least-squares dH/dt.
    - `secular`: |slope| times the duration. It is far below `largest` where the error is bounded, and like it
      where the energy drifts.
    """

    largest: Float[Array, ""]
    slope: Float[Array, ""]
    secular: Float[Array, ""]

    def __str__(self) -> str:
        return f"max |H - H_0| = {self.largest:.3g}, dH/dt = {self.slope:.3g}, over the duration {self.secular:.3g}"


def energy_drift(trajectory: Trajectory) -> EnergyDrift:
    """The energy error of a trajectory, bounded or secular; of one point, none. NaN throughout where it diverged."""
    ts, error = trajectory.ts, trajectory.energies - trajectory.energies[0]
    centred = ts - ts.mean()
    spread = centred @ centred
    slope = centred @ error / jnp.where(spread > 0.0, spread, 1.0)
    drift = EnergyDrift(jnp.abs(error).max(), slope, jnp.abs(slope * (ts[-1] - ts[0])))
    return jax.tree.map(lambda number: jnp.where(trajectory.finite, number, jnp.nan), drift)


def observed_order(
    system: System,
    integrator: AbstractIntegrator,
    x0: Float[Array, " two_d"],
    duration: float,
    *,
    steps: tuple[int, ...] = (40, 80, 160),
    reference: Float[Array, " two_d"] | None = None,
) -> float:
    """Slope of log error against log dt at time `duration`, from runs of `steps` equal steps.

    **Arguments:**

    - `steps`: the counts of steps, at least two, in increasing order.
    - `reference`: the true end point; by default the same method with 16 times the most steps, which biases
      the slope of a method of order 2 by less than 0.01.

    **Raises:** `ValueError` where `steps` are fewer than two different counts, which have no slope.
    """
    if len(set(steps)) < 2:
        raise ValueError(f"`observed_order` needs at least two different counts of `steps`, but was given {steps}.")
    integrator.accepts(system)
    strong = _strong(system, integrator, x0, 0.0, duration)
    if reference is None:
        reference = _end_point(*strong, jnp.asarray(16 * max(steps)))
    errors = [float(jnp.abs(_end_point(*strong, jnp.asarray(n)) - reference).max()) for n in steps]
    return float(-np.polyfit(np.log(steps), np.log(errors), 1)[0])


def _strong(
    system: System, integrator: AbstractIntegrator, *numbers: Array | float
) -> tuple[System, AbstractIntegrator, Array, Array, Array]:
    x, t, dt = (jnp.asarray(number, dtype=float) for number in numbers)
    return strongly_typed(system), strongly_typed(integrator), x, t, dt


@eqx.filter_jit
def _symplectic_defect(
    system: System, integrator: AbstractIntegrator, x: Array, t: Array, dt: Array, lifted: bool
) -> Array:
    def step(state: Array) -> Array:
        return integrator.step(system, state, t, dt)

    if lifted:
        copies, jacobian = integrator.copies, jax.jacfwd(step)(integrator.lift(x))
    else:
        copies, jacobian = 1, jax.jacfwd(lambda x: integrator.project(step(integrator.lift(x))))(x)
    one = jnp.kron(jnp.array([[0.0, 1.0], [-1.0, 0.0]]), jnp.eye(x.shape[0] // 2))
    form = jnp.kron(jnp.eye(copies), one)
    return jnp.abs(jacobian.T @ form @ jacobian - form).max()


@eqx.filter_jit
def _reversibility_defect(
    system: System, integrator: AbstractIntegrator, x: Array, t: Array, dt: Array, reversor: Array
) -> Array:
    signs = jnp.tile(reversor, integrator.copies)
    start = integrator.lift(x)
    # A loop rather than two calls: the step is compiled once.
    end = jax.lax.fori_loop(0, 2, lambda _, state: signs * integrator.step(system, state, t, dt), start)
    return jnp.abs(end - start).max()


@eqx.filter_jit
def _end_point(
    system: System, integrator: AbstractIntegrator, x0: Array, t: Array, duration: Array, steps: Array
) -> Array:
    # The count of steps is traced, so that all runs share one compilation.
    dt = duration / steps
    end = jax.lax.fori_loop(
        0, steps, lambda k, state: integrator.step(system, state, t + k * dt, dt), integrator.lift(x0)
    )
    return integrator.project(end)
