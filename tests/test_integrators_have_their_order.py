"""Each method converges to the true motion at the order it states."""

import jax.numpy as jnp
import numpy as np
import pytest
from mechanics_cases import CASES, METHODS, pairs, truth

import integrators as ig


@pytest.mark.parametrize(("method", "case"), pairs())
def test_the_error_against_dop853_falls_at_the_stated_order(method, case):
    """The log-log slope of the error against SciPy's solution is the stated order."""
    # Enough steps for the leading term, few enough that order 4 stays above the reference's 1e-12.
    # The binding of Tao's copies asks for smaller steps at order 4.
    coarsest = 200 if method.order == 2 else 50 * method.copies
    steps = (coarsest, 2 * coarsest, 4 * coarsest)
    end = truth(case, [0.0, case.duration])[-1]
    slope = ig.observed_order(
        case.system, method, case.system.initial, case.duration, steps=steps, reference=jnp.asarray(end)
    )
    # The next term of the expansion bends the slope by a few per cent at these steps; more where the leading term is
    # a hundred times smaller than a composition's, as Blanes and Moan's is: on Kepler's orbit the next one then shows.
    bend = 0.25 if isinstance(method, ig.BlanesMoan4) else 0.15
    assert slope == pytest.approx(method.order, abs=bend)


@pytest.mark.parametrize("problem", CASES)
def test_a_fine_trajectory_is_that_of_dop853(problem):
    """A method of order 4 at small steps, on irregular times, agrees with DOP853 to 1e-10 all along."""
    case = CASES[problem]
    ts = case.duration * np.array([0.0, 0.11, 0.13, 0.4, 0.77, 1.0])
    path = ig.integrate(case.system, ig.suzuki4(ig.ImplicitMidpoint()), case.system.initial, ts, substeps=400)
    np.testing.assert_allclose(path.xs, truth(case, ts), rtol=0, atol=1e-10)


def test_observed_order_without_a_reference_uses_a_finer_run():
    """The default reference, 16 times finer, gives the same order as the true one."""
    case = CASES["pendulum"]
    slope = ig.observed_order(case.system, METHODS["leapfrog"], case.system.initial, case.duration)
    # Bias of the reference: its error is 1/256 of the smallest one, under 0.01 in the slope.
    assert slope == pytest.approx(2.0, abs=0.03)


def test_suzuki_errs_less_than_yoshida_at_the_same_cost():
    """At equal evaluations of the force, Suzuki's composition errs less than half as much as Yoshida's."""
    case = CASES["henon-heiles"]
    end = truth(case, [0.0, 10.0])[-1]
    error = {}
    for name, substeps in (("yoshida4", 500), ("suzuki4", 300)):  # 1500 leapfrog steps each
        path = ig.integrate(case.system, METHODS[name], case.system.initial, np.array([0.0, 10.0]), substeps)
        error[name] = np.abs(path.xs[-1] - end).max()
    assert error["suzuki4"] < 0.5 * error["yoshida4"]


def test_leapfrog_is_the_dissertation_s_map():
    """For T = p.p/2 one step is (5.5)-(5.6) as printed."""
    q, p, dt = np.array([0.2, -0.25]), np.array([0.3, -0.25]), 0.25

    def slope(q):
        return np.array([q[0] + 2 * q[0] * q[1], q[1] + q[0] ** 2 - q[1] ** 2])

    q1 = q + dt * p - 0.5 * dt**2 * slope(q)
    p1 = p - 0.5 * dt * (slope(q) + slope(q1))
    step = ig.Leapfrog().step(ig.problems.HenonHeiles(1.0), jnp.concatenate([q, p]), 0.0, dt)
    np.testing.assert_allclose(step, np.concatenate([q1, p1]), rtol=0, atol=1e-15)


def test_tao_without_a_binding_is_the_limit_of_a_weak_one():
    """Where nothing binds the copies, the two half steps of the second stay one whole one: the same step."""
    system = ig.problems.TaoExample()
    x = ig.Tao().lift(system.initial) + 0.01 * jnp.arange(2.0 * len(system.initial))  # copies that have parted
    none, weak = (ig.Tao(omega).flow(system, x, 0.3, 0.1) for omega in (None, 0.0))
    # Two half steps against a whole one: each entry is rounded a few times more.
    np.testing.assert_allclose(none, weak, rtol=0, atol=1e-15 * float(jnp.abs(x).max() + 1))
