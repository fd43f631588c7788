"""Where an effect begins at a threshold, the misfit has kinks; a fit that rests in one has ended all the same."""

from dataclasses import replace

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis._calibrate import calibrate
from symplearn.diagnosis._start import priors_without_effects
from symplearn.diagnosis._trajectory import Stepper

NOISE, STIFFNESS, STOP = 0.01, 6.0, 0.55
TIMES = np.linspace(0.0, 16.0, 61)


def made(seed):
    """A spring with a stop at its upper end, by DOP853 from one touch to the next."""
    rates = lambda t, x: [x[1], -x[0] - STIFFNESS * max(x[0] - STOP, 0.0)]  # noqa: E731
    y = cases.solved(rates, [0.7, 0.1], TIMES, 1e-10)[:, 0]
    return cases.recorded(TIMES, y + NOISE * np.random.default_rng(seed).normal(size=len(TIMES)))


@pytest.fixture(scope="module")
def steppers():
    file = cases.simulation("p**2/2 + q**2/2", more=f"[recording.noise]\ny = {NOISE}")
    first = Stepper(cases.problem(file, [made(0)], 0.07))
    return [first, *(first.on(cases.problem(file, [made(seed)], 0.07)) for seed in range(1, 3))]


@pytest.mark.slow
def test_a_stop_that_was_found_has_converged(steppers):
    """In three recordings of one motion with different noise, from eight thresholds about the true one: the best fit
    follows the readings within their noise and counts as ended."""
    for stepper in steppers:
        p = stepper.problem
        bare = priors_without_effects(p)
        priors = replace(bare, scales=np.full(p.equations.size, 3.0), precision=np.full(p.size, 1e-2))
        stop = next(m for m in p.searched if p.candidate(m).effect.name == "contact_stop"
                    and p.candidate(m).side == "upper")  # fmt: skip
        ((_, place),) = p.placed((stop,))
        begin = np.tile(priors.mean, (8, 1))
        begin[:, [0, 2]] = 0.7, 0.1
        begin[:, place] = np.stack([np.full(8, 4.0), STOP + np.linspace(-0.07, 0.07, 8)], 1)
        fits = calibrate(stepper, begin, [(stop,)] * 8, priors, [len(TIMES)])
        best = int(np.argmin(fits.cost))
        assert fits.cost[best] < 1.6 * len(TIMES)
        assert fits.converged[best]
