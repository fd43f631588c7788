"""Learning Henon-Heiles ends in the best optimum known from at least 95 of 100 random starts."""

import jax
import numpy as np
import pytest
from learning_cases import PRIOR, TRUTH, henon_heiles, recording

from symplearn._learn import learn

# How far a start may end from the best optimum known, in nats (issue 4).
NEAR = 0.5
RECORDINGS = 10


def random_start(rng, k):
    """Coefficients about the truth or about zero, in turn, and variances over six decades, 1e-8 to 1e-2."""
    coefficients = TRUTH + rng.normal(0.0, 0.3, 9) if k % 2 else rng.normal(0.0, 0.5, 9)
    return henon_heiles(coefficients, *10.0 ** rng.uniform(-8.0, -2.0, 2))


def ended(estimate, coefficients, way):
    """Where one attempt ended; -inf if it was impossible."""
    found = next(one for one in estimate.attempts if one[:2] == (coefficients, way))
    return -np.inf if found.log_posterior is None else found.log_posterior


def measure(count):
    """How many of `count` starts end near the best known: all together, and the as-given coefficients alone."""
    rng, estimates = np.random.default_rng(20261121), []
    for k in range(count):
        estimates.append(learn(random_start(rng, k), recording(k % RECORDINGS), prior=PRIOR, key=jax.random.key(k)))
    # The best known: what any start reached, and the truth itself as the start.
    truth = [learn(henon_heiles(TRUTH), recording(j), prior=PRIOR) for j in range(min(count, RECORDINGS))]
    best = [
        max([truth[j].log_posterior, *(e.log_posterior for e in estimates[j::RECORDINGS])]) for j in range(len(truth))
    ]
    reached = np.array(
        [
            [
                estimate.log_posterior,
                ended(estimate, "as given", "lowering the process noise"),
                ended(estimate, "as given", "straight"),
            ]
            for estimate in estimates
        ]
    )
    below = np.array(best)[np.arange(count) % RECORDINGS][:, None] - reached
    return (below < NEAR).sum(axis=0), sum(estimate.converged for estimate in estimates)


@pytest.mark.slow
def test_ninety_five_of_a_hundred():
    """From coefficients N(truth, 0.3^2) and N(0, 0.5^2) in turn, variances over six decades, on ten recordings."""
    (together, lowered, straight), converged = measure(100)
    print(
        f"of 100: portfolio {together}, as given lowered {lowered}, as given straight {straight}; {converged} converged"
    )
    assert together >= 95


def test_a_handful():
    """Six random starts on six recordings all end in the best optimum known."""
    (together, _, _), converged = measure(6)
    assert together == 6 and converged == 6
