"""The augmented simulation moves as SciPy moves the same equations written by hand, whatever is switched on."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from engine_cases import solved

import integrators as ig
from symplearn._augmented import SimulatedFlow, SimulatedReading, Span, equations
from symplearn._expression import symbol

LEAPFROG, TAO = ig.suzuki4(ig.Leapfrog()), ig.suzuki4(ig.Tao(4.0))
MASS, A = 2.0, 0.7
START = np.array([0.9, 0.8])
LENGTH = 3.0
Q, P, M, K, U, T = (symbol(name) for name in ("q", "p", "m", "a", "u", "t"))


def compiled(hamiltonian, force=0, inputs=(), coordinates=(Q,), momenta=(P,)):
    forces = [sympy.sympify(force), *[sympy.Integer(0)] * (len(coordinates) - 1)]
    readings = {f"y{i}": q for i, q in enumerate(coordinates)}
    return equations(coordinates, momenta, hamiltonian, (M, K), inputs, forces, readings)


SOFT = compiled(P**2 / (2 * M) + K * sympy.cosh(Q))  # v = p / m, force -a sinh(q)
CURVED = compiled((Q**2 + 1) * (P**2 + 1) / (2 * M) * K)  # not separable: softness a (q^2 + 1) / m
DRIVEN = compiled(P**2 / (2 * M) + K * Q**2 / 2, K * U - sympy.Rational(1, 10) * P * sympy.cos(T), (U,))
SHAKEN = compiled(P**2 / (2 * M) + K * Q**2 * (1 + sympy.sin(3 * T) / 2) / 2, sympy.cos(T))
PAIR = compiled(
    sum(p**2 / (2 * M) for p in (P, symbol("p2"))) + K * (Q * symbol("q2")) ** 2 + sympy.cosh(Q + symbol("q2")),
    coordinates=(Q, symbol("q2")),
    momenta=(P, symbol("p2")),
)


def coefficients(built, **values):
    """The coefficient vector by effect, on the first coordinate or column."""
    out = np.zeros(len(built.candidates))
    for effect, value in values.items():
        out[next(i for i, c in enumerate(built.candidates) if c.effect.name == effect)] = value
    return out


@eqx.filter_jit
def flow(built, method, values, x, span):
    return SimulatedFlow(built, method, jnp.array([MASS, A]), values)(x, span)


def moved(built, method, values, x=START, length=LENGTH, pieces=300, inputs=None):
    inputs = np.zeros((pieces, 0)) if inputs is None else inputs
    span = Span(jnp.asarray(0.0), jnp.asarray(length / pieces), jnp.asarray(inputs))
    return np.asarray(flow(built, method, jnp.asarray(values), jnp.asarray(x, float), span))


def by_hand(rates, x=START, length=LENGTH):
    return solved(rates, x, np.array([0.0, length]), 1e-12)[-1]


EFFECTS = {  # coefficient, force of q and v by hand
    "constant_force": (0.4, lambda q, v: 0.4),
    "linear_stiffness": (0.5, lambda q, v: -0.5 * q),
    "quadratic_stiffness": (0.15, lambda q, v: -0.15 * q**2),
    "cubic_stiffness": (0.6, lambda q, v: -0.6 * q**3),
    "viscous_damping": (0.3, lambda q, v: -0.3 * v),
    "quadratic_drag": (0.5, lambda q, v: -0.5 * abs(v) * v),
}
CONSERVATIVE = list(EFFECTS)[:4]


def soft_rates(force):
    return lambda t, x: [x[1] / MASS, -A * np.sinh(x[0]) + force(x[0], x[1] / MASS)]


def curved_velocity(x):
    return A * x[1] * (x[0] ** 2 + 1) / MASS


def curved_rates(force):
    return lambda t, x: [curved_velocity(x), -A * x[0] * (x[1] ** 2 + 1) / MASS + force(x[0], curved_velocity(x))]


def tolerance(effect):
    """Order four at dt = 0.01 for what is conservative, order two for a drag: 1e-8 and 1e-4 times some constants."""
    return 1e-7 if effect in CONSERVATIVE else 2e-5


@pytest.mark.parametrize("effect", EFFECTS)
@pytest.mark.parametrize(
    ("built", "method", "rates"),
    [(SOFT, LEAPFROG, soft_rates), (CURVED, TAO, curved_rates)],
    ids=["separable", "nonseparable"],
)
def test_every_effect_enters_as_the_contract_says(built, method, rates, effect):
    """One effect at a time: phase points equal DOP853's on the equations of the contract's table; a momentum is not
    a velocity."""
    value, force = EFFECTS[effect]
    expected = by_hand(rates(force))
    found = moved(built, method, coefficients(built, **{effect: value}))
    # By order: see `tolerance`.
    np.testing.assert_allclose(found, expected, atol=tolerance(effect))
    # And the effect is seen: without it the motion ends elsewhere.
    assert np.abs(by_hand(rates(lambda q, v: 0.0)) - expected).max() > 1e-2


@pytest.mark.parametrize(("effect", "order"), [("cubic_stiffness", 4), ("quadratic_drag", 2)])
def test_halving_the_substep_shows_the_order(effect, order):
    """Errors fall by 2^4 per halving where all is conservative, by 2^2 where a drag is split in."""
    value, force = EFFECTS[effect]
    expected, values = by_hand(soft_rates(force)), coefficients(SOFT, **{effect: value})
    errors = [np.abs(moved(SOFT, LEAPFROG, values, pieces=n) - expected).max() for n in (12, 24)]
    # The next order's share at these steps is a quarter.
    assert 2 ** (order - 0.4) < errors[0] / errors[1] < 2 ** (order + 0.6)


def test_all_at_once_is_the_sum():
    """Effects add up: with every one switched on the motion is that of the summed forces."""
    values = coefficients(SOFT, **{effect: value for effect, (value, _) in EFFECTS.items()})
    expected = by_hand(soft_rates(lambda q, v: sum(force(q, v) for _, force in EFFECTS.values())))
    np.testing.assert_allclose(moved(SOFT, LEAPFROG, values), expected, atol=5e-5)


def test_known_forces_with_inputs_and_momenta_are_added():
    """dp/dt gains the right-hand side of [forces]: with an input that is held, a momentum and the time in it."""
    inputs = np.repeat([[1.0], [-0.5], [0.3]], 100, axis=0)
    x = START
    for k, u in enumerate([1.0, -0.5, 0.3]):
        rates = lambda t, x, u=u: [x[1] / MASS, -A * x[0] + A * u - 0.1 * x[1] * np.cos(t)]  # noqa: E731
        x = solved(rates, x, np.array([k, k + 1.0]), 1e-12)[-1]
    np.testing.assert_allclose(moved(DRIVEN, LEAPFROG, coefficients(DRIVEN), inputs=inputs), x, atol=2e-6)


def test_explicit_time_and_forces_of_time_are_followed():
    """A Hamiltonian that changes with time and a force of time alone: equal to DOP853, with friction beside them."""
    rates = lambda t, x: [x[1] / MASS, -A * x[0] * (1 + 0.5 * np.sin(3 * t)) + np.cos(t) - 0.3 * x[1] / MASS]  # noqa: E731
    found = moved(SHAKEN, LEAPFROG, coefficients(SHAKEN, viscous_damping=0.3))
    # The friction is split in at order two: (0.01)^2 times derivatives of a few.
    np.testing.assert_allclose(found, by_hand(rates), atol=1e-4)


def test_dry_friction_takes_the_same_from_every_half_swing():
    """A spring with dry friction loses 2 f / k of amplitude each half period, the closed form, and moves as fast."""
    half = np.pi * np.sqrt(MASS / A)
    found = moved(DRIVEN, LEAPFROG, coefficients(DRIVEN, coulomb_friction=0.05), [1.0, 0.0], 0.0, 1, np.zeros((1, 1)))
    np.testing.assert_array_equal(found, [1.0, 0.0])
    spring = compiled(P**2 / (2 * M) + K * Q**2 / 2)
    for k in range(1, 4):
        found = moved(spring, LEAPFROG, coefficients(spring, coulomb_friction=0.05), [1.0, 0.0], k * half, 600 * k)
        # Order two away from the turning points, order one where the sign turns: 1 % of the loss.
        np.testing.assert_allclose(abs(found[0]), 1 - 2 * 0.05 / A * k, atol=0.01 * 2 * 0.05 / A)


@pytest.mark.parametrize(("built", "method"), [(SOFT, LEAPFROG), (CURVED, TAO)], ids=["separable", "nonseparable"])
def test_dry_friction_holds_what_it_has_stopped(built, method):
    """Where the other forces stay below f the body stops and stays: not a digit of its place moves after that."""
    values = coefficients(built, coulomb_friction=0.5)
    stopped = moved(built, method, values, [0.2, 0.3], 6.0, 300)
    later = moved(built, method, values, stopped, 60.0, 300)
    np.testing.assert_array_equal(later[:1], stopped[:1])
    # The kick that stops takes p - v / softness, which is 0 to the last digit of the p before it, at most 0.01: 2e-18.
    np.testing.assert_allclose(later[1:], stopped[1:], rtol=0, atol=0 if method is LEAPFROG else 1e-18)
    # At rest: what is left of a momentum is one half kick of friction.
    assert abs(stopped[1]) <= 0.5 * 6.0 / 300 and 0.2 < stopped[0] < 0.5


def test_dry_friction_lets_go_when_pulled_harder():
    """A body at rest under a force beyond f starts to move, as under the difference of the two."""
    values = coefficients(DRIVEN, coulomb_friction=0.2)
    held = moved(DRIVEN, LEAPFROG, values, [0.0, 0.0], 1.0, 100, np.full((100, 1), 0.19 / A))
    np.testing.assert_array_equal(held, [0.0, 0.0])
    found = moved(DRIVEN, LEAPFROG, values, [0.0, 0.0], 1.0, 100, np.full((100, 1), 0.6 / A))
    rates = lambda t, x: [x[1] / MASS, -A * x[0] + 0.4 - 0.1 * x[1] * np.cos(t)]  # noqa: E731
    # Order two at dt = 0.01.
    np.testing.assert_allclose(found, by_hand(rates, [0.0, 0.0], 1.0), atol=1e-4)


@pytest.mark.parametrize("method", [ig.Leapfrog(), LEAPFROG], ids=["leapfrog", "suzuki4"])
@pytest.mark.parametrize("effect", CONSERVATIVE)
def test_conservative_effects_leave_the_flow_symplectic(method, effect):
    """J' S J = S to 1e-10 in two degrees of freedom, with explicit coupling."""
    values = jnp.asarray(coefficients(PAIR, **{effect: EFFECTS[effect][0]}))
    span = Span(jnp.asarray(0.0), jnp.asarray(0.05), jnp.zeros((40, 0)))
    J = np.asarray(jax.jacfwd(lambda x: flow(PAIR, method, values, x, span))(jnp.array([0.3, -0.4, 0.5, 0.2])))
    S = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.eye(2), np.zeros((2, 2))]])
    np.testing.assert_allclose(J.T @ S @ J, S, atol=1e-10)


@pytest.mark.parametrize("effect", ["viscous_damping", "quadratic_drag", "coulomb_friction"])
@pytest.mark.parametrize(("built", "method"), [(SOFT, LEAPFROG), (CURVED, TAO)], ids=["separable", "nonseparable"])
def test_dissipation_never_raises_the_energy(built, method, effect):
    """Along the whole motion, until long after dry friction has stopped it, the energy only falls."""
    values, x, energies = coefficients(built, **{effect: 0.3}), np.array([1.0, 0.5]), []
    for _ in range(25):
        x = moved(built, method, values, x, 0.4, 20)
        energies.append(float(built.energy(jnp.array([*x, MASS, A, 0.0, *np.zeros(len(values))]))[0]))
    # The conservative part keeps the energy to order four of dt = 0.02.
    assert np.diff(energies).max() < 1e-7
    assert energies[-1] < energies[0] - 0.05


def test_friction_of_any_step_cannot_turn_the_motion_round():
    """One kick of dry friction brings the velocity to zero at most, in one step of any length."""
    hamiltonian = SimulatedFlow(
        SOFT, LEAPFROG, jnp.array([MASS, A]), jnp.asarray(coefficients(SOFT, coulomb_friction=0.7))
    )
    system = hamiltonian.hamiltonian(jnp.asarray(0.0), jnp.zeros(0))
    q = jnp.array([0.1])
    for p in (0.5, -0.5):
        for dt in (0.1, 0.6, 100.0):
            left, stuck = system.kick(q, jnp.array([p]), jnp.asarray(dt))
            # |dp| = f dt, or all of p where that is less: the exact flow of dp/dt = -f sign(p).
            np.testing.assert_allclose(left[0], np.sign(p) * max(abs(p) - 0.7 * dt, 0.0), atol=1e-15)
            assert bool(stuck[0]) == (0.7 * dt >= abs(p))


def test_the_sensor_shows_gain_and_bias():
    """A reading is (1 + g) h(x) + b of its own column."""
    values = coefficients(PAIR, sensor_gain=0.1, sensor_bias=-0.3)
    read = SimulatedReading(PAIR, jnp.array([MASS, A]), jnp.asarray(values))
    found = read(jnp.array([0.7, -0.2, 0.1, 0.1]), (jnp.asarray(0.0), jnp.zeros(0)))
    np.testing.assert_allclose(found, [1.1 * 0.7 - 0.3, -0.2], rtol=1e-15)
