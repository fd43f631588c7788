"""Proposition 4: multiple shooting is the joint posterior of parameters and segment starts without process noise."""

import equinox as eqx
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from scipy.optimize import least_squares

import integrators as ig
from symplearn._constrained_fit import fit_constrained
from symplearn._errors import InputError
from symplearn._fit import fit
from symplearn._model import FullState, Gaussian, Propagator, StateSpaceModel
from symplearn._noise import AdditiveGaussian, ScaledIdentity
from symplearn._objectives import MarginalLikelihood, TimeSeries
from symplearn._parameters import Frozen, Learnt
from symplearn._prior import Flat
from symplearn._trajectory_objectives import (
    EverySteps,
    GaussianContinuity,
    MultipleShooting,
    PropagatorLeastSquares,
    SegmentStarts,
    SimulationLeastSquares,
    StartingAt,
    segment_starts,
)

N, SD, SPAN, SUBSTEPS = 12, 0.1, 0.5, 4
TIMES = SPAN * np.arange(N + 1)
SCORE = eqx.filter_jit(lambda objective, model, recording: objective(model, recording))
GAPS = eqx.filter_jit(lambda objective, model, recording: objective.gaps(model, recording))
CONSTANT = 2 * N * np.log(SD * np.sqrt(2 * np.pi))  # of twelve readings of two channels
FOURS = (0, 4, 8)


def leapfrog(x, gravity, intervals, substeps=SUBSTEPS):
    """The states of a pendulum after each data interval, kick, drift, kick, in numpy."""
    (q, p), dt, xs = x, SPAN / substeps, []
    for _ in range(intervals):
        for _ in range(substeps):
            p = p - dt / 2 * gravity * np.sin(q)
            q = q + dt * p
            p = p - dt / 2 * gravity * np.sin(q)
        xs.append([q, p])
    return np.array(xs)


def recorded(seed=0):
    """A pendulum of gravity 1 in steps forty times finer, read with noise."""
    start = np.array([1.2, 0.1])
    xs = np.vstack([start, leapfrog(start, 1.0, N, 160)])
    return xs + SD * np.random.default_rng(seed).normal(size=xs.shape)


def shots(gravity, starts, begins, ys):
    """Residuals k = l_i + 1..l_{i+1} of every segment, and the gaps between them."""
    ends = [*begins[1:], N]
    runs = [leapfrog(x, gravity, e - b) for x, b, e in zip(starts, begins, ends, strict=True)]
    residuals = [ys[b + 1 : e + 1] - run for run, b, e in zip(runs, begins, ends, strict=True)]
    return np.concatenate(residuals), np.array([x - run[-1] for x, run in zip(starts[1:], runs[:-1], strict=True)])


def pendulum(initial, gravity=1.1, process=0.0):
    return StateSpaceModel(
        Propagator(ig.problems.Pendulum(Frozen(1.0), Frozen(1.0), gravity), ig.Leapfrog(), SUBSTEPS),
        FullState(),
        AdditiveGaussian(ScaledIdentity(process, 2)),
        AdditiveGaussian(ScaledIdentity(SD**2, 2)),
        initial,
    )


SERIES = TimeSeries(jnp.asarray(TIMES), jnp.asarray(recorded()))


def given_starts(begins, seed=5):
    return recorded()[list(begins)] + 0.1 * np.random.default_rng(seed).normal(size=(len(begins), 2))


@pytest.mark.parametrize("segments", [EverySteps(5), StartingAt((0, 3, 5))])
def test_the_score_is_the_sum_of_squares_in_nats(segments):
    """Minus log L(theta, Z_L) is J_MS / (2 s^2) plus a constant, for segments of equal and unequal lengths."""
    begins = segments.starts(N)
    starts = given_starts(begins)
    residuals, gaps = shots(1.1, starts, begins, recorded())
    model = pendulum(SegmentStarts(jnp.asarray(starts)))
    found = float(SCORE(MultipleShooting(segments), model, SERIES))
    # Sums of a few hundred: the specification's 1e-10.
    assert found == pytest.approx(np.sum(residuals**2) / (2 * SD**2) + CONSTANT, abs=1e-10)
    np.testing.assert_allclose(GAPS(MultipleShooting(segments), model, SERIES), gaps, atol=1e-13)


def test_each_segment_is_a_marginal_likelihood():
    """The same number comes from the filter, without process noise and with known starts, segment by segment."""
    starts, filtered = given_starts(FOURS), eqx.filter_jit(MarginalLikelihood())
    total = 0.0
    for start, b in zip(starts, FOURS, strict=True):
        ys = recorded()[b : b + 5].copy()
        ys[0] = np.nan
        model = pendulum(Gaussian(jnp.asarray(start), jnp.zeros((2, 2))))
        total += float(filtered(model, TimeSeries(jnp.asarray(TIMES[b : b + 5]), jnp.asarray(ys))))
    found = SCORE(MultipleShooting(EverySteps(4)), pendulum(SegmentStarts(jnp.asarray(starts))), SERIES)
    assert float(found) == pytest.approx(total, abs=1e-10)


def test_one_step_is_prediction_and_all_steps_are_simulation():
    """With starts from the data T = 1 is the propagator objective; T = n is the simulation objective."""
    ys = recorded()
    ys[3, 1], ys[7] = np.nan, np.nan
    series = TimeSeries(jnp.asarray(TIMES), jnp.asarray(ys))
    # Propagator least squares weighs by the process noise, which is given the value of the other here.
    model = pendulum(None, process=SD**2)
    one, residuals = float(SCORE(MultipleShooting(EverySteps(1)), model, series)), []
    for k in range(N):
        if not np.isnan(ys[k]).any():
            residuals.append(ys[k + 1] - leapfrog(ys[k], 1.1, 1)[0])
    r = np.array(residuals)[~np.isnan(residuals)]
    assert one == pytest.approx(np.sum(r**2) / (2 * SD**2) + r.size * np.log(SD * np.sqrt(2 * np.pi)), abs=1e-10)
    assert one == pytest.approx(float(SCORE(PropagatorLeastSquares(), model, series)), abs=1e-10)
    whole = pendulum(Gaussian(jnp.asarray(ys[0]), 0.3 * jnp.eye(2)))
    started = float(SCORE(MultipleShooting(EverySteps(N), scores_first=True), whole, series))
    assert started == pytest.approx(float(SCORE(SimulationLeastSquares(), whole, series)), abs=1e-10)
    first = 2 * np.log(SD * np.sqrt(2 * np.pi))
    unscored = float(SCORE(MultipleShooting(EverySteps(N)), whole, series))
    assert unscored == pytest.approx(started - first, abs=1e-10)


def test_several_recordings_add():
    """Two recordings, each with its own starts, score the sum, and their gaps stand one after the other."""
    other = TimeSeries(jnp.asarray(TIMES), jnp.asarray(recorded(1)))
    starts = tuple(SegmentStarts(jnp.asarray(given_starts(FOURS, seed))) for seed in (5, 6))
    objective, model = MultipleShooting(EverySteps(4), GaussianContinuity(0.04)), pendulum(starts)
    expected = 0.0
    for start, series in zip(starts, (SERIES, other), strict=True):
        r, g = shots(1.1, np.asarray(start.means), FOURS, np.asarray(series.readings))
        expected += np.sum(r**2) / (2 * SD**2) + CONSTANT
        expected += np.sum(g**2) / (2 * 0.04) + 4 * np.log(0.2 * np.sqrt(2 * np.pi))
    assert float(SCORE(objective, model, [SERIES, other])) == pytest.approx(expected, abs=1e-10)
    firsts = [shots(1.1, np.asarray(one.means), FOURS, recorded())[1] for one in starts]
    np.testing.assert_allclose(GAPS(objective, model, (SERIES, other)), np.concatenate(firsts), atol=1e-13)


def unknown(free):
    return free[0], free[1:].reshape(-1, 2)


def test_parameters_and_starts_are_learnt_together():
    """The fit of unconstrained shooting is the least-squares solution for parameters and starts, by SciPy."""
    ys = recorded()
    start = np.append(1.1, ys[list(FOURS)])
    oracle = least_squares(lambda z: shots(*unknown(z), FOURS, ys)[0].ravel(), start, xtol=1e-12, ftol=1e-12).x
    model = pendulum(segment_starts(pendulum(None), SERIES, EverySteps(4)))
    np.testing.assert_array_equal(model.initial.means.value, ys[list(FOURS)])
    estimate = fit(model, SERIES, MultipleShooting(EverySteps(4)), prior=Flat())
    assert estimate.converged
    # The tolerance of `fit`, 1e-5 nats, in standard deviations of 0.1 or less: 5e-4 of them.
    np.testing.assert_allclose(estimate.values()["dynamics.system.gravity"], oracle[0], atol=5e-4)
    np.testing.assert_allclose(estimate.values()["initial.means"], unknown(oracle)[1], atol=5e-4)


@pytest.fixture(scope="module")
def constrained():
    start = segment_starts(pendulum(None), SERIES, EverySteps(4))
    return fit_constrained(pendulum(start), SERIES, MultipleShooting(EverySteps(4)), prior=Flat())


def test_delta_transitions_are_the_constraints(constrained):
    """With exact continuity the optimum is that of one trajectory with a free start: one shot, by SciPy."""
    ys = recorded()
    one = least_squares(lambda z: (ys[1:] - leapfrog(z[1:], z[0], N)).ravel(), [1.0, *ys[0]], xtol=1e-12, ftol=1e-12)
    estimate = constrained.estimate
    assert estimate.converged and constrained.largest_violation < 1e-10
    # Both solvers end where the score is flat to 1e-12 of its hundred nats: the root of that, in deviations of 0.05.
    np.testing.assert_allclose(estimate.values()["dynamics.system.gravity"], one.x[0], atol=1e-6)
    np.testing.assert_allclose(estimate.values()["initial.means"][0], one.x[1:], atol=1e-6)
    assert -estimate.log_posterior == pytest.approx(one.cost / SD**2 + CONSTANT, abs=1e-9)
    assert "largest gap" in str(constrained)


def test_soft_continuity_tends_to_the_constraint(constrained):
    """As the variance of the gaps vanishes they fall in proportion to it: the variance times Lagrange's multipliers."""
    start, gaps = constrained.estimate.model, {}
    for variance in (1e-4, 1e-5, 1e-6):
        soft = MultipleShooting(EverySteps(4), GaussianContinuity(variance))
        estimate = fit(start, SERIES, soft, prior=Flat(), tolerance=1e-10)
        gaps[variance] = np.asarray(GAPS(soft, estimate.model, SERIES))
    sizes = [np.linalg.norm(gap) for gap in gaps.values()]
    # The next order is the variance over that of a start, about 1e-3: a tenth of it at 1e-4.
    np.testing.assert_allclose(np.divide(sizes[:2], sizes[1:]), 10, rtol=0.1)
    # And at 1e-6 a thousandth of the gap.
    np.testing.assert_allclose(gaps[1e-6] / 1e-6, constrained.multipliers, rtol=5e-3, atol=5e-3 * sizes[2] / 1e-6)


def test_failures_are_finite():
    """Starts from which the motion leaves the reals score 1e15 nats, with derivatives that are finite numbers."""
    model = pendulum(SegmentStarts(Learnt(given_starts(FOURS))))
    broken = eqx.tree_at(lambda m: m.initial.means.free, model, model.initial.means.free.at[1].set(1e300))
    value = eqx.filter_jit(eqx.filter_value_and_grad(MultipleShooting(EverySteps(4))))
    for one in (broken, pendulum(model.initial, np.nan), pendulum(model.initial, 1e308)):
        score, slope = value(one, SERIES)
        assert float(score) == 1e15
        assert np.all(np.isfinite(slope.initial.means.free)) and np.isfinite(float(slope.dynamics.system.gravity))


def test_wrong_segments_are_one_clear_sentence(monkeypatch):
    """What cannot be shot at is refused with what was given and what to do."""
    two, fours = SegmentStarts(jnp.zeros((2, 2))), MultipleShooting(EverySteps(4))
    with pytest.raises(InputError, match="cut into 3 segments, but the model's `initial` has 2"):
        fours(pendulum(two), SERIES)
    with pytest.raises(InputError, match="last segment starts at reading 12"):
        MultipleShooting(StartingAt((0, 12)))(pendulum(None), SERIES)
    with pytest.raises(InputError, match="start states do not learn"):
        fit_constrained(pendulum(None), SERIES, fours, prior=Flat())
    with pytest.raises(InputError, match="no finite score at its start"):
        fit_constrained(pendulum(SegmentStarts(Learnt(given_starts(FOURS))), np.nan), SERIES, fours, prior=Flat())
    with pytest.raises(InputError, match="no reading at all"):
        blind = TimeSeries(SERIES.times, SERIES.readings.at[:, 0].set(jnp.nan))
        segment_starts(pendulum(None), blind, EverySteps(4))
    with pytest.raises(InputError, match="at least 1"):
        EverySteps(0)
    # The suite's type checker is off, as for a user: it would refuse the number before our sentence does.
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    with pytest.raises(InputError, match=r"`EverySteps\(length\)` or .* was given 10"):
        MultipleShooting(10)
    with pytest.raises(ValueError, match="increasing indices from 0"):
        StartingAt((0, 4, 4))
