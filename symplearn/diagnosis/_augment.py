"""The simulation with the findings put back, as a simulation file again."""

from dataclasses import replace

import numpy as np

from .._effects import EFFECTS
from .._simulation_records import Quantity, SimulationFile, Term
from ._problem import Problem
from ._weighed import Estimate


def augmented(
    file: SimulationFile, problem: Problem, estimate: Estimate, coefficients: dict[int, float]
) -> SimulationFile:
    """Findings as `[[terms]]` with point values, merged with a term already there, and recalibrated parameters.

    A calibrated parameter keeps its bounds and gets its posterior as prior.
    """
    parameters, c = dict(file.parameters), problem.calibrated
    z = estimate.z[problem.head : problem.head + c.size]
    sd = np.sqrt(np.diag(estimate.covariance)[problem.head : problem.head + c.size])
    for j in range(c.parameters):
        parameters[c.names[j]] = _recalibrated(parameters[c.names[j]], float(z[j]), float(sd[j]))
    terms = _recalibrated_terms(file, c.parameters, z, sd)
    for candidate, value in coefficients.items():
        one = problem.equations.candidates[candidate]
        terms = _merged(terms, one.effect.name, one.target, one.effect.coefficient, value)
    return replace(file, parameters=parameters, terms=tuple(terms))


def _recalibrated(quantity: Quantity, value: float, sd: float) -> Quantity:
    return replace(quantity, value=value, sd=sd if np.isfinite(sd) and sd > 0 else quantity.sd)


def _recalibrated_terms(file: SimulationFile, first: int, z: np.ndarray, sd: np.ndarray) -> list[Term]:
    """Known terms as they are; calibrated ones, which follow the parameters in z, at their posterior."""
    terms, place = [], first
    for term in file.terms:
        if term.effect not in EFFECTS:
            terms.append(term)
            continue
        ((name, quantity),) = term.coefficients.items()
        if not quantity.known:
            quantity = _recalibrated(quantity, float(z[place]), float(sd[place]))
            place += 1
        terms.append(replace(term, coefficients={name: quantity}))
    return terms


def _merged(terms: list[Term], effect: str, target: str, name: str, value: float) -> list[Term]:
    """Add to the term of the same effect and target that is in all recordings, or append a new one."""
    for k, term in enumerate(terms):
        if (term.effect, term.target) == (effect, (target,)) and term.recordings is None:
            old = term.coefficients[name]
            merged = replace(old, value=old.value + value)
            return [*terms[:k], replace(term, coefficients={name: merged}), *terms[k + 1 :]]
    return [*terms, Term(effect, (target,), {name: Quantity(value)})]
