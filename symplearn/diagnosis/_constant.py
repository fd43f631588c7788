"""Readings that are told as well by a constant: a simulation of which they show nothing.

Where the noise is not given, any misfit may pass for noise. A simulation that runs far away from what was read would
be consistent with it, and so would one in which a gain makes every reading zero.
"""

import numpy as np

from ._calibrate import weights
from ._problem import Problem
from ._weighed import Estimate, information


def constant_evidence(problem: Problem, bare: Estimate | None) -> float:
    """Log evidence of the fitted rows where every sensor reads a constant of its own, and noise.

    A noise that is not given has its likeliest value; each constant, unknown within the noise that then is seen, owes
    half the logarithm of the number of readings, as in BIC. But constants are ahead of a simulation, fitted as `bare`,
    by no more than they follow the readings better: that little is known of where it starts is none of its faults.
    Minus infinity where a sensor read one value throughout, of which no noise can be told.
    """
    likelihood, number = _likelihood(problem)
    evidence = likelihood - 0.5 * number
    if bare is None or not np.isfinite(bare.log_likelihood):
        return evidence
    return min(evidence, bare.log_evidence + likelihood - bare.log_likelihood)


def _likelihood(problem: Problem) -> tuple[float, float]:
    """The logarithm of the largest likelihood, and the sum of those of the numbers of readings."""
    rows = [r.fitted for r in problem.rows]
    weight = weights(problem, rows)
    total, owed = 0.5 * information(weight), 0.0
    every = np.concatenate(weight)
    readings = np.concatenate([r.readings[:n] for r, n in zip(problem.rows, rows, strict=True)])
    for y, w, given in zip(readings.T, every.T, problem.noise, strict=True):
        y, w = y[w > 0], w[w > 0]
        if np.isnan(given) and len(y) and np.ptp(y) == 0:
            return -np.inf, 0.0
        if len(y):
            square = float((w * (y - np.average(y, weights=w)) ** 2).sum())
            variance = square / len(y) if np.isnan(given) else given**2
            total -= 0.5 * (len(y) * np.log(2 * np.pi * variance) + square / variance)
            owed += np.log(len(y))
    return total, owed
