"""From a simulation file and its recordings to the problem that is fitted."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

import integrators as ig

from .._augmented import Equations, equations
from .._effects import EFFECTS, Candidate
from .._errors import InputError, nearest, shown
from .._expression import symbol
from .._recording import Recording
from .._rows import Rows, bin_width, lay_out
from .._simulation_records import Quantity, SimulationFile
from .._symbolic import TooLarge
from .._terms import mechanics, noise_factor
from .._thinning import highest_frequency
from ._problem import Calibrated, InitialPrior, Problem
from ._stochastic import free_run
from ._trajectory import courses

# Substeps per shortest period of the motion to begin with; the search refines it by doubling.
SUBSTEPS = 8
# Tao's binding turns the copies by this angle per substep; far larger ones make the composition lose its order.
_BINDING = 0.2
# Substeps are fine enough when halving them changes no reading by more than this share of its noise.
_CHANGE = 0.02
_HALVINGS = 5


@dataclass(frozen=True)
class Restriction:
    """Which effects are searched: all, or the named ones; of the sensor, of the dynamics, or both."""

    effects: tuple[str, ...] | None = None
    sensor: bool = True
    dynamics: bool = True

    def allows(self, candidate: Candidate) -> bool:
        """Whether a candidate may be reported."""
        named = self.effects is None or candidate.effect.name in self.effects
        return named and (self.sensor if candidate.effect.family == "sensor" else self.dynamics)


def augmented_equations(file: SimulationFile, start: float = 0.0) -> Equations:
    """The augmented simulation of a file whose first row used is at time `start`.

    `InputError` where its Hamiltonian is too large to differentiate.
    """
    try:
        known = mechanics(file, start)
        built = equations(
            known.coordinates,
            known.momenta,
            known.hamiltonian,
            [symbol(name) for name in file.parameters],
            [symbol(name) for name in file.recording.inputs],
            known.forces,
            known.readings,
            known.drifts,
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
    rows = tuple(lay_out(recordings, holdout, bin_width(recordings), substep, shorten=not file.initial))
    known, calibrated = _terms(file, built, len(recordings))
    used = max(float(np.max(r.spans.step)) for r in rows)
    return Problem(
        equations=built,
        integrator=_integrator(file, built, used),
        rows=rows,
        parameters=np.array([q.value for q in file.parameters.values()], float),
        terms=known,
        calibrated=calibrated,
        initial=_initial(file),
        noise=np.array([file.recording.noise.get(c, np.nan) * noise_factor(file, c) for c in built.columns], float),
        searched=tuple(i for i, c in enumerate(built.candidates) if restriction.allows(c)),
        units=dict(file.units),
    )


def _integrator(file: SimulationFile, built: Equations, substep: float) -> ig.AbstractIntegrator:
    """The file's symplectic method, composed to order four so that its error stays below what is looked for."""
    if file.integrator.name != "tao" and built.separable:
        return ig.suzuki4(ig.Leapfrog())
    return ig.suzuki4(ig.Tao(omega=jnp.asarray(_BINDING / substep)))


def _initial(file: SimulationFile) -> InitialPrior:
    given = [file.initial.get(name) for name in file.states]
    mean = [0.0 if q is None else q.value for q in given]
    sd = [np.inf if q is None else (0.0 if q.known else _sd(q)) for q in given]
    return InitialPrior(np.array(mean), np.array(sd))


def _sd(quantity: Quantity) -> float:
    return np.inf if quantity.sd is None else quantity.sd


def _bounds(quantity: Quantity) -> tuple[float, float]:
    lower = -np.inf if quantity.lower is None else quantity.lower
    # A positive parameter stays a little above zero, where it may be divided by.
    lower = max(lower, 1e-9 * abs(quantity.value)) if quantity.positive else lower
    return lower, np.inf if quantity.upper is None else quantity.upper


def _terms(file: SimulationFile, built: Equations, recordings: int) -> tuple[np.ndarray, Calibrated]:
    """Coefficients of known terms, and everything that is calibrated: parameters, then coefficients of terms."""
    keys = {c.key: i for i, c in enumerate(built.candidates)}
    known = np.zeros((recordings, len(built.candidates)))
    free = [(n, i, q, np.ones(recordings)) for i, (n, q) in enumerate(file.parameters.items()) if not q.known]
    parameters = len(free)
    for term in file.terms:
        if term.effect not in EFFECTS:
            continue  # written into the equations
        place = keys[term.effect, term.target[0]]
        ((name, quantity),) = term.coefficients.items()
        mask = np.array([term.recordings is None or r + 1 in term.recordings for r in range(recordings)], float)
        if quantity.known:
            known[:, place] += mask * quantity.value
        else:
            free.append((f"{term.effect}({term.target[0]}).{name}", place, quantity, mask))
    bounds = np.array([_bounds(q) for _, _, q, _ in free]).reshape(-1, 2)
    return known, Calibrated(
        names=tuple(n for n, _, _, _ in free),
        place=np.array([i for _, i, _, _ in free], int),
        parameters=parameters,
        mean=np.array([q.value for _, _, q, _ in free], float),
        sd=np.array([_sd(q) for _, _, q, _ in free], float),
        lower=bounds[:, 0],
        upper=bounds[:, 1],
        recordings=np.stack([m for _, _, _, m in free], axis=1) if free else np.zeros((recordings, 0)),
    )


def restriction_of(effects: str | None, sensor_only: bool, dynamics_only: bool) -> Restriction:
    """The restriction that the command line asks for. `InputError` for an unknown effect or a contradiction."""
    if sensor_only and dynamics_only:
        raise InputError("--sensor-only and --dynamics-only exclude each other; give one of them")
    names = None
    if effects is not None:
        names = tuple(name.strip() for name in effects.split(",") if name.strip())
        for name in names:
            if name not in EFFECTS:
                raise InputError(f"--effects: unknown effect {shown(name)}; {nearest(name, EFFECTS)}")
        if not names:
            raise InputError(f"--effects: names no effect; give some of {', '.join(EFFECTS)}, separated by commas")
    return Restriction(names, sensor=not dynamics_only, dynamics=not sensor_only)


def rows_fitted(rows: Sequence[Rows]) -> list[int]:
    """How many rows of each recording are for fitting."""
    return [r.fitted for r in rows]


def refined(
    rebuild: Callable[[float], Problem], problem: Problem, z: np.ndarray, noise: np.ndarray, substep: float
) -> Problem:
    """Halve the substep until the readings of a trajectory change by far less than their noise, at most five times.

    `rebuild` lays the problem out again with another longest substep.
    """
    coarse = _trajectories(problem, z)
    for _ in range(_HALVINGS):
        finer = rebuild(substep / 2)
        fine = _trajectories(finer, z)
        change = np.max([np.max(np.abs(a - b), axis=0) for a, b in zip(coarse, fine, strict=True)], axis=0)
        if not np.isfinite(change).all() or (change < _CHANGE * noise).all():
            return problem
        problem, coarse, substep = finer, fine, substep / 2
    return problem


def _trajectories(problem: Problem, z: np.ndarray) -> list[np.ndarray]:
    out = []
    for r, course in enumerate(courses(problem)):
        x = z[r * problem.state : (r + 1) * problem.state]
        out.append(free_run(problem, course, z, (), r, x, 0)[0][: problem.rows[r].fitted])
    return out
