"""Every effect of the vocabulary moves the augmented simulation as its row of the contract's table, solved by SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from augmented_cases import (
    CURVED,
    CURVED_PAIR,
    FLAT_PAIR,
    LEAPFROG,
    LENGTH,
    MASS,
    PAIR_START,
    SOFT,
    START,
    TAO,
    A,
    K,
    M,
    P,
    Q,
    by_hand,
    candidate,
    curved,
    curved_pair,
    flat_pair,
    flow,
    moved,
    soft,
    vector,
    widened,
)  # fmt: skip
from engine_cases import solved

from symplearn._augmented import equations
from symplearn._augmented_flow import SimulatedReading
from symplearn._effects import EFFECTS
from symplearn._terms import Mechanics

# Effect, side, the contract's coefficients, and the force of (t, q, v) by hand.
FORCES = [
    ("constant_force", None, {"f": 0.4}, lambda t, q, v: 0.4),
    ("linear_stiffness", None, {"k": 0.5}, lambda t, q, v: -0.5 * q),
    ("quadratic_stiffness", None, {"k": 0.15}, lambda t, q, v: -0.15 * q**2),
    ("cubic_stiffness", None, {"k": 0.6}, lambda t, q, v: -0.6 * q**3),
    ("viscous_damping", None, {"c": 0.3}, lambda t, q, v: -0.3 * v),
    ("quadratic_drag", None, {"c": 0.5}, lambda t, q, v: -0.5 * abs(v) * v),
    ("self_excitation", None, {"c": 0.3, "a": 0.6}, lambda t, q, v: 0.3 * (1 - q**2 / 0.36) * v),
    ("contact_stop", "upper", {"k": 3.0, "a": 0.6}, lambda t, q, v: -3 * max(q - 0.6, 0.0)),
    ("contact_stop", "lower", {"k": 3.0, "a": 1.0}, lambda t, q, v: 3 * max(1.0 - q, 0.0)),
    ("periodic_forcing", None, {"a": 0.3, "omega": 1.7, "phi": 0.4}, lambda t, q, v: 0.3 * np.cos(1.7 * t + 0.4)),
]  # fmt: skip
# Effect, the contract's coefficients, and the parameter's factor at time t.
FACTORS = [
    ("parameter_error", {"d": -0.2}, lambda t: 0.8),
    ("parameter_drift", {"r": 0.1}, lambda t: 1 + 0.1 * t),
    ("parametric_modulation", {"a": 0.3, "omega": 1.4, "phi": -0.8}, lambda t: 1 + 0.3 * np.cos(1.4 * t - 0.8)),
]
# The contract's coefficients and the forces on both coordinates.
PAIRS = {
    "relative_damping": ({"c": 0.4}, lambda q, v: [-0.4 * (v[0] - v[1]), 0.4 * (v[0] - v[1])]),
    "coupling_spring": ({"k": 0.5}, lambda q, v: [-0.5 * (q[0] - q[1]), 0.5 * (q[0] - q[1])]),
    "central_correction": ({"b": -0.2}, lambda q, v: 0.6 * q / np.hypot(*q) ** 5),
    "gyroscopic_coupling": ({"b": 0.6}, lambda q, v: [0.6 * v[1], -0.6 * v[0]]),
}
SHAPES = pytest.mark.parametrize(
    ("built", "method", "rates"), [(SOFT, LEAPFROG, soft), (CURVED, TAO, curved)], ids=["separable", "nonseparable"]
)
PAIR_SHAPES = pytest.mark.parametrize(
    ("built", "method", "rates"), [(FLAT_PAIR, LEAPFROG, flat_pair), (CURVED_PAIR, TAO, curved_pair)],
    ids=["separable", "nonseparable"],
)  # fmt: skip
# Splitting at order two at dt = 0.01, and the kink of a stop: 1e-4 times some constants. All else is of order four.
SPLIT = {"viscous_damping", "quadratic_drag", "self_excitation", "contact_stop", "relative_damping",
         "gyroscopic_coupling"}  # fmt: skip


def tolerance(effect):
    return 4e-5 if effect in SPLIT else 1e-7


def check(found, expected, without, effect):
    """Equal, and not because the effect hardly matters."""
    np.testing.assert_allclose(found, expected, atol=tolerance(effect))
    assert np.abs(without - expected).max() > 1e-2


def test_the_table_is_whole():
    """Every word that has values in the model is tested here; the other two change how readings scatter."""
    here = {row[0] for row in (*FORCES, *FACTORS)} | set(PAIRS)
    here |= {"coulomb_friction", "impulse", "regime_change", "hidden_oscillator"}  # below and in the steps' own file
    sensor = {"sensor_bias", "sensor_gain", "sensor_drift", "sensor_delay"}
    assert here | sensor | {"sensor_noise", "sensor_outliers"} == set(EFFECTS)


@pytest.mark.parametrize(("effect", "side", "values", "force"), FORCES, ids=[f"{r[0]}-{r[1]}" for r in FORCES])
@SHAPES
def test_forces_on_a_coordinate(built, method, rates, effect, side, values, force):
    """One force at a time, in d = 1; a momentum is not a velocity."""
    found = moved(built, method, vector(built, effect, values, side=side))
    check(found, by_hand(rates(force)), by_hand(rates()), effect)


@pytest.mark.parametrize("target", ["m", "a"])
@pytest.mark.parametrize(("effect", "values", "factor"), FACTORS, ids=[row[0] for row in FACTORS])
@SHAPES
def test_changes_of_a_parameter(built, method, rates, effect, values, factor, target):
    """A parameter is multiplied wherever it stands, in velocities and in forces."""
    by_name = {"m": lambda t: MASS * factor(t)} if target == "m" else {"a": lambda t: A * factor(t)}
    found = moved(built, method, vector(built, effect, values, target=target))
    check(found, by_hand(rates(**by_name)), by_hand(rates()), effect)


@pytest.mark.parametrize("effect", PAIRS)
@PAIR_SHAPES
def test_effects_between_two_coordinates(built, method, rates, effect):
    """Reaction equals action, and of gyroscopic coupling the first coordinate of the target is i."""
    values, force = PAIRS[effect]
    found = moved(built, method, vector(built, effect, values), PAIR_START)
    expected, without = (by_hand(rates(f), PAIR_START) for f in (force, lambda q, v: np.zeros(2)))
    check(found, expected, without, effect)


@pytest.mark.parametrize("effect", ["cubic_stiffness", "viscous_damping", "periodic_forcing"])
def test_the_second_coordinate_is_its_own_target(effect):
    """An effect on the second of two coordinates pushes that one alone."""
    row = next(row for row in FORCES if row[0] == effect)
    rates = lambda force: lambda t, x: flat_pair(lambda q, v: [0.0, force(t, q[1], v[1])])(t, x)  # noqa: E731
    found = moved(FLAT_PAIR, LEAPFROG, vector(FLAT_PAIR, effect, row[2], target="q2"), PAIR_START)
    check(found, by_hand(rates(row[3]), PAIR_START), by_hand(rates(lambda t, q, v: 0.0), PAIR_START), effect)


def test_all_at_once_is_the_sum():
    """Effects add up: with every force switched on the motion is that of the summed forces."""
    values = sum(vector(SOFT, effect, values, side=side) for effect, side, values, _ in FORCES)
    expected = by_hand(soft(lambda t, q, v: sum(force(t, q, v) for *_, force in FORCES)))
    # Two thresholds and three drags of order two.
    np.testing.assert_allclose(moved(SOFT, LEAPFROG, values), expected, atol=2e-4)


HIDDEN = {"omega": 1.3, "kappa": 0.9}
UNSEEN = (0.3, -0.2)  # the oscillator's own start, of unit mass


@SHAPES
def test_a_hidden_oscillator_is_the_contracts(built, method, rates):
    """H gains P^2/2 + omega^2 z^2/2 - kappa q z; inside, z and P are scaled by kappa."""
    omega, kappa = HIDDEN["omega"], HIDDEN["kappa"]

    def whole(t, x):
        v, push = rates(lambda *_: kappa * x[1])(t, x[[0, 2]])
        return [v, x[3], push, -(omega**2) * x[1] + kappa * x[0]]

    x = np.array([START[0], UNSEEN[0], START[1], UNSEEN[1]])
    inside = widened(START, np.multiply(kappa, UNSEEN))
    found = np.asarray(flow(built, method, vector(built, "hidden_oscillator", HIDDEN), inside, 0.0, 0.01, 300))
    np.testing.assert_allclose(found / [1, kappa, 1, kappa], by_hand(whole, x), atol=1e-7)  # order four
    assert np.abs(by_hand(rates()) - found[[0, 2]]).max() > 1e-2


def test_a_hidden_oscillator_starts_where_it_hangs_on_nothing():
    """At strength zero the motion's slope in the strength is that of a small one: no square root is in the way."""
    values = vector(SOFT, "hidden_oscillator", {"omega": 1.3, "kappa": 0.0})
    place = int(np.argmax(values == 1.3)) - 1
    run = lambda s: flow(SOFT, LEAPFROG, jnp.asarray(values).at[place].set(s), widened(START), 0.0, 0.01, 300)  # noqa: E731
    slope = jax.jvp(run, (0.0,), (1.0,))[1]
    expected = (run(1e-5) - run(-1e-5)) / 2e-5
    # Third derivatives times 1e-10.
    np.testing.assert_allclose(slope, expected, atol=1e-7)
    assert np.abs(slope[0]) > 0.1


TIMES = np.linspace(0.0, LENGTH, 16)


def shown(values, states, built=SOFT):
    """Readings at states of given times."""
    read = SimulatedReading(built, jnp.array([MASS, A]), jnp.asarray(values))
    of = jax.jit(jax.vmap(lambda x, t: read(x, (t, jnp.zeros(0)))))
    return np.asarray(of(jnp.asarray([widened(x) for x in states]), jnp.asarray(TIMES)))


def test_sensors_compose_as_the_contract_says():
    """(1 + g) h(x(t - tau)) + b + r (t - t_0) of its own column, the other one as it is."""
    chosen = {"sensor_gain": {"g": 0.1}, "sensor_bias": {"b": -0.3}, "sensor_drift": {"r": 0.05},
              "sensor_delay": {"tau": 0.1}}  # fmt: skip
    rates = flat_pair(lambda q, v: np.zeros(2))
    states = solved(rates, PAIR_START, TIMES, 1e-12)
    back = solved(rates, PAIR_START, np.array([0.0, -0.1]), 1e-12)[-1]
    earlier = np.concatenate([[back], solved(rates, back, TIMES - 0.1, 1e-12)[1:]])
    found = shown(sum(vector(FLAT_PAIR, effect, v, target="y1") for effect, v in chosen.items()), states, FLAT_PAIR)
    expected = np.stack([states[:, 0], 1.1 * earlier[:, 1] - 0.3 + 0.05 * TIMES], 1)
    # Two steps of 0.05 of a method of order four: 1e-7 times fifth derivatives of some tens over hundreds.
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert np.abs(earlier - states)[:, 1].max() > 0.02


def test_a_change_has_come_at_a_reading_or_not():
    """A pull that is read and stiffens at t = 1.2: it has from the row of that very time on, a hair later it has not,
    and nowhere does one row's reading go with the time of the change, by which a fit would give it what it asks for."""
    known = Mechanics([Q], [P], P**2 / (2 * M) + K * Q**2 / 2, [sympy.Integer(0)], {"pull": K * Q}, start=0.0)
    built = equations(known, (M, K), ())
    place = candidate(built, "regime_change", "a").values.stop - 1

    def pull(t_star, t):
        on = jnp.asarray(vector(built, "regime_change", {"d": 0.5, "t_star": 1.2}, "a")).at[place].set(t_star)
        return SimulatedReading(built, jnp.array([MASS, A]), on)(jnp.asarray(widened([0.3, 0.0])), (t, jnp.zeros(0)))[0]

    for t_star, factor in ((1.2, 1.5), (1.2 + 1e-12, 1.0), (1.1, 1.5), (1.3, 1.0)):
        value, slope = jax.jvp(lambda t_star: pull(t_star, jnp.asarray(1.2)), (t_star,), (1.0,))
        # Two products in double precision: 1e-12 is some thousands of their round-off.
        assert value == pytest.approx(factor * A * 0.3, rel=1e-12) and slope == 0.0


def test_a_delay_is_of_order_four():
    """With damping, forcing and drift of a parameter beside it; a delay half as long is off by 2^5 less."""
    on = (vector(SOFT, "viscous_damping", {"c": 0.3})
          + vector(SOFT, "periodic_forcing", {"a": 0.3, "omega": 1.7, "phi": 0.4})
          + vector(SOFT, "parameter_drift", {"r": 0.1}, target="a"))  # fmt: skip
    rates = soft(lambda t, q, v: 0.3 * np.cos(1.7 * t + 0.4) - 0.3 * v, a=lambda t: A * (1 + 0.1 * t))
    states, errors = solved(rates, START, TIMES, 1e-12), []
    for tau in (0.8, 0.4):
        back = solved(rates, START, np.array([0.0, -tau]), 1e-12)[-1]
        earlier = np.array([solved(rates, back, np.array([-tau, t - tau + 1e-300]), 1e-12)[-1, 0] for t in TIMES[1:]])
        found = shown(on + vector(SOFT, "sensor_delay", {"tau": tau}), states)[1:, 0]
        errors.append(np.sqrt(((found - earlier) ** 2).mean()))
    # The next order's share at these delays is a half.
    assert 2**4.2 < errors[0] / errors[1] < 2**6 and errors[1] < 1e-4


def test_a_delay_of_half_a_swing_is_gone_back():
    """What a sensor showed as late as half a small swing's period is still the swing of that time."""
    tau = np.pi / np.sqrt(A / MASS)
    states = solved(soft(), START, TIMES, 1e-12)
    back = solved(soft(), START, np.array([0.0, -tau]), 1e-12)[-1]
    earlier = solved(soft(), back, np.concatenate([[-tau], TIMES - tau + 1e-12]), 1e-12)[1:, 0]
    found = shown(vector(SOFT, "sensor_delay", {"tau": tau}), states)[:, 0]
    # Eight steps of a method of order four, each 0.4 of a radian: (pi / 8)^5 / 120 each, and more where it swings wide.
    np.testing.assert_allclose(found, earlier, atol=5e-3)
    assert np.abs(earlier - states[:, 0]).max() > 1.0
