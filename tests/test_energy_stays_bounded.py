"""Over 1e5 steps a symplectic method's energy error oscillates; that of Runge-Kutta grows."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanics_cases import METHODS

import integrators as ig

TS = np.linspace(0.0, 1000.0, 1001)
SUBSTEPS = 100  # 1e5 steps of 0.01
# Starts on bounded orbits. Cherry's are explosive and have a test of their own.
SYSTEMS = {
    "oscillator": ig.problems.HarmonicOscillator(2.0, 3.0),
    "pendulum": ig.problems.Pendulum(0.7, 1.3),
    "henon-heiles": ig.problems.HenonHeiles(1.0),
    "kepler": ig.problems.Kepler(1.0),
    "tao-example": ig.problems.TaoExample(),
    "double-pendulum": ig.problems.DoublePendulum(),
}
SEPARABLE = ("oscillator", "pendulum", "henon-heiles", "kepler")
# The copies of Tao's method must be bound tightly: 20 is too weak for the double pendulum, see below.
SYMPLECTIC = {
    "leapfrog": METHODS["leapfrog"],
    "yoshida4": METHODS["yoshida4"],
    "suzuki4": METHODS["suzuki4"],
    "tao": ig.Tao(40.0),
    "suzuki4-tao": ig.suzuki4(ig.Tao(40.0)),
    "implicit-midpoint": METHODS["implicit-midpoint"],
}
PAIRS = [
    (method, problem)
    for method, integrator in SYMPLECTIC.items()
    for problem in SYSTEMS
    if problem in SEPARABLE or not integrator.needs_separable
]


def _path(system, method, x0=None) -> ig.Trajectory:
    return ig.integrate(system, method, system.initial if x0 is None else x0, TS, SUBSTEPS).require_finite()


@pytest.mark.parametrize(("method", "problem"), PAIRS)
def test_symplectic_energy_error_does_not_grow(method, problem):
    """The largest error over 1e5 steps is that of the first tenth, and its trend is a small part of it."""
    path = _path(SYSTEMS[problem], SYMPLECTIC[method])
    drift = ig.energy_drift(path)
    early = np.abs(path.energies[:101] - path.energies[0]).max()
    # Twice: a quasi-periodic orbit may meet its worst point later. 1e-12: summed round-off.
    assert drift.largest < 2.0 * early + 1e-12
    # A drift would have its trend alike to its largest error; a tenth separates the two.
    assert drift.secular < 0.1 * drift.largest + 1e-12


@pytest.mark.parametrize("problem", [name for name in SYSTEMS if name != "double-pendulum"])
def test_midpoint_energy_error_grows_with_time(problem):
    """RK2's energy error is a trend: by the end it is several times that of the first tenth."""
    path = _path(SYSTEMS[problem], METHODS["midpoint"])
    drift = ig.energy_drift(path)
    early = np.abs(path.energies[:101] - path.energies[0]).max()
    assert drift.largest > 5.0 * early  # ten times as long
    assert drift.secular > 0.5 * drift.largest


@pytest.mark.parametrize("name", ["midpoint", "heun"])
def test_rk2_on_the_oscillator_gains_energy_at_the_known_rate(name):
    """Each RK2 step multiplies the oscillator's energy by 1 + (w dt)^4 / 4."""
    path = _path(SYSTEMS["oscillator"], METHODS[name])
    z = np.sqrt(3.0 / 2.0) * 0.01
    growth = np.exp(SUBSTEPS * np.arange(TS.size) * np.log1p(z**4 / 4.0))
    # Round-off of 1e5 steps, each 1e-16, of numbers near 1.
    np.testing.assert_allclose(path.energies / path.energies[0], growth, rtol=1e-11)


def test_henon_heiles_at_large_steps_keeps_to_the_known_band():
    """Leapfrog at dt = 0.25 keeps H in [0.1214, 0.1238] for 100 s; midpoint ends at 0.229. T5, 5.15."""
    system, ts = SYSTEMS["henon-heiles"], np.linspace(0.0, 100.0, 401)
    leapfrog = ig.integrate(system, METHODS["leapfrog"], system.initial, ts).require_finite()
    assert (round(float(leapfrog.energies.min()), 4), round(float(leapfrog.energies.max()), 4)) == (
        0.1214,
        0.1238,
    )
    midpoint = ig.integrate(system, METHODS["midpoint"], system.initial, ts).require_finite()
    assert midpoint.energies[-1] == pytest.approx(0.229, abs=5e-4)  # three digits printed


def test_lifting_once_beats_projecting_at_every_step():
    """On Henon-Heiles over 20,000 steps, Tao lifted once stays bounded; projected at every step it drifts."""
    system, method = SYSTEMS["henon-heiles"], ig.Tao(10.0, ig.FirstCopy())
    every = np.linspace(0.0, 5000.0, 20_001)  # dt 0.25, omega 10: the setting of house.md, measurement 1
    once = ig.energy_drift(ig.integrate(system, method, system.initial, every).require_finite())
    each = _projecting(system, method, every)
    assert each > 5.0 * float(once.secular) and each > 1e-3


def _projecting(system, method, ts) -> float:
    """Mean energy error where each step starts from one projected phase point."""

    def step(x, t):
        x = ig.propagate(system, method, x, t, t + ts[1])
        return x, system.energy(*ig.split(x))

    _, energies = jax.lax.scan(step, system.initial, jnp.asarray(ts[:-1]))
    return float(jnp.abs(energies - system.energy(*ig.split(system.initial))).mean())


def test_cherry_conserves_energy_better_while_it_grows():
    """On Cherry's growing orbit Tao's energy error is under a hundredth of RK2's at the same step."""
    system = ig.problems.Cherry(1.0)
    start = 0.01 * system.initial  # slow enough to last 1e5 steps
    tao = ig.energy_drift(_path(system, METHODS["tao"], start))
    midpoint = ig.energy_drift(_path(system, METHODS["midpoint"], start))
    assert tao.largest < 0.01 * midpoint.largest


def test_too_weak_a_binding_parts_the_copies():
    """On Kepler's ellipse Tao's method needs omega = 20; at 5 the copies part."""
    system = SYSTEMS["kepler"]
    loose = ig.energy_drift(_path(system, ig.Tao(5.0)))
    bound = ig.energy_drift(_path(system, ig.Tao(20.0)))
    assert bound.largest < 1e-3 and loose.largest > 0.5  # the energy is -0.5: nothing is left of the orbit


def test_a_drift_is_measured_as_one():
    """energy_drift returns the slope of a straight line, none of a single point and NaN for a diverged trajectory."""
    ts = jnp.array([0.0, 1.0, 3.0, 4.0])
    line = ig.Trajectory(ts, jnp.zeros((4, 2)), 2.0 + 0.5 * ts, jnp.array(True), jnp.array(jnp.inf))
    drift = ig.energy_drift(line)
    assert (drift.largest, drift.slope, drift.secular) == pytest.approx((2.0, 0.5, 2.0), abs=1e-14)
    point = ig.energy_drift(ig.integrate(ig.problems.Pendulum(), ig.Leapfrog(), jnp.array([1.0, 0.0]), [2.0]))
    assert (point.largest, point.slope, point.secular) == (0.0, 0.0, 0.0)
    broken = ig.Trajectory(ts, jnp.zeros((4, 2)), 2.0 + 0.5 * ts, jnp.array(False), jnp.array(3.0))
    assert np.isnan(ig.energy_drift(broken).largest)
