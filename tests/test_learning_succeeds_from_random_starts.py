"""Learning Henon-Heiles ends in the best optimum known from at least 95 of 100 random starts."""

import jax
import numpy as np
import pytest
from learning_cases import PRIOR, TRUTH, henon_heiles, recording

from symplearn._learn import learn

# How far a start may end from the best optimum known, in nats (issue 4).
NEAR = 0.5
RECORDINGS = 5


def random_start(rng, k):
    """Coefficients about the truth or about zero, in turn, and variances over six decades, 1e-8 to 1e-2."""
    coefficients = TRUTH + rng.normal(0.0, 0.3, 9) if k % 2 else rng.normal(0.0, 0.5, 9)
    return henon_heiles(coefficients, *10.0 ** rng.uniform(-8.0, -2.0, 2))


def ended(estimate, coefficients, way):
    """Where one attempt ended; -inf if it was impossible."""
    found = next(one for one in estimate.attempts if one[:2] == (coefficients, way))
    return -np.inf if found.log_posterior is None else found.log_posterior


def measure(count):
    """How many of `count` starts end near the best known, by all lanes and by two of them; how many converge."""
    rng, estimates = np.random.default_rng(20261121), []
    for k in range(count):
        estimates.append(learn(random_start(rng, k), recording(k % RECORDINGS), prior=PRIOR, key=jax.random.key(k)))
    # The best known: what any start reached, and what the truth itself leads to.
    truth = [learn(henon_heiles(TRUTH), recording(j), prior=PRIOR, key=jax.random.key(j)) for j in range(RECORDINGS)]
    known = [*truth, *estimates]
    best = np.array([max(one.log_posterior for one in known[j::RECORDINGS]) for j in range(RECORDINGS)])
    ways = ("lowering the process noise", "straight")
    reached = np.array([[one.log_posterior, *(ended(one, "as given", way) for way in ways)] for one in estimates])
    below = best[np.arange(count) % RECORDINGS][:, None] - reached
    return (below < NEAR).sum(axis=0), sum(one.converged for one in estimates)


@pytest.mark.slow
def test_ninety_five_of_a_hundred():
    """From coefficients N(truth, 0.3^2) and N(0, 0.5^2) in turn, variances over six decades, on five recordings."""
    (together, lowered, straight), converged = measure(100)
    print(f"of 100: portfolio {together}, as given lowered {lowered}, straight {straight}; converged {converged}")
    assert together >= 95


@pytest.mark.slow
def test_a_handful():
    """Four random starts on two recordings end in the best optimum known, which the truth as a start finds too."""
    rng = np.random.default_rng(1)
    for k in range(2):
        known = learn(henon_heiles(TRUTH), recording(k), prior=PRIOR, key=jax.random.key(k))
        for _ in range(2):
            estimate = learn(random_start(rng, k), recording(k), prior=PRIOR, key=jax.random.key(k))
            assert estimate.converged and abs(estimate.log_posterior - known.log_posterior) < NEAR
