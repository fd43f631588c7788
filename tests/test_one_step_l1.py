"""The L1 objective of (5.15) is a Laplace density of one-step errors in every copy of the phase point."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.stats import laplace

import integrators as ig
from symplearn._errors import InputError
from symplearn._hamiltonian_objectives import MiniBatch, OneStepL1
from symplearn._hamiltonians import Polynomial
from symplearn._model import Coordinates, FullState, Propagator, StateSpaceModel
from symplearn._noise import AdditiveGaussian, ScaledIdentity
from symplearn._objectives import TimeSeries

DT, N, OMEGA, SCALE = 0.05, 30, 20.0, 0.02
TIMES = DT * np.arange(N + 1)


def slopes(q, p):
    """dH/dq and dH/dp of Tao's example, H = (q^2 + 1)(p^2 + 1) / 2, by hand."""
    return q * (p**2 + 1), p * (q**2 + 1)


def tao_step(q, p, dt):
    """One step of (5.8) from a doubled point, composed of its three flows; the binding's by a matrix exponential."""
    y, x = p, q
    # The generator of omega ((q - x)^2 + (p - y)^2) / 2 on (q, p, x, y).
    D = np.array([[1.0, -1.0], [-1.0, 1.0]])
    turn = np.zeros((4, 4))
    turn[np.ix_([0, 2], [1, 3])], turn[np.ix_([1, 3], [0, 2])] = OMEGA * D, -OMEGA * D

    def a(q, p, x, y, d):
        by_q, by_p = slopes(q, y)
        return q, p - d * by_q, x + d * by_p, y

    def b(q, p, x, y, d):
        by_q, by_p = slopes(x, p)
        return q + d * by_p, p, x, y - d * by_q

    z = b(*a(q, p, x, y, dt / 2), dt / 2)
    return np.array(a(*b(*(expm(dt * turn) @ z), dt / 2), dt / 2))


def orbit(start, noise=0.0, seed=0):
    """Tao's example by SciPy's DOP853."""

    def field(t, x):
        by_q, by_p = slopes(*x)
        return [by_p, -by_q]

    xs = solve_ivp(field, (0.0, TIMES[-1]), start, "DOP853", TIMES, rtol=1e-12, atol=1e-13).y.T
    return xs + noise * np.random.default_rng(seed).normal(size=xs.shape)


def series(ys):
    return TimeSeries(jnp.asarray(TIMES), jnp.asarray(ys))


def model(system=None, integrator=None):
    noise = AdditiveGaussian(ScaledIdentity(1.0, 2))
    system = ig.problems.TaoExample() if system is None else system
    return StateSpaceModel(Propagator(system, integrator or ig.Tao(OMEGA)), FullState(), noise, noise)


ONE, TWO = orbit([0.0, -1.5], 0.02), orbit([0.4, 1.0], 0.02, 1)
OBJECTIVE = eqx.filter_jit(lambda objective, model, recording: objective(model, recording))


def four_blocks(ys):
    """Errors of q, p, and the auxiliary outputs, each interval started at its reading: (interval, 4)."""
    ahead = np.array([tao_step(*y, DT) for y in ys[:-1]])
    return np.tile(ys[1:], 2) - ahead


def test_all_four_blocks_are_scored():
    """For Tao's method the score is SciPy's Laplace density of the four blocks, which is the mean (5.15) in nats."""
    errors = four_blocks(ONE)
    found = float(OBJECTIVE(OneStepL1(SCALE), model(), series(ONE)))
    assert found == pytest.approx(-laplace(scale=SCALE).logpdf(errors).sum(), rel=1e-12)
    mean = np.mean(np.sum(np.abs(errors), axis=1))
    assert found == pytest.approx(N * mean / SCALE + 4 * N * np.log(2 * SCALE), rel=1e-12)
    # The auxiliary blocks are another pair of numbers, not the first two again.
    assert np.abs(errors[:, :2] - errors[:, 2:]).max() > 1e-4
    other = -laplace(scale=SCALE).logpdf(four_blocks(TWO)).sum()
    both = float(OBJECTIVE(OneStepL1(SCALE), model(), [series(ONE), series(TWO)]))
    assert both == pytest.approx(found + other, rel=1e-12)


def test_leapfrog_has_one_copy():
    """For leapfrog the score is of q and p alone; missing readings cost only themselves."""
    ys = orbit([0.0, -1.5], 0.02)
    ys[5], ys[9, 1] = np.nan, np.nan
    expected = 0.0
    for k in range(N):
        if np.isnan(ys[k]).any():
            continue
        q, p = ys[k]
        p = p - DT / 2 * 4.0 * np.sin(q)
        q = q + DT * p
        p = p - DT / 2 * 4.0 * np.sin(q)
        r = ys[k + 1] - [q, p]
        expected -= laplace(scale=SCALE).logpdf(r[~np.isnan(r)]).sum()
    pendulum = model(ig.problems.Pendulum(1.0, 1.0, 4.0), ig.Leapfrog())
    assert float(OBJECTIVE(OneStepL1(SCALE), pendulum, series(ys))) == pytest.approx(expected, rel=1e-12)


def test_batches_are_unbiased():
    """Batches over all recordings have the full score as their mean, and a batch of all is the full score."""
    recordings = [series(ONE), series(TWO)]
    full = float(OBJECTIVE(OneStepL1(SCALE), model(), recordings))

    @jax.jit
    def drawn(keys):
        return jax.vmap(lambda key: OneStepL1(SCALE, MiniBatch(6, key))(model(), recordings))(keys)

    scores = np.asarray(drawn(jax.random.split(jax.random.key(0), 2000)))
    # Four standard errors of the mean.
    assert abs(scores.mean() - full) < 4 * scores.std() / np.sqrt(2000) and scores.std() > 0
    assert len(np.unique(scores)) > 1900
    whole = OBJECTIVE(OneStepL1(SCALE, MiniBatch(2 * N, jax.random.key(1))), model(), recordings)
    assert float(whole) == pytest.approx(full, rel=1e-12)
    with pytest.raises(InputError, match="batch of 61"):
        OneStepL1(SCALE, MiniBatch(2 * N + 1, jax.random.key(1)))(model(), recordings)


def test_the_truth_is_the_minimum_signs_and_all():
    """On motion by DOP853 the true H scores least: every coefficient moved either way costs, and -H far more."""
    truth = np.zeros(14)
    truth[[2, 4, 11]] = 0.5  # q^2, p^2 and q^2 p^2 of Tao's example among the products up to degree 4
    changes = np.vstack([np.zeros(14), 0.01 * np.eye(14), -0.01 * np.eye(14), -2 * truth])

    @jax.jit
    def scores(rows):
        def one(row):
            at = Propagator(Polynomial(1, 4, row), ig.Tao(OMEGA), substeps=10)
            return OneStepL1(SCALE)(eqx.tree_at(lambda m: m.dynamics, model(), at), series(orbit([0.3, -1.5])))

        return jax.vmap(one)(rows)

    found = np.asarray(scores(jnp.asarray(truth + changes)))
    # Ten substeps leave errors of 1e-5, which a change of 0.01 in any term exceeds tenfold.
    assert np.all(found[1:] > found[0] + 0.1) and found[-1] > found[0] + 100


def test_what_cannot_be_scored():
    """Part of the state is refused; a step that leaves the reals scores 1e15 nats with finite derivatives."""
    with pytest.raises(InputError, match="whole phase point"):
        OneStepL1(SCALE)(eqx.tree_at(lambda m: m.observation, model(), Coordinates((0, 1))), series(ONE))
    value = eqx.filter_jit(eqx.filter_value_and_grad(OneStepL1(SCALE)))
    for bad in (np.nan, 1e300):
        broken = model(Polynomial(1, 3, jnp.full(9, bad)))
        score, slope = value(broken, series(ONE))
        assert float(score) == 1e15 and np.all(np.isfinite(slope.dynamics.system.coefficients))
