"""`integrate` compiles once per structure, differentiates both ways, says when it fails."""

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from jaxtyping import Array, Float
from mechanics_cases import CASES, METHODS, eats

import integrators as ig

TS = np.linspace(0.0, 1.0, 6)
TRACES = []


@pytest.fixture
def unchecked(monkeypatch):
    """The type checker of the suite is off, as for a user: it would refuse wrong types before our sentences do."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


class Many(ig.AbstractSeparableHamiltonian):
    """Oscillators that know how many they are."""

    dim: int

    def kinetic(self, p):
        return 0.5 * p @ p

    def potential(self, q):
        return 0.5 * q @ q


class Counted(ig.AbstractSeparableHamiltonian):
    """An oscillator that notes each trace of its potential. Its field has no converter: users forget it."""

    stiffness: Float[Array, ""]

    def kinetic(self, p):
        return 0.5 * p @ p

    def potential(self, q):
        TRACES.append(1)
        return 0.5 * self.stiffness * q @ q


@pytest.mark.parametrize("name", ["leapfrog", "tao", "rk4"])
def test_a_new_parameter_value_compiles_nothing(name):
    """Another value, float or weakly typed, another start and other times all reuse one compilation."""
    ig.integrate(Counted(2.0), METHODS[name], jnp.array([1.0, 0.0]), TS, substeps=3)
    before = len(TRACES)
    assert before > 0
    ig.integrate(Counted(3.0), METHODS[name], jnp.array([1.0, 0.0]), TS, substeps=3)
    ig.integrate(Counted(jnp.asarray(4.0)), METHODS[name], [0.5, 0.0], 2.0 * TS, substeps=3)
    assert len(TRACES) == before


def test_substeps_are_not_unrolled():
    """A hundred times the substeps trace the potential no more often."""
    counts = []
    for substeps in (2, 200):
        before = len(TRACES)
        ig.integrate(Counted(2.0), ig.yoshida4(ig.Leapfrog()), jnp.array([1.0, 0.0]), TS, substeps)
        counts.append(len(TRACES) - before)
    assert counts[0] == counts[1] > 0


@pytest.mark.parametrize("name", ["leapfrog", "suzuki4", "tao", "heun", "rk4", "implicit-midpoint"])
def test_forward_and_reverse_derivatives_agree_with_finite_differences(name):
    """The end point's derivatives, forward and reverse, match central differences."""
    method, x = METHODS[name], jnp.array([1.0, 0.3])

    def end(theta):
        system = ig.Forced(ig.problems.Pendulum(theta[0]), [ig.ViscousDamping(theta[1])])
        return ig.propagate(system, method, jnp.stack([theta[2], x[1]]), 0.0, 1.0, 5).sum()

    theta = jnp.array([1.3, 0.2, 1.0])
    fast = jax.jit(end)
    h = 1e-5
    differences = [(fast(theta + h * e) - fast(theta - h * e)) / (2.0 * h) for e in jnp.eye(3)]
    # Central differences: h^2 and round-off over h, both about 1e-10.
    np.testing.assert_allclose(jax.jit(jax.grad(end))(theta), differences, atol=1e-8)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(end))(theta), differences, atol=1e-8)


@pytest.mark.parametrize("dtype", [np.int64, np.float32])
@pytest.mark.parametrize("name", ["leapfrog", "suzuki4", "tao", "rk4", "implicit-midpoint", "blanes-moan"])
def test_a_state_of_any_kind_of_numbers_is_stepped(name, dtype, unchecked):
    """From whole numbers, or in single precision, the phase point at the end is that from the same numbers in the
    working precision."""
    method = ig.BlanesMoan4() if name == "blanes-moan" else METHODS[name]
    ends = [
        ig.propagate(ig.problems.Pendulum(), method, np.array([1, 0], kind), 0.0, 1.0, 3) for kind in (dtype, float)
    ]
    np.testing.assert_array_equal(*ends)


def test_a_batch_is_a_vmap():
    """`vmap` over starts gives the same trajectories as one at a time."""
    system, starts = ig.problems.Pendulum(), jnp.array([[0.5, 0.0], [1.0, 0.2]])
    batch = jax.vmap(lambda x: ig.integrate(system, ig.Leapfrog(), x, TS, 4).xs)(starts)
    for x, xs in zip(starts, batch, strict=True):
        # The same operations in another order of fusion: a few ulps.
        np.testing.assert_allclose(ig.integrate(system, ig.Leapfrog(), x, TS, 4).xs, xs, atol=1e-14)


def test_irregular_times_run_through_the_same_points():
    """Where the substeps coincide, an irregular grid and a regular one give the same phase points."""
    system = ig.problems.HenonHeiles()
    regular = ig.integrate(system, ig.Leapfrog(), system.initial, 0.1 * np.arange(7.0), substeps=2)
    coarse = ig.integrate(system, ig.Leapfrog(), system.initial, [0.0, 0.2, 0.4, 0.6], substeps=4)
    np.testing.assert_allclose(coarse.xs, regular.xs[::2], atol=1e-14)  # round-off of the step sizes
    np.testing.assert_array_equal(jnp.concatenate([regular.qs, regular.ps], axis=1), regular.xs)


def test_the_zoo_starts_where_the_literature_does():
    """Each initial phase point has its published energy; Kepler's and Tao's orbits close after a period."""
    published = {"henon-heiles": 0.122708, "cherry": -0.00775, "tao-example": 5.0, "kepler": -0.5}
    for name, energy in published.items():
        system = CASES[name].system
        assert system.energy(*ig.split(system.initial)) == pytest.approx(energy, abs=5e-7)  # printed digits
    double = ig.problems.DoublePendulum()
    assert double.energy(*ig.split(double.initial)) == pytest.approx(-20.41, abs=5e-3)  # specification 5.19
    for name, period in (("kepler", 2.0 * np.pi), ("tao-example", 3.26106)):
        system = CASES[name].system
        path = ig.integrate(system, METHODS["rk4"], system.initial, np.array([0.0, period]), substeps=5000)
        # Five digits of the printed period, times a speed of 15.
        np.testing.assert_allclose(path.xs[-1], system.initial, atol=1e-4)


def test_a_divergence_is_said():
    """Cherry's blow-up near t = 28 is in the record, with its time, and `require_finite` says it in words."""
    system = ig.problems.Cherry()
    path = ig.integrate(system, METHODS["rk4"], system.initial, np.arange(0.0, 41.0), substeps=50)
    assert not path.finite
    assert 26.0 < path.diverged_at < 32.0
    with pytest.raises(FloatingPointError, match="left the finite numbers at t = "):
        path.require_finite()


def test_newton_s_failure_is_said():
    """An implicit step that did not converge makes the trajectory not finite."""
    system = ig.problems.Pendulum()
    path = ig.integrate(system, ig.ImplicitMidpoint(iterations=1), system.initial, TS)
    assert not path.finite and path.diverged_at == TS[1]


def test_a_method_refuses_what_it_cannot_step():
    """Leapfrog refuses a nonseparable Hamiltonian in the field's words, composed and forced too."""
    expected = (
        r"steps a separable Hamiltonian, T\(p\) \+ U\(q\), but was given `Cherry`\. "
        r"Use `Tao` for H\(q, p\), or `RK2` for any system\."
    )
    cherry = ig.problems.Cherry()
    for method in (ig.Leapfrog(), ig.suzuki4(ig.Leapfrog())):
        for system in (cherry, ig.Forced(cherry, [ig.ViscousDamping(1.0)])):
            with pytest.raises(TypeError, match=f"`{type(method).__name__}` {expected}"):
                ig.integrate(system, method, cherry.initial, TS)
    assert sum(eats(method, cherry) for method in METHODS.values()) == 6


def test_what_is_no_system_is_refused(unchecked):
    """Something else in the place of the system is named in the refusal."""
    with pytest.raises(TypeError, match="steps a Hamiltonian system, but was given `dict`"):
        ig.integrate({}, ig.Tao(), jnp.array([1.0, 0.0]), TS)


@pytest.mark.parametrize(
    ("x0", "ts", "substeps", "message"),
    [
        ([1.0, 0.0, 0.0], TS, 1, r"`x0` must be one phase point .* shape \(3,\)"),
        ([[1.0, 0.0]], TS, 1, r"`x0` must be one phase point"),
        ([1.0, 0.0], 3.0, 1, r"`ts` must be a row"),
        ([1.0, 0.0], TS, 0, r"`substeps` must be a whole number from 1 up, but is 0"),
        ([1.0, 0.0], TS, 1.5, r"`substeps` must be a whole number"),
    ],
)
def test_bad_arguments_get_one_clear_sentence(unchecked, x0, ts, substeps, message):
    """A wrong shape or count is refused with what was given and what is needed."""
    with pytest.raises(ValueError, match=message):
        ig.integrate(ig.problems.Pendulum(), ig.Leapfrog(), x0, ts, substeps)


@pytest.mark.parametrize("size", [2, 6])
@pytest.mark.parametrize("verb", ["integrate", "propagate"])
def test_a_phase_point_is_of_the_system_s_size(unchecked, verb, size):
    """A system that tells its degrees of freedom refuses a phase point of another size; a list is one, too."""
    system, x0 = Many(2), [0.1] * size
    times = (TS,) if verb == "integrate" else (0.0, 1.0)
    with pytest.raises(ValueError, match=rf"must hold 4 numbers .* 2 degrees of freedom, but has shape \({size},\)"):
        getattr(ig, verb)(system, ig.Leapfrog(), x0, *times)
    end = ig.integrate(system, ig.Leapfrog(), [0.1] * 4, TS).xs[-1]
    once = ig.propagate(system, ig.Leapfrog(), [0.1] * 4, 0.0, 1.0, len(TS) - 1)
    # Five steps of 0.2, of which differences of the times are off by 6e-17: seen 3e-16, and other processors may
    # round elsewhere.
    np.testing.assert_allclose(once, end, rtol=1e-14)


def test_an_energy_drift_prints_its_numbers():
    """What is printed are the largest error, its slope and what that adds up to: of a line of slope 2, both 2."""
    ts, h = jnp.linspace(0.0, 1.0, 3), jnp.array([1.0, 2.0, 3.0])
    path = ig.Trajectory(ts, jnp.zeros((3, 2)), h, jnp.asarray(True), jnp.asarray(np.inf))
    assert str(ig.energy_drift(path)) == "max |H - H_0| = 2, dH/dt = 2, over the duration 2"


def test_bad_methods_are_refused_at_construction():
    """A node outside the step, weights that do not sum to one, and a base not symmetric are refused."""
    with pytest.raises(ValueError, match=r"node in \(0, 1\], but was given 0"):
        ig.RK2(0.0)
    with pytest.raises(ValueError, match="palindromic weights that sum to one"):
        ig.Composition(ig.Leapfrog(), (0.5, 0.6), 2)
    with pytest.raises(ValueError, match="symmetric method, but was given `RK4`"):
        ig.yoshida4(ig.RK4())
