"""Today's practice is done well: what it can find it finds, and its derivatives and weak forms are right."""

import numpy as np
import pytest
from concealed_cases import damped_duffing, setting

from experiments._concealed_network import network_force
from experiments._concealed_repair import free_run_errors, momenta, smoothed
from experiments._concealed_today import library, right_terms, weak


@pytest.fixture(scope="module")
def damped():
    """The damped Duffing oscillator, drawn once."""
    return damped_duffing()


def test_smoothing_gives_velocities_and_the_missing_force(damped):
    """In the middle of the recording the force left over correlates with the speed, and velocities are the truth's."""
    document, seen = damped
    (one,) = smoothed(document, seen, 0.0).runs
    inside = slice(10, -10)  # splines are worst at their ends
    left = (one.slope - one.force)[0, inside]
    assert np.corrcoef(left, one.v[0, inside])[0, 1] < -0.5
    assert one.p == pytest.approx(one.v * document["parameters"]["m"])


def test_momenta_follow_from_velocities():
    """Velocities of a double pendulum's momenta give these momenta back."""
    setup, _ = setting("double_pendulum")
    rng = np.random.default_rng(0)
    q, p = rng.normal(size=(2, 7)), rng.normal(size=(2, 7))
    v = np.array(setup.system.velocity(q, p, setup.values))
    assert momenta(setup, q, v) == pytest.approx(p)


def test_weak_form_is_the_strong_one_by_parts(damped):
    """Integrals against a bump of p' = f + theta give the same as -phi' p: the coefficients come out again."""
    document, seen = damped
    (one,) = smoothed(document, seen, 0.0).runs
    times = np.linspace(0.0, 10.0, 2000)
    v = np.cos(times)[None, :]
    made = one._replace(times=times, q=np.sin(times)[None, :], v=v, p=2.0 * np.sin(times)[None, :], force=0.5 * v)
    theta, goal = weak(library(made.q, made.v)[0], made, 1.0)
    names = library(made.q, made.v)[1]
    # p' = 2 cos t = force + 1.5 v; the trapezoidal rule at 2,000 points is good to 1e-5.
    assert goal[:, 0] == pytest.approx(1.5 * theta[:, names.index("v0")], abs=1e-4)


def test_right_terms_are_the_formulas():
    """Truths that are sums of terms have their terms; others have none; nothing has the empty set."""
    base = {"system": "coupled", "effects": []}
    pair = {"effect": "gyroscopic_coupling", "target": ["x1", "x2"], "recordings": []}
    assert right_terms(base) == set()
    assert right_terms(base | {"effects": [pair]}) == {(0, "v1"), (1, "v0")}
    drag = {"effect": "quadratic_drag", "target": "x2", "recordings": []}
    assert right_terms(base | {"effects": [drag]}) == {(1, "vv1")}
    assert right_terms(base | {"effects": [drag | {"recordings": [2]}]}) is None
    assert right_terms(base | {"effects": [drag | {"effect": "impulse"}]}) is None


def test_a_repair_with_the_true_force_predicts(damped):
    """With the true damping the free run is off by the noise alone; without it by more."""
    document, seen = damped
    early, whole = smoothed(document, seen, 0.25), smoothed(document, seen, 0.0)
    c = document["effects"][0]["values"]["c"]
    repaired = free_run_errors(document, seen, early, whole, lambda q, v: -c * v)
    none = free_run_errors(document, seen, early, whole, None)
    assert none["holdout"] > 3 * repaired["holdout"]
    # Recalibration without the damping has moved no parameter: all are known. Forty rows of noise.
    assert repaired["holdout"] == pytest.approx(1.0, abs=0.4) and repaired["forecast"] < 0.1


@pytest.mark.slow  # compiles the training
def test_a_network_learns_a_damping(damped):
    """The network's force is against the motion where it was trained."""
    document, seen = damped
    force = network_force(smoothed(document, seen, 0.0).runs)
    v = np.linspace(-0.5, 0.5, 5)[None, :]
    assert np.all(np.diff(force(np.zeros_like(v), v)[0]) < 0)
