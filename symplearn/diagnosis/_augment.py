"""The simulation with the findings put back, as a simulation file again."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from .._effects import EFFECTS, Candidate
from .._expression import Expression
from .._simulation_records import Quantity, SimulationFile, Term
from ._calibrate import Priors
from ._found import within_bounds
from ._problem import Problem
from ._weighed import Estimate


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
    z = within_bounds(problem, priors, estimate).z[problem.head : problem.slots]
    sd = np.sqrt(np.diag(estimate.covariance)[problem.head : problem.slots])
    for j in range(c.parameters):
        if c.names[j] in parameters:
            parameters[c.names[j]] = _recalibrated(parameters[c.names[j]], float(z[j]), float(sd[j]))
    terms = _recalibrated_terms(file, dict(zip(c.names, zip(z, sd, strict=True), strict=True)))
    for member, values in coefficients.items():
        terms = _merged(terms, _term(problem, member, values))
    for member, some in expressions.items():
        bare = _term(problem, member, {})
        bare = replace(bare, memory=memories.get(member, {}))
        terms += [replace(bare, target=one.targets, expression=expression) for one, expression in some.items()]
    return replace(file, parameters=parameters, terms=tuple(terms))


def _term(problem: Problem, member: int, values: Mapping[str, float]) -> Term:
    one, which = problem.candidate(member), problem.members[member].recordings
    return Term(
        effect=one.effect.name,
        target=one.targets,
        coefficients={name: Quantity(float(value)) for name, value in values.items()},
        side=one.side,
        recordings=None if len(which) == len(problem.rows) else tuple(r + 1 for r in which),
    )


def _recalibrated(quantity: Quantity, value: float, sd: float) -> Quantity:
    return replace(quantity, value=value, sd=sd if np.isfinite(sd) and sd > 0 else quantity.sd)


def _recalibrated_terms(file: SimulationFile, found: Mapping[str, tuple[float, float]]) -> list[Term]:
    """Known terms as they are; calibrated coefficients, found by their names, at their posterior."""
    terms = []
    for term in file.terms:
        spoken = f"{term.effect}({', '.join(term.target)})"
        values = {
            name: _recalibrated(q, *map(float, found[f"{spoken}.{name}"])) if f"{spoken}.{name}" in found else q
            for name, q in term.coefficients.items()
        }
        terms.append(replace(term, coefficients=values))
    return terms


def _merged(terms: list[Term], new: Term) -> list[Term]:
    """Add to the term of the same effect, target and recordings where effects of this kind add, or append it."""
    for k, term in enumerate(terms):
        same = (term.effect, term.target, term.recordings) == (new.effect, new.target, new.recordings)
        if same and (EFFECTS[new.effect].is_additive or new.effect == "sensor_noise"):
            (name,) = new.coefficients
            old, more = term.coefficients[name], new.coefficients[name].value
            value = old.value * more if new.effect == "sensor_noise" else old.value + more
            return [*terms[:k], replace(term, coefficients={name: replace(old, value=value)}), *terms[k + 1 :]]
    return [*terms, new]
