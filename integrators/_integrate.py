"""The one verb: a system, an integrator and a phase point become a trajectory."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from integrators._integrator import AbstractIntegrator
from integrators._system import System, Time, split


class Trajectory(eqx.Module):
    """Phase points along time.

    **Fields:**

    - `ts`: times.
    - `xs`: phase points [q, p], shape `(time, 2d)`.
    - `energies`: H at each; forces are no part of it.
    - `finite`: whether every number is finite.
    - `diverged_at`: the first time at which one is not; infinity where there is none.
    """

    ts: Float[Array, " time"]
    xs: Float[Array, "time two_d"]
    energies: Float[Array, " time"]
    finite: Bool[Array, ""]
    diverged_at: Float[Array, ""]

    @property
    def qs(self) -> Float[Array, "time d"]:
        """Coordinates."""
        return self.xs[:, : self.xs.shape[1] // 2]

    @property
    def ps(self) -> Float[Array, "time d"]:
        """Momenta."""
        return self.xs[:, self.xs.shape[1] // 2 :]

    def require_finite(self) -> "Trajectory":
        """Itself, or `FloatingPointError` saying when it diverged. Not inside `jit`."""
        if not bool(self.finite):
            raise FloatingPointError(
                f"The trajectory left the finite numbers at t = {float(self.diverged_at):g}. "
                "Take more substeps, or a start nearer to bounded motion."
            )
        return self


def integrate(
    system: System,
    integrator: AbstractIntegrator,
    x0: ArrayLike | Sequence[float],
    ts: ArrayLike | Sequence[float],
    substeps: int = 1,
) -> Trajectory:
    """The trajectory of `system` from the phase point `x0`, at the times `ts`.

    Lifted once, so a symplectic method stays one. A divergence is said in `Trajectory.finite`.

    **Arguments:**

    - `x0`: phase point [q, p] at `ts[0]`, shape `(2d,)`.
    - `ts`: times, shape `(time,)`, as irregular as you like.
    - `substeps`: steps between two successive times.

    **Raises:** `TypeError` where the integrator cannot step the system; `ValueError` where a shape is wrong.
    """
    integrator.accepts(system)
    x0, ts = jnp.asarray(x0, dtype=float), jnp.asarray(ts, dtype=float)
    if x0.ndim != 1 or x0.shape[0] % 2 or x0.shape[0] == 0:
        raise ValueError(f"`x0` must be one phase point [q, p] of even length, but has shape {x0.shape}.")
    _refuse_misfit(system, x0, "x0")
    if ts.ndim != 1 or ts.shape[0] == 0:
        raise ValueError(f"`ts` must be a row of one or more times, but has shape {ts.shape}.")
    _refuse_count(substeps)
    return _integrate(strongly_typed(system), strongly_typed(integrator), x0, ts, substeps)


def _refuse_count(substeps: Any) -> None:
    is_count = isinstance(substeps, int | np.integer) and not isinstance(substeps, bool)
    if not is_count or substeps < 1:
        raise ValueError(f"`substeps` must be a whole number from 1 up, but is {substeps!r}.")


def _refuse_misfit(system: System, x: Array, name: str) -> None:
    """Refuse a phase point of another size than a system that tells its degrees of freedom, `dim`, is of."""
    dim = getattr(system, "dim", None)
    if isinstance(dim, int) and x.shape[:1] != (2 * dim,):
        raise ValueError(
            f"`{name}` must hold {2 * dim} numbers [q, p], since the system has {dim} degrees of freedom, but has "
            f"shape {x.shape}."
        )


def propagate(
    system: System,
    integrator: AbstractIntegrator,
    x: ArrayLike | Sequence[float],
    t0: Time,
    t1: Time,
    substeps: int = 1,
) -> Float[Array, "two_d ..."]:
    """The phase point at `t1` of the trajectory through `x` at `t0`: lift, `substeps` steps, project.

    The propagator of a filter, not jitted. It lifts at each call, so over many calls a method of two copies,
    such as `Tao`, is no longer symplectic.

    **Arguments:** `x` - phase point [q, p], shape `(2d, ...)`; further axes are points side by side.

    **Raises:** `ValueError` as `advance`, and where `x` is of another size than the system.
    """
    x = jnp.asarray(x)
    _refuse_misfit(system, x, "x")
    return integrator.project(advance(system, integrator, integrator.lift(x), t0, t1, substeps))


def advance(
    system: System,
    integrator: AbstractIntegrator,
    state: Float[Array, "n ..."],
    t0: Time,
    t1: Time,
    substeps: int = 1,
) -> Float[Array, "n ..."]:
    """The integrator's own state after `substeps` equal steps from `t0` to `t1`, in the working precision. Not jitted.

    **Raises:** `ValueError` where `substeps` is no whole number from 1 up.
    """
    _refuse_count(substeps)
    # As `integrate`: parameters and times are of that precision, and a loop's state keeps one.
    state = jnp.asarray(state, dtype=float)
    return integrator.march(system.prepared(), state, t0, (t1 - t0) / substeps, substeps)


def strongly_typed(tree: Any) -> Any:
    """The same tree with each float a leaf of JAX and no weak types, so that a new value compiles nothing."""

    def strong(leaf: Any) -> Any:
        if isinstance(leaf, float):
            return jnp.asarray(leaf, dtype=float)
        return jnp.asarray(leaf, dtype=leaf.dtype) if getattr(leaf, "weak_type", False) else leaf

    return jax.tree.map(strong, tree)


@eqx.filter_jit
def _integrate(system: System, integrator: AbstractIntegrator, x0: Array, ts: Array, substeps: int) -> Trajectory:
    prepared = system.prepared()

    def interval(state: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        state = advance(prepared, integrator, state, *ends, substeps)
        return state, integrator.project(state)

    _, later = jax.lax.scan(interval, integrator.lift(x0), (ts[:-1], ts[1:]))
    xs = jnp.concatenate([x0[None], later])
    energies = jax.vmap(lambda x, t: system.at(t).energy(*split(x)))(xs, ts)
    sound = jnp.isfinite(xs).all(axis=1) & jnp.isfinite(energies)
    first = jnp.where(sound.all(), jnp.inf, ts[jnp.argmin(sound)])
    return Trajectory(ts, xs, energies, sound.all(), first)
