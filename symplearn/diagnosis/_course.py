"""What every recording gives to its trajectories, and the model at given values: flow and observation."""

from functools import lru_cache, partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import integrators as ig

from .._augmented import Equations
from .._augmented_flow import SimulatedFlow, SimulatedReading, Span
from .._augmented_system import EVERYTHING, Switches
from .._effects import COULOMB, DELAY, FORCING, IMPULSE, MODULATION, REGIME, STOP
from ._problem import Combination, Problem

# Effects whose work is left out where no lane has one of them, by the switch that they share.
_SWITCHED = ((COULOMB,), (IMPULSE,), (DELAY,), (FORCING,), (MODULATION, REGIME), (STOP,))


class Course(eqx.Module):
    """What one recording gives to a trajectory: spans, rows, and the part of the model that is its own."""

    spans: Span
    times: Float[Array, " time"]
    inputs: Float[Array, "time known"]
    parameters: Float[Array, " parameter"]
    terms: Float[Array, " coefficient"]
    # How calibrated values enter the parameters and the coefficients.
    to_parameters: Float[Array, "f parameter"]
    to_coefficients: Float[Array, "f coefficient"]


def courses(problem: Problem) -> list[Course]:
    """The courses of a problem's recordings, padded to one length."""
    longest = max(len(rows.times) for rows in problem.rows)
    return [_course(problem, r, longest) for r in range(len(problem.rows))]


def _course(problem: Problem, r: int, length: int) -> Course:
    rows, c = problem.rows[r], problem.calibrated
    to_parameters = np.zeros((c.size, problem.parameters.shape[1]))
    to_coefficients = np.zeros((c.size, problem.equations.size))
    for j in range(c.size):
        table = to_parameters if j < c.parameters else to_coefficients
        table[j, c.place[j]] = c.recordings[r, j]
    known = problem.parameters[r].copy()
    known[c.place[: c.parameters]] = 0.0
    lack = length - len(rows.times)

    def padded(leaf: Any, more: int) -> Array:
        return jax.device_put(np.pad(np.asarray(leaf), [(0, more)] + [(0, 0)] * (np.ndim(leaf) - 1)))

    return Course(
        # One span more than there are gaps: the last leads nowhere, and padding has steps of length zero.
        jax.tree.map(partial(padded, more=lack + 1), rows.spans),
        padded(rows.times, lack),
        padded(rows.inputs, lack),
        *map(jax.device_put, (known, problem.terms[r], to_parameters, to_coefficients)),
    )


def model_at(
    equations: Equations, integrator: ig.AbstractIntegrator, course: Course, calibrated: Array, coefficients: Array,
    switches: Switches = EVERYTHING,
) -> tuple[SimulatedFlow, SimulatedReading]:  # fmt: skip
    """Flow and observation at calibrated values, with `coefficients` added to the terms already there."""
    parameters = course.parameters + calibrated @ course.to_parameters
    total = course.terms + calibrated @ course.to_coefficients + coefficients
    return (
        SimulatedFlow(equations, integrator, parameters, total, switches),
        SimulatedReading(equations, parameters, total, switches),
    )


def effect_coefficients(slots: Float[Array, " slot"], onehot: Float[Array, "row coefficient"]) -> Array:
    """The coefficient vector of a combination's values; the last row of `onehot` is always on."""
    return jnp.append(slots, 1.0) @ onehot


def costly(problem: Problem, combination: Combination) -> int:
    """Which switches a combination needs; lanes that need the same ones are stepped together."""
    mine = {problem.candidate(member).effect for member in combination}
    return sum(2**k * bool(mine & set(effects)) for k, effects in enumerate(_SWITCHED))


def needed(
    problem: Problem, recording: int, hots: Float[np.ndarray, "lane row coefficient"]
) -> Bool[np.ndarray, " switch"]:
    """Which switches lanes that are stepped together need, for what they have or what is known."""
    return np.any(needed_each(problem, recording, hots), axis=0)


def needed_each(
    problem: Problem, recording: int, hots: Float[np.ndarray, "lane row coefficient"]
) -> Bool[np.ndarray, "lane switch"]:
    """Which switches each lane needs."""
    on = (problem.terms[recording] != 0) | (hots != 0).any(1)
    on[:, problem.calibrated.place[problem.calibrated.parameters :]] = True
    own, always = _touched(problem.equations)
    return (own & on[:, None]).any(2) | always


@lru_cache(maxsize=8)
def _touched(equations: Equations) -> tuple[Bool[np.ndarray, "switch coefficient"], Bool[np.ndarray, " switch"]]:
    """The first coefficient of every effect of a switch, and whether it is on whatever they are."""
    own = np.zeros((len(_SWITCHED), equations.size), bool)
    for k, effects in enumerate(_SWITCHED):
        own[k, [c.first for c in equations.candidates if c.effect in effects]] = True
    return own, np.array([IMPULSE in effects and bool(equations.jumping) for effects in _SWITCHED])
