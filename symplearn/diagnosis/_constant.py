"""Readings that are told as well by a constant: a simulation of which they show nothing.

Where the noise is not given, any misfit may pass for noise. A simulation that runs far away from what was read would
be consistent with it, and so would one in which a gain makes every reading zero.
"""

import numpy as np

from ._calibrate import weights
from ._problem import Problem
from ._weighed import information


def constant_evidence(problem: Problem) -> float:
    """Log evidence of the fitted rows where every sensor reads a constant of its own, and noise.

    A noise that is not given has its likeliest value; each constant, unknown within the noise that then is seen, owes
    half the logarithm of the number of readings, as in BIC. Minus infinity where a sensor read one value throughout,
    of which no noise can be told.
    """
    rows = [r.fitted for r in problem.rows]
    weight = weights(problem, rows)
    total = 0.5 * information(weight)
    every = np.concatenate(weight)
    readings = np.concatenate([r.readings[:n] for r, n in zip(problem.rows, rows, strict=True)])
    for y, w, given in zip(readings.T, every.T, problem.noise, strict=True):
        y, w = y[w > 0], w[w > 0]
        if np.isnan(given) and len(y) and np.ptp(y) == 0:
            return -np.inf
        if len(y):
            square = float((w * (y - np.average(y, weights=w)) ** 2).sum())
            variance = square / len(y) if np.isnan(given) else given**2
            total -= 0.5 * (len(y) * np.log(2 * np.pi * variance) + square / variance + np.log(len(y)))
    return total
