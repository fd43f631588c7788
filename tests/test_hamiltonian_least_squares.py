"""Least squares of Hamilton's equations finds the Hamiltonian, with the signs right, and priors enter it in nats."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import integrators as ig
from symplearn._errors import InputError
from symplearn._fit import fit
from symplearn._hamiltonian_objectives import (
    HamiltonianLeastSquares,
    SecondOrderDifferences,
    hamiltonian_least_squares,
)
from symplearn._hamiltonians import Polynomial, PolynomialPotential
from symplearn._model import Coordinates, FullState, LinearDynamics, Propagator, StateSpaceModel
from symplearn._noise import AdditiveGaussian, ScaledIdentity
from symplearn._objectives import TimeSeries
from symplearn._prior import Normal

# H = q^2/2 + 0.7 q p + 0.8 p^2 - 0.2 q^2 p + 0.1 p^3: nothing in it is symmetric under a change of sign.
# The products up to degree 3 in the order q, p, q^2, q p, p^2, q^3, q^2 p, q p^2, p^3.
TRUE = np.array([0.0, 0.0, 0.5, 0.7, 0.8, 0.0, -0.2, 0.0, 0.1])
STARTS = (np.array([0.6, -0.2]), np.array([-0.3, 0.5]))


def gradient_features(q, p):
    """d/dq and d/dp of the nine products, (2, 9), by hand."""
    by_q = [1, 0, 2 * q, p, 0, 3 * q**2, 2 * q * p, p**2, 0]
    by_p = [0, 1, 0, q, 2 * p, 0, q**2, 2 * q * p, 3 * p**2]
    return np.array([by_q, by_p], dtype=float)


def orbit(start, times):
    """The motion by SciPy's DOP853: qdot = dH/dp, pdot = -dH/dq."""

    def field(t, x):
        slope = gradient_features(*x) @ TRUE
        return [slope[1], -slope[0]]

    return solve_ivp(field, (0.0, times[-1]), start, "DOP853", times, rtol=1e-12, atol=1e-13).y.T


def recordings(dt=0.05, span=4.0, noise=0.0):
    rng, times = np.random.default_rng(3), np.arange(0.0, span + dt / 2, dt)
    paths = [orbit(start, times) for start in STARTS]
    return [TimeSeries(jnp.asarray(times), jnp.asarray(x + noise * rng.normal(size=x.shape))) for x in paths]


def stacked(recordings):
    """Features and [-pdot; qdot] by numpy's own gradient of second order."""
    rows, targets = [], []
    for one in recordings:
        xs = np.asarray(one.readings)
        rates = np.gradient(xs, np.asarray(one.times), axis=0, edge_order=2)
        for x, rate in zip(xs, rates, strict=True):
            rows.append(gradient_features(*x))
            targets.append([-rate[1], rate[0]])
    return np.concatenate(rows), np.concatenate(targets)


def as_model(hamiltonian):
    noise = AdditiveGaussian(ScaledIdentity(1.0, 2 * hamiltonian.dim))
    return StateSpaceModel(Propagator(hamiltonian, ig.Tao()), FullState(), noise, noise)


SCORE = eqx.filter_jit(eqx.filter_value_and_grad(HamiltonianLeastSquares(0.01)))


def test_differences_are_of_second_order():
    """Rates at uneven times are numpy's second-order ones, and a missing reading costs its neighbours' rates."""
    times = np.cumsum(np.random.default_rng(0).uniform(0.1, 0.4, size=9))
    ys = np.stack([np.sin(times), np.exp(-times)], axis=1)
    found = SecondOrderDifferences()(jnp.asarray(times), jnp.asarray(ys))
    np.testing.assert_allclose(found, np.gradient(ys, times, axis=0, edge_order=2), atol=1e-13)
    ys[4, 0] = np.nan
    missing = np.isnan(SecondOrderDifferences()(jnp.asarray(times), jnp.asarray(ys)))
    assert np.array_equal(np.flatnonzero(missing[:, 0]), [3, 4, 5]) and not missing[:, 1].any()
    with pytest.raises(InputError, match="at least 3"):
        SecondOrderDifferences()(jnp.asarray(times[:2]), jnp.asarray(ys[:2]))


def test_the_closed_form_finds_the_hamiltonian_at_second_order():
    """The coefficients tend to the truth, signs and all, and their error falls fourfold as the step halves."""
    errors = []
    for dt in (0.1, 0.05, 0.025):
        found = hamiltonian_least_squares(Polynomial(1, 3), recordings(dt))
        errors.append(np.abs(np.asarray(found.coefficients) - TRUE).max())
    # Order 2; the ends of the recording, at order 2 too, weigh a little less with each halving.
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), 2.0, atol=0.25)
    # dt^2 = 6e-4 times a third derivative of order one.
    assert errors[-1] < 2e-3


def test_the_sign_as_printed_gives_the_opposite():
    """The normal equations agree where b uses [-pdot; qdot]; with the printed [pdot; -qdot] they give -H (E37)."""
    series = recordings()
    features, rates = stacked(series)
    a, b = features.T @ features / len(rates), features.T @ rates / len(rates)
    found = hamiltonian_least_squares(Polynomial(1, 3), series).coefficients
    # The normal equations square a condition number of some hundreds: eight digits remain to spare.
    np.testing.assert_allclose(found, np.linalg.solve(a, b), atol=1e-9)
    np.testing.assert_allclose(np.linalg.solve(a, -b), -TRUE, atol=1e-2)


def test_the_closed_form_minimises_the_objective():
    """At the closed form the objective is SciPy's sum of squares in nats, and its gradient vanishes."""
    series = recordings(noise=0.01)
    features, rates = stacked(series)
    found = hamiltonian_least_squares(Polynomial(1, 3), series)
    r = rates - features @ np.asarray(found.coefficients)
    score, slope = SCORE(as_model(found), series)
    expected = np.sum(r**2) / 0.02 + 0.5 * r.size * np.log(2 * np.pi * 0.01)
    assert float(score) == pytest.approx(expected, rel=1e-12)
    # 324 terms of up to about 10 nats per unit, each to round-off of the solution, 1e-13.
    np.testing.assert_allclose(slope.dynamics.system.coefficients, 0.0, atol=1e-9)
    elsewhere = as_model(Polynomial(1, 3, TRUE + 0.1))
    expected = -features.T @ (rates - features @ (TRUE + 0.1)) / 0.01
    np.testing.assert_allclose(SCORE(elsewhere, series)[1].dynamics.system.coefficients, expected, rtol=1e-10)


def test_a_normal_prior_is_ridge_regression():
    """The MAP under N(0.1, V) is the ridge regression with penalty variance / V about 0.1: priors add in nats."""
    series, variance, V = recordings(noise=0.01), 0.01, 1e-3
    features, rates = stacked(series)
    precision = features.T @ features / variance + np.eye(9) / V
    ridge = np.linalg.solve(precision, features.T @ rates / variance + 0.1 / V)
    estimate = fit(as_model(Polynomial(1, 3)), series, HamiltonianLeastSquares(variance), prior=Normal(0.1, V),
                   tolerance=1e-10)  # fmt: skip
    assert estimate.converged
    # 1e-10 nats are 1e-5 standard deviations, each below the prior's 0.03.
    np.testing.assert_allclose(estimate.values()["dynamics.system.coefficients"], ridge, atol=1e-6)
    # And the prior matters: without it the answer lies elsewhere.
    assert np.abs(ridge - np.linalg.lstsq(features, rates)[0]).max() > 0.01


def test_a_potential_keeps_its_kinetic_energy():
    """For H = p'p/2 + U(q) the known part stays, and U of two coordinates is found from two recordings."""
    truth = np.array([0.3, 0.0, 0.5, 0.2, 0.7])  # q0, q1, q0^2, q0 q1, q1^2

    def field(t, x):
        return [x[2], x[3], -0.3 - x[0] - 0.2 * x[1], -0.2 * x[0] - 1.4 * x[1]]

    times, series = np.arange(0.0, 6.0, 0.02), []
    for start in ([0.5, 0.2, 0.0, 0.3], [-0.4, 0.6, 0.2, -0.1]):
        path = solve_ivp(field, (0.0, 6.0), start, "DOP853", times, rtol=1e-12, atol=1e-13).y.T
        series.append(TimeSeries(jnp.asarray(times), jnp.asarray(path)))
    found = hamiltonian_least_squares(PolynomialPotential(2, 2), series)
    # dt^2 / 6 of a third derivative of order one: 1e-4.
    np.testing.assert_allclose(found.coefficients, truth, atol=3e-4)


def test_missing_readings_cost_only_themselves():
    """An incomplete point, and a rate without a neighbour, are left out of score and closed form."""
    series = recordings(noise=0.01)[0]
    ys = np.asarray(series.readings).copy()
    ys[10, 0], ys[20], ys[0, 1] = np.nan, np.nan, np.nan
    holed = TimeSeries(series.times, jnp.asarray(ys))
    rates = np.gradient(ys, np.asarray(series.times), axis=0, edge_order=2)
    keep, expected = ~np.isnan(ys).any(axis=1), 0.0
    rows, targets = [], []
    for x, rate in zip(ys[keep], rates[keep], strict=True):
        rows.append(gradient_features(*x))
        targets.append([-rate[1], rate[0]])
    rows, targets = np.concatenate(rows), np.concatenate(targets)
    rows, targets = rows[~np.isnan(targets)], targets[~np.isnan(targets)]
    expected = np.sum((targets - rows @ TRUE) ** 2) / 0.02 + 0.5 * targets.size * np.log(2 * np.pi * 0.01)
    score, slope = SCORE(as_model(Polynomial(1, 3, TRUE)), holed)
    assert float(score) == pytest.approx(expected, rel=1e-12)
    assert np.all(np.isfinite(slope.dynamics.system.coefficients))
    found = hamiltonian_least_squares(Polynomial(1, 3), holed).coefficients
    np.testing.assert_allclose(found, np.linalg.lstsq(rows, targets)[0], atol=1e-9)


def test_forces_are_part_of_the_equations():
    """With a force of -c v the momentum's rate is compared with -dH/dq - c v."""
    series = recordings()[0]
    features, rates = stacked([series])
    velocity = (features @ TRUE)[1::2]
    errors = rates - features @ TRUE
    errors[0::2] -= 0.3 * velocity
    model = as_model(Polynomial(1, 3, TRUE))
    forced = ig.Forced(model.dynamics.system, (ig.ViscousDamping(0.3),))
    model = eqx.tree_at(lambda m: m.dynamics, model, Propagator(forced, ig.Tao()))
    expected = np.sum(errors**2) / 0.02 + 0.5 * errors.size * np.log(2 * np.pi * 0.01)
    assert float(eqx.filter_jit(HamiltonianLeastSquares(0.01))(model, series)) == pytest.approx(expected, rel=1e-12)


def test_what_cannot_be_solved_is_said():
    """Too few data, another dynamics or part of the state are refused; what is not finite scores 1e15 nats."""
    series = recordings()[0]
    short = TimeSeries(series.times[:4], series.readings[:4])
    with pytest.raises(InputError, match="determine 8 of the Hamiltonian's 9 coefficients"):
        hamiltonian_least_squares(Polynomial(1, 3), short)
    model = as_model(Polynomial(1, 3))
    with pytest.raises(InputError, match="LinearDynamics"):
        HamiltonianLeastSquares(1.0)(eqx.tree_at(lambda m: m.dynamics, model, LinearDynamics(jnp.eye(2))), series)
    with pytest.raises(InputError, match="Coordinates"):
        HamiltonianLeastSquares(1.0)(eqx.tree_at(lambda m: m.observation, model, Coordinates((0, 1))), series)
    for bad in (np.inf, np.nan):
        score, slope = SCORE(as_model(Polynomial(1, 3, jnp.full(9, bad))), [series, series])
        assert float(score) == 2e15 and np.all(np.isfinite(jax.tree.leaves(slope.dynamics.system.coefficients)[0]))
