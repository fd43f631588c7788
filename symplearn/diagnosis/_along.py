"""What the augmented simulation has at given phase points: velocities, forces, energy, readings."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import integrators as ig

from .._augmented_flow import SimulatedHamiltonian, SimulatedReading
from ._problem import Combination, Problem


def velocity(system: SimulatedHamiltonian, x: Array) -> Array:
    return system.velocity(*ig.split(x))


def force(system: SimulatedHamiltonian, x: Array) -> Array:
    """Every force but dry friction and impulses."""
    return system.rates(x)[system.equations.width :]


def energy(system: SimulatedHamiltonian, x: Array) -> Array:
    return system.energy(*ig.split(x))


def readings(system: SimulatedHamiltonian, x: Array) -> Array:
    read = SimulatedReading(system.equations, system.parameters, system.coefficients)
    return read(x, (system.time, system.inputs))


def along(
    problem: Problem,
    what: Callable[[SimulatedHamiltonian, Array], Array],
    recording: int,
    z: Float[np.ndarray, " z"],
    combination: Combination,
    states: Float[np.ndarray, "row state"],
) -> np.ndarray:
    """One of the functions above at phase points of a recording's leading rows."""
    rows, n = problem.rows[recording], len(states)
    given = (problem.parameter_values(recording, z), problem.coefficients(recording, z, combination))
    moving = (states, rows.inputs[:n], rows.times[:n])
    found = _mapped(problem.equations, what, *(jnp.asarray(a) for a in (*given, *moving)))
    return np.asarray(found)


@eqx.filter_jit
def _mapped(equations: Any, what: Any, parameters: Array, coefficients: Array, states: Array, inputs: Array, times):
    def one(x: Array, u: Array, t: Array) -> Array:
        sudden = jnp.full((), 1e-9, x.dtype)
        return what(SimulatedHamiltonian(equations, parameters, u, t, coefficients, sudden), x)

    return jax.vmap(one)(states, inputs, times)


def along_all(
    problem: Problem,
    what: Callable[[SimulatedHamiltonian, Array], Array],
    z: Float[np.ndarray, " z"],
    paths: Sequence[Float[np.ndarray, "_ state"]],
) -> np.ndarray:
    """The same without effects along the paths of all recordings, end to end."""
    return np.concatenate([along(problem, what, r, z, (), path) for r, path in enumerate(paths)])
