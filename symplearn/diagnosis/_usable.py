"""What a diagnosis cannot begin with, each told in one sentence."""

from collections.abc import Iterator, Sequence

import numpy as np

from .._effects import UNNAMED
from .._errors import InputError, shown
from .._recording import Recording
from .._simulation_records import SimulationFile
from ._along import along, force, readings, velocity
from ._build import Restriction
from ._drawn import scattered
from ._problem import Problem
from ._start import priors_without_effects

# Squares of readings, of inputs and of times, and sums of them, stay numbers below this; those of spans above that.
_LARGEST, _SHORTEST = 1e100, 1e-100
# Substeps that can be laid out in all, some hundred megabytes of times.
_STEPS = 2e7
# Readings beyond the unknown numbers with which a column tells its noise: an effect has up to so many numbers more.
_MORE = 3
# Starts at which the equations of motion are looked at together.
_AT_ONCE = 3
_SAID = {
    "velocities that follow from the Hamiltonian": velocity,
    "forces that follow from the Hamiltonian": force,
    "readings": readings,
}


def check_readings(file: SimulationFile, recordings: Sequence[Recording]) -> None:
    """Every recording has two rows, and no number is so large that its square is none. `InputError` otherwise."""
    for r in recordings:
        if len(r.times) < 2:
            raise InputError(
                f"{r.name}: only one row is used, which shows no motion; give a second row, or leave the recording out"
            )
        # NaN, where nothing was read, is not larger than anything.
        for row, column in np.argwhere(np.abs(r.readings) > _LARGEST)[:1]:
            raise InputError(
                f"{r.name}, line {r.lines[row]}, column {shown(r.columns[column])}: {r.readings[row, column]:g} is too "
                f"large to compute with; leave the cell empty, or give the column in a unit in which it is below "
                f"{_LARGEST:g}"
            )
        for t, name, value in _too_large(file, r):
            raise InputError(
                f"{r.name}, t = {t:g}: {name} is {value:g}, which is too large to compute with; give it in a unit in "
                f"which it is below {_LARGEST:g}"
            )
        if np.diff(r.times).min() < _SHORTEST:
            raise InputError(
                f"{r.name}: rows lie {np.diff(r.times).min():g} apart, which is too short to compute with; give times "
                f"in a unit in which it is above {_SHORTEST:g}"
            )


def _too_large(file: SimulationFile, r: Recording) -> Iterator[tuple[float, str, float]]:
    """Times, and inputs, beyond what can be squared, and when."""
    yield from ((float(t), "the time", float(t)) for t in r.times[np.abs(r.times) > _LARGEST])
    if r.inputs is not None:
        for row, column in np.argwhere(np.abs(r.inputs.values) > _LARGEST):
            name = f"input {shown(file.recording.inputs[column])}"
            yield float(r.inputs.times[row]), name, float(r.inputs.values[row, column])


def check_steps(file: SimulationFile, recordings: Sequence[Recording]) -> None:
    """The file's own step is no finer than can be laid out. `InputError` otherwise."""
    step = file.integrator.step
    if step is None:
        return
    span = sum(float(r.times[-1] - r.times[0]) for r in recordings)
    if span / step > _STEPS:
        raise InputError(
            f"{file.name}, [integrator] step: {step:g} makes {span / step:,.0f} steps of the recordings' {span:g}, "
            f"more than can be taken; give at least {span / _STEPS:.1g}"
        )


def check_fitted(file: SimulationFile, problem: Problem, holdout: float) -> None:
    """Enough rows are left for fitting. `InputError` otherwise."""
    rows = sum(int((r.counts[: r.fitted] > 0).any(1).sum()) for r in problem.rows)
    unknown = file.unknowns + file.unknown_states * len(problem.rows)
    if rows < max(unknown, 1):
        raise InputError(
            f"--holdout: {holdout:g} leaves {rows} rows with readings for fitting, but {file.name} leaves {unknown} "
            "numbers unknown; hold out less, or give more rows"
        )


def check_columns(file: SimulationFile, problem: Problem) -> None:
    """No column has so few readings, beside others that have enough, that a trajectory may go through every one of
    them, and its noise be nothing. `InputError` otherwise."""
    seen = np.array([(r.counts[: r.fitted] > 0).sum(0) for r in problem.rows])
    enough = file.unknowns + file.unknown_states * (seen > 0).sum(0) + _MORE
    few = seen.sum(0) < enough
    for j in np.flatnonzero(few & np.isnan(problem.noise))[: 0 if few.all() else 1]:
        column = shown(problem.equations.columns[j])
        raise InputError(
            f"{file.name}, [recording.observe] {column}: {seen[:, j].sum()} readings are left for fitting, too few "
            f"to tell their noise; give {enough[j]}, give the noise in [recording.noise], or take the column out"
        )


def check_searched(problem: Problem, restriction: Restriction) -> None:
    """Some effect that was asked for can be in the simulation. `InputError` otherwise."""
    if restriction.effects is not None and not (problem.searched or restriction.has(UNNAMED)):
        raise InputError(
            f"--effects: the simulation has nothing that {', '.join(restriction.effects)} could act on; "
            "name others, or leave the option out"
        )


def check_motion(file: SimulationFile, problem: Problem) -> None:
    """What moves the simulation and what is read of it are numbers at some start. `InputError` otherwise."""
    priors = priors_without_effects(problem)
    starts = scattered(problem, priors)[:, : problem.state]
    for said, what in _SAID.items():
        tried = (
            along(problem, what, 0, priors.mean, (), starts[k : k + _AT_ONCE])
            for k in range(0, len(starts) - _AT_ONCE, _AT_ONCE)
        )
        if not any(np.isfinite(found).all(1).any() for found in tried):
            raise InputError(
                f"{file.name}: the {said} are no numbers wherever the motion starts; look for a division by zero or "
                "a root of what is negative, and correct the expression or the parameters"
            )
