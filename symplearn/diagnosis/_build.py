"""From a simulation file and its recordings to the problem that is fitted."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import integrators as ig

from .._augmented import Equations, equations
from .._effects import DELAY, EFFECTS, ERROR, HIDDEN, NOISE, OUTLIERS, UNNAMED, Candidate, Drifting, Effect, Nameless
from .._errors import InputError, nearest, shown
from .._expression import symbol
from .._recording import Recording
from .._rows import HasRows, Rows, bin_width, fitted_count, lay_out
from .._simulation_records import Quantity, SimulationFile
from .._symbolic import TooLarge
from .._terms import calibrated_names, mechanics, noise_factor
from .._thinning import highest_frequency
from .._vocabulary import PARAMETER
from ._calibrate import weights
from ._course import courses
from ._problem import Calibrated, Combination, InitialPrior, Problem
from ._stochastic import free_run

# Substeps per shortest period of the motion to begin with; the search refines it by doubling.
SUBSTEPS = 8
# Substeps are fine enough when halving them changes all readings together by less than this chi-square. What is left is
# a third more in size and shifts no coefficient by more than 0.42 of its error; each halving is worth a factor of 16
# to order two, which effects of velocity are stepped to, and of 256 to order four.
_CHANGE = 0.1
_SETTLING = 0.1  # of the first change: order one would leave a thousandth after the last halving
# Rows that a sensor may be late by, and share of a period.
_LATE, _LATE_BY = 5.0, 0.5
BROAD = 3.0  # standard deviations that a sensor may be later than is known
_HALVINGS = 6  # the first of them may only keep a stiff motion from being thrown out


@dataclass(frozen=True)
class Restriction:
    """Which effects are searched: all, or the named ones; of the sensor, of the dynamics, or both.

    `restriction_of` makes it, and checks it.
    """

    effects: tuple[str, ...] | None = None
    sensor: bool = True
    dynamics: bool = True

    def allows(self, candidate: Candidate) -> bool:
        """Whether a candidate may be reported."""
        named = self.effects is None or candidate.effect.name in self.effects
        return named and (self.dynamics if candidate.effect.is_dynamics else self.sensor)

    def has(self, effect: Effect) -> bool:
        """Whether an effect is searched on any target."""
        return self.allows(Candidate(effect, ("",), (0,)))


def augmented_equations(
    file: SimulationFile,
    start: float = 0.0,
    restriction: Restriction = Restriction(),
    origin: float | None = None,
    nameless: Sequence[Nameless] = (),
) -> Equations:
    """The augmented simulation of a file whose first row used is at time `start`; phases inside count from `origin`.

    `InputError` where its Hamiltonian is too large to differentiate.
    """
    delayed = any(term.effect == DELAY.name for term in file.terms)
    try:
        built = equations(
            mechanics(file, start),
            [symbol(name) for name in file.parameters],
            [symbol(name) for name in file.recording.inputs],
            hidden=restriction.has(HIDDEN) or restriction.has(UNNAMED),  # what a force remembers takes its place
            delayed=delayed or restriction.has(DELAY),
            origin=origin,
            nameless=nameless,
        )
    except TooLarge:
        raise InputError(
            f"{file.name}: [system] hamiltonian: its derivatives are too large to work with; "
            "shorten the expression or name its parts as parameters"
        ) from None
    if file.integrator.name == "leapfrog" and not built.separable:
        raise InputError(
            f"{file.name}: [integrator] name: leapfrog steps a separable Hamiltonian, T(p) + U(q), which this is not; "
            'use "tao" or "auto"'
        )
    return built


def equations_for(
    file: SimulationFile, recordings: Sequence[Recording], restriction: Restriction, nameless: Sequence[Nameless] = ()
) -> Equations:
    """The augmented simulation of some recordings: from the first row of the first one, with phases from its middle."""
    times = recordings[0].times
    return augmented_equations(file, float(times[0]), restriction, float(np.mean(times[[0, -1]])), nameless)


def first_substep(file: SimulationFile, recordings: Sequence[Recording]) -> float:
    """The longest substep to begin with: the file's own, or a fraction of the readings' shortest period."""
    if file.integrator.step is not None:
        return file.integrator.step
    span = max(r.times[-1] - r.times[0] for r in recordings)
    frequency = max(highest_frequency(r.times, r.readings) for r in recordings)
    return float(1.0 / (SUBSTEPS * max(frequency, 4.0 / span)))


def build(
    file: SimulationFile,
    built: Equations,
    recordings: Sequence[Recording],
    holdout: float,
    substep: float,
    restriction: Restriction,
) -> Problem:
    """Lay the recordings out and gather every prior."""
    # A prior of the initial state belongs to the first row, which must then stay.
    averaged = averaged_over(file, recordings)
    latest = max(_latest(r, fitted_count(len(r.times), holdout), averaged) for r in recordings)
    past = _aligned(latest + _known_lateness(file), recordings) if built.delayed else None
    rows = tuple(lay_out(recordings, holdout, averaged, substep, bool(file.initial), past))
    parameters, known, calibrated = _values(file, built, len(recordings))
    for one in built.candidates:
        if isinstance(one.effect, Drifting):
            known[:, one.first + one.effect.size] = [r.times[0] - built.start for r in recordings]
    return Problem(
        equations=built,
        integrator=_integrator(file, built),
        rows=rows,
        parameters=parameters,
        terms=known,
        calibrated=calibrated,
        initial=_initial(file, built),
        noise=np.array([file.recording.noise.get(c, np.nan) * noise_factor(file, c) for c in built.columns], float),
        searched=tuple(
            i
            for i, c in enumerate(built.candidates)
            if c.effect.name in EFFECTS and restriction.allows(c) and _is_open(file, c)
        ),
        units=dict(file.units),
        latest=latest,
        known_outliers=tuple(j for j, c in enumerate(built.columns) if _has_outliers(file, c)),
    )


def _latest(recording: Recording, fitted: int, averaged: float) -> float:
    """How late a sensor may be by its fitted rows: some of them, or a share of the motion's shortest period, of which
    there may be many."""
    times, readings = recording.times[:fitted], recording.readings[:fitted]
    seen = [times[~np.isnan(column)] for column in readings.T]
    gaps = [averaged, *(float(np.median(np.diff(one))) for one in seen if len(one) > 1)]
    frequency = highest_frequency(times, readings)
    return max(_LATE * max(gaps), _LATE_BY / frequency if frequency > 0 else 0.0)


def _aligned(past: float, recordings: Sequence[Recording]) -> float:
    """At least a time of which every piece begins where a row does, or rows do where pieces begin."""
    shortest = _LATE * min(float(np.median(np.diff(r.times))) for r in recordings)
    return float(shortest * 2.0 ** max(0.0, np.ceil(np.log2(past / shortest) - 1e-9)))


def _known_lateness(file: SimulationFile) -> float:
    """How late sensors may be by what is known of them."""
    known = (quantity for term in file.terms if term.effect == DELAY.name for quantity in term.coefficients.values())
    return sum((abs(one.value) + BROAD * (0.0 if one.sd is None else one.sd) for one in known), 0.0)


def averaged_over(file: SimulationFile, recordings: Sequence[HasRows]) -> float:
    """How far readings are averaged; not at all where an input is part of one: it may change from row to row."""
    inputs = {file.symbols[name] for name in file.recording.inputs}
    is_fed = any(inputs & seen.tree.free_symbols for seen in file.recording.observe.values())
    return 0.0 if is_fed else bin_width(recordings)


def _has_outliers(file: SimulationFile, column: str) -> bool:
    return any(term.effect == OUTLIERS.name and term.target == (column,) for term in file.terms)


def _is_open(file: SimulationFile, candidate: Candidate) -> bool:
    """Whether the simulation leaves room for an effect: a noise can be wrong only where it is given, a parameter only
    where it is known, and nothing multiplies a parameter that is zero. Outliers that the file knows of are taken out
    whatever their share and size, and are none to be found."""
    (target, *_) = candidate.targets
    if candidate.effect is OUTLIERS:
        return not _has_outliers(file, target)
    if candidate.effect is NOISE:
        return bool(np.isfinite(file.recording.noise.get(target, np.nan) * noise_factor(file, target)))
    if candidate.effect.acts_on != PARAMETER:
        return True
    quantity = file.parameters[target]
    return quantity.value != 0 and (quantity.known or candidate.effect is not ERROR)


def _integrator(file: SimulationFile, built: Equations) -> ig.AbstractIntegrator:
    """The file's symplectic method; the flow composes it to order 4, so that its error stays below what is sought.

    Of the two leapfrogs the one with half the evaluations of the force. Tao's copies are joined after every substep, so
    that nothing need bind them; a binding strong enough to be felt within a substep takes the composition's order.
    """
    if file.integrator.name != "tao" and built.separable:
        return ig.PositionVerlet()
    return ig.Tao(omega=None)


def _initial(file: SimulationFile, built: Equations) -> InitialPrior:
    """Priors of the file's states; those of what is known but not seen are open, what is searched for starts at
    rest."""
    mean, sd = [], []
    further = range(len(file.coordinates), built.dim)
    open_ = [[0.0 if k in built.remembered else np.inf for k in further], [np.inf for _ in further]]
    for names, unseen in zip((file.coordinates, file.momenta), open_, strict=True):
        given = [file.initial.get(name) for name in names]
        mean += [0.0 if q is None else q.value for q in given] + [0.0] * (built.width - len(names))
        sd += [np.inf if q is None else (0.0 if q.known else _sd(q)) for q in given]
        sd += unseen + [0.0] * built.hidden
    return InitialPrior(np.array(mean), np.array(sd))


def _sd(quantity: Quantity) -> float:
    return np.inf if quantity.sd is None else quantity.sd


def _bounds(quantity: Quantity) -> tuple[float, float]:
    lower = -np.inf if quantity.lower is None else quantity.lower
    # A positive parameter stays a little above zero, where it may be divided by.
    lower = max(lower, 1e-9 * abs(quantity.value)) if quantity.positive else lower
    return lower, np.inf if quantity.upper is None else quantity.upper


def _values(file: SimulationFile, built: Equations, recordings: int) -> tuple[np.ndarray, np.ndarray, Calibrated]:
    """Parameters and coefficients of known terms by recording, and everything that is calibrated."""
    listed = [(name, quantity) for name, quantity in file.parameters.items()]
    listed += [(one.name, one.quantity) for one in built.further]
    parameters = np.tile([q.value for _, q in listed], (recordings, 1)).reshape(recordings, -1)
    for k, one in enumerate(built.further, start=len(file.parameters)):
        parameters[:, k] *= _mask(one.recordings, recordings)
    everywhere = np.ones(recordings)
    free = [(n, i, q, everywhere) for i, (n, q) in enumerate(listed) if not q.known]
    number = len(free)
    known = np.zeros((recordings, built.size))
    firsts, names = {c.key: c.first for c in built.candidates}, calibrated_names(file.terms)
    for count, term in enumerate(file.terms, start=1):
        if not (term.effect in EFFECTS and EFFECTS[term.effect].is_additive):
            continue  # written into the equations
        ((name, quantity),) = term.coefficients.items()
        place, mask = firsts[term.effect, term.target], _mask(term.recordings, recordings)
        if quantity.known:
            known[:, place] += mask * quantity.value
        else:
            free.append((names[count, name], place, quantity, mask))
    return parameters, known, _calibrated(free, number, recordings)


def _mask(which: Sequence[int] | None, recordings: int) -> np.ndarray:
    """One for each recording that a term is in, which are counted from 1."""
    return np.array([which is None or r + 1 in which for r in range(recordings)], float)


def _calibrated(free: Sequence[tuple[str, int, Quantity, np.ndarray]], parameters: int, recordings: int) -> Calibrated:
    bounds = np.array([_bounds(q) for _, _, q, _ in free]).reshape(-1, 2)
    return Calibrated(
        names=tuple(n for n, _, _, _ in free),
        place=np.array([i for _, i, _, _ in free], int),
        parameters=parameters,
        mean=np.array([q.value for _, _, q, _ in free], float),
        sd=np.array([_sd(q) for _, _, q, _ in free], float),
        lower=bounds[:, 0],
        upper=bounds[:, 1],
        recordings=np.stack([m for _, _, _, m in free], axis=1) if free else np.zeros((recordings, 0)),
    )


def restriction_of(
    effects: str | Iterable[str] | None = None, sensor_only: bool = False, dynamics_only: bool = False
) -> Restriction:
    """Which effects to search: `effects` by name, in a list or separated by commas, or all. With `unnamed_force` among
    them an expression is tried where none of the others explains the recording.

    **Raises:** `InputError` for an unknown effect or a contradiction.
    """
    if sensor_only and dynamics_only:
        raise InputError("--sensor-only and --dynamics-only exclude each other; give one of them")
    names = None if effects is None else _names(effects)
    return Restriction(names, sensor=not dynamics_only, dynamics=not sensor_only)


def _names(effects: str | Iterable[str]) -> tuple[str, ...]:
    given = effects.split(",") if isinstance(effects, str) else effects
    names = tuple(name.strip() for name in map(str, given) if name.strip())
    for name in names:
        if name not in EFFECTS and name != UNNAMED.name:
            raise InputError(f"--effects: unknown effect {shown(name)}; {nearest(name, EFFECTS, len(EFFECTS))}")
    if not names:
        raise InputError(f"--effects: names no effect; give some of {', '.join(EFFECTS)}, separated by commas")
    return names


def rows_fitted(rows: Sequence[Rows]) -> list[int]:
    """How many rows of each recording are for fitting."""
    return [r.fitted for r in rows]


def refined(
    rebuild: Callable[[float], Problem],
    problem: Problem,
    z: np.ndarray,
    noise: np.ndarray,
    substep: float,
    combination: Combination = (),
) -> tuple[Problem, float, bool]:
    """Halve the substep until a trajectory changes by far less than its readings can tell, at most six times.

    `rebuild` lays the problem out again with another longest substep, which is returned with it, and whether it is fine
    enough. What diverges in substeps of every length, or does not settle, as a motion that is not the recorded one may
    not near a singularity, is left as it is.
    """
    given, is_fine, changes = (problem, substep), False, list[float]()
    # Half of a substep that is longer than two spans cuts none of them, and would change nothing.
    substep = min(substep, _usual_span(problem))
    coarse, weight = _trajectories(problem, z, combination), weights(problem, rows_fitted(problem.rows))
    for _ in range(_HALVINGS):
        finer = rebuild(substep / 2)
        fine = _trajectories(finer, z, combination)
        changes.append(_chi_square(weight, coarse, fine, noise))
        if is_fine := changes[-1] < _CHANGE:
            break
        problem, coarse, substep = finer, fine, substep / 2
    finite = all(np.isfinite(one).all() for one in coarse)
    settles = is_fine or not changes[-1] > _SETTLING * changes[0]  # what diverged at first may settle yet
    return (problem, substep, is_fine) if finite and settles else (*given, is_fine)


def _chi_square(weight: Sequence[Any], a: Sequence[Any], b: Sequence[Any], noise: Any) -> float:
    """Of the difference of two runs in all recordings; not finite where one of them, too coarsely stepped, is not."""
    with np.errstate(invalid="ignore", over="ignore"):
        return sum(float((w * ((x - y) / noise) ** 2).sum()) for w, x, y in zip(weight, a, b, strict=True))


def _usual_span(problem: Problem) -> float:
    """The time between rows by which spans are cut, of the recording with the longest."""
    return max(float(np.median(np.diff(r.times))) for r in problem.rows)


def _trajectories(problem: Problem, z: np.ndarray, combination: Combination) -> list[np.ndarray]:
    out = []
    for r, course in enumerate(courses(problem)):
        x = z[r * problem.state : (r + 1) * problem.state]
        out.append(free_run(problem, course, z, combination, r, x, 0)[0][: problem.rows[r].fitted])
    return out
