"""Hand-made estimates of a system of two coordinates, to weigh against each other."""

import engine_cases as cases
import numpy as np

from symplearn.diagnosis._calibrate import Priors
from symplearn.diagnosis._found import Found
from symplearn.diagnosis._weighed import Estimate


def made(recordings):
    """Two coordinates, a parameter, two columns."""
    file = cases.simulation("(p1**2 + p2**2 + k*q1**2 + q2**2)/2", ["q1", "q2"], ["p1", "p2"], {"a": "q1", "b": "q2"},
                            more="[parameters]\nk = 1.0")  # fmt: skip
    return cases.problem(file, [cases.recorded(np.arange(10.0), np.ones((10, 2)))] * recordings, 1.0)


def place(problem, effect, target):
    return next(i for i, c in enumerate(problem.equations.candidates) if c.key == (effect, (target,)))


def estimate(problem, combination, log_evidence, kind="white", sd=0.01):
    """A hand-made record: every coefficient known to `sd`, in units of its prior's. Sudden changes come in the middle
    of the recording: what changes at its beginning was not seen to change."""
    covariance = np.diag(np.full(problem.size, sd**2))
    nothing, noise = np.zeros(problem.size), np.ones(problem.channels)
    for member, entries in problem.placed(combination):
        if problem.candidate(member).effect.name == "regime_change":
            nothing[entries.stop - 1] = 4.5
    return Estimate(combination, kind, nothing, covariance, noise, log_evidence, True)


def found(problem, *estimates):
    zero, ones = np.zeros(problem.size), np.ones(problem.equations.size)
    out = Found(problem, Priors(zero, zero, 0 * ones, ones, -ones, ones, np.ones((problem.equations.declared, 2))))
    for one in estimates:
        out.add(one)
    return out
