"""Independent recordings of one system are scored together by the sum of their scores, each from its own start."""

import equinox as eqx
import estimation_cases as cases
import jax.numpy as jnp
import numpy as np
import pytest

from symplearn._errors import InputError
from symplearn._fit import fit
from symplearn._model import Gaussian
from symplearn._objectives import MARGINAL_LIKELIHOOD, TimeSeries
from symplearn._parameters import Frozen, Learnt
from symplearn._prior import Flat, Prior

# A damped rotation, read in one channel.
A, H = np.array([[0.9, 0.3], [-0.3, 0.8]]), np.array([[1.0, 0.5]])
Q, R, M0, P0 = np.diag([0.1, 0.05]), np.array([[0.2]]), np.array([0.5, 0.0]), np.diag([0.4, 0.3])
SYSTEM = (A, H, Q, R, M0, P0)
MEANS = np.array([[1.0, -0.5], [-2.0, 1.0]])
SCORE = eqx.filter_jit(MARGINAL_LIKELIHOOD)


def recorded(mean, seed):
    ys = cases.simulate(A, H, Q, R, mean, P0, 8, np.random.default_rng(seed))[1]
    ys[2 + seed] = np.nan
    return ys


READINGS = [recorded(mean, seed) for seed, mean in enumerate(MEANS)]
SERIES = [TimeSeries(jnp.arange(8.0), jnp.asarray(ys)) for ys in READINGS]


def model(*means):
    """The linear system with one initial distribution for all recordings, or one for each."""
    starts = tuple(Gaussian(mean if isinstance(mean, Learnt) else jnp.asarray(mean), jnp.asarray(P0)) for mean in means)
    known = cases.as_model(*SYSTEM)
    return eqx.tree_at(lambda m: m.initial, known, starts if len(starts) > 1 else starts[0])


def textbook(means, readings=READINGS):
    """The sum of the textbook filters' scores, and one of them for each recording."""
    each = [-cases.kalman_log_likelihood(A, H, Q, R, m, P0, ys)[0] for m, ys in zip(means, readings, strict=True)]
    return sum(each), each


def test_scores_add_from_one_initial_distribution():
    """Two recordings have the sum of their scores, in either order, and one in a list has its own."""
    total, each = textbook([M0, M0])
    # Sums of the same numbers in another order.
    assert float(SCORE(model(M0), SERIES)) == pytest.approx(total, rel=1e-12)
    assert float(SCORE(model(M0), SERIES[::-1])) == pytest.approx(total, rel=1e-12)
    assert [float(SCORE(model(M0), [one])) for one in SERIES] == pytest.approx(each, rel=1e-12)


def test_recordings_may_differ_in_length():
    """A short recording beside a long one adds its own score; a tuple is as good as a list."""
    short = TimeSeries(SERIES[1].times[:5], SERIES[1].readings[:5])
    total, _ = textbook([M0, M0], [READINGS[0], READINGS[1][:5]])
    assert float(SCORE(model(M0), (SERIES[0], short))) == pytest.approx(total, rel=1e-12)


def test_each_recording_may_have_its_own_start():
    """With an initial distribution for each, recording k starts from the k-th; pairs may be exchanged together only."""
    right, wrong = textbook(MEANS)[0], textbook(MEANS[::-1])[0]
    assert float(SCORE(model(*MEANS), SERIES)) == pytest.approx(right, rel=1e-12)
    assert float(SCORE(model(*MEANS[::-1]), SERIES[::-1])) == pytest.approx(right, rel=1e-12)
    assert float(SCORE(model(*MEANS[::-1]), SERIES)) == pytest.approx(wrong, rel=1e-12)
    # And it matters: the starts are standard deviations apart.
    assert abs(right - wrong) > 1.0


def test_a_wrong_count_of_starts_is_refused():
    """Two initial distributions for one recording or for three, or no recording at all, are one clear sentence."""
    for recordings in (SERIES[0], [SERIES[0]], [*SERIES, SERIES[0]]):
        with pytest.raises(InputError, match="2 initial distributions, but there are"):
            MARGINAL_LIKELIHOOD(model(*MEANS), recordings)
    with pytest.raises(InputError, match="at least one"):
        MARGINAL_LIKELIHOOD(model(M0), [])


def most_probable_start(ys):
    """The initial mean of highest likelihood: generalised least squares on the joint Gaussian of all readings."""
    n, d = len(ys), len(M0)
    powers = [np.linalg.matrix_power(A, k) for k in range(n)]
    zero = np.zeros((d, d))
    F = np.block([[powers[k - j] if j <= k else zero for j in range(n)] for k in range(n)])
    W = np.kron(np.eye(n), Q)
    W[:d, :d] = P0
    seen = ~np.isnan(ys.ravel())
    G = np.kron(np.eye(n), H)[seen]
    S = G @ F @ W @ F.T @ G.T + np.kron(np.eye(n), R)[np.ix_(seen, seen)]
    design = G @ np.concatenate(powers)
    information = design.T @ np.linalg.solve(S, design)
    return np.linalg.solve(information, design.T @ np.linalg.solve(S, ys.ravel()[seen])), information


@pytest.mark.slow
def test_two_starts_are_learnt_together():
    """A fit of two short recordings with learnt initial means finds the generalised least squares of each."""
    given = model(*(Learnt(np.zeros(2)) for _ in MEANS))
    # Bare arrays of the dynamics and observation would learn.
    given = eqx.tree_at(lambda m: (m.dynamics, m.observation), given, replace_fn=Frozen)
    estimate = fit(given, SERIES, prior=Prior({"initial.0": Flat(), "initial.1": Flat()}))
    assert estimate.converged
    for k, ys in enumerate(READINGS):
        expected, information = most_probable_start(ys)
        distance = estimate.values()[f"initial.{k}.mean"] - expected
        # The fit stops within 1e-5 nats of the best.
        assert 0.5 * distance @ information @ distance < 1e-5
    found = [estimate.values()[f"initial.{k}.mean"] for k in range(2)]
    assert estimate.log_likelihood == pytest.approx(-textbook(np.asarray(found))[0], rel=1e-10)
