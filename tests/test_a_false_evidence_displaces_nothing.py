"""An estimate that did not converge keeps no other from being weighed again, and is fitted again itself."""

from dataclasses import replace

import engine_cases as cases
import numpy as np
import pytest

from symplearn.diagnosis._refinement import Refinement
from symplearn.diagnosis._score import Start
from symplearn.diagnosis._search import Search
from symplearn.diagnosis._start import first_fits, priors_without_effects
from symplearn.diagnosis._trajectory import Stepper


def damped_spring():
    """A search of a spring whose damping, left out, has been weighed; and that damping."""
    times = np.linspace(0.0, 20.0, 120)
    q = cases.solved(lambda t, x: [x[1], -x[0] - 0.1 * x[1]], [1.0, 0.0], times)[:, 0]
    y = q + 0.01 * np.random.default_rng(0).normal(size=len(q))
    stepper = Stepper(cases.problem(cases.simulation("p**2/2 + q**2/2"), [cases.recorded(times, y)], 0.1))
    p = stepper.problem
    rows = [r.fitted for r in p.rows]
    seeds = first_fits(stepper, priors_without_effects(p), rows)
    search = Search(stepper, seeds.z, np.inf, lambda message: None)
    search.beginning.run()
    (damping,) = (m for m in p.searched if p.candidate(m).effect.name == "viscous_damping")
    search.weigher.weigh([Start((damping,), search.beginning.seed, 0.0)], whole=True)
    return search, damping


@pytest.mark.slow
def test_finer_steps_keep_what_had_converged():
    """A damped spring: its damping is among what is weighed in finer steps, although a fit of nothing that did not
    converge was said to be 24,000 nats likelier."""
    search, damping = damped_spring()
    nothing = search.found.of((), "white")
    search.found.add(replace(nothing, kind="positional", log_evidence=nothing.log_evidence + 24_000, converged=False))
    assert (damping,) in search.again(search.stepper).estimates


@pytest.mark.slow
def test_what_did_not_converge_is_fitted_again():
    """A damping whose only fit was stopped short of its optimum converges where it would have, in the same steps and in
    finer ones."""
    search, damping = damped_spring()
    (settled,) = (e for e in search.found.estimates[(damping,)] if e.kind == "white")
    move = Refinement(search.prospects, search.progress).move_places
    for again in (move, lambda: search.again(search.stepper)):
        short = settled.z + 0.3 * np.sqrt(np.diag(settled.covariance))
        search.found.estimates[(damping,)] = [replace(settled, z=short, converged=False)]
        again()
        found = search.found.of((damping,), "white")
        assert found.converged
        # A fit stops where a step promises less than 1e-3 of the cost.
        assert np.abs(found.z - settled.z)[0] < 0.1 * np.sqrt(settled.covariance[0, 0])
