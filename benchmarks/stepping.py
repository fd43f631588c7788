"""Trajectories with their slopes, as a diagnosis steps them: by machine code, and by XLA."""

import time
from typing import Any

import numpy as np

from symplearn import Recording, parse_simulation
from symplearn.diagnosis import Restriction
from symplearn.diagnosis._batched_steps import LANES, BatchedSteps
from symplearn.diagnosis._build import augmented_equations, build
from symplearn.diagnosis._course import courses
from symplearn.diagnosis._lanes import AbstractSteps, Lanes, Threads
from symplearn.diagnosis._native_rows import NativeRows
from symplearn.diagnosis._native_steps import NativeSteps
from symplearn.diagnosis._problem import SLOTS, Problem

from ._contest import Check, Contender, contest
from ._figures import ratio_line
from ._row import Effort, Line

_ROWS, _SUBSTEP, _DIRECTIONS = 300, 0.05, 8
# Round-off of six hundred substeps, along motions that are not chaotic.
_CHECK = Check(1e-8, 1e-8)
_SYSTEMS = {
    "pendulum": ('["q"]', '["p"]', "p**2/2 - 9.81*cos(q)"),
    "Henon-Heiles": ('["q", "r"]', '["p", "s"]', "(p**2 + s**2 + q**2 + r**2)/2 + q**2*r - r**3/3"),
    "double pendulum": (
        '["q", "r"]', '["p", "s"]',
        "(p**2 + 2*s**2 - 2*p*s*cos(q - r))/(2*(1 + sin(q - r)**2)) - 2*cos(q) - cos(r)",
    ),
}  # fmt: skip


def measure(effort: Effort) -> dict[str, Any]:
    """Four motions with eight slopes each, on one thread."""
    found = {name: _contested(name, effort) for name in (("Henon-Heiles",) if effort.quick else _SYSTEMS)}
    return {"lines": [_line(name, one) for name, one in found.items()], "systems": found}


def _contested(name: str, effort: Effort) -> dict[str, Any]:
    problem = _problem(*_SYSTEMS[name])
    contenders = {"symplearn, machine code": _native, "symplearn, XLA": _batched}
    made = {who: lambda make=make: _ready(make, problem) for who, make in contenders.items()}
    return contest(f"stepping, {name}", made, {"symplearn, XLA": _CHECK}, effort)


def _native(problem: Problem) -> AbstractSteps:
    return NativeSteps(NativeRows(problem.equations, problem.integrator, 0), courses(problem), Threads(1))


def _batched(problem: Problem) -> AbstractSteps:
    return BatchedSteps(courses(problem), Threads(1))


def _ready(make: Any, problem: Problem) -> Contender:
    """What is timed, called once: tracing and compiling are in that."""
    began = time.perf_counter()
    steps, run = make(problem), _lanes(problem)

    def call() -> tuple[np.ndarray, np.ndarray]:
        (found,) = steps(problem, [run])
        return found.shown, np.stack(found.slopes)

    call()
    return Contender(call, time.perf_counter() - began)


def _problem(coordinates: str, momenta: str, hamiltonian: str) -> Problem:
    text = f"""
[system]
coordinates = {coordinates}
momenta = {momenta}
hamiltonian = "{hamiltonian}"
[recording]
time = "t"
[recording.observe]
y = "q"
"""
    file = parse_simulation(text, "stepping.toml")
    times = 2 * _SUBSTEP * np.arange(_ROWS)
    recording = Recording(1, "stepping.csv", ("y",), times, np.zeros((_ROWS, 1)), np.arange(_ROWS) + 2, None)
    return build(file, augmented_equations(file), [recording], 0.0, _SUBSTEP, Restriction())


def _lanes(problem: Problem) -> Lanes:
    """A viscous damping and a stiffness of unknown size, and the start."""
    state, size = problem.state, problem.equations.size
    z = np.concatenate([np.linspace(0.1, 0.3, state), np.full(SLOTS, 0.01)])
    hot = np.zeros((SLOTS + 1, size))
    for slot, effect in enumerate(("viscous_damping", "linear_stiffness")):
        one = next(c for c in problem.equations.candidates if c.effect.name == effect)
        hot[slot, one.first] = 1.0
    along = np.append(np.arange(state), [state, state + 1])[:_DIRECTIONS]
    return Lanes(0, np.stack([z] * LANES), np.stack([hot] * LANES), [along] * LANES, _ROWS)


def _line(name: str, found: dict[str, Any]) -> Line:
    return ratio_line(f"{LANES} motions with slopes, {name}, {_ROWS} rows x 2 substeps", found, "symplearn, XLA")
