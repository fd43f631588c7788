"""J'SJ = S on the space where a method is symplectic, and not elsewhere. Theorem 5; T5, E40."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from mechanics_cases import CASES, METHODS, pairs

import integrators as ig


class RandomCubic(ig.AbstractSeparableHamiltonian):
    """T = p.p/2 and U a quadratic and cubic form with random coefficients."""

    quadratic: Float[Array, "d d"]
    cubic: Float[Array, "d d d"]

    def kinetic(self, p):
        return 0.5 * p @ p

    def potential(self, q):
        return q @ self.quadratic @ q + jnp.einsum("ijk,i,j,k", self.cubic, q, q, q)


@pytest.mark.parametrize(("method", "case"), pairs(lambda method: method.is_symplectic))
def test_one_step_preserves_the_symplectic_form(method, case):
    """The one-step Jacobian on the method's own space satisfies J'SJ = S to 1e-12."""
    # Round-off of a product of three matrices with entries of order 1 to 10.
    assert ig.symplectic_defect(case.system, method, case.system.initial, 0.05) < 1e-12


@pytest.mark.parametrize(("method", "case"), pairs(lambda method: not method.is_symplectic))
def test_runge_kutta_does_not_preserve_it(method, case):
    """An explicit Runge-Kutta step breaks the form by far more than round-off."""
    assert ig.symplectic_defect(case.system, method, case.system.initial, 0.05) > 1e-11


def test_leapfrog_is_symplectic_for_any_potential():
    """At 20 random points of a random cubic potential the defect is round-off, and det J = 1."""
    rng = np.random.default_rng(5)
    system = RandomCubic(jnp.asarray(rng.normal(size=(3, 3))), jnp.asarray(rng.normal(size=(3, 3, 3))))
    points = jnp.asarray(rng.uniform(-1.0, 1.0, (20, 6)))
    step = eqx.filter_jit(jax.vmap(jax.jacfwd(lambda x: ig.Leapfrog().step(system, x, 0.0, 0.1))))
    jacobians = np.asarray(step(points))
    form = np.kron([[0.0, 1.0], [-1.0, 0.0]], np.eye(3))
    defects = np.abs(np.swapaxes(jacobians, 1, 2) @ form @ jacobians - form)
    # Specification T5: 1e-13.
    assert defects.max() < 1e-13
    np.testing.assert_allclose(np.linalg.det(jacobians), 1.0, rtol=0, atol=1e-12)


def test_a_thousand_steps_are_symplectic():
    """The map of 1000 leapfrog steps is symplectic to 1e-10. Specification T5."""
    system = ig.problems.HenonHeiles(1.0)
    flow = eqx.filter_jit(jax.jacfwd(lambda x: ig.propagate(system, ig.Leapfrog(), x, 0.0, 100.0, 1000)))
    jacobian = np.asarray(flow(system.initial))
    form = np.kron([[0.0, 1.0], [-1.0, 0.0]], np.eye(2))
    assert np.abs(jacobian.T @ form @ jacobian - form).max() < 1e-10


def _projected(projection: ig.AbstractProjection, x, dt: float) -> float:
    method = ig.Tao(20.0, projection)
    return float(ig.symplectic_defect(ig.problems.TaoExample(), method, x, dt, lifted=False))


@pytest.mark.parametrize("start", [(0.0, -3.0), (0.3, -1.0)])
def test_tao_projected_at_every_step_is_not_symplectic(start):
    """Lift, step, drop the copy (5.18) breaks the form by 1e-7 to 1e-4 at dt = 0.01, omega = 20. E40."""
    assert 1e-7 < _projected(ig.FirstCopy(), jnp.array(start), 0.01) < 1e-4


@pytest.mark.parametrize("start", [(0.0, -3.0), (0.3, -1.0)])
def test_the_mean_of_the_copies_is_far_nearer_to_symplectic(start):
    """Reading the mean of the copies has a defect over 1000 times smaller, falling at order 6. E40."""
    x = jnp.array(start)
    assert _projected(ig.MeanOfCopies(), x, 0.01) < 1e-3 * _projected(ig.FirstCopy(), x, 0.01)
    # One halving, far above round-off: order 6 is a factor 64, and 40 leaves room for the next term.
    assert _projected(ig.MeanOfCopies(), x, 0.04) > 40.0 * _projected(ig.MeanOfCopies(), x, 0.02)


@pytest.mark.parametrize(("method", "case"), pairs(lambda method: method.is_symmetric))
def test_motion_can_be_reversed(method, case):
    """Reversing the motion after a step and stepping again leads back to the start, to round-off."""
    reversor = jnp.asarray(case.reversor, dtype=float)
    defect = ig.reversibility_defect(case.system, method, case.system.initial, 0.05, reversor=reversor)
    assert defect < 1e-12  # round-off of phase points up to 10


@pytest.mark.parametrize("name", ["midpoint", "heun", "rk4"])
def test_runge_kutta_cannot_be_reversed(name):
    """An explicit Runge-Kutta step is not undone by its reversal."""
    system = CASES["pendulum"].system
    assert ig.reversibility_defect(system, METHODS[name], system.initial, 0.05) > 1e-9
