"""Nature's motions are those of textbooks, by code that the package has no part in."""

import ast
from pathlib import Path

import numpy as np
import pytest

from experiments._concealed_effects import Effect, Inputs, World
from experiments._concealed_lanes import STEPS, run
from experiments._concealed_motion import true_motion
from experiments._concealed_planes import ZOO
from experiments._concealed_sensors import faulty

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
NATURE = ("systems", "planes", "effects", "motion", "lanes", "sensors", "fit", "drawing", "coefficients", "hiding",
          "nature", "plan", "files", "seal", "equivalent", "rivals", "oracle", "likelihoods", "score")  # fmt: skip
SPRING = ZOO["driven_spring"]


def spring(*effects, values=None):
    """A mass of 1 on a spring of 4, undriven."""
    return World(SPRING, values or {"m": 1.0, "k": 4.0, "gain": 0.0}, effects)


def moved(world, start, times):
    return true_motion(world, np.array(start), times[0], times[-1]).at(times)


@pytest.mark.parametrize("module", NATURE)
def test_nature_shares_no_code(module):
    """No module that draws, hides, seals, scores or knows the truth imports the package or its integrators."""
    tree = ast.parse((EXPERIMENTS / f"_concealed_{module}.py").read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 1 and node.module.startswith("_concealed_") or node.module.split(".")[0] in (
                "numpy", "scipy", "collections", "dataclasses", "functools", "itertools", "pathlib", "typing",
            ), node.module  # fmt: skip
        elif isinstance(node, ast.Import):
            names = {alias.name.split(".")[0] for alias in node.names}
            assert names <= {"numpy", "scipy", "re", "csv", "hashlib", "json", "os"}, names


@pytest.mark.parametrize("name", ZOO)
def test_equations_are_hamiltons(name):
    """Velocity and force are the slopes of the energy, by central differences, and the text is the same energy."""
    system, rng = ZOO[name], np.random.default_rng(0)
    values, d = system.draw(rng), system.dof
    x = system.start(rng, values) + 0.1 * rng.normal(size=2 * d)
    words = {"sin": np.sin, "cos": np.cos, "exp": np.exp, "sqrt": np.sqrt, "__builtins__": {}}
    state = dict(zip((*system.coordinates, *system.momenta), x, strict=True))
    assert eval(system.hamiltonian, words, values | state) == pytest.approx(system.energy(x[:d], x[d:], values))
    slopes = []
    for k in range(2 * d):
        h = 1e-6 * np.eye(2 * d)[k]
        up, down = (system.energy((x + s * h)[:d], (x + s * h)[d:], values) for s in (1, -1))
        slopes.append((up - down) / 2e-6)
    # A central difference of step 1e-6 is good to about 1e-9 of the energies.
    assert system.velocity(x[:d], x[d:], values) == pytest.approx(slopes[d:], rel=1e-6, abs=1e-7)
    assert system.force(x[:d], x[d:], values) == pytest.approx([-s for s in slopes[:d]], rel=1e-6, abs=1e-7)


@pytest.mark.parametrize("name", ZOO)
def test_energy_is_conserved(name):
    """Without effects and drive the energy of ten periods stays to 1e-8 of the kinetic energy's size."""
    system, rng = ZOO[name], np.random.default_rng(1)
    values, d = system.draw(rng), system.dof
    times = np.linspace(0.0, 10 * system.period(values), 200)
    x = true_motion(World(system, values), system.start(rng, values), 0.0, times[-1]).at(times)
    kinetic = np.ptp(np.sum(x[d:] * np.array(system.velocity(x[:d], x[d:], values)), axis=0))
    assert np.ptp(system.energy(x[:d], x[d:], values)) < 1e-8 * kinetic


def test_viscous_damping_is_the_closed_form():
    """A damped oscillator decays as the textbook says."""
    times = np.linspace(0.0, 12.0, 100)
    x = moved(spring(Effect("viscous_damping", "q", {"c": 0.2})), [1.0, 0.0], times)
    omega = np.sqrt(4.0 - 0.01)
    true = np.exp(-0.1 * times) * (np.cos(omega * times) + 0.1 / omega * np.sin(omega * times))
    assert x[0] == pytest.approx(true, abs=1e-8)


def test_dry_friction_takes_the_same_from_every_swing_and_holds():
    """Each half period takes 2 f/k off the amplitude; within f/k of the middle the mass stays for good."""
    world = spring(Effect("coulomb_friction", "q", {"f": 0.5}))
    half = np.pi / 2
    x = moved(world, [1.1, 0.0], half * np.arange(8))
    # f/k = 0.125: 1.1, -0.85, 0.6, -0.35, 0.1, and there it sticks.
    assert x[0] == pytest.approx([1.1, -0.85, 0.6, -0.35, 0.1, 0.1, 0.1, 0.1], abs=1e-8)
    assert np.all(x[1][5:] == 0.0)


def test_friction_that_holds_lets_go():
    """Under a force that grows as u = t, a mass held by f = 0.5 begins to move at gain u = 0.5."""
    rows = np.linspace(0.0, 1.0, 21)
    world = World(SPRING, {"m": 1.0, "k": 4.0, "gain": 1.0}, (Effect("coulomb_friction", "q", {"f": 0.5}),),
                  Inputs(rows, rows, linear=True))  # fmt: skip
    x = moved(world, [0.0, 0.0], np.array([0.0, 0.49, 0.5, 0.6]))
    assert np.all(x[:, :3] == 0.0)
    # From then on q'' = (t - 0.5) - 4 q, so q = (s - sin(2 s)/2)/4 with s = t - 0.5.
    assert x[0, 3] == pytest.approx((0.1 - np.sin(0.2) / 2) / 4, abs=1e-9)


def test_an_impulse_is_a_jump():
    """The momentum jumps by j at t_star, and nothing else does."""
    x = moved(spring(Effect("impulse", "q", {"j": 0.3, "t_star": 1.0})), [1.0, 0.0],
              np.array([0.0, 1.0 - 1e-9, 1.0, 1.5]))  # fmt: skip
    assert x[1, 2] - x[1, 1] == pytest.approx(0.3, abs=1e-7)
    assert x[0, 2] == pytest.approx(x[0, 1], abs=1e-7)


def test_a_stop_changes_half_of_the_swing():
    """A stop at the middle with 12 beside the spring's 4: half periods of pi/2 and pi/4."""
    x = moved(spring(Effect("contact_stop", "q", {"k": 12.0, "a": 0.0, "side": "upper"})), [-1.0, 0.0],
              np.array([0.0, np.pi / 2 + np.pi / 4]))  # fmt: skip
    assert x[:, 1] == pytest.approx([-1.0, 0.0], abs=1e-8)


def test_a_hidden_oscillator_makes_two_modes():
    """Spring and hidden coordinate are two linear oscillators: a start in one normal mode stays in it."""
    world = spring(Effect("hidden_oscillator", "q", {"omega": 3.0, "kappa": 1.5, "z_0": 0.0, "w_0": 0.0}))
    squares, modes = np.linalg.eigh([[4.0, -1.5], [-1.5, 9.0]])
    q, z = modes[:, 0]
    times = np.linspace(0.0, 10.0, 50)
    x = moved(world, [q, 0.0, z, 0.0], times)
    assert x[0] == pytest.approx(q * np.cos(np.sqrt(squares[0]) * times), abs=1e-8)


def test_parameters_vary_as_the_contract_says():
    """A regime begins at t_star; a drift counts from the first row; a modulation has its phase at t = 0."""
    times = np.array([0.0, 1.0, 1.0 + np.pi / 3])
    x = moved(spring(Effect("regime_change", "k", {"d": 1.25, "t_star": 1.0})), [1.0, 0.0], times)
    before = np.array([np.cos(2.0), -2 * np.sin(2.0)])
    assert x[:, 1] == pytest.approx(before, abs=1e-9)
    assert x[:, 2] == pytest.approx([-before[0], -before[1]], abs=1e-8)  # k = 9: half a period is pi/3
    from experiments._concealed_effects import Modes

    drift = World(SPRING, {"m": 1.0, "k": 4.0, "gain": 0.0}, (Effect("parameter_drift", "k", {"r": 0.1}),), None, 2.0)
    assert drift.parameters(5.0, Modes())["k"] == pytest.approx(4 * 1.3)
    wave = Effect("parametric_modulation", "k", {"a": 0.5, "omega": 1.0, "phi": 0.2})
    assert spring(wave).parameters(3.0, Modes())["k"] == pytest.approx(4 * (1 + 0.5 * np.cos(3.2)))


def test_sensor_faults_compose():
    """(1 + g) h + b + r (t - t_0), on their own column alone."""
    faults = [Effect("sensor_gain", "y", {"g": 0.1}), Effect("sensor_bias", "y", {"b": 2.0}),
              Effect("sensor_drift", "y", {"r": 0.5})]  # fmt: skip
    assert faulty(faults, "y", 10.0, 4.0) == pytest.approx(15.0)
    assert faulty(faults, "x", 10.0, 4.0) == 10.0


def test_a_late_sensor_shows_what_was():
    """y(t) = h(x(t - tau)) from the first row on, before which the motion is the one that led there."""
    from concealed_cases import setting

    from experiments._concealed_hiding import clean_readings, form_of, starts

    setup, public = setting("driven_spring", ["q_m"], rows=30)
    setup = setup._replace(values=dict(setup.values) | {"gain": 0.0})
    late = Effect("sensor_delay", "q_m", {"tau": 0.3})
    (record,) = setup.records
    omega = np.sqrt(setup.values["k"] / setup.values["m"])
    t = record.times[:, None] - record.times[0] - 0.3
    q, p = record.start
    true = q * np.cos(omega * t) + p / (setup.values["m"] * omega) * np.sin(omega * t)
    (found,) = clean_readings(setup, (late,))
    assert found == pytest.approx(true, abs=1e-8)
    form = form_of(setup, public, (late,), ((0, "tau"),))
    # The lanes step back by tau in one step of order 8.
    assert form.readings(form.begin(starts(setup))[:, None])[0][:, :, 0] == pytest.approx(true, abs=1e-4)


def test_a_delayed_force_pulls_at_what_was():
    """Before one delay has passed the force is that of the start; then it follows the motion a delay ago."""
    times = np.linspace(0.0, 1.0, 11)
    world = World(SPRING, {"m": 1.0, "k": 0.0, "gain": 0.0}, (Effect("delayed_force", "q", {"k": 2.0, "tau": 0.5}),))
    q = moved(world, [1.0, 0.0], times)[0]
    s = np.maximum(times - 0.5, 0.0)
    # q'' = -2 at first, so q = 1 - t^2; half a second later q'' = -2 (1 - s^2), which gives s^4/6 more.
    assert q == pytest.approx(1 - times**2 + s**4 / 6, abs=1e-8)


LANES = {
    "pendulum": Effect("quadratic_drag", "theta", {"c": 0.01}),
    "coupled": Effect("coulomb_friction", "x1", {"f": 0.05}),
    "henon_heiles": Effect("impulse", "q2", {"j": 0.05, "t_star": 7.3}),
    "orbit": Effect("hidden_oscillator", "x", {"omega": 2.0, "kappa": 0.1, "z_0": 0.0, "w_0": 0.0}),
    "double_well": Effect("contact_stop", "q", {"k": 0.5, "a": 1.05, "side": "upper"}),
    "duffing": Effect("regime_change", "k", {"d": 0.05, "t_star": 3.21}),
}


@pytest.mark.parametrize("name", LANES)
def test_lanes_follow_the_true_motion(name):
    """The stepped lanes, which the fits use, stay within 1e-4 of DOP853's amplitude, jumps and friction too."""
    system, rng = ZOO[name], np.random.default_rng(2)
    values = system.draw(rng)
    times = np.linspace(0.0, 6 * system.period(values), 121)
    world = World(system, values, (LANES[name],))
    start = np.concatenate([system.start(rng, values), np.zeros(world.extra)])
    true = moved(world, start, times)
    found = run(world, np.repeat(start[:, None], 2, axis=1), times, system.period(values) / system.quick / STEPS)
    # Smooth motions agree to 1e-6; a stop's kink is met by a secant and leaves some 1e-5.
    assert np.all(np.max(np.abs(found[:, :, 1].T - true), axis=1) < 1e-4 * np.max(np.abs(true), axis=1) + 1e-12)
