"""Readings or times in another unit than the simulation's, turned round, as an input may be, or in each other's column.

What seems missing is then as strong as all that is there, and whatever follows the recording has many names. Once they
are converted the simulation as it is follows them, which is told beside the answer.
"""

import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from .._effects import OUTLIERS
from .._errors import InputError
from .._recording import Recording
from .._simulation_records import SimulationFile
from ._along import along, force
from ._build import build, equations_for, first_substep, rows_fitted
from ._calibrate import grow
from ._found import Found
from ._missed import share_missed, variances
from ._options import Options
from ._problem import Problem
from ._start import beginning, first_fits, priors_without_effects, windows
from ._trajectory import Stepper

# What readings and times may have been multiplied by, and how that comes about.
_READ = ((180 / np.pi, "degrees for radians"), (1e3, "thousandths for units"), (1e2, "hundredths for units"),
         (1e-3, "thousands for units"))  # fmt: skip
_TIMED = ((1e3, "milliseconds for seconds"), (1e-3, "seconds for milliseconds"), (60.0, "seconds for minutes"),
          (1 / 60.0, "minutes for seconds"))  # fmt: skip
# A missing force counts as strong from this share of all that is there, by the best path that follows the recording.
# Seen: 0.93 for columns exchanged, 1.8 for a sign and 12 for degrees; 0.09 at most in fifteen concealed cases.
_STRONG = 0.5
# The largest share of what the readings vary by that a converted recording may be missed by, and that share's of what
# it is missed by as it is. Seen once converted: 0.0004 to 0.07, and 0.21 beside a strong damping.
_FOLLOWED, _BETTER = 0.3, 0.3
# How many conversions are tried at most, and by how many rows of every recording.
_MOST, _ROWS = 20, 200
# A share of what it is missed by from which on nothing else is tried.
_CLEARLY = 0.1
# Conversions do about as well that miss the readings by no more than so many times as much as the best.
_AS_WELL = 1.5
# Windows in which trajectories are fitted, by share of the rows, and how many are.
_GROWTH, _STARTS = (0.16, 0.32, 0.64, 1.0), 4
_CHECK = "check units, signs and columns before anything else"


@dataclass(frozen=True)
class _Conversion:
    """What is done to the recordings, in words, and the recordings then."""

    said: str
    recordings: Sequence[Recording]


def in_another_time(
    file: SimulationFile, recordings: Sequence[Recording], stepper: Stepper, z: Float[np.ndarray, "lane z"],
    options: Options, deadline: float,
) -> list[str]:  # fmt: skip
    """A sentence, told at once, where the first fits do not even follow a few rows, and the simulation follows many
    once the times are converted: the search takes many times as long then, and may find a motion among so many swings
    between two rows that follows them as well."""
    few = beginning(stepper.problem, rows_fitted(stepper.problem.rows))
    if _share(stepper, z[:_STARTS], few) < _FOLLOWED:
        return []
    options.progress("trying whether the time is in another unit")
    missed = _missed(file, recordings, options)
    for one in _in_other_times(file, recordings):
        if time.monotonic() > deadline:
            break
        share = _missed(file, one.recordings, options)
        if share < _CLEARLY * min(1.0, missed):
            options.notice(f"{_told(one, share, missed)}: stop here and convert them, if that is what they are")
            return [f"{_told(one, share, missed)}: {_CHECK}"]
    return []


def in_other_units(
    file: SimulationFile, recordings: Sequence[Recording], stepper: Stepper, found: Found, options: Options,
    deadline: float,
) -> list[str]:  # fmt: skip
    """A sentence where the simulation as it is follows the recordings far better once a column or the time is
    converted; none where no missing force is as strong as what is there, and where time has run out."""
    if not found.complete:
        return []
    bare = found.of((), "white")
    missed = np.inf if bare is None else _share(stepper, bare.z[None], _first(stepper.problem))
    if missed < _FOLLOWED or not _is_as_strong(stepper.problem, found):
        return []
    options.progress("trying whether something is in another unit")
    missed = min(missed, _missed(file, recordings, options))
    tried: list[tuple[float, _Conversion]] = []
    for one in itertools.islice(_conversions(file, recordings), _MOST):
        if time.monotonic() > deadline:
            return []
        tried.append((_missed(file, one.recordings, options), one))
        if tried[-1][0] < _CLEARLY * min(1.0, missed):
            break
    least = min(share for share, _ in tried)
    if not least < min(_FOLLOWED, _BETTER * missed):
        return []
    # Of those that do about as well, as all scales do for what is linear, the one that comes about most easily.
    share, one = next((share, one) for share, one in tried if share <= _AS_WELL * least)
    return [f"{_told(one, share, missed)}: {_CHECK}"]


def _told(one: _Conversion, share: float, missed: float) -> str:
    return (
        f"with {one.said} the simulation misses the readings by {_percent(share)} of what they vary by, with nothing "
        f"added to it, and by {_percent(missed)} as they are"
    )


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share < 1 else "more than all"


def _conversions(file: SimulationFile, recordings: Sequence[Recording]) -> Iterator[_Conversion]:
    """Everything that is tried, what comes about most easily first."""
    columns = recordings[0].columns
    every = tuple(range(len(columns)))
    yield from _rescaled(recordings, every)
    driven = ", or of what drives it," if file.recording.inputs else ""  # of what is symmetric these are one
    for j, name in enumerate(columns):
        yield _Conversion(f"the sign of {name}{driven} turned round", [_scaled(r, (j,), -1.0) for r in recordings])
    for j, name in enumerate(file.recording.inputs):
        yield _Conversion(f"the sign of the input {name} turned round", [_driven_back(r, j) for r in recordings])
    yield from _in_other_times(file, recordings)
    for j, k in itertools.combinations(every, 2):
        yield _Conversion(f"{columns[j]} and {columns[k]} exchanged", [_exchanged(r, j, k) for r in recordings])
    for j in every if len(every) > 1 else ():
        yield from _rescaled(recordings, (j,))


def _in_other_times(file: SimulationFile, recordings: Sequence[Recording]) -> Iterator[_Conversion]:
    for factor, said in _TIMED:
        what = f"{file.recording.time} divided by {factor:.4g} ({said})"
        yield _Conversion(what, [_timed(r, factor) for r in recordings])


def _rescaled(recordings: Sequence[Recording], group: Sequence[int]) -> Iterator[_Conversion]:
    names = " and ".join(recordings[0].columns[j] for j in group)
    for factor, said in _READ:
        what = f"{names} divided by {factor:.4g} ({said})"
        yield _Conversion(what, [_scaled(r, group, factor) for r in recordings])


def _scaled(recording: Recording, group: Sequence[int], factor: float) -> Recording:
    readings = recording.readings.copy()
    readings[:, group] /= factor
    return replace(recording, readings=readings)


def _exchanged(recording: Recording, j: int, k: int) -> Recording:
    readings = recording.readings.copy()
    readings[:, [j, k]] = readings[:, [k, j]]
    return replace(recording, readings=readings)


def _driven_back(recording: Recording, j: int) -> Recording:
    assert recording.inputs is not None  # it has a column of them
    values = recording.inputs.values.copy()
    values[:, j] *= -1.0
    return replace(recording, inputs=replace(recording.inputs, values=values))


def _timed(recording: Recording, factor: float) -> Recording:
    inputs = recording.inputs
    if inputs is not None:
        inputs = replace(inputs, times=inputs.times / factor, missing=inputs.missing / factor)
    return replace(recording, times=recording.times / factor, inputs=inputs)


def _is_as_strong(problem: Problem, found: Found) -> bool:
    """Whether a missing force is as strong as what is there on some coordinate, or none follows the recording."""
    bare = [c for c in found.estimates if all(problem.candidate(m).effect is OUTLIERS for m in c)]
    paths = [path for c in bare if (path := found.of(c, "force"))]
    path = max(paths, key=lambda one: one.log_evidence, default=None)
    if path is None or path.paths is None or not all(np.isfinite(one).all() for one in path.paths):
        return True
    noise, shown = variances(problem)
    if (path.noise**2 > noise + _FOLLOWED**2 * shown).any():
        return True
    assert found.priors.forces is not None  # effects were weighed
    own, d = problem.equations.momentum, problem.equations.declared  # what is unseen may come after it
    missing = [np.gradient(one[:, own], rows.times[: len(one)], axis=0)[:, :d]
               - along(problem, force, r, path.z, (), one)[:, :d]
               for r, (one, rows) in enumerate(zip(path.paths, problem.rows, strict=True)) if len(one) > 1]  # fmt: skip
    size = np.sqrt(np.mean(np.concatenate(missing) ** 2, axis=0)) if missing else np.zeros(d)
    return bool((size > _STRONG * found.priors.forces[:d]).any())


def _missed(file: SimulationFile, recordings: Sequence[Recording], options: Options) -> float:
    """What share of their variation converted recordings are missed by along the simulation's best trajectory;
    infinite where they cannot be laid out."""
    try:
        stepper = Stepper(_converted(file, recordings, options), options.jobs)
    except InputError:
        return np.inf
    priors, rows = priors_without_effects(stepper.problem), _first(stepper.problem)
    z = first_fits(stepper, priors, rows).z[:_STARTS]
    growing = windows(rows, _GROWTH, max(8, 4 * stepper.problem.state))
    return _share(stepper, grow(stepper, z, [()] * len(z), priors, growing).z, rows)


def _converted(file: SimulationFile, recordings: Sequence[Recording], options: Options) -> Problem:
    """The problem of converted recordings, in steps as long as they ask: one that the file gives is for what it was
    written for."""
    built = equations_for(file, recordings, options.restriction)
    substep = first_substep(replace(file, integrator=replace(file.integrator, step=None)), recordings)
    return build(file, built, recordings, options.holdout, substep, options.restriction)


def _first(problem: Problem) -> list[int]:
    """The rows that conversions are judged by: what is missing besides, as a damping, soon hides all else."""
    return [min(n, _ROWS) for n in rows_fitted(problem.rows)]


def _share(stepper: Stepper, z: Float[np.ndarray, "lane z"], rows: Sequence[int]) -> float:
    """What share of their variation the first rows of every recording are missed by along the best trajectory."""
    return float(share_missed(stepper.problem, stepper.predict(z, [()] * len(z), rows), rows).min())
