"""The simulation with the findings put back, as a simulation file again."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from .._effects import EFFECTS, NOISE, Candidate
from .._expression import Expression
from .._simulation_records import Quantity, SimulationFile, Term
from .._terms import calibrated_names
from .._vocabulary import VOCABULARY
from ._calibrate import Priors
from ._found import within_bounds
from ._problem import Problem
from ._weighed import Estimate


@dataclass(frozen=True)
class Put:
    """A term as it is put back, and where in z that of it stands which is calibrated, or was found."""

    term: Term
    places: tuple[int, ...] = ()


def augmented(
    file: SimulationFile,
    problem: Problem,
    priors: Priors,
    estimate: Estimate,
    coefficients: Mapping[int, Mapping[str, float]],
    expressions: Mapping[int, Mapping[Candidate, Expression]],
    memories: Mapping[int, Mapping[str, Expression]],
) -> SimulationFile:
    """Findings as `[[terms]]` with point values, merged with a term already there, and recalibrated parameters.

    A calibrated parameter keeps its bounds and gets its posterior as prior. `coefficients` are by member, as are the
    `expressions` of forces without a name, on each coordinate, and the `memories` of those that have one.
    """
    parameters, c = dict(file.parameters), problem.calibrated
    z = within_bounds(problem, priors, estimate).z
    sd, where = np.sqrt(np.diag(estimate.covariance)), {name: problem.head + j for j, name in enumerate(c.names)}
    for name, k in where.items():
        if name in parameters:
            parameters[name] = _recalibrated(parameters[name], float(z[k]), float(sd[k]))
    known, found = _recalibrated_terms(file, where, z, sd), dict(problem.placed(estimate.combination))
    for member, values in coefficients.items():
        one = Put(_term(problem, member, values), tuple(range(found[member].start, found[member].stop)))
        known = merged(known, one, len(problem.rows), estimate.covariance)
    terms = [one.term for one in known]
    for member, some in expressions.items():
        bare = _term(problem, member, {})
        bare = replace(bare, memory=memories.get(member, {}))
        terms += [replace(bare, target=one.targets, expression=expression) for one, expression in some.items()]
    return replace(file, parameters=parameters, terms=tuple(terms))


def _term(problem: Problem, member: int, values: Mapping[str, float]) -> Term:
    one = problem.candidate(member)
    return Term(
        effect=one.effect.name,
        target=one.targets,
        coefficients={name: Quantity(float(value)) for name, value in values.items()},
        side=one.side,
        recordings=_told({r + 1 for r in problem.members[member].recordings}, len(problem.rows)),
    )


def _recalibrated(quantity: Quantity, value: float, sd: float) -> Quantity:
    return replace(quantity, value=value, sd=sd if np.isfinite(sd) and sd > 0 else quantity.sd)


def _recalibrated_terms(
    file: SimulationFile, where: Mapping[str, int], z: Float[np.ndarray, " z"], sd: Float[np.ndarray, " z"]
) -> list[Put]:
    """Known terms as they are; calibrated coefficients, of which `where` tells the places in z, at their posterior."""
    out, names = [], calibrated_names(file.terms)
    for number, term in enumerate(file.terms, start=1):
        called = {name: names.get((number, name), "") for name in term.coefficients}
        places = {name: where[one] for name, one in called.items() if one in where}
        values = {name: _recalibrated(term.coefficients[name], float(z[k]), float(sd[k])) for name, k in places.items()}
        out.append(Put(replace(term, coefficients=dict(term.coefficients) | values), tuple(places.values())))
    return out


def merged(known: Sequence[Put], new: Put, number: int, covariance: Float[np.ndarray, "z z"]) -> list[Put]:
    """Terms with a finding among `number` recordings: where its kind adds, one term of the sum with all that act there
    already, and what stands for other recordings stays for these."""
    if not (EFFECTS[new.term.effect].is_additive or new.term.effect == NOISE.name):
        return [*known, new]
    here, law, out = _recordings(new.term, number), (new.term.effect, new.term.target), list[Put]()
    own = {k: _recordings(one.term, number) for k, one in enumerate(known) if (one.term.effect, one.term.target) == law}
    own = {k: some for k, some in own.items() if some & here}
    sums = [
        _sum([known[k] for k in acting], new, _told(which, number), covariance)
        for acting, which in _together(own, here).items()
    ]
    for k, one in enumerate(known):
        if k not in own:
            out.append(one)
        elif rest := own[k] - here:
            out.append(replace(one, term=replace(one.term, recordings=_told(rest, number))))
        out += sums if k == min(own, default=None) else []
    return out if own else [*out, *sums]


def _together(own: Mapping[int, set[int]], here: set[int]) -> dict[tuple[int, ...], set[int]]:
    """Which of some terms act together, and in which of some recordings they do."""
    out: dict[tuple[int, ...], set[int]] = {}
    for r in sorted(here):
        out.setdefault(tuple(k for k in own if r in own[k]), set()).add(r)
    return out


def _recordings(term: Term, number: int) -> set[int]:
    return set(term.recordings or range(1, number + 1))


def _told(recordings: set[int], number: int) -> tuple[int, ...] | None:
    """As a term has them: None where it is in all."""
    return None if len(recordings) == number else tuple(sorted(recordings))


def _sum(known: Sequence[Put], new: Put, recordings: tuple[int, ...] | None, covariance: np.ndarray) -> Put:
    """One term for what acts in the same recordings: its coefficient, and how well it is known, are the sum's."""
    ((name, found),) = new.term.coefficients.items()
    parts, places = [one.term.coefficients[name] for one in known], [k for one in (*known, new) for k in one.places]
    every = [q.value for q in (*parts, found)]
    # A wrong noise is looked for only where its factors are numbers, so that none of them is calibrated.
    value = math.prod(every) if new.term.effect == NOISE.name else math.fsum(every)
    sd = math.sqrt(max(0.0, covariance[np.ix_(places, places)].sum()))
    quantity = _allowed(parts, value, sd, name in VOCABULARY[new.term.effect].positive)
    return Put(replace(new.term, coefficients={name: quantity}, recordings=recordings), tuple(places))


def _allowed(parts: Sequence[Quantity], value: float, sd: float, is_positive: bool) -> Quantity:
    """A sum as it is read back: known where all of its parts are, otherwise calibrated within those limits that it
    keeps to; others were its part's and not its own."""
    if is_positive and value <= 0:
        return Quantity(0.0)  # a loss that is wholly taken back, to rounding: the term stays, and does nothing
    free = [q for q in parts if not q.known]
    if not free:
        return Quantity(value)
    old = free[0] if len(parts) == 1 else Quantity(value, known=False, sd=free[0].sd)
    return _recalibrated(
        replace(
            old,
            positive=old.positive and value > 0,
            lower=old.lower if old.lower is not None and old.lower <= value else None,
            upper=old.upper if old.upper is not None and value <= old.upper else None,
        ),
        value,
        sd,
    )
