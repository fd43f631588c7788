"""Left-out forces enter by Strang splitting: any method serves, at order 2, and friction sticks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from mechanics_cases import METHODS
from scipy.integrate import solve_ivp

import integrators as ig

OSCILLATOR = ig.problems.HarmonicOscillator(2.0, 3.0)
START = jnp.array([1.0, 0.0])


def damped_oscillator(t, mass=2.0, stiffness=3.0, c=0.4):
    """m q'' + c q' + k q = 0 from q = 1 at rest: the phase point in closed form."""
    decay = c / (2.0 * mass)
    omega = np.sqrt(stiffness / mass - decay**2)
    cos, sin, fall = np.cos(omega * t), np.sin(omega * t), np.exp(-decay * t)
    return np.stack([fall * (cos + decay / omega * sin), -mass * fall * (decay**2 / omega + omega) * sin], -1)


@pytest.mark.parametrize("name", METHODS)
def test_viscous_damping_converges_to_the_closed_form_at_order_two(name):
    """With a force every method, whatever its own order, converges at order 2 to the damped oscillation."""
    system = ig.Forced(OSCILLATOR, [ig.ViscousDamping(0.4)])
    end = jnp.asarray(damped_oscillator(5.0))
    slope = ig.observed_order(system, METHODS[name], START, 5.0, steps=(200, 400, 800), reference=end)
    assert slope == pytest.approx(2.0, abs=0.1)  # the next term is of relative order dt


@pytest.mark.parametrize("name", METHODS)
def test_without_forces_it_is_the_method_itself(name):
    """`Forced` with no forces gives the same numbers, bit by bit."""
    bare = METHODS[name].step(OSCILLATOR, METHODS[name].lift(START), 0.0, 0.1)
    wrapped = METHODS[name].step(ig.Forced(OSCILLATOR), METHODS[name].lift(START), 0.0, 0.1)
    np.testing.assert_array_equal(bare, wrapped)


@pytest.mark.parametrize("force", [ig.ViscousDamping(0.4), ig.QuadraticDrag(0.4), ig.CoulombFriction(0.1)])
def test_dissipation_never_raises_the_energy(force):
    """Dissipative kicks lower the energy; the implicit midpoint flow keeps a quadratic one exactly."""
    path = ig.integrate(ig.Forced(OSCILLATOR, [force]), ig.ImplicitMidpoint(), START, np.linspace(0.0, 30.0, 601))
    # Newton's round-off, a few 1e-16 of an energy of 1.5.
    assert np.diff(path.energies).max() < 1e-14
    assert path.energies[-1] < 0.2 * path.energies[0]


def test_quadratic_drag_slows_a_free_body_as_in_closed_form():
    """Without a spring p' = -c |v| v gives p = p0 / (1 + c p0 t / m^2)."""
    free = ig.Forced(ig.problems.HarmonicOscillator(2.0, 0.0), [ig.QuadraticDrag(0.7)])
    ts = np.linspace(0.0, 10.0, 11)
    for sign in (1.0, -1.0):
        path = ig.integrate(free, ig.Leapfrog(), jnp.array([0.0, sign * 3.0]), ts, substeps=200)
        # Order 2 at dt 0.005: about 1e-5 of the initial 3.
        np.testing.assert_allclose(path.ps[:, 0], sign * 3.0 / (1.0 + 0.7 * 3.0 * ts / 4.0), atol=3e-5)


@pytest.mark.parametrize("name", ["leapfrog", "tao", "suzuki4", "implicit-midpoint"])
def test_coulomb_friction_takes_a_fixed_amount_off_each_swing(name):
    """The amplitude falls by 2 f / k each half swing: 1.03, 0.83, 0.63, 0.43, 0.23, 0.03, for f / k = 0.1."""
    system = ig.Forced(ig.problems.HarmonicOscillator(), [ig.CoulombFriction(0.1)])
    turns = np.pi * np.arange(6)
    path = ig.integrate(system, METHODS[name], jnp.array([1.03, 0.0]), turns, substeps=2000)
    expected = (-1.0) ** np.arange(6) * (1.03 - 0.2 * np.arange(6))
    # The sign of v changes within a step of 1.6e-3: a friction impulse wrong by f dt at each turn.
    np.testing.assert_allclose(path.qs[:, 0], expected, atol=5e-4)


@pytest.mark.parametrize("name", ["leapfrog", "tao", "suzuki4", "rk4", "implicit-midpoint"])
def test_a_body_held_by_friction_stays_off_its_equilibrium(name):
    """It sticks within f / k of the equilibrium and does not creep, however long one waits."""
    system = ig.Forced(ig.problems.HarmonicOscillator(), [ig.CoulombFriction(0.1)])
    path = ig.integrate(system, METHODS[name], jnp.array([1.03, 0.0]), np.linspace(0.0, 200.0, 201), substeps=50)
    resting = path.xs[30:]
    assert np.ptp(resting[:, 0]) == 0.0 and np.abs(resting[:, 1]).max() == 0.0
    assert resting[0, 0] == pytest.approx(-0.03, abs=5e-3)  # f dt times the number of turns


def test_a_push_beyond_the_limit_sets_it_free():
    """A body at rest stays while the spring pulls with less than f, and moves once it pulls with more."""
    system = ig.Forced(ig.problems.HarmonicOscillator(), [ig.CoulombFriction(0.1)])
    for start, moves in ((0.099, False), (0.101, True)):
        path = ig.integrate(system, ig.Leapfrog(), jnp.array([start, 0.0]), np.array([0.0, 0.5]), substeps=50)
        assert bool(path.xs[-1, 0] < start) is moves


def test_friction_s_gradient_exists_where_friction_is_absent():
    """At f = 0, from rest, q(T) has the right derivatives in f and p: a search can start without friction."""

    @jax.jit
    def end(f, p):
        system = ig.Forced(OSCILLATOR, [ig.CoulombFriction(f)])
        return ig.propagate(system, ig.Leapfrog(), jnp.stack([1.0, p]), 0.0, 3.0, 300)[0]

    h = 1e-6
    in_friction, in_momentum = jax.grad(end, argnums=(0, 1))(0.0, 0.0)
    # One-sided in f, where the error is of order h; in p dq/dp = sin(w T) / (m w), to order 2 at dt = 0.01.
    assert in_friction == pytest.approx(float((end(h, 0.0) - end(0.0, 0.0)) / h), abs=1e-5)
    omega = np.sqrt(1.5)
    assert in_momentum == pytest.approx(np.sin(3.0 * omega) / (2.0 * omega), abs=1e-4)


def test_forces_on_two_coordinates_and_together():
    """Damping and drag, per coordinate, on a nonseparable system agree with DOP853 through Tao's method."""
    pendulum = ig.problems.DoublePendulum()
    c, drag = np.array([0.3, 0.1]), 0.05
    system = ig.Forced(pendulum, [ig.ViscousDamping(c), ig.QuadraticDrag(drag)])

    def equations(t, x):
        (a, b), p = x[:2], x[2:]
        mass = np.array([[2.0, np.cos(a - b)], [np.cos(a - b), 1.0]])
        u, w = v = np.linalg.solve(mass, p)
        twist = u * w * np.sin(a - b)
        force = np.array([-twist - 2.0 * 9.81 * np.sin(a), twist - 9.81 * np.sin(b)])
        return np.concatenate([v, force - c * v - drag * np.abs(v) * v])

    ts = np.linspace(0.0, 2.0, 5)
    truth = solve_ivp(equations, (0.0, 2.0), pendulum.initial, "DOP853", ts, rtol=1e-11, atol=1e-12).y.T
    path = ig.integrate(system, ig.Tao(40.0), pendulum.initial, ts, substeps=2000)
    # Order 2 at dt 2.5e-4, with derivatives of some 100: 1e-5.
    np.testing.assert_allclose(path.xs, truth, atol=2e-5)


class Push(ig.AbstractForce):
    """F = cos(w t), a force in time alone."""

    w: Float[Array, ""]

    def force(self, q, v, t):
        return jnp.cos(self.w * t) * jnp.ones_like(q)


class Driven(ig.AbstractSeparableHamiltonian):
    """H = p^2 / 2 + q^2 / 2 - q cos(w t), the same push inside the Hamiltonian."""

    w: Float[Array, ""]
    t: Float[Array, ""]

    def kinetic(self, p):
        return 0.5 * p @ p

    def potential(self, q):
        return 0.5 * q @ q - jnp.sum(q) * jnp.cos(self.w * self.t)

    def at(self, t):
        return Driven(self.w, jnp.asarray(t, dtype=float))


def driven_end(t, w):
    """q'' + q = cos(w t) from rest at 0: q = (cos w t - cos t) / (1 - w^2)."""
    scale = 1.0 / (1.0 - w**2)
    return scale * jnp.array([np.cos(w * t) - np.cos(t), np.sin(t) - w * np.sin(w * t)])


@pytest.mark.parametrize("name", METHODS)
def test_a_driven_hamiltonian_is_followed_at_the_method_s_order(name):
    """Each method asks for the system at its own stage times: the closed form is met at the stated order."""
    method, system = METHODS[name], Driven(jnp.array(1.7), jnp.array(0.0))
    coarsest = 200 if method.order == 2 else 50 * method.copies
    steps = (coarsest, 2 * coarsest, 4 * coarsest)
    end = driven_end(2.0, 1.7)
    slope = ig.observed_order(system, method, jnp.zeros(2), 2.0, steps=steps, reference=end)
    assert slope == pytest.approx(method.order, abs=0.15)  # as for the autonomous problems


@pytest.mark.parametrize("name", ["leapfrog", "tao", "suzuki4"])
def test_a_driving_force_is_followed_at_order_two(name):
    """A push that depends on time alone, split in as a force, meets the same closed form at order 2."""
    system = ig.Forced(ig.problems.HarmonicOscillator(), [Push(jnp.array(1.7))])
    end = driven_end(2.0, 1.7)
    slope = ig.observed_order(system, METHODS[name], jnp.zeros(2), 2.0, steps=(200, 400, 800), reference=end)
    assert slope == pytest.approx(2.0, abs=0.1)
