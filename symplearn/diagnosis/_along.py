"""What the augmented simulation has at given phase points: velocities, forces, energy, readings."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

import integrators as ig

from .._augmented_flow import SimulatedReading
from .._augmented_system import Simulated
from ._problem import Combination, Problem

# Of a system, at a phase point, with its inputs, at a time.
What = Callable[[Simulated, Array, Array, Array], Array]


def velocity(system: Simulated, x: Array, u: Array, t: Array) -> Array:
    return system.at(t, u).velocity(*ig.split(x))


def force(system: Simulated, x: Array, u: Array, t: Array) -> Array:
    """Every force but dry friction and impulses."""
    return rates(system, x, u, t)[system.equations.width :]


def parts(system: Simulated, x: Array, u: Array, t: Array) -> Array:
    """What the known forces are sums of."""
    return system.equations.parts(system.at(t, u).arguments(*ig.split(x)))


def rates(system: Simulated, x: Array, u: Array, t: Array) -> Array:
    """The rate of change of the phase point, dry friction and impulses left out."""
    return system.at(t, u).rates(x)


def energy(system: Simulated, x: Array, u: Array, t: Array) -> Array:
    return system.at(t, u).energy(*ig.split(x))


def readings(system: Simulated, x: Array, u: Array, t: Array) -> Array:
    return SimulatedReading(system.equations, system.parameters, system.coefficients)(x, (t, u))


def along(
    problem: Problem,
    what: What,
    recording: int,
    z: Float[np.ndarray, " z"],
    combination: Combination,
    states: Float[np.ndarray, "row state"],
) -> np.ndarray:
    """One of the functions above at phase points of a recording's leading rows; of its last row those beyond."""
    rows, n = problem.rows[recording], len(states)
    given = (problem.parameter_values(recording, z), problem.coefficients(recording, z, combination))
    # The last row is repeated up to the longest recording's length, so that one program serves all.
    every = np.minimum(np.arange(max(len(one.times) for one in problem.rows)), n - 1)
    row = np.minimum(every, len(rows.times) - 1)
    moving = (states[every], rows.inputs[row], rows.times[row])
    return np.asarray(_mapped(problem.equations, what, *given, *moving))[:n]


@partial(jax.jit, static_argnums=(0, 1))
def _mapped(equations: Any, what: Any, parameters: Array, coefficients: Array, states: Array, inputs: Array, times):
    system = Simulated(equations, parameters, coefficients)
    return jax.vmap(lambda x, u, t: what(system, x, u, t))(states, inputs, times)


def along_all(
    problem: Problem,
    what: What,
    z: Float[np.ndarray, " z"],
    paths: Sequence[Float[np.ndarray, "_ state"]],
) -> np.ndarray:
    """The same without effects along the paths of all recordings, end to end."""
    return np.concatenate([along(problem, what, r, z, (), path) for r, path in enumerate(paths)])
